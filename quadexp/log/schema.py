"""What a flight is: named columns over time, each with one unit and one frame, and the record of where it came from.

The unit and frame of every column this program writes are stated once, here or by the plug-in that writes it (seam
`columns`: by kind of table, by name), and travel with the file (Arrow field metadata), so that a reader in another
language needs nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.physics.state import STATE_COLUMNS, input_columns
from quadexp.plugin import brought, shipped_places


class Column(NamedTuple):
    """unit: SI. frame: "world" (ENU), "body" (FLU) or "". description: one phrase."""

    unit: str
    frame: str
    description: str


Columns = dict[str, Column]
SOME_ROTORS = [[0.17, -0.17, 0.0], [-0.17, -0.17, 0.0], [-0.17, 0.17, 0.0], [0.17, 0.17, 0.0]]  # m, unless recorded
_AXES = "xyz"


def each(name: str, unit: str, frame: str, description: str, axes: str = _AXES) -> Columns:
    """A column for each axis of a vector."""
    return {f"{name}_{i}": Column(unit, frame, description) for i in axes}


def besides(prefix: str, columns: Columns, description: str = "{}") -> Columns:
    """The same columns in another role, which the description says."""
    return {f"{prefix}{k}": c._replace(description=description.format(c.description)) for k, c in columns.items()}


_STATE = {
    **each("p", "m", "world", "position"),
    **each("q", "1", "body to world", "attitude quaternion, Hamilton, w first", "wxyz"),
    **each("v", "m/s", "world", "velocity"),
    **each("w", "rad/s", "body", "angular velocity"),
}
BIAS = {
    **each("bias_a", "m/s^2", "body", "bias of the accelerometer"),
    **each("bias_g", "rad/s", "body", "bias of the gyroscope"),
}

FLIGHT_COLUMNS: Columns = {
    "t": Column("s", "", "time since the start of the flight"),
    **_STATE,
    **besides("ref_", _STATE, "reference {}"),
    **besides("est_", _STATE, "{}, as the controller was given it"),
    **each("acc", "m/s^2", "body", "specific force an accelerometer reads"),
    **BIAS,
    "solve_time": Column("s", "", "wall time of the control step; the only column that two runs may differ in"),
    "status": Column("1", "", "0 riccati, 1 active_set, 3 failed"),
    "sweeps": Column("1", "", "exchanges of the active set in the control step"),
    "active": Column("1", "", "input bounds active over the horizon"),
    "unconverged": Column("1", "", "1: the first step's iterations ended away from a stationary point"),
    "kkt": Column("1", "", "KKT residual of the control step"),
    "segment": Column("1", "", "number of the uninterrupted stretch the sample belongs to"),
    **each("wind", "m/s", "world", "velocity of the air"),
    "thrust_acceleration": Column("m/s^2", "body", "collective thrust over mass, as the log has it"),
    "battery_voltage": Column("V", "", "voltage of the battery"),
    "est_battery_voltage": Column("V", "", "voltage of the battery, as a sensor reads it"),
    "battery_current": Column("A", "", "current that is drawn from the battery"),
    "state_of_charge": Column("1", "", "charge left in the battery, of the full one"),
}

RESIDUAL_COLUMNS: Columns = {
    "flight": Column("1", "", "number of the flight the row comes from"),
    "flight_name": Column("", "", "name of the flight the row comes from"),
    "t": Column("s", "", "time since the start of the flight"),
    "dt": Column("s", "", "duration of the transition"),
    **each("v", "m/s", "body", "velocity"),
    **each("w", "rad/s", "body", "angular velocity"),
    "thrust": Column("N", "body", "collective thrust commanded"),
    **each("a", "m/s^2", "body", "acceleration the rigid body does not explain"),
    **each("tau", "N m", "body", "torque the rigid body does not explain"),
}

RESULT_COLUMNS: Columns = {
    "speed": Column("m/s", "", "nominal speed of the trajectory; asked peak speed of a random path or of waypoints"),
    "rmse": Column("m", "world", "sqrt(mean ||e||^2) of the position error e"),
    "mean_error": Column("m", "world", "mean ||e||; Torrente et al. 2021 print this one as RMSE"),
    "max_error": Column("m", "world", "max ||e||"),
    "attitude_rmse": Column(
        "rad", "", "sqrt(mean angle^2) between attitude and reference; heading left out where free"
    ),
    "heading_rmse": Column("rad", "", "sqrt(mean angle^2) between the azimuths of y_body and of the reference's"),
    "solve_time_median": Column("s", "", "wall time of the control step"),
    "solve_time_p99": Column("s", "", "wall time of the control step"),
    "solve_time_max": Column("s", "", "wall time of the control step"),
    "saturated_share": Column("1", "", "share of samples with a rotor at its thrust limit"),
    "command_change": Column("1", "", "change of a command in a step, as a share of the thrust range (RMS)"),
    "charge_used": Column("1", "", "share of the full battery that was used"),
    "peak_speed": Column("m/s", "world", "largest speed flown"),
    "duration": Column("s", "", "length of the flight"),
    "unconverged_count": Column("1", "", "1 where the first step ended away from a stationary point"),
    "reference_residual": Column(
        "1",
        "",
        "share of the controller's residual that the reference contains, mean over the flight; empty: none by design",
    ),
    "outside_data": Column(
        "1", "", "share of samples outside the data of the controller's learned model; NaN without one, or unknown"
    ),
    "outside_where": Column("", "world", "the longest stretch of them, in s, and the position in its middle, in m"),
}

# One row per metric, condition and contestant; `unit` names the unit of the columns that are in the metric's own.
_OWN = "see `unit`"
STATISTIC_COLUMNS: Columns = {
    "speed": RESULT_COLUMNS["speed"],
    "setting": Column("", "", "what else varies between the conditions"),
    "variant": Column("", "", "settings of the controller that vary"),
    "label": Column("", "", "controller, and its settings that differ from the others'"),
    "confidence": Column("1", "", "of every interval"),
    "seeds": Column("1", "", "cells asked for"),
    "trials": Column("1", "", "cells that are valid"),
    "n": Column("1", "", "completed flights, which the mean is over"),
    "mean": Column(_OWN, "", "mean over its own completed flights"),
    **{f: Column(_OWN, "", f"{end} limit of the mean") for f, end in (("low", "lower"), ("high", "upper"))},
    "std": Column(_OWN, "", "standard deviation over the seeds"),
    "interval": Column("", "", "t (Student's), or none: fewer than two values, or all the same"),
    "common": Column("1", "", "flights that all compared controllers completed; 0: not compared"),
    "common_mean": Column(_OWN, "", "mean over the common flights"),
    "common_std": Column(_OWN, "", "standard deviation over the common flights"),
    "common_interval": Column("", "", "as interval, of the common mean"),
    "best_p": Column("1", "", "p of the least of a line against all others; see report/winner.py"),
    "success": Column("1", "", "share of the trials that completed; limits by Clopper and Pearson"),
    "baseline": Column("", "", "label of the baseline"),
    "pairs": Column("1", "", "flights that both completed"),
    "left_out": Column("", "", "seeds that make no pair, by cause"),
    "baseline_mean": Column(_OWN, "", "mean of the baseline over the pairs"),
    "difference": Column(_OWN, "", "mean of contestant - baseline over the pairs"),
    "reduction": Column("%", "", "100 (1 - mean / baseline mean) over the pairs"),
    "effect": Column("1", "", "matched-pairs rank-biserial correlation, positive where smaller than the baseline"),
    "p": Column("1", "", "paired permutation test of the ln of the ratio, two-sided; see report/inference.py"),
    "conditions": Column("1", "", "over how many conditions"),
    "units": Column("1", "", "seeds that are compared"),
    "between": Column("", "", "the least and the largest reduction of a single condition"),
    "p_holm": Column("1", "", "p corrected for the number of comparisons; see report/significance.py"),
    "p_least": Column("1", "", "the least p that so many seeds can give"),
    "comparisons": Column("1", "", "over how many p_holm is corrected"),
}
for _name in ("success", "difference", "reduction", "common"):
    for _end in ("low", "high"):
        STATISTIC_COLUMNS[f"{_name}_{_end}"] = STATISTIC_COLUMNS[_name]._replace(description=f"{_end} limit of {_name}")

_BY_KIND = {
    "flight": FLIGHT_COLUMNS,
    "residuals": RESIDUAL_COLUMNS,
    "results": RESULT_COLUMNS,
    "statistics": STATISTIC_COLUMNS,
}
_OF_ROTORS = {  # of columns with the number of a rotor behind
    "u": Column("N", "body", "commanded static rotor thrust"),
    "ref_u": Column("N", "body", "reference static rotor thrust"),
    "rotor_speed": Column("rad/s", "", "rotor speed"),
    "est_rotor_speed": Column("rad/s", "", "rotor speed, as the controller was given it"),
    "delivered": Column("N", "body", "static thrust that the rotor delivers"),
    "motor_command": Column("1", "", "normalised command of the motor, 0 to 1"),
    "induced_velocity": Column("m/s", "body", "induced velocity through the rotor, downwards"),
}


def describe(name: str, kind: str = "flight") -> Column:
    """Unit, frame and meaning of a column; an unknown name has none (a user's own column is kept, not refused)."""
    known = _BY_KIND.get(kind, {}).get(name)
    if known is not None:
        return known
    if name.startswith("taken_"):
        return Column("s", "", f"when the reading of the {name.removeprefix('taken_')} was taken that is given")
    quantity, _, rotor = name.rpartition("_")
    if rotor.isdecimal() and quantity in _OF_ROTORS:
        return _OF_ROTORS[quantity]
    return _of_plugins(kind).get(name, Column("", "", ""))


@cache
def _of_plugins(kind: str) -> Columns:
    """The columns that plug-ins bring to a kind of tables."""
    columns: Columns = {}
    for place in shipped_places("columns"):
        columns |= brought("columns", place).get(kind, {})
    return columns


def n_inputs(columns: Any) -> int:
    """Number of rotors a table's columns speak of."""
    return sum(1 for name in columns if name.startswith("u_") and name[2:].isdecimal())


@dataclass(frozen=True)
class Flight:
    """One flight: columns over time (each (k,)), and metadata that can be written as JSON.

    Columns carry the names, units and frames of `FLIGHT_COLUMNS`. Metadata: config, seed, vehicle, plant, trajectory,
    controller, model, outcome (see outcome.py), versions, provenance.
    """

    columns: dict[str, np.ndarray]
    metadata: dict[str, Any]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()))) if self.columns else 0

    def __getitem__(self, name: str) -> np.ndarray:
        try:
            return self.columns[name]
        except KeyError:
            raise DataError(f"the flight has no column {name!r}") from None

    def stack(self, names: tuple[str, ...] | list[str]) -> np.ndarray:
        """Several columns side by side, (k, len(names))."""
        return np.stack([self[name] for name in names], axis=-1)

    @property
    def n_rotors(self) -> int:
        return n_inputs(self.columns)

    @property
    def t(self) -> np.ndarray:
        """Time, (k,) (s)."""
        return self["t"]

    @property
    def state(self) -> np.ndarray:
        """State, (k, 13), in the order of quadexp/physics/state.py."""
        return self.stack(STATE_COLUMNS)

    @property
    def input(self) -> np.ndarray:
        """Commanded rotor thrusts, (k, n) (N)."""
        return self.stack(input_columns(self.n_rotors))

    @property
    def wind(self) -> np.ndarray | None:
        """Velocity of the air, (k, 3), world (m/s); None for a flight without wind columns."""
        names = tuple(f"wind_{axis}" for axis in _AXES)
        return self.stack(names) if any(name in self.columns for name in names) else None

    @property
    def air_velocity(self) -> np.ndarray:
        """Velocity relative to the air, (k, 3), body (m/s); see rotation.air_velocity."""
        from quadexp.physics.rotation import air_velocity

        attitude, velocity = (tuple(f"{name}_{axis}" for axis in axes) for name, axes in (("q", "wxyz"), ("v", _AXES)))
        return air_velocity(self.stack(attitude), self.stack(velocity), self.wind)

    @property
    def rotor_position(self) -> np.ndarray:
        """Of the rotors in the body, (n, 3) (m), as the vehicle's record has them; else of any small vehicle."""
        vehicle = self.metadata.get("config", {}).get("vehicle") or {}
        return np.array(vehicle.get("rotor_position") or SOME_ROTORS, float)

    @property
    def reference_state(self) -> np.ndarray:
        """Reference state, (k, 13)."""
        return self.stack([f"ref_{name}" for name in STATE_COLUMNS])

    @property
    def outcome(self) -> str:
        return str(self.metadata.get("outcome", "ok"))


def is_recorded(flight: Flight) -> bool:
    """Whether the flight comes from a log, not from a simulated plant."""
    return bool(flight.metadata.get("recorded", False))


BIAS_COLUMNS = tuple(f"bias_{kind}_{axis}" for kind in "ag" for axis in "xyz")
