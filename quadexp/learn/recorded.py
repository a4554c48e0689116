"""Residual rows from the accelerometer: what the thrust curve does not explain of the specific force, sample by sample.

    a = f - (0, 0, sum_i a_i)        body FLU, m/s^2;   u_i = m a_i  (N)

f is the specific force that was read and a_i what the thrust curve says a rotor adds (quadexp.learn.thrust_curve).
The velocity among the features is relative to the air. This is the target of recorded flights: differentiating an
estimated velocity (target "velocity", the transitions of quadexp.learn.dataset) lets the estimator's filter and the
noise of the derivative into it. `target_cost` measures that on the user's own flights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.learn.dataset import THRUST, ResidualDataset, transitions
from quadexp.learn.linear_drag import fit_linear_drag
from quadexp.learn.samples import choose_signal, gather
from quadexp.learn.thrust_curve import ThrustCurve
from quadexp.log.schema import Flight
from quadexp.physics.vehicle import Vehicle

TARGETS = ("auto", "specific_force", "velocity")
OWN_SIGNALS = ("u", "thrust_acceleration")  # say the thrust in units of force or acceleration by themselves
RATES = ("w_x", "w_y", "w_z")
AXES = "xyz"


def is_recorded(flight: Flight) -> bool:
    """Whether the flight comes from a log, not from this program's plants."""
    return bool(flight.metadata.get("recorded", False))


def logged_thrust(flights: Sequence[Flight], vehicle: Vehicle) -> ThrustCurve:
    """The curve of a log that states its thrust: u in N, or thrust_acceleration in m/s^2, taken as it is.

    Raises UsageError where the log has commands or rotor speeds only: these need an identified curve.
    """
    signal = choose_signal(flights)
    stated = [name for name in OWN_SIGNALS if _all_have(flights, name)]
    if not stated:
        raise UsageError(
            f"collect.identified: these flights say {signal}, not thrust: give the folder of `quadexp identify"
            " FLIGHT... --out models/NAME`"
        )
    scale = 1 / vehicle.mass if stated[0] == "u" else 1.0
    return ThrustCurve(stated[0], np.array([1.0]), np.array([scale]), np.zeros(1), rotors=vehicle.n_rotors)


def _all_have(flights: Sequence[Flight], signal: str) -> bool:
    column = signal if signal == "thrust_acceleration" else f"{signal}_0"
    return all(column in flight.columns for flight in flights)


def force_rows(flight: Flight, vehicle: Vehicle, curve: ThrustCurve, name: str = "flight") -> dict[str, np.ndarray]:
    """Columns t, dt, v_* (body, relative to the air), w_*, a_*, u_*, thrust of one flight, (k,) each; see the module.

    Raises DataError for a column that is missing or not finite, and for another number of rotors than the vehicle's.
    """
    samples = gather([flight], curve.signal, [name])
    first = len(flight) - len(samples)  # a simulated flight's first row has no reading yet
    rotors = curve.of_signal(samples.signal, samples.voltage)
    if rotors.shape[1] != vehicle.n_rotors:
        raise DataError(f"{name}: {rotors.shape[1]} rotors, vehicle '{vehicle.name}' has {vehicle.n_rotors}")
    missing = [column for column in RATES if column not in flight.columns]
    if missing:
        raise DataError(f"{name}: column '{missing[0]}' is missing in the flight")
    rate = flight.stack(RATES)[first:]
    bad = np.flatnonzero(~np.isfinite(rate).all(axis=1))
    if len(bad):
        raise DataError(f"{name}: a body rate is not finite in row {bad[0] + first} ({len(bad)} such rows)")
    left = samples.force.copy()
    left[:, 2] -= rotors.sum(axis=1)
    columns = {"t": samples.time, "dt": _steps(samples.time, samples.segment)}
    for prefix, values in (("v", samples.velocity), ("w", rate), ("a", left)):
        columns |= {f"{prefix}_{axis}": values[:, i].copy() for i, axis in enumerate(AXES)}
    columns |= {f"u_{i}": vehicle.mass * rotors[:, i] for i in range(vehicle.n_rotors)}
    columns[THRUST] = vehicle.mass * rotors.sum(axis=1)
    return columns


def _steps(time: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """What time every row stands for, (k,) (s): the step to the next within a segment, the median at its end."""
    steps = np.diff(time)
    together = segment[1:] == segment[:-1]
    usual = float(np.median(steps[together])) if together.any() else 0.0
    return np.append(np.where(together, steps, usual), usual)


def velocity_rows(flight: Flight, vehicle: Vehicle, curve: ThrustCurve, *, frame: str) -> dict[str, np.ndarray]:
    """The same from the velocity's change over each step: the transitions under the curve's thrusts."""
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
    """The rows of many flights in one table, each with the flight it came from.

    The metadata of quadexp.learn.dataset, with target, thrust (the curve, so that a model can be flown against other
    flights by itself). Raises DataError, UsageError as the functions above do.
    """
    if target not in TARGETS[1:]:
        raise UsageError(f"collect.target: '{target}' is none of {', '.join(TARGETS)}")
    names = list(names or [str(flight.metadata.get("name") or f"flight_{i}") for i, flight in enumerate(flights)])
    tables, records = [], []
    for index, (flight, name) in enumerate(zip(flights, names, strict=True)):
        flown = (flight.metadata.get("vehicle") or {}).get("fingerprint", vehicle.fingerprint)
        if flown != vehicle.fingerprint:
            raise DataError(f"{name}: flown by vehicle {flown}, not by '{vehicle.name}' ({vehicle.fingerprint})")
        if target == "velocity":
            table = velocity_rows(flight, vehicle, curve, frame=frame)
        else:
            table = force_rows(flight, vehicle, curve, name)
        rows = len(table["t"])
        tables.append({"flight": np.full(rows, index, np.int32), "flight_name": np.full(rows, name, object)} | table)
        records.append({"name": name, "rows": rows, "left_out": len(flight) - rows, "seed": None})
    columns = {column: np.concatenate([table[column] for table in tables]) for column in tables[0]}
    return ResidualDataset(
        columns,
        {
            "vehicle": {"name": vehicle.name, "fingerprint": vehicle.fingerprint, "mass": vehicle.mass},
            "frame": "sample" if target == "specific_force" else frame,
            "target": target,
            "flights": records,
            "recorded": True,
            "thrust": curve_record(curve),
        },
    )


def curve_record(curve: ThrustCurve) -> dict[str, Any]:
    """A thrust curve as JSON."""
    return {key: value.tolist() if hasattr(value, "tolist") else value for key, value in asdict(curve).items()}


def curve_from_record(record: dict[str, Any]) -> ThrustCurve:
    """The curve that `curve_record` wrote."""
    arrays = ("powers", "coefficients", "errors", "signal_range")
    made: dict[str, Any] = {
        key: np.array(value, float) if key in arrays and value is not None else value for key, value in record.items()
    }
    return ThrustCurve(**made)


class TargetCost(NamedTuple):
    """Root mean squares of vectors, m/s^2: what linear drag leaves of either target."""

    force: float
    velocity: float

    def __str__(self) -> str:
        return (
            f"linear drag leaves {self.velocity:.3f} m/s^2 of the velocity's derivative where it leaves"
            f" {self.force:.3f} m/s^2 of the specific force ({self.velocity / max(self.force, 1e-9):.1f} times as much)"
        )


def target_cost(flights: Sequence[Flight], vehicle: Vehicle, curve: ThrustCurve, *, frame: str) -> TargetCost | None:
    """What the target from the velocity costs on these flights; None where they have no accelerometer."""
    if not all(f"acc_{axis}" in flight.columns for flight in flights for axis in AXES):
        return None
    left = []
    for target in ("specific_force", "velocity"):
        data = recorded_dataset(flights, vehicle, curve, target=target, frame=frame)
        residual = data.matrix(["a_x", "a_y", "a_z"]) - fit_linear_drag(
            data, loss="squares", intervals=False
        ).acceleration(data)
        left.append(float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))))
    return TargetCost(*left)
