"""Residual dataset from recorded flights: measured specific force minus the thrust curve, one row per sample.

    a = f - (0, 0, sum_i a_i)        body FLU, m/s^2;   u_i = m a_i  (N)

with f the accelerometer's specific force and a_i the acceleration of a rotor by the thrust curve
(quadexp.models.thrust_curve). The velocity in the features is relative to the air. The alternative target "velocity"
(transitions of quadexp.models.dataset) differentiates an estimated velocity and so contains the estimator's filter and
amplified noise; `target_cost` measures the difference on the user's own flights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.log.schema import Flight
from quadexp.models.base import rms
from quadexp.models.checkpoint import plain
from quadexp.models.dataset import ResidualDataset, joined, transitions
from quadexp.models.linear_drag import fit_linear_drag
from quadexp.models.residual import AXES, THRUST
from quadexp.models.samples import choose_signal, read_rows, rotor_columns
from quadexp.models.thrust_curve import ThrustCurve
from quadexp.physics.vehicle import Vehicle

TARGETS = ("auto", "specific_force", "velocity")
THRUST_SIGNALS = ("u", "thrust_acceleration")  # in units of force or acceleration, usable without a thrust curve


def is_recorded(flight: Flight) -> bool:
    """Whether the flight comes from a log, not from a simulated plant."""
    return bool(flight.metadata.get("recorded", False))


def logged_thrust(flights: Sequence[Flight], vehicle: Vehicle) -> ThrustCurve:
    """The curve of a log with logged thrust: u in N, or thrust_acceleration in m/s^2, unchanged. Of simulated flights
    with rotor speeds those, by the vehicle's thrust coefficient.

    Raises UsageError where the log has commands or rotor speeds only, which need an identified curve.
    """
    k, simulated = vehicle.thrust_coefficient, not any(map(is_recorded, flights))
    if simulated and k is not None and all(rotor_columns(flight, "rotor_speed") for flight in flights):
        scale = k / vehicle.mass
        return ThrustCurve("rotor_speed", np.array([2.0]), np.array([scale]), np.zeros(1), rotors=vehicle.n_rotors)
    signals = [name for name in THRUST_SIGNALS if all(rotor_columns(flight, name) for flight in flights)]
    if not signals:
        raise UsageError(
            f"collect.identified: these flights have {choose_signal(flights)}, not thrust: give the folder of"
            " `quadexp identify FLIGHT... --out models/NAME`"
        )
    scale = 1 / vehicle.mass if signals[0] == "u" else 1.0
    return ThrustCurve(signals[0], np.array([1.0]), np.array([scale]), np.zeros(1), rotors=vehicle.n_rotors)


def force_rows(flight: Flight, vehicle: Vehicle, curve: ThrustCurve, name: str = "flight") -> dict[str, np.ndarray]:
    """Columns t, dt, v_* (body, relative to the air), w_*, a_*, u_*, thrust of one flight, (k,) each; see the module.

    Raises DataError for a column that is missing or not finite, and for another number of rotors than the vehicle's.
    """
    row = read_rows(flight, name, curve.signal, curve.delay)
    samples, rate = row.samples, row.rate
    rotors = curve.of_signal(samples.signal, samples.voltage)
    if rotors.shape[1] != vehicle.n_rotors:
        raise DataError(f"{name}: {rotors.shape[1]} rotors, vehicle '{vehicle.name}' has {vehicle.n_rotors}")
    residual = samples.force.copy()
    residual[:, 2] -= rotors.sum(axis=1)
    steps = np.diff(samples.time)  # to the next row within a segment, the median step at its end
    together = samples.segment[1:] == samples.segment[:-1]
    usual = float(np.median(steps[together])) if together.any() else 0.0
    columns = {"t": samples.time, "dt": np.append(np.where(together, steps, usual), usual)}
    for prefix, values in (("v", samples.velocity), ("w", rate), ("a", residual)):
        columns |= {f"{prefix}_{axis}": values[:, i].copy() for i, axis in enumerate(AXES)}
    columns |= {f"u_{i}": vehicle.mass * rotors[:, i] for i in range(vehicle.n_rotors)}
    columns[THRUST] = vehicle.mass * rotors.sum(axis=1)
    return columns


def velocity_rows(flight: Flight, vehicle: Vehicle, curve: ThrustCurve, *, frame: str) -> dict[str, np.ndarray]:
    """The same columns from the change of the velocity over each step: transitions under the curve's thrusts."""
    thrust = vehicle.mass * curve.rotor_acceleration(flight)
    commanded = {f"u_{i}": thrust[:, i] for i in range(thrust.shape[1])}
    return transitions(replace(flight, columns=dict(flight.columns) | commanded), vehicle, frame=frame)


def recorded_dataset(
    flights: Sequence[Flight],
    vehicle: Vehicle,
    curve: ThrustCurve,
    *,
    target: str = "specific_force",
    frame: str = "midpoint",
    names: Sequence[str] | None = None,
) -> ResidualDataset:
    """The rows of many flights in one table, each row with its flight.

    names: see quadexp.models.dataset.joined. The metadata also contain the target, and the thrust curve, with which a
    model can predict other flights. Raises DataError, UsageError as the functions above do.
    """
    if target not in TARGETS[1:]:
        raise UsageError(f"collect.target: '{target}' is none of {', '.join(TARGETS)}")

    def table_of(flight: Flight, name: str) -> dict[str, np.ndarray]:
        if target == "velocity":
            return velocity_rows(flight, vehicle, curve, frame=frame)
        return force_rows(flight, vehicle, curve, name)

    columns, records = joined(flights, vehicle, names, table_of)
    for record, flight in zip(records, flights, strict=True):
        record |= {"left_out": len(flight) - record["rows"], "seed": None}
    return ResidualDataset(
        columns,
        {
            "vehicle": {"name": vehicle.name, "fingerprint": vehicle.fingerprint, "mass": vehicle.mass},
            "frame": "sample" if target == "specific_force" else frame,
            "target": target,
            "flights": records,
            "recorded": True,
            "thrust": plain(curve),
        },
    )


class TargetCost(NamedTuple):
    """Root mean square residual of linear drag for either target, m/s^2."""

    force: float
    velocity: float

    def __str__(self) -> str:
        return (
            f"the residual of linear drag is {self.velocity:.3f} m/s^2 for the velocity's derivative and"
            f" {self.force:.3f} m/s^2 for the specific force (ratio {self.velocity / max(self.force, 1e-9):.1f})"
        )


def target_cost(flights: Sequence[Flight], vehicle: Vehicle, curve: ThrustCurve, *, frame: str) -> TargetCost | None:
    """Compare the two targets on these flights; None where they have no accelerometer."""
    if not all(f"acc_{axis}" in flight.columns for flight in flights for axis in AXES):
        return None
    errors = []
    for target in ("specific_force", "velocity"):
        data = recorded_dataset(flights, vehicle, curve, target=target, frame=frame)
        drag = fit_linear_drag(data, loss="squares", intervals=False)
        errors.append(rms(data.matrix(["a_x", "a_y", "a_z"]) - drag.acceleration(data)))
    return TargetCost(*errors)
