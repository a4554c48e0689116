"""What the rigid body does not explain, row by row: the residual dataset.

A transition is two consecutive samples of a flight, x_k -> x_{k+1} under the constant input u_k. Its targets are

    a   = R^T (v_{k+1} - v_pred) / dt          residual acceleration, body frame, m/s^2
    tau = J (w_{k+1} - w_pred) / dt            residual torque, body frame, N m

with (v_pred, w_pred) the nominal rigid body's RK4 over the true dt from x_k. One frame R for both velocities (the
difference of two body velocities, each in its own frame, mixes the frames' rotation into the target).

The velocity among the features is relative to the air, where the flight has wind columns; the target is the same in
every frame that moves steadily (Galilei).

frame="midpoint": R and the features (body velocity, body rate) belong to the middle of the transition, averages of
x_k and x_{k+1}; the target then is the residual at that point to second order in dt (for the torque, after the gap's
own gyroscopic moment, dt/2 (dw x J w + w x J dw) with dw = (w_{k+1} - w_pred) / dt, is added). frame="start": both at
x_k as in Torrente et al. 2021 (section III-C), first order in dt. On the simplified simulation at 50 Hz the targets lie
.004 m/s^2 from the plant's own drag with the one and .08 m/s^2 with the other (root mean square, x and y).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.log.schema import Flight
from quadexp.log.store import read_table
from quadexp.physics.state import ATTITUDE, RATE, STATE_COLUMNS, VELOCITY, input_columns
from quadexp.physics.vehicle import Vehicle

FRAMES = ("midpoint", "start")
DT_RANGE = (0.5, 1.5)  # of the flight's median dt; outside it two samples are not consecutive
TARGETS = ("a_x", "a_y", "a_z", "tau_x", "tau_y", "tau_z")
THRUST = "thrust"
WIND = ("wind_x", "wind_y", "wind_z")


class ResidualDataset(NamedTuple):
    """Rows of transitions and where they came from.

    columns: name -> (k,): flight, flight_name, t (s), dt (s), v_x v_y v_z (body, m/s), w_x w_y w_z (body, rad/s),
        u_0 .. (N), thrust (N), a_x a_y a_z (body, m/s^2), tau_x tau_y tau_z (body, N m).
    metadata: vehicle {name, fingerprint}, frame, flights [{name, rows, left_out, seed}].
    """

    columns: Mapping[str, np.ndarray]
    metadata: Mapping[str, Any]

    @property
    def n_rows(self) -> int:
        return len(self.columns["flight"]) if "flight" in self.columns else 0

    @property
    def flights(self) -> np.ndarray:
        """Indices of the flights that have rows, ascending."""
        return np.unique(self.columns["flight"])

    def rows(self, selection: np.ndarray) -> ResidualDataset:
        """The same dataset with the rows of a mask or of an index array only."""
        return ResidualDataset({name: column[selection] for name, column in self.columns.items()}, self.metadata)

    def matrix(self, names: Sequence[str]) -> np.ndarray:
        """Columns side by side, (k, len(names)); `thrust` is summed up from the rotors where it is not stored.

        Raises DataError for a column that is missing or not finite, naming it.
        """
        columns = [self._column(name) for name in names]
        return np.stack(columns, axis=1) if columns else np.empty((self.n_rows, 0))

    def _column(self, name: str) -> np.ndarray:
        if name in self.columns:
            column = np.asarray(self.columns[name], float)
        elif name == THRUST and any(key.startswith("u_") for key in self.columns):
            column = np.sum([self.columns[key] for key in self.columns if key.startswith("u_")], axis=0)
        else:
            known = ", ".join(key for key in self.columns if key not in ("flight", "flight_name", "t", "dt"))
            raise DataError(f"dataset: column '{name}' is missing; it has {known or 'no columns'}")
        _require_finite(column, f"dataset: column '{name}'")
        return column

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
        """What a checkpoint remembers of its data: hash, rows, flights, seconds, frame; of recorded flights also their
        names, the target and the thrust curve."""
        recorded = {key: self.metadata[key] for key in ("target", "thrust") if key in self.metadata}
        if recorded:
            recorded["names"] = sorted(set(map(str, self.columns["flight_name"])))
        return recorded | {
            "sha256": self.sha256,
            "rows": self.n_rows,
            "flights": len(self.flights),
            "duration": float(np.sum(self.columns["dt"])) if "dt" in self.columns else None,
            "frame": self.metadata.get("frame"),
        }


def transitions(flight: Flight, vehicle: Vehicle, *, frame: str = "midpoint") -> dict[str, np.ndarray]:
    """Features and targets of every pair of consecutive samples of one flight, without its provenance columns.

    flight: columns t (s, increasing), the state, u_i (N); an optional column `segment` marks resets by its changes,
    optional columns wind_x, wind_y, wind_z (world, m/s) are the velocity of the air.
    frame: "midpoint" or "start", see the module.

    Samples whose dt lies outside 0.5 .. 1.5 of the median, or whose segment differs, are not consecutive.
    Raises DataError for a missing column or a value that is not finite (column and row), UsageError for the frame.
    """
    from quadexp.physics.rotation import air_velocity  # CasADi: reading a model does without it

    if frame not in FRAMES:
        raise UsageError(f"collect.frame: '{frame}' is none of {', '.join(FRAMES)}")
    inputs = input_columns(vehicle.n_rotors)
    t = _read(flight, ("t",))[:, 0]
    state = _read(flight, STATE_COLUMNS)
    thrust = _read(flight, inputs)

    k = _consecutive(t, flight.columns.get("segment"))
    before, after, u, dt = state[k], state[k + 1], thrust[k], np.diff(t)[k]
    before[:, ATTITUDE] = _unit(before[:, ATTITUDE], k)
    after[:, ATTITUDE] = _unit(after[:, ATTITUDE], k + 1)
    after[:, ATTITUDE] *= np.where(np.sum(before[:, ATTITUDE] * after[:, ATTITUDE], axis=1) < 0, -1.0, 1.0)[:, None]

    predicted = _predict(vehicle, before, u, dt)
    point = before if frame == "start" else (before + after) / 2
    to_body = _rotation(point[:, ATTITUDE] / np.linalg.norm(point[:, ATTITUDE], axis=1, keepdims=True))
    air = np.zeros((len(t), 3)) if flight.wind is None else _read(flight, WIND)
    wind = air[k] if frame == "start" else (air[k] + air[k + 1]) / 2
    velocity = air_velocity(point[:, ATTITUDE], point[:, VELOCITY], wind)
    gap = (after - predicted) / dt[:, None]
    acceleration = np.einsum("kij,ki->kj", to_body, gap[:, VELOCITY])
    torque = gap[:, RATE] @ vehicle.inertia_matrix
    if frame == "midpoint":
        # What the gap itself adds to w x J w on its way from 0 to its end, to first order in dt.
        w, inertia = point[:, RATE], vehicle.inertia_matrix
        gyroscopic = np.cross(gap[:, RATE], w @ inertia) + np.cross(w, torque)
        torque = torque + dt[:, None] / 2 * gyroscopic

    columns = {"t": (t[k] + dt / 2 if frame == "midpoint" else t[k]), "dt": dt}
    for prefix, values in (("v", velocity), ("w", point[:, RATE]), ("a", acceleration), ("tau", torque)):
        columns |= {f"{prefix}_{axis}": values[:, i].copy() for i, axis in enumerate("xyz")}
    columns |= {column: u[:, i].copy() for i, column in enumerate(inputs)}
    columns[THRUST] = u.sum(axis=1)
    return columns


def residual_dataset(
    flights: Sequence[Flight],
    vehicle: Vehicle,
    *,
    frame: str = "midpoint",
    names: Sequence[str] | None = None,
) -> ResidualDataset:
    """The transitions of many flights in one table, each row with the flight it came from.

    names: one per flight, for the provenance (its file, say); without it metadata["name"] or `flight_<index>`.

    Raises DataError for a flight of another vehicle, and if no transition is left at all.
    """
    names = names or [str(flight.metadata.get("name") or f"flight_{i}") for i, flight in enumerate(flights)]
    if len(names) != len(flights):
        raise ValueError(f"{len(names)} names for {len(flights)} flights")
    tables, records = [], []
    for index, (flight, name) in enumerate(zip(flights, names, strict=True)):
        flown = (flight.metadata.get("vehicle") or {}).get("fingerprint", vehicle.fingerprint)
        if flown != vehicle.fingerprint:
            raise DataError(f"{name}: flown by vehicle {flown}, not by '{vehicle.name}' ({vehicle.fingerprint})")
        try:
            table = transitions(flight, vehicle, frame=frame)
        except DataError as error:
            raise DataError(f"{name}: {error}") from None
        rows = len(table["t"])
        provenance = {"flight": np.full(rows, index, np.int32), "flight_name": np.full(rows, name, object)}
        tables.append(provenance | table)
        samples = len(np.asarray(flight.columns["t"]))
        left_out = max(samples - 1, 0) - rows
        records.append({"name": name, "rows": rows, "left_out": left_out, "seed": flight.metadata.get("seed")})
    if not any(len(table["t"]) for table in tables):
        raise DataError(f"dataset: {len(flights)} flights hold no transition (two consecutive samples make one)")
    columns = {column: np.concatenate([table[column] for table in tables]) for column in tables[0]}
    vehicle_record = {"name": vehicle.name, "fingerprint": vehicle.fingerprint, "mass": vehicle.mass}
    return ResidualDataset(columns, {"vehicle": vehicle_record, "frame": frame, "flights": records})


def _read(flight: Flight, columns: Sequence[str]) -> np.ndarray:
    """Columns of a flight side by side, (k, len(columns)), finite."""
    for column in columns:
        if column not in flight.columns:
            raise DataError(f"column '{column}' is missing in the flight")
        _require_finite(np.asarray(flight.columns[column], float), f"column '{column}'")
    return np.stack([np.asarray(flight.columns[column], float) for column in columns], axis=1)


def _require_finite(column: np.ndarray, what: str) -> None:
    bad = np.flatnonzero(~np.isfinite(column))
    if len(bad):
        raise DataError(f"{what} holds {column[bad[0]]} in row {bad[0]} ({len(bad)} such rows); all must be finite")


def _consecutive(t: np.ndarray, segment: np.ndarray | None) -> np.ndarray:
    """Indices k for which samples k and k + 1 belong together."""
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
    norm = np.linalg.norm(quaternion, axis=1)
    bad = np.flatnonzero(np.abs(norm - 1) > 0.1)
    if len(bad):
        raise DataError(f"row {rows[bad[0]]}: the quaternion's norm is {norm[bad[0]]:.3g}, it must be 1")
    return quaternion / norm[:, None]


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices body to world, (k, 3, 3), of unit quaternions (k, 4), w first."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix() if len(quaternion) else np.empty((0, 3, 3))


def _predict(vehicle: Vehicle, state: np.ndarray, u: np.ndarray, dt: np.ndarray) -> np.ndarray:
    """The nominal rigid body after dt, row by row: (k, 13)."""
    import casadi as ca

    from quadexp.physics.integrator import rk4_step
    from quadexp.physics.rigid_body import rigid_body_function

    if not len(state):
        return state.copy()
    rigid_body = rigid_body_function(vehicle)
    x, thrust, step = ca.SX.sym("x", state.shape[1]), ca.SX.sym("u", u.shape[1]), ca.SX.sym("dt")
    end = rk4_step(lambda at: rigid_body(at, thrust), x, step)
    return np.array(ca.Function("step", [x, thrust, step], [end])(state.T, u.T, dt[None, :]).full()).T


def read_dataset(path: str | Path) -> ResidualDataset:
    """A residual data set from its file; refuses NaN, naming column and row."""
    columns, record = read_table(path, "residuals", required=("flight", "flight_name", "t", "dt"), finite=True)
    if not len(columns["flight"]):
        raise DataError(f"{path}: the data set has no rows; collect again")
    return ResidualDataset(columns, record)


def feature_rows(velocity: np.ndarray, rate: np.ndarray, thrust: np.ndarray) -> ResidualDataset:
    """Features as a data set: velocity, rate (k, 3), rotor thrusts (k, n) in N."""
    columns = {f"v_{axis}": velocity[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"w_{axis}": rate[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"u_{i}": thrust[:, i] for i in range(thrust.shape[1])}
    return ResidualDataset(columns | {"thrust": thrust.sum(axis=1), "flight": np.zeros(len(velocity), int)}, {})
