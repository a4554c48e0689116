"""The residual dataset: differences between flights and the nominal rigid body, one row per transition.

A transition is two consecutive samples of a flight, x_k -> x_{k+1} under the constant input u_k. Its targets are

    a   = R^T (v_{k+1} - v_pred) / dt          residual acceleration, body frame, m/s^2
    tau = J (w_{k+1} - w_pred) / dt            residual torque, body frame, N m

with (v_pred, w_pred) the RK4 prediction of the nominal rigid body from x_k over the true dt. Both velocities are in one
frame R (the difference of two body velocities, each in its own frame, would contain the rotation between the frames).

The velocity in the features is relative to the air where the flight has wind columns; the target is the same in every
inertial frame.

frame="midpoint": R and the features (body velocity, body rate) are those of the middle of the transition, averages of
x_k and x_{k+1}; the target is then the residual at that point to second order in dt (for the torque, after adding the
gyroscopic moment due to the difference itself, dt/2 (dw x J w + w x J dw) with dw = (w_{k+1} - w_pred) / dt).
frame="start": both at x_k as in Torrente et al. 2021 (section III-C), first order in dt. On the simplified simulation
at 50 Hz the targets deviate from the plant's drag by 0.004 and 0.08 m/s^2 respectively (root mean square, x and y).

`known_noise`: standard deviations of the targets, from white noise of the plant (densities S) and of the estimate
(standard deviations s per sample, velocity v, rate w, attitude q), which no model of the air can explain:

    a_i^2   = (S_force / m)^2 / dt + 2 s_v^2 / dt^2 + (T / m)^2 s_q^2 [i = x, y] + motors [i = z]
    tau_i^2 = S_torque^2 / dt + 2 (J_ii s_w)^2 / dt^2 + motors
    motors  = sum_j g_ij^2 S_motor^2 u_j u_max / dt,    g: effect of a thrust on that axis, 1 / m or the lever

with thrusts u and their sum T. The attitude enters by the direction of the predicted thrust. Noise of the features is
left out; it is multiplied by the slope of the residual.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import DataError, UsageError
from quadexp.log.schema import Flight, n_inputs
from quadexp.log.store import read_table
from quadexp.models.residual import AXES, OUTPUTS, THRUST
from quadexp.names import named
from quadexp.physics.expression import symbols
from quadexp.physics.integrator import rk4_step
from quadexp.physics.rigid_body import rigid_body_function
from quadexp.physics.rotation import air_velocity
from quadexp.physics.state import ATTITUDE, RATE, STATE_COLUMNS, VELOCITY, finite_rows, input_columns, norms
from quadexp.physics.vehicle import Vehicle

DT_RANGE = (0.5, 1.5)  # of the flight's median dt; outside it two samples are not consecutive
BATCH = 20_000  # samples evaluated per call
WIND = ("wind_x", "wind_y", "wind_z")
ESTIMATE = ("velocity_noise", "rate_noise", "attitude_noise")
SILENT = ("from_model", "blade_element", "simplified")  # plants whose only noise is that of their densities


class ResidualDataset(NamedTuple):
    """Rows of transitions with their origin.

    columns: name -> (k,): flight, flight_name, t (s), dt (s), v_x v_y v_z (body, m/s), w_x w_y w_z (body, rad/s),
        u_0 .. (N), thrust (N), a_x a_y a_z (body, m/s^2), tau_x tau_y tau_z (body, N m).
    metadata: vehicle {name, fingerprint}, frame, flights [{name, rows, left_out, seed}].
    """

    columns: Mapping[str, np.ndarray]
    metadata: Mapping[str, Any]

    @property
    def n_rows(self) -> int:
        return len(self.columns.get("flight", ()))

    @property
    def flights(self) -> np.ndarray:
        """Indices of the flights that have rows, ascending."""
        return np.unique(self.columns["flight"])

    def rows(self, selection: np.ndarray) -> ResidualDataset:
        """The dataset with the rows of a mask or an index array only."""
        return ResidualDataset({name: column[selection] for name, column in self.columns.items()}, self.metadata)

    def matrix(self, names: Sequence[str]) -> np.ndarray:
        """Columns as a matrix, (k, len(names)); `thrust` is the sum over the rotors where it is not stored.

        Raises DataError for a column that is missing or not finite, naming it.
        """
        columns = [self._column(name) for name in names]
        if not columns:
            return np.empty((self.n_rows, 0))
        return np.column_stack(columns)

    def _column(self, name: str) -> np.ndarray:
        if name in self.columns:
            column = np.asarray(self.columns[name], float)
        elif name == THRUST and any(key.startswith("u_") for key in self.columns):
            column = np.sum([self.columns[key] for key in self.columns if key.startswith("u_")], axis=0)
        else:
            present = ", ".join(key for key in self.columns if key not in ("flight", "flight_name", "t", "dt"))
            raise DataError(f"dataset: column '{name}' is missing; it has {present or 'no columns'}")
        _require_finite(column, f"dataset: column '{name}'")
        return column

    @property
    def rotor_thrusts(self) -> np.ndarray:
        """u_0, u_1, ... of the rows, (k, n) (N)."""
        return self.matrix(input_columns(n_inputs(self.columns)))

    @property
    def sha256(self) -> str:
        """Hash of every column's name, type and bytes (in the order of the names)."""
        digest = hashlib.sha256()
        for name in sorted(self.columns):
            column = np.asarray(self.columns[name])
            if column.dtype.kind not in "biuf":
                column = np.array("\0".join(map(str, column)).encode())
            else:
                column = np.ascontiguousarray(column.astype(column.dtype.newbyteorder("<")))
            digest.update(f"{name}\0{column.dtype.str}\0{column.size}\0".encode())
            digest.update(column.tobytes())
        return digest.hexdigest()

    def summary(self) -> dict[str, Any]:
        """Record of the data for a checkpoint: hash, rows, flights, seconds, frame; timing and known noise where they
        are not those of a clean flight; for recorded flights also names, target and thrust curve."""
        names = ("timing", "known_noise", "target", "thrust")
        record = {key: self.metadata[key] for key in names if self.metadata.get(key)}
        if "target" in record:
            record["names"] = sorted(set(map(str, self.columns["flight_name"])))
        duration = float(np.sum(self.columns["dt"])) if "dt" in self.columns else None
        record |= {"sha256": self.sha256, "rows": self.n_rows, "flights": len(self.flights), "duration": duration}
        return record | {"frame": self.metadata.get("frame")}


def transitions(
    flight: Flight, vehicle: Vehicle, *, frame: str = "midpoint", thrust: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Features and targets of every pair of consecutive samples of one flight.

    flight: columns t (s, increasing), the state, u_i (N); an optional column `segment` marks resets by its changes,
    optional columns wind_x, wind_y, wind_z (world, m/s) are the velocity of the air.
    frame: "midpoint" or "start", see the module. thrust: mean thrusts (k - 1, n) (N) between the samples, NaN where
    there are none; None: as commanded, u_i.

    Samples whose dt lies outside 0.5 .. 1.5 of the median, or whose segment differs, are not consecutive.
    Raises DataError for a missing column or a value that is not finite (column and row), UsageError for the frame.
    """
    from scipy.spatial.transform import Rotation

    if frame not in ("midpoint", "start"):
        raise UsageError(f"collect.frame: '{frame}' is neither midpoint nor start")

    def of_frame(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        if frame == "start":
            return first
        return (first + second) / 2

    inputs = input_columns(vehicle.n_rotors)
    t = _read(flight, ("t",))[:, 0]
    state = _read(flight, STATE_COLUMNS)
    if thrust is None:
        thrust = _read(flight, inputs)[:-1]

    k = consecutive(t, flight.columns.get("segment"))
    k = k[finite_rows(thrust[k])]
    before = state[k]
    after = state[k + 1]
    u = thrust[k]
    dt = np.diff(t)[k]
    before[:, ATTITUDE] = _unit(before[:, ATTITUDE], k)
    after[:, ATTITUDE] = _unit(after[:, ATTITUDE], k + 1)
    opposite = np.sum(before[:, ATTITUDE] * after[:, ATTITUDE], axis=1) < 0
    after[:, ATTITUDE] *= np.where(opposite, -1.0, 1.0)[:, None]

    predicted = _predict(vehicle, before, u, dt)
    point = of_frame(before, after)
    to_body = np.empty((0, 3, 3))
    if len(k):
        to_body = Rotation.from_quat(point[:, ATTITUDE], scalar_first=True).as_matrix()
    air = np.zeros((len(t), 3))
    if flight.wind is not None:
        air = _read(flight, WIND)
    velocity = air_velocity(point[:, ATTITUDE], point[:, VELOCITY], of_frame(air[k], air[k + 1]))
    gap = (after - predicted) / dt[:, None]
    acceleration = np.einsum("kij,ki->kj", to_body, gap[:, VELOCITY])
    torque = gap[:, RATE] @ vehicle.inertia_matrix
    if frame == "midpoint":
        # contribution of the difference itself to w x J w, to first order in dt
        w = point[:, RATE]
        inertia = vehicle.inertia_matrix
        gyroscopic = np.cross(gap[:, RATE], w @ inertia) + np.cross(w, torque)
        torque = torque + dt[:, None] / 2 * gyroscopic

    when = t[k]
    if frame == "midpoint":
        when = when + dt / 2
    columns = {"t": when, "dt": dt}
    columns |= by_axis(v=velocity, w=point[:, RATE], a=acceleration, tau=torque)
    columns |= {column: u[:, i].copy() for i, column in enumerate(inputs)}
    return columns | {THRUST: u.sum(axis=1)}


def by_axis(**vectors: np.ndarray) -> dict[str, np.ndarray]:
    """Columns NAME_x, NAME_y, NAME_z, (k,) each, of vectors (k, 3) by name."""
    return {f"{name}_{a}": values[:, i].copy() for name, values in vectors.items() for i, a in enumerate(AXES)}


def residual_dataset(
    flights: Sequence[Flight], vehicle: Vehicle, *, frame: str = "midpoint", names: Sequence[str] | None = None,
    thrusts: Sequence[np.ndarray] | None = None,
) -> ResidualDataset:  # fmt: skip
    """The transitions of many flights in one table, each row with its flight.

    names: see `joined`. thrusts: of every flight those between its samples, see `transitions`; None: as commanded.
    Raises DataError for a flight of another vehicle, and where there is no transition.
    """
    delivered = iter(thrusts) if thrusts else repeat(None)

    def table_of(flight: Flight, name: str) -> dict[str, np.ndarray]:
        try:
            return transitions(flight, vehicle, frame=frame, thrust=next(delivered))
        except DataError as error:
            raise DataError(f"{name}: {error}") from None

    columns, records = joined(flights, vehicle, names, table_of)
    if not len(columns.get("t", ())):
        raise DataError(f"dataset: {len(flights)} flights hold no transition (two consecutive samples make one)")
    for record, flight in zip(records, flights, strict=True):
        record["left_out"] = max(len(np.asarray(flight.columns["t"])) - 1, 0) - record["rows"]
        record["seed"] = flight.metadata.get("seed")
    return ResidualDataset(columns, {"vehicle": vehicle.record, "frame": frame, "flights": records})


def as_told(flight: Flight) -> Flight:
    """The flight with the estimate that its controller was given, est_p_x .., in place of the truth where it has
    one."""
    columns = flight.columns
    estimate = {name: columns[f"est_{name}"] for name in STATE_COLUMNS if f"est_{name}" in columns}
    if not estimate:
        return flight
    return replace(flight, columns={**columns, **estimate})


def joined(
    flights: Sequence[Flight], vehicle: Vehicle, names: Sequence[str] | None,
    table_of: Callable[[Flight, str], dict[str, np.ndarray]],
) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:  # fmt: skip
    """Rows of all flights as columns, with the columns flight and flight_name; and {name, rows} of each flight.

    names: one per flight, such as its file; None: metadata["name"] or `flight_<index>`. table_of: columns of a flight.
    Raises DataError for a flight of another vehicle.
    """
    names = names or [name_of(flight, i) for i, flight in enumerate(flights)]
    tables = []
    records = []
    for index, (flight, name) in enumerate(zip(flights, names, strict=True)):
        flown = (flight.metadata.get("vehicle") or {}).get("fingerprint", vehicle.fingerprint)
        if flown != vehicle.fingerprint:
            raise DataError(f"{name}: flown by vehicle {flown}, not by '{vehicle.name}' ({vehicle.fingerprint})")
        table = table_of(flight, name)
        rows = len(table["t"])
        tables.append({"flight": np.full(rows, index, np.int32), "flight_name": np.full(rows, name, object)} | table)
        records.append({"name": name, "rows": rows})
    columns = tables[0] if tables else ()
    return {column: np.concatenate([table[column] for table in tables]) for column in columns}, records


def name_of(flight: Flight, index: int) -> str:
    """Name of a flight in messages: that in its metadata, or `flight_<index>`."""
    return str(flight.metadata.get("name") or f"flight_{index}")


def _read(flight: Flight, columns: Sequence[str]) -> np.ndarray:
    """Columns of a flight as a matrix, (k, len(columns)); raises DataError unless all are finite."""
    read = []
    for column in columns:
        if column not in flight.columns:
            raise DataError(f"column '{column}' is missing in the flight")
        values = np.asarray(flight.columns[column], float)
        _require_finite(values, f"column '{column}'")
        read.append(values)
    return np.column_stack(read)


def _require_finite(column: np.ndarray, what: str) -> None:
    bad = np.flatnonzero(~np.isfinite(column))
    if len(bad):
        raise DataError(f"{what} holds {column[bad[0]]} in row {bad[0]} ({len(bad)} such rows); all must be finite")


def consecutive(t: np.ndarray, segment: np.ndarray | None) -> np.ndarray:
    """Transitions of samples at times t (k,) with segments (k,): indices k of which k and k + 1 are consecutive."""
    dt = np.diff(t)
    if not len(dt):
        return np.empty(0, int)
    median = np.median(dt)
    together = (dt > 0) & (dt >= DT_RANGE[0] * median) & (dt <= DT_RANGE[1] * median)
    if segment is not None:
        segment = np.asarray(segment)
        together &= segment[1:] == segment[:-1]
    return np.flatnonzero(together)


def _unit(quaternion: np.ndarray, rows: np.ndarray) -> np.ndarray:
    norm = norms(quaternion)
    bad = np.flatnonzero(np.abs(norm - 1) > 0.1)
    if len(bad):
        raise DataError(f"row {rows[bad[0]]}: the quaternion's norm is {norm[bad[0]]:.3g}, it must be 1")
    return quaternion / norm[:, None]


def evaluate_rows(function: Any, arguments: Sequence[np.ndarray], result: np.ndarray) -> None:
    """Write into the rows of `result`, (k, m), what a CasADi function of dense vectors makes of the rows of its
    arguments, (k, ..) each.

    Through buffers, batch by batch: conversions to CasADi's matrices take seven times as long as the evaluation.
    """
    batch = min(BATCH, len(result))
    if not batch:
        return
    buffers: list[Any] = [np.zeros((batch, array.shape[1])) for array in (*arguments, result)]
    handle, evaluate = function.map(batch).buffer()
    for i, buffer in enumerate(buffers[:-1]):
        handle.set_arg(i, memoryview(buffer))
    handle.set_res(0, memoryview(buffers[-1]))
    for start in range(0, len(result), batch):
        count = min(batch, len(result) - start)
        for buffer, array in zip(buffers, arguments, strict=False):
            buffer[:count] = array[start : start + count]
        evaluate()
        result[start : start + count] = buffers[-1][:count]


def _predict(vehicle: Vehicle, state: np.ndarray, u: np.ndarray, dt: np.ndarray) -> np.ndarray:
    """State of the nominal rigid body after dt, (k, 13)."""
    if not len(state):
        return state.copy()
    rigid_body = rigid_body_function(vehicle)
    x, thrust, step = symbols(ca.SX, x=state.shape[1], u=u.shape[1], dt=1)
    end = rk4_step(lambda at: rigid_body(at, thrust), x, step)
    after = np.empty(state.shape)
    evaluate_rows(ca.Function("step", [x, thrust, step], [ca.densify(end)]), (state, u, dt[:, None]), after)
    return after


def read_dataset(path: str | Path) -> ResidualDataset:
    """Read a residual data set; raises DataError for NaN, with column and row."""
    columns, record = read_table(path, "residuals", required=("flight", "flight_name", "t", "dt"), finite=True)
    if not len(columns["flight"]):
        raise DataError(f"{path}: the data set has no rows; collect again")
    return ResidualDataset(columns, record)


def feature_rows(velocity: np.ndarray, rate: np.ndarray, thrust: np.ndarray) -> ResidualDataset:
    """Features as a data set: velocity (m/s) and rate (rad/s), (k, 3), rotor thrusts, (k, n) (N)."""
    columns = by_axis(v=velocity, w=rate) | {f"u_{i}": u for i, u in enumerate(thrust.T)}
    return ResidualDataset(columns | {THRUST: thrust.sum(axis=1), "flight": np.zeros(len(velocity), int)}, {})


def known_noise(
    dataset: ResidualDataset, vehicle: Vehicle, worlds: Sequence[Mapping[str, Any]], *, of_estimate: bool
) -> dict[str, Any] | None:
    """Root mean square of the known noise, {output: std}, over the rows of simulated flights.

    worlds: configuration of every flight, by group. of_estimate: the targets come from what the controller was given.
    None where some part of a world has noise that it does not state.
    """
    squares = np.zeros(len(OUTPUTS))
    flight = dataset.columns["flight"]
    thrust = dataset.matrix([f"u_{i}" for i in range(vehicle.n_rotors)])
    dt = np.asarray(dataset.columns["dt"], float)
    for index, world in enumerate(worlds):
        plant = world.get("plant") or {}
        estimator = (world.get("estimator") or {}) if of_estimate else {}
        if plant.get("kind") not in SILENT or (estimator and not all(name in estimator for name in ESTIMATE)):
            return None
        rows = flight == index
        squares += np.sum(_variances(vehicle, plant, estimator, thrust[rows], dt[rows, None]), axis=0)
    return named(OUTPUTS, np.sqrt(squares / max(dataset.n_rows, 1)).tolist())


def _variances(
    vehicle: Vehicle, plant: Mapping[str, Any], estimator: Mapping[str, Any], thrust: np.ndarray, dt: np.ndarray
) -> np.ndarray:
    """Variance of every target in every row, (k, 6)."""
    density = {name: float(plant.get(f"{name}_noise_density") or 0.0) for name in ("force", "torque", "motor")}
    velocity, rate, attitude = (float(estimator.get(name) or 0.0) for name in ESTIMATE)
    mass = vehicle.mass + float(plant.get("payload") or 0.0)
    inertia = vehicle.inertia_matrix
    effect = np.vstack([np.zeros((2, vehicle.n_rotors)), np.full(vehicle.n_rotors, 1 / mass), vehicle.allocation[1:]])
    motors = density["motor"] ** 2 * vehicle.thrust_max * np.maximum(thrust, 0) @ (effect**2).T
    white = np.repeat([(density["force"] / mass) ** 2, density["torque"] ** 2], 3)
    sampled = 2 * np.concatenate([np.full(3, velocity**2), np.sum(inertia**2, axis=1) * rate**2])
    tilt = (attitude * thrust.sum(axis=1, keepdims=True) / vehicle.mass) ** 2 * np.array([1, 1, 0, 0, 0, 0])
    return (motors + white) / dt + sampled / dt**2 + tilt
