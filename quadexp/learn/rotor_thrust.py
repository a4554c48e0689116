"""Thrust that the rotors delivered between two samples of a flight, from commands that act late and from rotor speeds.

    T'  = (u(t - d) - T) / tau            commands u, held from sample to sample, act d late through a lag tau
    T_k = k w_k^2                         where the rotor speeds w_k were logged
    T(t) = T_model(t) + what the measured ones are beside it, interpolated between the samples

A transition needs the mean of T over its time. For commands it is exact, because the lag has a closed form; measured
thrusts correct the model at both ends of the transition. Where the state comes from an estimator that is late, its
transitions belong to earlier times: with commands alone this adds to d and cannot be told from it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from quadexp.learn.samples import rotor_columns
from quadexp.log.schema import Flight
from quadexp.physics.state import input_columns
from quadexp.physics.vehicle import Vehicle


@dataclass(frozen=True)
class Timing:
    """How the logged streams belong together.

    lag: time constant of the rotors' thrust (s). delay: between a command and its effect on the rotors (s).
    state_delay: by which the logged state is behind the rotors (s). measured: whether rotor speeds are used.
    """

    lag: float = 0.0
    delay: float = 0.0
    state_delay: float = 0.0
    measured: bool = False

    @property
    def is_ideal(self) -> bool:
        """Whether commands are thrusts, at once."""
        return not (self.lag or self.delay or self.state_delay or self.measured)

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

    lag, delay: s, see Timing. first: thrust (n,) (N) before the first command acts.
    """

    def __init__(self, t: np.ndarray, u: np.ndarray, lag: float, delay: float, first: np.ndarray) -> None:
        self._begin, self._u, self._lag, self._first = t + delay, u, lag, first
        steps = np.diff(t)
        self._start = np.empty_like(u)  # thrust at the instant when each command begins to act
        self._start[0] = first
        kept = np.exp(-steps / lag) if lag > 0 else np.zeros(len(steps))
        for k in range(len(steps)):
            self._start[k + 1] = u[k] + (self._start[k] - u[k]) * kept[k]
        area = np.zeros_like(u)  # integral of the thrust from the first command to each
        area[1:] = np.cumsum(u[:-1] * steps[:, None] + self._lagging(slice(0, -1), steps), axis=0)
        self._area = area

    def value(self, t: np.ndarray) -> np.ndarray:
        """Thrusts (j, n) at times (j,); at the instant of a change, those just before it."""
        k = self._acting(t, side="left")
        elapsed = np.maximum(t - self._begin[k], 0.0)
        decayed = np.exp(-elapsed / self._lag) if self._lag > 0 else (elapsed <= 0).astype(float)
        later = self._u[k] + (self._start[k] - self._u[k]) * decayed[:, None]
        return np.where((t <= self._begin[0])[:, None], self._first, later)

    def integral(self, t: np.ndarray) -> np.ndarray:
        """Integral (j, n) (N s) of the thrusts from the first command's instant to times (j,)."""
        k = self._acting(t, side="right")
        elapsed = t - self._begin[k]
        later = self._area[k] + self._u[k] * elapsed[:, None] + self._lagging(k, elapsed)
        return np.where((t < self._begin[0])[:, None], self._first * elapsed[:, None], later)

    def _acting(self, t: np.ndarray, side: str) -> np.ndarray:
        """Index (j,) of the command that acts at times (j,); a nanosecond belongs to rounding."""
        nudge = -1e-9 if side == "left" else 1e-9
        return (np.searchsorted(self._begin, t + nudge, side="right") - 1).clip(0)

    def _lagging(self, k: Any, elapsed: np.ndarray) -> np.ndarray:
        """Integral of what the thrusts are still beside command k after a time (s)."""
        if self._lag <= 0:
            return np.zeros((len(elapsed), self._u.shape[1]))
        share = self._lag * -np.expm1(-np.maximum(elapsed, 0.0) / self._lag)
        return (self._start[k] - self._u[k]) * share[:, None]


def held_commands(flight: Flight, vehicle: Vehicle, lag: float, delay: float) -> HeldCommands:
    """The commands of a flight; before the first a simulated one hovers, of a recorded one it is not known."""
    command = flight.stack(input_columns(vehicle.n_rotors)).astype(float)
    recorded = flight.metadata.get("recorded", False)
    first = command[0] if recorded else np.full(vehicle.n_rotors, vehicle.hover_thrust)
    return HeldCommands(np.asarray(flight.t, float), command, lag, delay, first)


def mean_thrust(flight: Flight, vehicle: Vehicle, timing: Timing) -> np.ndarray:
    """Mean thrusts (k - 1, n) (N) between the samples of the logged state.

    NaN where these belong to a time before the flight.
    """
    t = np.asarray(flight.t, float)
    if timing.is_ideal:
        return flight.stack(input_columns(vehicle.n_rotors)).astype(float)[:-1]
    model = held_commands(flight, vehicle, timing.lag, timing.delay)
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
