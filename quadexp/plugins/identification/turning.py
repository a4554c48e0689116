"""Stretches of flights as the torque sees them: rates, and over each interval torque, rotor speeds, velocity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.log.runs import runs
from quadexp.models.regression import Regression
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.blocks import regress
from quadexp.plugins.identification.thrust_curve import ThrustCurve
from quadexp.plugins.logs.samples import QUATERNION, FlightRows, Samples

STRIDE = 0.1  # s, between the starts of rollouts
LEAST = 6.0  # s of a stretch
AXES = ("roll", "pitch", "yaw")
OTHER = (1, 0, None)  # axis of the velocity that makes the blades flap


class Turning(NamedTuple):
    """A stretch of a flight without gaps. rate: (k, 3), rad/s. attitude: k of them. Of the interval from each sample to
    the next: torque (k - 1, 3) N m, spin (k - 1,) S, velocity (k - 1, 3) body m/s. flight: its number. dt: s."""

    rate: np.ndarray
    attitude: Rotation
    torque: np.ndarray
    spin: np.ndarray
    velocity: np.ndarray
    flight: int
    dt: float

    @property
    def acceleration(self) -> np.ndarray:
        """w', (k - 1, 3), rad/s^2."""
        return np.diff(self.rate, axis=0) / self.dt

    def columns(self, axis: int, *, motors: bool = True) -> np.ndarray:
        """Torque (with motors), one and flapping, (k - 1, p)."""
        return regressors(axis, self.torque if motors else None, self.spin, self.velocity)

    def damped(self, axis: int) -> np.ndarray:
        """-S w, (k - 1,)."""
        return -self.spin * (self.rate[:-1, axis] + self.rate[1:, axis]) / 2

    def starts(self, steps: int) -> np.ndarray:
        """Samples from which rollouts of so many steps begin, STRIDE apart."""
        return np.arange(0, len(self.spin) - steps, max(1, round(STRIDE / self.dt)))

    def part(self, first: int, last: int) -> Turning:
        """Samples first .. last - 1."""
        inner = slice(first, last - 1)
        return self._replace(
            rate=self.rate[first:last],
            attitude=self.attitude[first:last],
            torque=self.torque[inner],
            spin=self.spin[inner],
            velocity=self.velocity[inner],
        )


def regressed(
    data: Sequence[Turning], axis: int, parts: Sequence[np.ndarray], *, offset: bool = True, intervals: bool = True
) -> Regression:
    """w' of an axis on torque, one (unless `offset` is False), flapping where there is any, and damping.

    parts: of each stretch these columns and, last, w'. Raises as `regress` does."""
    names = ["torque"]
    if offset:
        names.append("offset")
    if OTHER[axis] is not None:
        names.append("flapping")
    names.append("damping")
    rows = np.concatenate(parts)
    lengths = [len(part) for part in parts]
    stretch = np.repeat(np.arange(len(data)), lengths)
    flight = np.repeat([turning.flight for turning in data], lengths)
    what = f"torque about {AXES[axis]}"
    return regress(rows[:, :-1], rows[:, -1], names, stretch, flight, what=what, intervals=intervals)


def regressors(axis: int, torque: np.ndarray | None, spin: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Torque (unless None), one and flapping S v of an axis, (n, p), of torque and velocity (n, 3) and S (n,)."""
    parts = [] if torque is None else [torque[:, axis]]
    parts.append(np.ones(len(spin)))
    other = OTHER[axis]
    if other is not None:
        parts.append(spin * velocity[:, other])
    return np.column_stack(parts)


def turnings(rows: FlightRows, curve: ThrustCurve, vehicle: Vehicle, flight: int, mean_speed: float) -> list[Turning]:
    """The stretches of a flight that are long enough. mean_speed: sum of the rotor speeds that S is relative to."""
    samples = rows.samples
    rotors = between_samples(samples, curve.of_signal(samples.signal, samples.voltage))
    whole = Turning(
        rate=rows.rate,
        attitude=Rotation.from_quat(rows.flight.stack(QUATERNION)[rows.first :], scalar_first=True),
        torque=vehicle.mass * rotors @ vehicle.allocation[1:].T,
        spin=speed_of(rotors) / mean_speed,
        velocity=(samples.velocity[:-1] + samples.velocity[1:]) / 2,
        flight=flight,
        dt=rows.dt,
    )
    gap = (np.diff(samples.time) > 1.5 * rows.dt) | (np.diff(samples.segment) != 0)
    stretches = []
    for first, last in runs(~gap):
        if (last + 1 - first) * rows.dt > LEAST:
            stretches.append(whole.part(first, last + 1))
    return stretches


def between_samples(samples: Samples, rotors: np.ndarray) -> np.ndarray:
    """Mean from each sample to the next, (k - 1, n), of thrusts (k, n) by the signal of the samples."""
    ahead = samples.during(rotors)
    if samples.held.all() and not samples.lag:
        return ahead[:-1]
    return (ahead[:-1] + ahead[1:]) / 2


def speed_of(rotors: np.ndarray) -> np.ndarray:
    """Sum of the rotor speeds, each the root of its thrust, (k,)."""
    return np.sqrt(np.maximum(rotors, 0.0)).sum(axis=1)
