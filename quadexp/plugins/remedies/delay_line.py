"""What was given some time ago: readings of one instant are compared, though one of the sensors is late.

A value of t - a, linear between the control instants on either side, at t = k T:

    y(t - a) = (1 - r) y_{k-n} + r y_{k-n-1},      n + r = a / T,  0 <= r < 1
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.compile.memory import NEXT, NOW, Memory, connected, sizes_of
from quadexp.compile.symbolic import ca
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, call
from quadexp.parts.sensor_spec import SensorSpec
from quadexp.physics.expression import named_function, named_symbols


def later_speeds(sheet: SensorSpec) -> float:
    """By how much rotor speeds are older than the body rates (s), as far as it is stated."""
    speeds = sheet.rotor_speed
    gyroscope = sheet.gyroscope
    if speeds is None:
        return 0.0
    rates = 0.0 if gyroscope is None else gyroscope.delay or 0.0
    return max((speeds.delay or 0.0) - rates, 0.0)


def kept_size(size: int, age: float, period: float) -> int:
    """How many numbers `earlier` keeps of so many, that are given every period (s)."""
    return size * (int(age / period + 1e-9) + 2)


def delayed(values: Any, kept: Any, age: float, period: float) -> tuple[Any, Any]:
    """The values of `age` (s) ago, and the next value of what is kept, the oldest first; symbols."""
    n = values.numel()
    whole = int(age / period + 1e-9)
    kept = ca.vertcat(kept[n:], values)
    share = age / period - whole
    output = share * kept[:n] + (1 - share) * kept[n : 2 * n]
    return output, kept


class DelayLine:
    """Numbers (n,) of `age` (s) ago, in `then`; `reset` begins a flight, `before` stands at every control instant.

    oldest: those that were given before all that `then` is made of, (n,). memory: a part of the instant's.
    """

    def __init__(self, size: int, age: float, period: float, backend: str) -> None:
        self._function = cached_function(backend, delay_line_function, size, age, period)
        self.memory = Memory("DelayLine", sizes_of([self._function]))
        self.output = np.zeros(size)
        self.oldest = self.memory.of_next["kept"].reshape(-1, size)[0 if age else -1]

    def reset(self, values: np.ndarray) -> None:
        """These values, (n,), have been there for long."""
        self.memory.begin({"kept": np.tile(values, self.memory.now.size // len(values))})
        self.output[...] = values

    def before(self, values: np.ndarray) -> list[Call]:
        """Takes the values that are found there, (n,), and leaves `then`."""
        transition = connected(self._function, {"values": values}, {"output": self.output}, self.memory)
        return [call(transition)]


def delay_line_function(size: int, age: float, period: float) -> ca.Function:
    """`earlier` as a function: values -> then; kept is remembered."""
    a = named_symbols(ca.SX, {"values": size, f"{NOW}kept": kept_size(size, age, period)})
    output, kept = delayed(a["values"], a[f"{NOW}kept"], age, period)
    return named_function("earlier", a, {"output": output, f"{NEXT}kept": kept})
