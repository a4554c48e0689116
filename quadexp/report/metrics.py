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
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.log.outcome import COMPLETED
from quadexp.log.schema import Flight
from quadexp.names import named, without
from quadexp.parts.part import Part
from quadexp.parts.settings import keyed
from quadexp.parts.user_modules import fault
from quadexp.physics.state import ATTITUDE, POSITION, STATE_COLUMNS, VELOCITY, norms, root_mean_square
from quadexp.report.table import csv_text

SATURATION_MARGIN = 1e-6  # share of the thrust range within which a rotor counts as at its limit


class Flown:
    """A flight with what several numbers of it are made from, computed once.

    thrust_min, thrust_max: of a rotor (N). period: between two steps of the controller (s), None for that of the
    samples. Between its steps an inner loop has instants of its own, which are no steps of the controller.
    """

    def __init__(self, flight: Flight, thrust_min: float, thrust_max: float, period: float | None = None) -> None:
        self.flight = flight
        self.thrust_min = thrust_min
        self.thrust_max = thrust_max
        self.every = 1
        t = flight.t
        if period and len(t) > 1 and t[1] > t[0]:
            self.every = max(1, round(period / (t[1] - t[0])))

    @cached_property
    def error(self) -> np.ndarray:
        return position_error(self.flight)

    @cached_property
    def solve_times(self) -> list[float]:
        """Median, 99 % quantile and largest, s."""
        solve_time = self.flight["solve_time"][:: self.every]
        last = len(solve_time) - 1
        ordered = np.sort(solve_time)  # a third of the time of np.quantile
        return list(np.interp([0.5 * last, 0.99 * last, last], np.arange(last + 1), ordered).tolist())

    @property
    def heading_rmse(self) -> float | None:
        return None if _free(self.flight) else root_mean_square(heading_error(self.flight))

    @property
    def unconverged(self) -> int:
        return int(np.sum(self.flight.columns.get("unconverged", np.zeros(0))[:: self.every]))


@dataclass(frozen=True)
class Metric:
    """A number of a flight. function: of Flown; None of one that is only read from a table. title: in tables and
    figures. factor: from SI to their unit. error: of the path, so that a flight that was not flown to its end has none.
    tabled: whether it has a table, which evaluate.metric chooses. more_is_better: then no controller is called best."""

    name: str
    function: Callable[[Flown], Any] | None
    title: str = ""
    factor: float = 1.0
    unit: str = ""
    error: bool = False
    tabled: bool = False
    more_is_better: bool = False


_DEGREES = 180 / math.pi
_METRICS = (
    Metric("rmse", lambda f: root_mean_square(f.error), "RMSE", 1e3, "mm", error=True, tabled=True),
    Metric("mean_error", lambda f: float(np.mean(f.error)), "mean error", 1e3, "mm", error=True, tabled=True),
    Metric("max_error", lambda f: float(np.max(f.error)), "largest error", 1e3, "mm", error=True, tabled=True),
    Metric(
        "attitude_rmse", lambda f: root_mean_square(attitude_error(f.flight)), "attitude error (RMS)", _DEGREES, "°",
        error=True,
    ),
    Metric("heading_rmse", lambda f: f.heading_rmse, "heading error (RMS)", _DEGREES, "°", error=True),
    Metric(
        "saturated_share", lambda f: saturated_share(f.flight, f.thrust_min, f.thrust_max), "samples at a thrust limit",
        100.0, "%",
    ),
    Metric("peak_speed", lambda f: float(norms(both(f.flight, VELOCITY)[0]).max()), "peak speed", 1.0, "m/s"),
    Metric("duration", lambda f: float(f.flight.t[-1] - f.flight.t[0]), "duration", 1.0, "s"),
    Metric("unconverged_count", lambda f: f.unconverged, "unconverged count"),
    Metric("solve_time_median", lambda f: f.solve_times[0], "solve time median", 1e6, "us"),
    Metric("solve_time_p99", lambda f: f.solve_times[1], "solve time p99", 1e6, "us"),
    Metric("solve_time_max", lambda f: f.solve_times[2], "solve time max", 1e6, "us"),
    Metric(
        "command_change", lambda f: command_change(f.flight, f.thrust_min, f.thrust_max, f.every),
        "change of a command in a step (RMS)", 100.0, "% of the thrust range",
    ),
    Metric("charge_used", lambda f: charge_used(f.flight), "charge used", 100.0, "% of the battery"),
)  # fmt: skip
METRICS = tuple(metric.name for metric in _METRICS)
ERRORS = tuple(metric.name for metric in _METRICS if metric.error)
# What else is printed as a number of flights.
_BESIDE = (
    Metric("outside_data", None, "outside data", 100.0, "%"),
    Metric("success", None, "completed flights", 100.0, "%"),  # of several flights
)
_KNOWN = {metric.name: metric for metric in (*_METRICS, *_BESIDE)}
_own: dict[str, Metric] = {}  # of the user's, see `declare`

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


@keyed
class FlightMetric(Part):
    """A user's metric, as an option of the group `metric`: title, factor, unit and the others are those of Metric.

    It is a function of a flight as it is stored: of all samples unless evaluate.log_period thins them."""

    prefix = "metric."
    title: ClassVar[str] = ""
    factor: ClassVar[float] = 1.0
    unit: ClassVar[str] = ""
    error: ClassVar[bool] = True
    tabled: ClassVar[bool] = True
    more_is_better: ClassVar[bool] = False

    def of(self, flight: Flight) -> float:
        """Its value, in SI units: flight["p_z"] is a column, (k,)."""
        raise NotImplementedError

    @property
    def metric(self) -> Metric:
        return Metric(
            self.name,
            lambda flown: self.of(flown.flight),
            self.title or self.name.replace("_", " "),
            self.factor,
            self.unit,
            self.error,
            self.tabled,
            self.more_is_better,
        )


def declare(metrics: Iterable[Metric]) -> None:
    """Have tables, figures and conditions know a user's metrics. Raises UsageError where a name is taken."""
    for metric in metrics:
        texts = isinstance(metric.title, str) and isinstance(metric.unit, str)
        if not texts or not isinstance(metric.factor, (int, float)) or not 0 < abs(metric.factor) < math.inf:
            about = f"title {metric.title!r}, unit {metric.unit!r}, factor {metric.factor!r}"
            raise UsageError(f"metric={metric.name}: {about}: two texts and a number that is not 0 are needed")
        if metric.name in (*ROW_COLUMNS, *_KNOWN):
            raise UsageError(f"metric={metric.name}: results have a column of that name: choose another one")
        _own[metric.name] = metric


def declare_parts(parts: Iterable[FlightMetric]) -> None:
    """Those of options, and no others."""
    _own.clear()
    declare(part.metric for part in parts)


def own_record() -> dict[str, Any]:
    """The user's metrics, for the record of the results; empty without any."""
    about = {name: without(vars(metric), ("name", "function")) for name, metric in _own.items()}
    return {"metrics": about} if about else {}


def declare_record(record: Mapping[str, Any]) -> None:
    """Those of a table of results, which it says itself."""
    declare(Metric(name, None, **about) for name, about in record.get("metrics", {}).items() if name not in _own)


def metric_of(name: str) -> Metric:
    """What is known of a metric; an unknown one has no unit."""
    return _KNOWN.get(name) or _own.get(name) or Metric(name, None, name.replace("_", " "))


def tabled() -> tuple[str, ...]:
    """Names of the metrics that have a table."""
    return tuple(metric.name for metric in (*_METRICS, *_own.values()) if metric.tabled)


def is_own(name: str) -> bool:
    """Whether a metric is a user's."""
    return name in _own


def is_measured() -> bool:
    """Whether flights are to be measured by metrics of the user's."""
    return any(metric.function for metric in _own.values())


def measured(flight: Flight) -> dict[str, float]:
    """The user's metrics of a flight. Raises UsageError where one fails, or gives no number."""
    values = {}
    fixed = Flight({name: _fixed(column) for name, column in flight.columns.items()}, flight.metadata)
    for metric in _own.values():
        values[metric.name] = math.nan
        if metric.function is None or not len(flight) or (metric.error and flight.outcome not in COMPLETED):
            continue
        try:
            values[metric.name] = _finite(metric.function(Flown(fixed, math.nan, math.nan)))
        except Exception as error:
            raise UsageError(f"metric={metric.name}: of(flight): {fault(error)}") from error
    return values


def _fixed(column: np.ndarray) -> np.ndarray:
    """A column that a metric cannot write into: it may be stored after it."""
    view = column.view()
    view.flags.writeable = False
    return view


def _finite(value: Any) -> float:
    """A number, or NaN, of which tables say that there is none."""
    number = float(value)
    return number if math.isfinite(number) else math.nan


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
    row = flight.metadata.get("row") or {}
    return float(row.get("mean_error") or position_error(flight).mean())


def attitude_error(flight: Flight) -> np.ndarray:
    """phi, (k,) (rad), in [0, pi]; see the module.

    2 atan2(|a - b|, |a + b|) of unit vectors a and b: the thrust axes, or the quaternions, which have half the angle,
    with the sign of b such that |a - b| is the smaller one.
    """
    a, b = both(flight, ATTITUDE)
    a = a / np.linalg.norm(a, axis=1, keepdims=True)
    b = b / np.linalg.norm(b, axis=1, keepdims=True)
    free = _free(flight)
    if free:
        from quadexp.physics.rotation import thrust_axis  # imports CasADi, which showing a flight does without

        a = thrust_axis(a)
        b = thrust_axis(b)
    apart = norms(a - b)
    together = norms(a + b)
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


def charge_used(flight: Flight) -> float | None:
    """Share of the full battery that a flight used; None without a battery."""
    if "state_of_charge" not in flight.columns:
        return None
    charge = flight["state_of_charge"]
    return float(charge[0] - charge[-1])


def flight_metrics(flight: Flight, thrust_min: float, thrust_max: float, period: float | None = None) -> dict[str, Any]:
    """The numbers of a result row that come from the flight itself; NaN for a flight without samples, and the errors
    of one that was not flown to its end.

    period: see Flown.
    """
    if len(flight) == 0:
        return dict.fromkeys(METRICS, float("nan")) | {"unconverged_count": 0, "duration": 0.0}
    flown = Flown(flight, thrust_min, thrust_max, period)
    metrics = {metric.name: metric.function(flown) for metric in _METRICS if metric.function}
    return metrics | errors_none(flight.outcome)


def renewed(flight: Flight) -> dict[str, Any]:
    """The metadata of a flight whose samples are no longer those that were flown: the numbers of its row are of the
    samples that are there, in the order of time; without a row where these do not suffice."""
    metadata = without(flight.metadata, ("row", "thinned"))
    row = flight.metadata["row"]
    config = flight.metadata["config"]
    limits = config["vehicle"]
    rate = config["controller"].get("rate")
    try:
        numbers = flight_metrics(flight, limits["thrust_min"], limits["thrust_max"], 1 / rate if rate else None)
    except DataError:
        return metadata
    return metadata | {"row": {**row, **numbers, "outside_data": None}, "outside_data": None}


def errors_none(outcome: Any) -> dict[str, float]:
    """The errors of a flight with this outcome as far as they are none; {} where it was flown to its end."""
    return {} if outcome in COMPLETED else dict.fromkeys(ERRORS, math.nan)


def row_columns(rows: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Columns of rows of results with those metrics of the user's that they have."""
    return (*ROW_COLUMNS, *(name for name in _own if rows and name in rows[0]))


def to_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of results as CSV, numbers in full precision."""
    names = row_columns(rows)
    return csv_text(names, ([row.get(name) for name in names] for row in rows))


def to_columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Rows of results as columns of fixed types, for Parquet."""
    kinds = dict.fromkeys(row_columns(rows), float) | dict.fromkeys(TEXT_COLUMNS, object)
    kinds |= dict.fromkeys(INTEGER_COLUMNS, np.int64)
    return {name: np.array([typed(name, row.get(name)) for row in rows], kinds[name]) for name in kinds}


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
