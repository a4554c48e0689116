"""Identification of the blade-element coefficients from a recorded flight (Lei & Li 2017, section 3).

The flight needs rotor speeds and specific force. The recursive estimator processes the samples as it would in flight,
which gives a time series of estimates. The result with its 95 % intervals is the fit of all samples at once
(quadexp.learn.blade_fit): the final recursive estimate depends on its initial values, neglects the accelerometer's bias
and, as published, the dependence of the induced velocity on C_la; an interval about it contains the truth in 0 to 15 of
40 flights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.errors import DataError
from quadexp.learn.blade_fit import BladeFit, fit_blade_element
from quadexp.learn.rls import SLOWEST, BladeElementRLS, RLSSettings
from quadexp.log.schema import Flight
from quadexp.physics.rotor import THETA, BladeCoefficients
from quadexp.physics.vehicle import Vehicle

FIRST_VALUES = BladeCoefficients(lift_slope=1.66, profile_drag=0.11, body_drag=(0.005, 0.005, 0.01))  # half of Table 1
OFFLINE = RLSSettings.scaled(gauss_newton=True)


@dataclass(frozen=True)
class Identification:
    """Estimates over time. name: of the flight. t: (k,) s. theta: clipped, raw: not clipped, standard_error: (k, 5).

    standard_error: from the recursion's covariance, including its initial value; not an interval. error: (k, 3),
    measured minus predicted specific force (m/s^2). noise: standard deviation of the readings, from the errors of the
    second half (m/s^2). clips: number of clipped samples per coefficient, (5,). skipped: number of samples with a
    stopped rotor. fit: of all samples, with intervals; None for the reason in `note`.
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
    fit: BladeFit | None = None
    note: str = ""

    def columns(self) -> dict[str, np.ndarray]:
        """The time series as named columns, for a table of kind "estimates"."""
        columns = {"t": self.t}
        for prefix, values in (("", self.theta), ("raw_", self.raw), ("std_", self.standard_error)):
            columns |= {f"{prefix}{name}": values[:, i].copy() for i, name in enumerate(THETA)}
        return columns | {f"error_{axis}": self.error[:, i].copy() for i, axis in enumerate("xyz")}

    def metadata(self) -> dict[str, object]:
        """Metadata of the table; the estimates are those of the fit to all samples where there is one."""
        recursion = dict(zip(THETA, self.raw[-1].tolist(), strict=True))
        record: dict[str, object] = {"flight": self.name, "estimates": recursion, "recursion": recursion}
        if self.fit is not None:
            record["estimates"] = dict(zip(THETA, self.fit.theta.tolist(), strict=True))
            record["interval_95"] = {name: list(self.fit.interval(name)) for name in THETA}
            record["accelerometer_offset"] = self.fit.offset.tolist()
            record["blocks"] = self.fit.blocks
        return record | {
            "note": self.note,
            "noise": self.noise if self.fit is None else self.fit.noise,
            "clips": dict(zip(THETA, self.clips.tolist(), strict=True)),
            "skipped": self.skipped,
        }

    def lines(self) -> list[str]:
        """The estimates with their 95 % intervals and the final recursive estimates, one line per coefficient."""
        noise = self.noise if self.fit is None else self.fit.noise
        lines = [f"{self.name}: {len(self.t)} samples, noise {noise:.3g} m/s^2"]
        if self.fit is not None:
            offset = ", ".join(f"{value:.4f}" for value in self.fit.offset)
            lines.append(f"  all samples at once, with the accelerometer bias ({offset} m/s^2)")
        for i, name in enumerate(THETA):
            clipped = f"   clipped on {self.clips[i]} samples" if self.clips[i] else ""
            if self.fit is None:
                lines.append(f"  {name:<5} {self.raw[-1, i]:9.5f}, no interval{clipped}")
                continue
            low, high = self.fit.interval(name)
            estimate = f"{self.fit.theta[i]:9.5f}   95 % interval {low:.5f} to {high:.5f}"
            lines.append(f"  {name:<5} {estimate}   recursion ends at {self.raw[-1, i]:.5f}{clipped}")
        if self.note:
            lines.append(f"  no intervals: {self.note}")
        if self.skipped:
            lines.append(f"  {self.skipped} samples skipped: a rotor was stopped")
        return lines


def identify_flight(
    flight: Flight,
    vehicle: Vehicle,
    settings: RLSSettings | None = None,
    *,
    name: str | None = None,
) -> Identification:
    """Run the recursive estimator over a flight, and fit all its samples at once.

    The first sample is skipped, because in a simulated flight it has no reading yet.
    vehicle: with rotor and thrust coefficient. settings: of the recursion, None for OFFLINE.
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

    estimator = BladeElementRLS(vehicle, FIRST_VALUES, settings or OFFLINE)
    theta, raw, standard_error = np.empty((3, len(state), len(THETA)))
    error = np.full((len(state), 3), np.nan)
    for k in range(len(state)):
        theta[k] = estimator.update(velocity[k], speed[k], force[k])
        raw[k], standard_error[k], error[k] = estimator.raw, estimator.standard_error(), estimator.error
    if estimator.samples == 0:
        raise DataError(f"{name}: the rotors do not turn in this flight, nothing can be identified")
    noise = float(np.sqrt(np.nanmean(error[len(error) // 2 :] ** 2)))
    standard_error *= noise / estimator.settings.noise
    turning = speed.min(axis=1) >= SLOWEST
    stretch = np.asarray(flight.columns.get("segment", np.zeros(len(flight))))[1:]
    fit, note = None, ""
    try:
        fit = fit_blade_element(
            vehicle, velocity[turning], speed[turning], force[turning], FIRST_VALUES,
            stretch=np.concatenate([[0], np.cumsum(stretch[1:] != stretch[:-1])])[turning],
            printed_coefficients=estimator.settings.printed_coefficients,
        )  # fmt: skip
    except DataError as reason:
        note = str(reason)
    return Identification(
        name, flight.t[1:], theta, raw, standard_error, error, noise,
        estimator.clips.copy(), estimator.skipped, fit, note,
    )  # fmt: skip
