"""A loop at a rate of its own around a controller: every n-th instant the controller, at every instant the loop."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from quadexp.control.base import Controller, Measurement, Window
from quadexp.control.instant import Instant, Operation, Told, copy, instant_of
from quadexp.control.mpc.mpc import StepRecord
from quadexp.control.wrapped import WrappedController
from quadexp.errors import UsageError

WHOLE = 1e-6  # how far a ratio of rates may be from a whole number


class MultiRate(WrappedController, ABC):
    """A Controller at `rate` (Hz) whose inner one steps at its own; a subclass says what becomes of its thrusts.

    Raises UsageError where the rate is no whole multiple of the controller's.
    """

    def __init__(self, inner: Controller, rate: float) -> None:
        super().__init__(inner)
        ratio = rate * inner.control_period
        self._every = round(ratio)
        if self._every < 1 or abs(ratio - self._every) > WHOLE * ratio:
            raise UsageError(
                f"inner.rate={rate:g}: must be a whole multiple of the controller's rate of"
                f" {1 / inner.control_period:g} Hz"
            )
        self.control_period = inner.control_period / self._every
        self._instant, self._wanted = 0, np.zeros(inner.vehicle.n_rotors)

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        self._instant = 0

    def step(self, measurement: Measurement, window: Window) -> tuple[np.ndarray, StepRecord]:
        """See Controller.step; the record is that of the controller's last step."""
        if self._instant % self._every == 0:
            self._wanted[...], self._record = self.inner.step(measurement, window)
        self._instant += 1
        return self.shaped(measurement, self._wanted), self._record

    def instant(self, told: Told) -> Instant | None:
        """See control.instant."""
        inner = instant_of(self.inner, told)
        if inner is None:
            return None
        due = [o._replace(every=o.every * self._every) for o in (*inner.operations, copy(self._wanted, inner.command))]
        shaped, command = self.shaping(told, self._wanted)
        resumed = (*inner.resumed, self._go_on)
        return inner._replace(operations=[*due, *shaped], command=command, resumed=resumed)

    def _go_on(self, k: int, record: StepRecord) -> None:
        self._instant, self._record = k, record

    @abstractmethod
    def shaping(self, told: Told, wanted: np.ndarray) -> tuple[list[Operation], np.ndarray]:
        """`shaped` for C, of the thrusts that are found in `wanted`; and the array that has the command then."""

    @abstractmethod
    def shaped(self, measurement: Measurement, wanted: np.ndarray) -> np.ndarray:
        """Rotor thrusts (n,) (N) to command, of those that the controller wants."""
