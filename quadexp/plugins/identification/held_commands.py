"""The thrust that follows commands, which are held from sample to sample, act late, and through a lag.

    y'  = (c(t - d) - y) / tau            y = T and c = u, or y = sqrt(T) and c = sqrt(u): quadexp.physics.motor

The lag tau may be another one upwards than downwards. The integral of the thrust is exact, because the lag has a closed
form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

NO_LAG = 1e-12  # s, in place of 0: what is left after a step of it is 0
ROUNDING = 1e-9  # s


@dataclass(frozen=True)
class Timing:
    """How the logged streams belong together.

    lag_up, lag_down: time constants of the rotors (s). lag_of: what lags, "thrust" or "rotor_speed". delay: between a
    command and its effect on the rotors (s). state_delay: by which the logged state is behind the rotors (s).
    measured: whether rotor speeds are used.
    """

    lag_up: float = 0.0
    lag_down: float = 0.0
    lag_of: str = "thrust"
    delay: float = 0.0
    state_delay: float = 0.0
    measured: bool = False

    @property
    def is_ideal(self) -> bool:
        """Whether commands are thrusts, at once."""
        return not (self.lag_up or self.lag_down or self.delay or self.state_delay or self.measured)

    @property
    def lag(self) -> float:
        """Mean of both time constants (s), for a model that has one."""
        return (self.lag_up + self.lag_down) / 2


class HeldCommands:
    """Commands u (k, n) (N), each held from its time t (k,) (s) to the next, as the thrust that follows them.

    timing: its lag and delay. first: thrust (n,) (N) before the first command acts.
    """

    def __init__(self, t: np.ndarray, u: np.ndarray, timing: Timing, first: np.ndarray) -> None:
        self._begin = t + timing.delay
        self._first = first
        self._squared = timing.lag_of == "rotor_speed"
        self._to = u
        y = first
        if self._squared:
            self._to = np.sqrt(np.maximum(u, 0))
            y = np.sqrt(np.maximum(first, 0))
        up = max(timing.lag_up, NO_LAG)
        down = max(timing.lag_down, NO_LAG)
        steps = np.diff(t)
        kept_up = np.exp(-steps / up)
        kept_down = np.exp(-steps / down)
        beside = np.empty_like(u)  # y - c at the instant when each command begins to act
        for k in range(len(u)):
            beside[k] = y - self._to[k]
            if k < len(steps):
                kept = np.where(beside[k] < 0, kept_up[k], kept_down[k])
                y = self._to[k] + beside[k] * kept
        self._beside = beside
        self._lag = np.where(beside < 0, up, down)
        area = np.zeros_like(u)  # integral of the thrust from the first command to each
        area[1:] = np.cumsum(self._piece(slice(0, -1), steps), axis=0)
        self._area = area

    def value(self, t: np.ndarray) -> np.ndarray:
        """Thrusts (j, n) at times (j,); at the instant of a change, those just before it."""
        k = self._acting(t, -ROUNDING)
        elapsed = np.maximum(t - self._begin[k], 0.0)[:, None]
        y = self._to[k] + self._beside[k] * np.exp(-elapsed / self._lag[k])
        if self._squared:
            y = y**2
        before = (t <= self._begin[0])[:, None]
        return np.where(before, self._first, y)

    def integral(self, t: np.ndarray) -> np.ndarray:
        """Integral (j, n) (N s) of the thrusts from the first command's instant to times (j,)."""
        k = self._acting(t, ROUNDING)
        elapsed = t - self._begin[k]
        area = self._area[k] + self._piece(k, elapsed)
        before = (t < self._begin[0])[:, None]
        return np.where(before, self._first * elapsed[:, None], area)

    def _acting(self, t: np.ndarray, nudge: float) -> np.ndarray:
        """Index (j,) of the command that acts at times (j,)."""
        return (np.searchsorted(self._begin, t + nudge, side="right") - 1).clip(0)

    def _piece(self, k: Any, elapsed: np.ndarray) -> np.ndarray:
        """Integral of the thrust over a time (s) from where command k begins to act."""
        s = elapsed[:, None]
        to = self._to[k]
        beside = self._beside[k]
        lag = self._lag[k]
        once = -lag * np.expm1(-np.maximum(s, 0) / lag)
        if not self._squared:
            return to * s + beside * once
        twice = -lag / 2 * np.expm1(-2 * np.maximum(s, 0) / lag)
        return to**2 * s + 2 * to * beside * once + beside**2 * twice
