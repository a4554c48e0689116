"""Identification of the blade-element coefficients from a recorded flight (Lei & Li 2017, section 3).

Any flight serves that has rotor speeds and specific force: the samples go through the estimator one by one, as they
would in flight, and leave a time series of estimates with their standard errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.errors import DataError
from quadexp.flight.schema import Flight
from quadexp.identify.rls import BladeElementRLS, RLSSettings
from quadexp.rotor import THETA, BladeCoefficients
from quadexp.vehicle import Vehicle

FIRST_VALUES = BladeCoefficients(lift_slope=1.66, profile_drag=0.11, body_drag=(0.005, 0.005, 0.01))  # half of Table 1
CONFIDENCE = 1.96  # standard errors either side: 95 %


@dataclass(frozen=True)
class Identification:
    """Estimates over time. name: of the flight. t: (k,) s. theta: in use, raw: as estimated, standard_error: (k, 5).

    error: (k, 3), specific force less its prediction (m/s^2). noise: standard deviation of the readings, taken from the
    second half's errors (m/s^2). clips: samples on which each value in use was clipped, (5,). skipped: samples with a
    standing rotor.
    """

    name: str
    t: np.ndarray
    theta: np.ndarray
    raw: np.ndarray
    standard_error: np.ndarray
    error: np.ndarray
    noise: float
    clips: np.ndarray
    skipped: int

    def columns(self) -> dict[str, np.ndarray]:
        """The time series as named columns, for a table of kind "estimates"."""
        columns = {"t": self.t}
        for prefix, values in (("", self.theta), ("raw_", self.raw), ("std_", self.standard_error)):
            columns |= {f"{prefix}{name}": values[:, i].copy() for i, name in enumerate(THETA)}
        return columns | {f"error_{axis}": self.error[:, i].copy() for i, axis in enumerate("xyz")}

    def metadata(self) -> dict[str, object]:
        """What goes with the columns."""
        final = dict(zip(THETA, self.raw[-1].tolist(), strict=True))
        return {
            "flight": self.name,
            "estimates": final,
            "standard_errors": dict(zip(THETA, self.standard_error[-1].tolist(), strict=True)),
            "noise": self.noise,
            "clips": dict(zip(THETA, self.clips.tolist(), strict=True)),
            "skipped": self.skipped,
        }

    def lines(self) -> list[str]:
        """The final estimates with their 95 % confidence, one line each."""
        lines = [f"{self.name}: {len(self.t)} samples, noise {self.noise:.3g} m/s^2"]
        for i, name in enumerate(THETA):
            half = CONFIDENCE * self.standard_error[-1, i]
            clipped = f"   clipped on {self.clips[i]} samples" if self.clips[i] else ""
            lines.append(f"  {name:<5} {self.raw[-1, i]:9.5f} +- {half:.5f}{clipped}")
        if self.skipped:
            lines.append(f"  {self.skipped} samples left out: a rotor stood still")
        return lines


def identify_flight(
    flight: Flight,
    vehicle: Vehicle,
    initial: BladeCoefficients = FIRST_VALUES,
    settings: RLSSettings | None = None,
    *,
    name: str | None = None,
) -> Identification:
    """Run the estimator over a flight; the first sample is left out, since a simulated one has not been measured yet.

    vehicle: with rotor and static_thrust. settings: None for `RLSSettings.scaled()`.
    Raises DataError where rotor speeds or specific force are missing, or not finite.
    """
    rotors = [f"rotor_speed_{i}" for i in range(vehicle.n_rotors)]
    needed = [*rotors, "acc_x", "acc_y", "acc_z"]
    missing = [column for column in needed if column not in flight.columns]
    name = name or str(flight.metadata.get("name", "flight"))
    if missing:
        raise DataError(f"{name}: column {missing[0]!r} is missing; identification needs {', '.join(needed)}")
    if len(flight) < 3:
        raise DataError(f"{name}: {len(flight)} samples, identification needs at least 3")
    state, speed, force = flight.state[1:], flight.stack(rotors)[1:], flight.stack(needed[-3:])[1:]
    for column, values in (("state", state), ("rotor_speed", speed), ("acc", force)):
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise DataError(f"{name}: {column} is not finite at row {bad[0] + 1}")
    velocity = flight.air_velocity[1:]

    estimator = BladeElementRLS(vehicle, initial, settings or RLSSettings.scaled())
    theta, raw, standard_error = np.empty((3, len(state), len(THETA)))
    error = np.full((len(state), 3), np.nan)
    for k in range(len(state)):
        theta[k] = estimator.update(velocity[k], speed[k], force[k])
        raw[k], standard_error[k], error[k] = estimator.raw, estimator.standard_error(), estimator.error
    if estimator.samples == 0:
        raise DataError(f"{name}: the rotors never turned, nothing can be identified")
    noise = float(np.sqrt(np.nanmean(error[len(error) // 2 :] ** 2)))
    standard_error *= noise / estimator.settings.noise
    return Identification(
        name, flight.t[1:], theta, raw, standard_error, error, noise, estimator.clips.copy(), estimator.skipped
    )
