"""What to draw of a sweep: which keys are x, lines and panels; chosen by what was swept where nobody says.

    one key        it is x, the controllers are lines, the trajectories panels
    two keys       the longer one is x, the other one lines, or panels beside the controllers; and a heat map of both
    more           parallel coordinates: a line a combination, from the values of its keys to its error

A figure shows every panel, or says which it leaves out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.report.frame import ALIASES, SweepFrame, is_metric, is_number, setting_text, with_unit
from quadexp.report.points import SUCCESS, Place, Point, points, shown_column
from quadexp.report.text import count, listed
from quadexp.report.text import shown as unit_shown

Kind = Literal["lines", "heat", "parallel"]
What = tuple[Kind, str, Sequence[str], Sequence[str]]  # kind, x, by, facet
WHO = ("controller", "model")
MOST_LINES = 12  # in a panel, before a key makes panels instead
Y_TITLES = {
    "mean_error": "mean error", "rmse": "RMSE", "max_error": "largest error", "attitude_rmse": "attitude error (RMS)",
    "heading_rmse": "heading error (RMS)", SUCCESS: "completed flights",
    "saturated_share": "samples at a thrust limit",
}  # fmt: skip
Y_UNITS = {SUCCESS: (100.0, "%"), "saturated_share": (100.0, "%"), "outside_data": (100.0, "%"),
           "peak_speed": (1.0, "m/s"), "duration": (1.0, "s")}  # fmt: skip
Y_UNITS |= dict.fromkeys(("solve_time_median", "solve_time_p99", "solve_time_max"), (1e6, "us"))


@dataclass(frozen=True)
class Axis:
    """A key as an axis. values: in their order. kind: "number" where values are numbers, otherwise "group"."""

    key: str
    values: tuple[Any, ...]
    kind: Literal["number", "group"]

    @classmethod
    def of(cls, key: str, values: Sequence[Any]) -> Axis:
        return cls(key, tuple(values), "number" if values and all(map(is_number, values)) else "group")

    @property
    def scale(self) -> Literal["linear", "log", "symlog"]:
        """Logarithmic for three or more positive values that are rather spaced by a ratio than by a difference, over a
        factor of 4 or more; symlog where zero is among them."""
        if self.kind == "group":
            return "linear"
        positive = [float(value) for value in self.values if value > 0]
        if len(positive) < 3 or min(map(float, self.values)) < 0 or positive[-1] < 4 * positive[0]:
            return "linear"
        steps = [b - a for a, b in zip(positive, positive[1:], strict=False)]
        ratios = [math.log(b / a) for a, b in zip(positive, positive[1:], strict=False)]
        if max(ratios) / min(ratios) >= max(steps) / min(steps):
            return "linear"
        return "log" if len(positive) == len(self.values) else "symlog"

    @property
    def label(self) -> str:
        return with_unit(self.key, self.key)

    def text(self, value: Any) -> str:
        return value_text(self.key, value)


@dataclass(frozen=True)
class View:
    """A figure to be drawn. y: a column of numbers, or "success". by: keys of the lines (of a heat map its rows).
    facet: keys of the panels. others: keys that vary and are averaged. notes: what a reader has to know. alone: who
    flew and what, as far as all flights share it: values of the controller, its model, the trajectory and the speed."""

    kind: Kind
    y: str
    x: Axis
    by: tuple[str, ...] = ()
    facet: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    along: tuple[Axis, ...] = ()
    confidence: float = 0.95
    notes: tuple[str, ...] = ()
    places: dict[Place, Point] = field(default_factory=dict)
    alone: dict[str, Any] = field(default_factory=dict)

    @property
    def keys(self) -> tuple[str, ...]:
        """What a place has a value of, in this order."""
        if self.kind == "parallel":
            return tuple(axis.key for axis in self.along)
        return (*self.facet, *self.by, self.x.key)

    @property
    def panels(self) -> list[Place]:
        """The panels, in the order of the values of their keys."""
        found = list(dict.fromkeys(place[: len(self.facet)] for place in self.places))
        return sorted(found, key=lambda one: [_order(value) for value in one]) if self._sortable(found) else found

    def lines(self) -> list[Place]:
        """The values of `by`, the same in every panel."""
        start = len(self.facet)
        found = list(dict.fromkeys(place[start : start + len(self.by)] for place in self.places))
        return sorted(found, key=lambda one: [_order(value) for value in one]) if self._sortable(found) else found

    @staticmethod
    def _sortable(found: Sequence[Place]) -> bool:
        return all(all(map(is_number, values)) for values in zip(*found, strict=True))

    @property
    def file_name(self) -> str:
        """What a file of this figure is called: "against_nodes", "map_of_nodes_and_horizon"."""
        if self.kind == "parallel":
            return "over_all_keys"
        x, *others = (key.rpartition(".")[2] for key in (self.x.key, *self.by))
        return f"map_of_{x}_and_{others[0]}" if self.kind == "heat" else f"against_{x}"

    @property
    def factor(self) -> float:
        return unit_and_factor(self.y)[0]

    @property
    def unit(self) -> str:
        return unit_and_factor(self.y)[1]

    @property
    def y_label(self) -> str:
        title = Y_TITLES.get(self.y, self.y.replace("_", " "))
        return f"{title} ({self.unit})" if self.unit else title

    @property
    def caption(self) -> str:
        """Who flew, and what the means and bars are, in a line."""
        return "; ".join(filter(None, (self.title(tuple(self.alone), tuple(self.alone.values())), self._bars)))

    @property
    def _bars(self) -> str:
        shown = [point for point in self.places.values() if point.is_shown]
        if self.y == SUCCESS:
            exact = any(math.isfinite(point.low) for point in self.places.values())
            bars = f"; bars: its {100 * self.confidence:g} % interval (Clopper-Pearson)" if exact else ""
            return f"share of flights{bars}"
        seeds = sorted({point.seeds for point in shown})
        over = "one flight each" if seeds == [1] and not self.others else f"mean over {_span(seeds)}"
        if self.kind != "lines":
            return over
        known = any(point.method == "t" for point in shown)
        return over + (f"; bars: its {100 * self.confidence:g} % interval (Student's t)" if known else "")

    def title(self, keys: Sequence[str], values: Place) -> str:
        return ", ".join(
            value_text(key, value)
            if key in ("trajectory", *WHO)
            else f"{value_text(key, value)} m/s"
            if key == "trajectory.speed"
            else setting_text(key, value)
            for key, value in zip(keys, values, strict=True)
        )


def view(
    frame: SweepFrame, *, y: str = "mean_error", x: str | None = None, by: Sequence[str] | None = None,
    facet: Sequence[str] | None = None, kind: Kind | None = None, confidence: float = 0.95,
) -> View:  # fmt: skip
    """The view that is asked for, completed by what was swept. by, facet: None to choose.

    Raises UsageError for a key that is none, a key that is given twice, or where nothing can be drawn.
    """
    _check_y(frame, y)
    if x is None and kind is None and not by and not facet:
        return automatic(frame, y, confidence)[0]
    if kind == "parallel":
        return _made(frame, _parallel(frame, [*([x] if x else []), *(by or ())] or None), y, confidence)
    given = [ALIASES.get(key, key) for key in [*([x] if x else []), *(by or ()), *(facet or ())]]
    for key in given:
        _check_key(frame, key)
        if given.count(key) > 1:
            raise UsageError(f"{key}: stands twice among --x, --by and --facet")
    told = {"model"} if any(key.startswith("model.") for key in given) else set()
    free = [key for key in frame.swept if key not in (*given, "seed", *told)]
    x = ALIASES.get(x, x) if x else _longest(frame, [k for k in free if k not in (*WHO, "trajectory")] or free)
    free = [key for key in free if key != x]
    own_by = [ALIASES.get(key, key) for key in by or ()]
    own_facet = [ALIASES.get(key, key) for key in facet or ()]
    who = [key for key in WHO if key in free]
    if kind == "heat":
        if not own_by:
            rest = [key for key in free if key not in (*WHO, "trajectory")] or free
            own_by = [_longest(frame, rest)] if rest else []
        if len(own_by) != 1:
            raise UsageError("--kind heat: needs two keys: one for --x, one for --by")
        who = [key for key in who if key not in own_by]
        own_facet += who
    elif by is None:
        own_by, who = who, []
    else:
        own_facet += who  # the mean of two controllers is the error of none
    if facet is None and "trajectory" in free and "trajectory" not in own_by:
        own_facet += ["trajectory"]
    return _made(frame, (kind or "lines", x, own_by, own_facet), y, confidence)


def automatic(frame: SweepFrame, y: str = "mean_error", confidence: float = 0.95) -> list[View]:
    """The views that show what was swept, the first one first of all."""
    swept = [key for key in frame.swept if key != "seed"]
    who = [key for key in WHO if key in swept]
    course = [key for key in ("trajectory",) if key in swept]
    axes = [key for key in swept if key not in (*who, *course)]
    if "trajectory.speed" in axes:  # plants and vehicles are panels beside it
        course += [key for key in ("plant", "vehicle") if key in axes]
        axes = [key for key in axes if key not in course]
    if not axes:
        x = who[0] if who else course[0] if course else "seed"
        rest = [key for key in (*who, *course) if key != x]
        return [
            _made(frame, ("lines", x, [k for k in rest if k in who], [k for k in rest if k in course]), y, confidence)
        ]
    if len(axes) > 2:
        return [_made(frame, _parallel(frame, [*who, *course, *axes]), y, confidence)]
    x = _longest(frame, axes)
    rest = [key for key in axes if key != x]
    if not rest:
        return [_made(frame, ("lines", x, who, course), y, confidence)]
    few = not who and len(frame.values(rest[0])) <= MOST_LINES
    lines: What = ("lines", x, rest if few else who, course if few else [*course, *rest])
    found = [_made(frame, lines, y, confidence)]
    if all(len(frame.values(key)) > 2 for key in axes):
        found.append(_made(frame, ("heat", x, rest, [*who, *course]), y, confidence))
    return found


def _made(frame: SweepFrame, what: What, y: str, confidence: float) -> View:
    kind, x, by, facet = what
    keys = [*by] if kind == "parallel" else [*facet, *by, x]
    told = {"model"} if any(key.startswith("model.") for key in keys) else set()  # which tells the checkpoints apart
    others = [key for key in frame.swept if key not in (*keys, "seed", *told)]
    if kind != "parallel" and (mixed := [key for key in WHO if key in others]):
        facet, others = [*facet, *mixed], [key for key in others if key not in mixed]
        keys = [*facet, *by, x]
    found = points(frame, keys, y, others=[*others], confidence=confidence)
    if not any(point.is_shown for point in found.values()):
        raise UsageError(_why_nothing(frame, keys, y))
    notes = _notes(frame, keys, others, y, found)
    along = tuple(_axis(frame, key, keys) for key in by) if kind == "parallel" else ()
    by, facet = ((), ()) if kind == "parallel" else (by, facet)
    return View(
        kind, y, _axis(frame, x, keys), tuple(by), tuple(facet),
        tuple(others), along, confidence, tuple(notes), found, _alone(frame, [*keys, *others]),
    )  # fmt: skip


def _alone(frame: SweepFrame, shown: Sequence[str]) -> dict[str, Any]:
    """What all flights share of who flew and what, without what a figure shows."""
    found = {}
    for key in ("controller", "trajectory", "trajectory.speed"):
        values = frame.controllers(shown) if key == "controller" else frame.column(key)
        if key not in shown and len(set(values)) == 1 and values[0] is not None:
            found[key] = values[0]
    return found


def _parallel(frame: SweepFrame, keys: Sequence[str] | None) -> tuple[Kind, str, list[str], list[str]]:
    chosen = [ALIASES.get(key, key) for key in keys or [key for key in frame.swept if key != "seed"]]
    for key in chosen:
        _check_key(frame, key)
    chosen += [key for key in WHO if key in frame.swept and key not in chosen]
    if len(chosen) < 2:
        raise UsageError("--kind parallel: needs two keys or more that take several values")
    return "parallel", chosen[0], list(dict.fromkeys(chosen)), []


def _notes(
    frame: SweepFrame, keys: Sequence[str], others: Sequence[str], y: str, found: dict[Place, Point]
) -> list[str]:
    notes = []
    for key in keys:
        values = frame.values(key)
        if len(values) == 1 and key not in ("seed", *WHO, "trajectory"):
            notes.append(f"{key} is {value_text(key, values[0])} in all flights that have it")
        shown = shown_column(frame, key, keys)
        lacking = [row for row, value in zip(frame.rows, shown, strict=True) if value is None]
        if lacking:
            names = list(dict.fromkeys(row["controller"] for row in lacking))
            notes.append(f"not drawn: {count(len(lacking), 'flight')} without {key} ({listed(names)})")
    for key in others:
        texts = [value_text(key, value) for value in frame.values(key)]
        rest = f", ... ({len(texts)} values)" if len(texts) > 6 else ""
        notes.append(f"mean over {key}: {', '.join(texts[:6])}{rest}")
    if y != SUCCESS:
        trials = sum(point.trials for point in found.values())
        ended = sum(point.ended for point in found.values())
        if ended < trials:
            notes.append(f"{trials - ended} of {trials} flights were not completed: marked k/n where k of n were")
    if wrong := sum(bool(point.invalid) for point in found.values()):
        notes.append(f"{count(wrong, 'place')} invalid: settings that contradict each other")
    return notes


def _why_nothing(frame: SweepFrame, keys: Sequence[str], y: str) -> str:
    if not any(row["outcome"] == "ok" for row in frame.rows):
        flights = count(len(frame.rows), "flight")
        return f"none of the {flights} was completed: there is no {y} to draw (--y success draws that)"
    return f"no completed flight has {y} and a value of {listed(keys)}"


def _check_y(frame: SweepFrame, y: str) -> None:
    metrics = [name for name in frame.names if is_metric(name)] + [SUCCESS]
    if y not in metrics:
        raise UsageError(f"--y {y}: no number of a flight{suggestion(y, metrics)}")


def _check_key(frame: SweepFrame, key: str) -> None:
    if is_metric(key):
        raise UsageError(f"{key}: is a result of a flight, not a setting: it can be --y")
    if not frame.has(key):
        raise UsageError(f"{key}: no such key{suggestion(key, frame.names, frame.swept)}")


def _longest(frame: SweepFrame, keys: Sequence[str]) -> str:
    """The key with most values, numbers first."""
    if not keys:
        return "controller"
    return max(keys, key=lambda key: (all(map(is_number, frame.values(key))), len(frame.values(key)), -keys.index(key)))


def _axis(frame: SweepFrame, key: str, keys: Sequence[str]) -> Axis:
    if key in WHO:
        return Axis.of(key, list(dict.fromkeys(shown_column(frame, key, keys))))
    return Axis.of(key, frame.values(key))


def _order(value: Any) -> tuple[bool, Any]:
    return (False, value) if is_number(value) else (True, str(value))


def _span(counts: Sequence[int]) -> str:
    return count(counts[0], "seed") if len(counts) == 1 else f"{counts[0]} to {counts[-1]} seeds" if counts else "seeds"


def value_text(key: str, value: Any) -> str:
    """A value of a key: numbers without superfluous digits, a checkpoint by the end of its path."""
    if isinstance(value, bool):
        return str(value).lower()
    if is_number(value):
        return f"{value:.6g}"
    return str(value).rstrip("/").rpartition("/")[2] if key == "model" else str(value)


def unit_and_factor(y: str) -> tuple[float, str]:
    """Factor from SI and unit in which a column is drawn."""
    return Y_UNITS.get(y) or unit_shown(y)
