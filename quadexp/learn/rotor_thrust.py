"""Thrust that the rotors delivered between two samples of a flight, from commands that act late and from rotor speeds.

    y'  = (c(t - d) - y) / tau            y = T and c = u, or y = sqrt(T) and c = sqrt(u): quadexp.physics.motor
    T_k = k w_k^2                         where the rotor speeds w_k were logged
    T(t) = T_model(t) + what the measured ones are beside it, interpolated between the samples

Commands u are held from sample to sample, act d late, and through the lag tau, which may be another one upwards than
downwards. A transition needs the mean of T over its time. For commands it is exact, because the lag has a closed form;
measured thrusts correct the model at both ends of the transition. Where the state comes from an estimator that is late,
its transitions belong to earlier times: with commands alone this adds to d and cannot be told from it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from quadexp.learn.samples import rotor_columns
from quadexp.log.schema import Flight
from quadexp.physics.state import N_STATE, STATE_COLUMNS, in_motion, input_columns
from quadexp.physics.vehicle import Vehicle

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

    def as_dict(self) -> dict[str, Any]:
        """JSON types."""
        return asdict(self)


def measured_thrust(flight: Flight, vehicle: Vehicle) -> np.ndarray | None:
    """Thrusts (k, n) (N) by the logged rotor speeds, None where these or the vehicle's thrust coefficient are unknown.

    A first row without a reading, as simulated flights may have, is that of the second.
    """
    columns = rotor_columns(flight, "rotor_speed")
    if vehicle.thrust_coefficient is None or len(columns) != vehicle.n_rotors:
        return None
    speed = flight.stack(columns).astype(float)
    if len(speed) > 1 and not np.isfinite(speed[0]).all():
        speed[0] = speed[1]
    return vehicle.thrust_coefficient * speed**2 if np.isfinite(speed).all() else None


class HeldCommands:
    """Commands u (k, n) (N), each held from its time t (k,) (s) to the next, as the thrust that follows them.

    timing: its lag and delay. first: thrust (n,) (N) before the first command acts.
    """

    def __init__(self, t: np.ndarray, u: np.ndarray, timing: Timing, first: np.ndarray) -> None:
        self._begin, self._first = t + timing.delay, first
        self._squared = timing.lag_of == "rotor_speed"
        self._to = np.sqrt(np.maximum(u, 0)) if self._squared else u
        up, down = max(timing.lag_up, NO_LAG), max(timing.lag_down, NO_LAG)
        steps = np.diff(t)
        kept_up, kept_down = np.exp(-steps / up), np.exp(-steps / down)
        beside = np.empty_like(u)  # y - c at the instant when each command begins to act
        y = np.sqrt(np.maximum(first, 0)) if self._squared else first
        for k in range(len(u)):
            beside[k] = y - self._to[k]
            if k < len(steps):
                y = self._to[k] + beside[k] * np.where(beside[k] < 0, kept_up[k], kept_down[k])
        self._beside, self._lag = beside, np.where(beside < 0, up, down)
        area = np.zeros_like(u)  # integral of the thrust from the first command to each
        area[1:] = np.cumsum(self._piece(slice(0, -1), steps), axis=0)
        self._area = area

    def value(self, t: np.ndarray) -> np.ndarray:
        """Thrusts (j, n) at times (j,); at the instant of a change, those just before it."""
        k = self._acting(t, -ROUNDING)
        elapsed = np.maximum(t - self._begin[k], 0.0)[:, None]
        y = self._to[k] + self._beside[k] * np.exp(-elapsed / self._lag[k])
        return np.where((t <= self._begin[0])[:, None], self._first, y**2 if self._squared else y)

    def integral(self, t: np.ndarray) -> np.ndarray:
        """Integral (j, n) (N s) of the thrusts from the first command's instant to times (j,)."""
        k = self._acting(t, ROUNDING)
        elapsed = t - self._begin[k]
        before = (t < self._begin[0])[:, None]
        return np.where(before, self._first * elapsed[:, None], self._area[k] + self._piece(k, elapsed))

    def _acting(self, t: np.ndarray, nudge: float) -> np.ndarray:
        """Index (j,) of the command that acts at times (j,)."""
        return (np.searchsorted(self._begin, t + nudge, side="right") - 1).clip(0)

    def _piece(self, k: Any, elapsed: np.ndarray) -> np.ndarray:
        """Integral of the thrust over a time (s) from where command k begins to act."""
        s, to, beside, lag = elapsed[:, None], self._to[k], self._beside[k], self._lag[k]
        once = -lag * np.expm1(-np.maximum(s, 0) / lag)
        if not self._squared:
            return to * s + beside * once
        twice = -lag / 2 * np.expm1(-2 * np.maximum(s, 0) / lag)
        return to**2 * s + 2 * to * beside * once + beside**2 * twice


def held_commands(flight: Flight, vehicle: Vehicle, timing: Timing) -> HeldCommands:
    """The commands of a flight, and before the first what the rotors gave when it began."""
    command = flight.stack(input_columns(vehicle.n_rotors)).astype(float)
    return HeldCommands(np.asarray(flight.t, float), command, timing, _before(flight, vehicle, command[0]))


def _before(flight: Flight, vehicle: Vehicle, command: np.ndarray) -> np.ndarray:
    """Thrusts (n,) (N) before the first command acts: of a recorded flight they are not known; a simulated one begins
    with those of its reference where that begins in motion (experiment.rollout), else in hover."""
    if flight.metadata.get("recorded", False):
        return command
    columns = [f"ref_{name}" for name in (*STATE_COLUMNS, *input_columns(vehicle.n_rotors))]
    if all(name in flight.columns for name in columns):
        state, thrust = np.split(flight.stack(columns)[0].astype(float), [N_STATE])
        if in_motion(state):
            return np.clip(thrust, vehicle.thrust_min, vehicle.thrust_max)
    return np.full(vehicle.n_rotors, vehicle.hover_thrust)


def mean_thrust(flight: Flight, vehicle: Vehicle, timing: Timing) -> np.ndarray:
    """Mean thrusts (k - 1, n) (N) between the samples of the logged state.

    NaN where these belong to a time before the flight.
    """
    t = np.asarray(flight.t, float)
    if timing.is_ideal:
        return flight.stack(input_columns(vehicle.n_rotors)).astype(float)[:-1]
    model = held_commands(flight, vehicle, timing)
    at = t - timing.state_delay
    dt = np.diff(t)[:, None]
    mean = np.diff(model.integral(at), axis=0) / dt
    if timing.measured:
        measured = measured_thrust(flight, vehicle)
        assert measured is not None
        beside = measured - model.value(t)
        area = np.concatenate([np.zeros((1, beside.shape[1])), np.cumsum((beside[1:] + beside[:-1]) / 2 * dt, axis=0)])
        mean = mean + np.diff(_between(at, t, area, beside), axis=0) / dt
    late = timing.state_delay + (0.0 if timing.measured else timing.delay)
    mean[t[:-1] < t[0] + late - 1e-9] = np.nan
    return mean


def _between(at: np.ndarray, t: np.ndarray, area: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Integral (j, n) at times (j,) of a piecewise linear rate (k, n), given at t (k,) with its integral there."""
    k = (np.searchsorted(t, at, side="right") - 1).clip(0, len(t) - 2)
    s, step = (at - t[k])[:, None], np.diff(t)[k][:, None]
    inside = rate[k] * s + (rate[k + 1] - rate[k]) * s**2 / (2 * step)
    return area[k] + np.where(s < 0, rate[0] * s, inside)
