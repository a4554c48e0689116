"""What was told some time ago: readings of one instant are compared, though one of the sensors is late.

A value of t - a, linear between the control instants on either side, at t = k T:

    y(t - a) = (1 - r) y_{k-n} + r y_{k-n-1},      n + r = a / T,  0 <= r < 1
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.instant import Operation, move


def kept_size(size: int, age: float, period: float) -> int:
    """How many numbers `earlier` keeps of so many, that are told every period (s)."""
    return size * (int(age / period + 1e-9) + 2)


def earlier(values: Any, kept: Any, age: float, period: float) -> tuple[Any, Any]:
    """The values of `age` (s) ago, and the next value of what is kept, the oldest first; symbols."""
    n, whole = values.numel(), int(age / period + 1e-9)
    kept = ca.vertcat(kept[n:], values)
    share = age / period - whole
    return share * kept[:n] + (1 - share) * kept[n : 2 * n], kept


class Earlier:
    """Numbers (n,) of `age` (s) ago, in `then`; `reset` begins a flight, `before` stands at every control instant.

    oldest: those that were told before all that `then` is made of, (n,).
    """

    def __init__(self, size: int, age: float, period: float) -> None:
        whole = int(age / period + 1e-9)
        self._share = age / period - whole
        self._kept = np.zeros((whole + 2, size))  # the oldest first
        self.then = np.zeros(size) if age else self._kept[-1]
        self.oldest = self._kept[0 if age else -1]

    def reset(self, values: np.ndarray) -> None:
        """These values, (n,), have been there for long."""
        self._kept[...] = self.then[...] = values

    def before(self, values: np.ndarray, when: np.ndarray | None = None) -> list[Operation]:
        """Takes the values that are found there, (n,), and leaves `then`. when: (1,), only where it is not 0."""
        flat, n = self._kept.reshape(-1), self._kept.shape[1]
        taken = [move(flat[:-n], flat[n:], when), move(flat[-n:], values, when)]
        if self.then.base is not None:
            return taken
        return [*taken, Operation("mix", self.then, self._kept[0], self._kept[1], factor=self._share)]
