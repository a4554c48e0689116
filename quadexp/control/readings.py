"""One gate for what a controller is given at a control instant: numbers that are not finite reach no controller.

    state                               refused, with the name of the value; so is an attitude of no length
    accelerometer, rotor speeds         missing, as a reading is that did not come, for HELD at most after the last good
                                        one; after that, and where there is none yet, refused

A number beyond LARGEST is treated alike, since sums of squares of such numbers need not be finite. A controller that is
not called remembers nothing of what was refused: with the next good reading it goes on as if that instant had not been.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.control.base import Measurement
from quadexp.errors import QuadexpError, UsageError
from quadexp.physics.state import ATTITUDE, STATE_COLUMNS

HELD = 0.1  # s
ROUNDING = 1e-9  # s, of times: a reading that is HELD old is used, whatever their last bits
LARGEST = 1e9  # SI units
LENGTH_ERROR = 0.5  # of a quaternion's squared length


class ReadingGate:
    """`begin` with a flight, then `admit` what is measured at every control instant. rotors: n."""

    def __init__(self, rotors: int) -> None:
        self._names = {
            "state": STATE_COLUMNS,
            "specific_force": tuple(f"acc_{axis}" for axis in "xyz"),
            "rotor_speed": tuple(f"rotor_speed_{rotor}" for rotor in range(rotors)),
        }
        self.begin()

    def begin(self) -> None:
        """Forget the readings of an earlier flight."""
        self._read_at: dict[str, float] = {}  # s, of the last good one

    def admit(self, measurement: Measurement) -> Measurement:
        """The measurement to step with. Raises QuadexpError where it is refused, UsageError for a wrong size."""
        t, state, force, speed = measurement
        state, admitted = self._read("state", state)
        q = state[ATTITUDE]
        if not admitted:
            raise self._refusal("state", state, t)
        if not abs(q.dot(q) - 1) < LENGTH_ERROR:
            raise QuadexpError(f"t={t:g} s: the measured attitude has length {math.sqrt(q.dot(q)):.3g}, 1 is needed")
        return Measurement(t, state, self._good("specific_force", force, t), self._good("rotor_speed", speed, t))

    def _good(self, name: str, reading: Any, t: float) -> np.ndarray | None:
        """The reading; None where there is none, or where it may not be used."""
        if reading is None:
            return None
        values, admitted = self._read(name, reading)
        if admitted:
            self.keep(name, t)
            return values
        if not abs(t - self._read_at.get(name, -math.inf)) <= HELD + ROUNDING:
            raise self._refusal(name, values, t)
        return None

    def keep(self, name: str, t: float) -> None:
        """A good reading was taken at that time (s)."""
        self._read_at[name] = t

    def _read(self, name: str, reading: Any) -> tuple[np.ndarray, bool]:
        """A reading as an array, and whether all its numbers may be used."""
        values = np.asarray(reading, float)
        size = len(self._names[name])
        if values.shape != (size,):
            detail = ": p, q (w first), v, w" if name == "state" else ""
            raise UsageError(f"{name}: {values.shape} numbers are given, ({size},) are needed{detail}")
        return values, math.hypot(*values.tolist()) < LARGEST

    def _refusal(self, name: str, values: np.ndarray, t: float) -> QuadexpError:
        first = int(np.argmin(np.abs(values) < LARGEST))
        late = "" if name == "state" else f", and no good reading is younger than {HELD:g} s"
        return QuadexpError(f"t={t:g} s: the measured {self._names[name][first]} is {values[first]:g}{late}")
