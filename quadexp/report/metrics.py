"""How well a flight followed its reference, and the row of results that says it.

With e the position error (m), phi the angle of the rotation between attitude and reference (rad), or, where the path
leaves the heading free, between their thrust axes:

    rmse = sqrt(mean ||e||^2)    mean_error = mean ||e||    max_error = max ||e||    attitude_rmse = sqrt(mean phi^2)
    heading_rmse = sqrt(mean psi^2), psi the difference of the azimuths of y_body, which a prescribed yaw commands; none
                   where the heading is free

Torrente et al. 2021 print mean ||e|| under the name RMSE. All samples of the flight count, ramps included. A flight
that was not flown to its end has no error (log/outcome.py).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.log.outcome import COMPLETED
from quadexp.log.schema import Flight
from quadexp.names import named, without
from quadexp.physics.state import ATTITUDE, POSITION, STATE_COLUMNS, VELOCITY, norms, root_mean_square
from quadexp.report.table import csv_text

SATURATION_MARGIN = 1e-6  # share of the thrust range within which a rotor counts as at its limit
ERRORS = ("rmse", "mean_error", "max_error", "attitude_rmse", "heading_rmse")
METRICS = (
    *ERRORS, "saturated_share", "peak_speed", "duration", "unconverged_count", "solve_time_median", "solve_time_p99",
    "solve_time_max", "command_change", "charge_used",
)  # fmt: skip
# Columns of a row of results, in the order they are written.
SETTING_COLUMNS = ("plant", "vehicle", "trajectory", "speed", "controller", "model", "variant", "seed")
ROW_COLUMNS = (
    *SETTING_COLUMNS, *ERRORS, "solve_time_median",
    "solve_time_p99", "solve_time_max", "saturated_share", "command_change", "charge_used", "peak_speed",
    "duration", "unconverged_count", "reference_residual", "outside_data", "outside_where", "outcome", "backend",
    "cause", "program", "sources", "libraries", "key",
)  # fmt: skip
_NUMBERS = (*METRICS, "speed", "seed", "reference_residual", "outside_data")
TEXT_COLUMNS = tuple(name for name in ROW_COLUMNS if name not in _NUMBERS)
INTEGER_COLUMNS = ("seed", "unconverged_count")


class Shown(NamedTuple):
    """How a number of a flight is printed and drawn. factor: from SI to `unit`."""

    title: str
    factor: float
    unit: str


NUMBERS = {
    "rmse": Shown("RMSE", 1e3, "mm"),
    "mean_error": Shown("mean error", 1e3, "mm"),
    "max_error": Shown("largest error", 1e3, "mm"),
    "attitude_rmse": Shown("attitude error (RMS)", 180 / math.pi, "°"),
    "heading_rmse": Shown("heading error (RMS)", 180 / math.pi, "°"),
    "saturated_share": Shown("samples at a thrust limit", 100.0, "%"),
    "command_change": Shown("change of a command in a step (RMS)", 100.0, "% of the thrust range"),
    "charge_used": Shown("charge used", 100.0, "% of the battery"),
    "outside_data": Shown("outside data", 100.0, "%"),
    "peak_speed": Shown("peak speed", 1.0, "m/s"),
    "duration": Shown("duration", 1.0, "s"),
    "solve_time_median": Shown("solve time median", 1e6, "us"),
    "solve_time_p99": Shown("solve time p99", 1e6, "us"),
    "solve_time_max": Shown("solve time max", 1e6, "us"),
    "success": Shown("completed flights", 100.0, "%"),  # of several flights
}
# Errors that have a table of results.
SHOWN = {name: (NUMBERS[name].factor, NUMBERS[name].unit) for name in ("rmse", "mean_error", "max_error")}


def position_error(flight: Flight) -> np.ndarray:
    """Distance to the reference, (k,) (m)."""
    return norms(np.subtract(*both(flight, POSITION)))


def both(flight: Flight, part: slice) -> list[np.ndarray]:
    """A part of the state, (k, ..), and of the reference state."""
    names = list(STATE_COLUMNS)[part]
    return [flight.stack(names), flight.stack([f"ref_{name}" for name in names])]


def mean_error(flight: Flight) -> float:
    """Mean position error (m) as in the table of results, also of a flight of which only some samples are stored; over
    its samples where it has no row there."""
    return float((flight.metadata.get("row") or {}).get("mean_error") or position_error(flight).mean())


def attitude_error(flight: Flight) -> np.ndarray:
    """phi, (k,) (rad), in [0, pi]; see the module.

    2 atan2(|a - b|, |a + b|) of unit vectors a and b: the thrust axes, or the quaternions, which have half the angle,
    with the sign of b such that |a - b| is the smaller one.
    """
    a, b = (attitude / np.linalg.norm(attitude, axis=1, keepdims=True) for attitude in both(flight, ATTITUDE))
    free = _free(flight)
    if free:
        from quadexp.physics.rotation import thrust_axis  # imports CasADi, which showing a flight does without

        a, b = thrust_axis(a), thrust_axis(b)
    apart, together = norms(a - b), norms(a + b)
    if free:
        return 2 * np.arctan2(apart, together)
    return 4 * np.arctan2(np.minimum(apart, together), np.maximum(apart, together))


def _free(flight: Flight) -> bool:
    return bool(flight.metadata.get("free_heading", False))


def heading_error(flight: Flight) -> np.ndarray:
    """Azimuth of y_body minus that of the reference, (k,) (rad), in [-pi, pi]."""
    from quadexp.physics.rotation import heading  # imports CasADi, which showing a flight does without

    flown, wanted = heading(np.stack(both(flight, ATTITUDE)))
    return np.remainder(flown - wanted + np.pi, 2 * np.pi) - np.pi


def saturated_share(flight: Flight, thrust_min: float, thrust_max: float) -> float:
    """Share of the samples in which at least one rotor is commanded to a limit."""
    margin = SATURATION_MARGIN * (thrust_max - thrust_min)
    thrust = flight.input
    at_limit = (thrust <= thrust_min + margin) | (thrust >= thrust_max - margin)
    return float(at_limit.any(axis=1).mean())


def command_change(flight: Flight, thrust_min: float, thrust_max: float, every: int = 1) -> float:
    """Root mean square, over rotors and steps, of a command's change from one step of the controller to the next, as a
    share of the thrust range; NaN for one step. every: samples in a step."""
    changes = np.diff(flight.input[::every], axis=0) / (thrust_max - thrust_min)
    return float(np.sqrt(np.mean(changes**2))) if changes.size else math.nan


def charge_used(flight: Flight) -> float:
    """Share of the full battery that a flight used; NaN without a battery."""
    if "state_of_charge" not in flight.columns:
        return math.nan
    charge = flight["state_of_charge"]
    return float(charge[0] - charge[-1])


def flight_metrics(flight: Flight, thrust_min: float, thrust_max: float, period: float | None = None) -> dict[str, Any]:
    """The numbers of a result row that come from the flight itself; NaN for a flight without samples, and the errors
    of one that was not flown to its end.

    period: between two steps of the controller (s), None for that of the samples. Between its steps an inner loop has
    instants of its own, which are no steps of the controller.
    """
    if len(flight) == 0:
        return dict.fromkeys(METRICS, float("nan")) | {"unconverged_count": 0, "duration": 0.0}
    error, angle, t = position_error(flight), attitude_error(flight), flight.t
    every = max(1, round(period / (t[1] - t[0]))) if period and len(t) > 1 and t[1] > t[0] else 1
    solve_time, unconverged = flight["solve_time"][::every], flight.columns.get("unconverged", np.zeros(0))[::every]
    last, ordered = len(solve_time) - 1, np.sort(solve_time)  # a third of the time of np.quantile
    median, p99, longest = np.interp([0.5 * last, 0.99 * last, last], np.arange(last + 1), ordered).tolist()
    metrics = {
        "rmse": root_mean_square(error),
        "mean_error": float(np.mean(error)),
        "max_error": float(np.max(error)),
        "attitude_rmse": root_mean_square(angle),
        "heading_rmse": None if _free(flight) else root_mean_square(heading_error(flight)),
        "saturated_share": saturated_share(flight, thrust_min, thrust_max),
        "peak_speed": float(norms(both(flight, VELOCITY)[0]).max()),
        "duration": float(t[-1] - t[0]),
        "unconverged_count": int(np.sum(unconverged)),
        "solve_time_median": median,
        "solve_time_p99": p99,
        "solve_time_max": longest,
        "command_change": command_change(flight, thrust_min, thrust_max, every),
        "charge_used": charge_used(flight),
    }
    return metrics | errors_none(flight.outcome)


def renewed(flight: Flight) -> dict[str, Any]:
    """The metadata of a flight whose samples are no longer those that were flown: the numbers of its row are of the
    samples that are there, in the order of time; without a row where these do not suffice."""
    metadata = without(flight.metadata, ("row", "thinned"))
    row, config = flight.metadata["row"], flight.metadata["config"]
    limits, rate = config["vehicle"], config["controller"].get("rate")
    try:
        numbers = flight_metrics(flight, limits["thrust_min"], limits["thrust_max"], 1 / rate if rate else None)
    except DataError:
        return metadata
    return metadata | {"row": {**row, **numbers, "outside_data": None}, "outside_data": None}


def errors_none(outcome: Any) -> dict[str, float]:
    """The errors of a flight with this outcome as far as they are none; {} where it was flown to its end."""
    return {} if outcome in COMPLETED else dict.fromkeys(ERRORS, math.nan)


def to_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of results as CSV, numbers in full precision."""
    return csv_text(ROW_COLUMNS, ([row.get(name) for name in ROW_COLUMNS] for row in rows))


def to_columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Rows of results as columns of fixed types, for Parquet."""
    kinds = dict.fromkeys(ROW_COLUMNS, float) | dict.fromkeys(TEXT_COLUMNS, object)
    kinds |= dict.fromkeys(INTEGER_COLUMNS, np.int64)
    return {name: np.array([typed(name, row.get(name)) for row in rows], kinds[name]) for name in ROW_COLUMNS}


def typed(name: str, value: Any) -> Any:
    """A value in the type of its column: a missing text is empty, a missing count zero, another number NaN."""
    if name in TEXT_COLUMNS:
        return "" if value is None else str(value)
    if name in INTEGER_COLUMNS:
        return 0 if value is None else int(value)
    return math.nan if value is None else float(value)


def from_columns(columns: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Rows of results from the columns of their file; a flight that was lost has no errors, whatever wrote it."""
    lists = (column.tolist() for column in columns.values())
    rows = (named(columns, values) for values in zip(*lists, strict=True))
    return [row | errors_none(row["outcome"]) for row in rows]
