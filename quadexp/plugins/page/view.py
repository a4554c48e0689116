"""What to draw of a sweep: which keys are x, lines and panels, and the number at each of their places.

Keys are chosen by what was swept where nobody says:

    one key        it is x, the controllers are lines, the trajectories panels
    two keys       the longer one is x, the other one lines, or panels beside the controllers; and a heat map of both
    more           the longest one is x, the next one lines, or a panel for each; panels of all values of the others

A place is one value of every key that the figure shows (x, lines, panels). Its mean is over the common flights, by the
one rule of every table (pairing.py): places that differ in keys of the controller stand beside each other, and are over
the flights that all of them completed. The settings of who flies are never averaged: they have lines or panels.
Settings of the world that the figure does not show are averaged, seed by seed:

    mean      over the seeds, of the mean over the other settings of that seed
    interval  of the mean over the seeds, as in tables (inference.mean_interval); of a share, where each flight has a
              seed of its own

A figure shows every panel, or says which it leaves out.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.names import distinct
from quadexp.parts.cells import OPTION
from quadexp.parts.schema import of_contestant
from quadexp.report.frame import ALIASES, SweepFrame, is_metric, is_number, setting_text, with_unit
from quadexp.report.inference import mean_interval, success_interval
from quadexp.report.metrics import metric_of
from quadexp.report.pairing import common, grouped, is_flown, is_invalid, seed_means
from quadexp.report.paper_cells import Point
from quadexp.report.text import count, listed, plain
from quadexp.report.text import shown as unit_shown

Kind = Literal["lines", "heat"]
Place = tuple[Any, ...]  # a value of each key that is shown
SUCCESS = "success"  # the share of completed flights
WHO = ("controller", "model")
FLOWN = (*WHO, "trajectory")
MOST_LINES = 12  # in a panel, before a key makes panels instead
MOST_VALUES = 6  # of a key that is averaged, named in a note


def points(
    frame: SweepFrame, keys: Sequence[str], y: str, *, others: Sequence[str] = (), confidence: float = 0.95
) -> dict[Place, Point]:
    """Place -> point, in the order of the rows. keys: what a place has a value of. y: a number of the flights, or
    "success". others: keys that vary beside them, which are averaged. A flight without a value of a key has no place.
    """
    columns = [shown_column(frame, key, keys) for key in keys]
    others_columns = [frame.column(key) for key in others]
    values = [1.0] * len(frame.rows) if y == SUCCESS else frame.column(y)
    flights = []
    for i, row in enumerate(frame.rows):
        flights.append((tuple(column[i] for column in others_columns), row["seed"]))
    well = [is_flown(row) and value is not None for row, value in zip(frame.rows, values, strict=True)]
    places = grouped((place, i) for i, place in enumerate(zip(*columns, strict=True)) if None not in place)
    beside: dict[Place, dict[Place, set[Any]]] = {}  # what is flown -> place -> completed flights
    for place, numbers in places.items():
        flown = tuple(value for value, key in zip(place, keys, strict=True) if not of_contestant(key))
        broken = set()
        for i in numbers:
            if not well[i] and not is_invalid(frame.rows[i]):
                broken.add(flights[i])
        beside.setdefault(flown, {})[place] = {flights[i] for i in numbers if well[i]} - broken
    used = {place: shared for ended in beside.values() for compared, shared in [common(ended)] for place in compared}
    result = {}
    for place, numbers in places.items():
        rows = [frame.rows[i] for i in numbers]
        outcomes = Counter(row["outcome"] for row in rows if not is_invalid(row))
        trials = outcomes.total()
        completed = outcomes.pop("ok", 0)
        point = Point(ended=completed, trials=trials, lost=outcomes, invalid="" if trials else str(rows[0]["cause"]))
        if y == SUCCESS:
            single = len({row["seed"] for row in rows}) == len(rows)
            low, high = success_interval(completed, trials, confidence) if single else (math.nan, math.nan)
            share = completed / trials if trials else math.nan
            point = replace(point, mean=share, low=low, high=high, flights=trials, method="Clopper-Pearson")
        elif place in used:
            errors = grouped((flights[i], float(values[i])) for i in numbers if well[i] and flights[i] in used[place])
            means = seed_means({flight: np.mean(several) for flight, several in errors.items()})
            low, high, method = mean_interval(means, confidence, least=0.0 if min(means) >= 0 else -math.inf)
            limits: dict[str, Any] = {"mean": float(means.mean()), "low": low, "high": high, "method": method}
            point = replace(point, **limits, flights=sum(map(len, errors.values())), seeds=len(means))
        result[place] = point
    return result


def shown_column(frame: SweepFrame, key: str, keys: Sequence[str]) -> list[Any]:
    """The column of a key as a figure of these keys shows it: a flight without a checkpoint has an empty one, and the
    name of a controller has no compensation in it that is a key of its own."""
    if key == "controller":
        return frame.controllers(keys)
    if key == "model":
        return [row["model"] or "" for row in frame.rows]
    return frame.column(key)


@dataclass(frozen=True)
class Axis:
    """A key as an axis. values: in their order. kind: "number" where values are numbers, otherwise "group". names: see
    `View.named`."""

    key: str
    values: tuple[Any, ...]
    kind: Literal["number", "group"]
    names: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, key: str, values: Sequence[Any]) -> Axis:
        return cls(key, tuple(values), "number" if values and all(map(is_number, values)) else "group")

    @property
    def scale(self) -> Literal["linear", "log"]:
        """Logarithmic for three or more values, all positive, that are rather spaced by a ratio than by a difference,
        over a factor of 4 or more."""
        if self.kind == "group" or len(self.values) < 3:
            return "linear"
        values = [float(value) for value in self.values]
        if values[0] <= 0 or values[-1] < 4 * values[0]:
            return "linear"
        steps = [after - before for before, after in pairwise(values)]
        ratios = [math.log(after / before) for before, after in pairwise(values)]
        if max(ratios) / min(ratios) < max(steps) / min(steps):
            return "log"
        return "linear"

    @property
    def label(self) -> str:
        return self.names.get(self.key) or with_unit(self.key, self.key)

    def text(self, value: Any) -> str:
        text = value_text(self.key, value)
        return self.names.get(text, text)


@dataclass(frozen=True)
class View:
    """A figure to be drawn. y: a column of numbers, or "success". by: keys of the lines (of a heat map its rows).
    facet: keys of the panels. others: keys that vary and are averaged. notes: what a reader has to know. alone: who
    flew and what, as far as all flights share it: values of the controller, its model, the trajectory and the speed.
    heading: the title. width: of a figure for a paper (inches). height: of any figure (inches). colours: of a
    line's label or value, "#rrggbb"."""

    kind: Kind
    y: str
    x: Axis
    by: tuple[str, ...] = ()
    facet: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    confidence: float = 0.95
    notes: tuple[str, ...] = ()
    places: dict[Place, Point] = field(default_factory=dict)
    alone: dict[str, Any] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    heading: str = ""
    width: float | None = None
    height: float | None = None
    colours: Mapping[str, str] = field(default_factory=dict)

    def named(self, names: Mapping[str, str]) -> View:
        """The same with other texts for the metric, keys, and values of keys, such as {"gp_mpc": "GP"}.

        Raises UsageError for a name of none of these."""
        known = {self.y, *self.keys, *self._texts()}
        for name in names:
            if name not in known:
                raise UsageError(f"--label {name}: no key or value of this figure{suggestion(name, sorted(known))}")
        return replace(self, names=names, x=replace(self.x, names=names))

    def coloured(self, colours: Mapping[str, str]) -> View:
        """The same with other colours for values of keys, such as {"gp_mpc": "#004fc3"}.

        Raises UsageError for a value of none of the lines."""
        known = self._texts()
        for name in colours:
            if name not in known:
                raise UsageError(f"--color {name}: no value of this figure{suggestion(name, sorted(known))}")
        return replace(self, colours=colours)

    def _texts(self) -> set[str]:
        values = set()
        for place in self.places:
            for key, v in zip(self.keys, place, strict=True):
                values.add(value_text(key, v))
        return values | set(map(str, self.alone.values()))

    def parts(self) -> dict[str, View]:
        """Name of a file -> the view of one panel, of which it is the heading."""
        n = len(self.facet)
        name = f"{self.y}_{self.file_name}"
        if not n:
            return {name: self}
        parts = {}
        for facet in self.panels:
            places = {}
            for place, point in self.places.items():
                if place[:n] == facet:
                    places[place[n:]] = point
            heading = self.title(self.facet, facet)
            if any(point.is_shown for point in places.values()):
                words = "_".join(heading.replace(",", "").split())
                parts[f"{name}_{words}"] = replace(self, facet=(), places=places, heading=heading)
        return parts

    @property
    def keys(self) -> tuple[str, ...]:
        """What a place has a value of, in this order."""
        return (*self.facet, *self.by, self.x.key)

    @property
    def panels(self) -> list[Place]:
        """The values of `facet`, each a panel."""
        return self._values(0, len(self.facet))

    def lines(self) -> list[Place]:
        """The values of `by`, the same in every panel."""
        return self._values(len(self.facet), len(self.facet) + len(self.by))

    def _values(self, start: int, end: int) -> list[Place]:
        """The different values of some of the keys, sorted where all are numbers."""
        values = distinct(place[start:end] for place in self.places)
        if all(is_number(value) for place in values for value in place):
            return sorted(values)
        return values

    @property
    def file_name(self) -> str:
        """What a file of this figure is called: "against_nodes", "map_of_nodes_and_horizon"."""
        x, *others = (key.rpartition(".")[2] for key in (self.x.key, *self.by))
        return f"map_of_{x}_and_{others[0]}" if self.kind == "heat" else f"against_{x}"

    @property
    def factor(self) -> float:
        return unit_shown(self.y)[0]

    @property
    def unit(self) -> str:
        return unit_shown(self.y)[1]

    @property
    def y_label(self) -> str:
        if self.y in self.names:
            return self.names[self.y]
        title = metric_of(self.y).title
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
        seeds = sorted({point.seeds for point in shown if point.seeds})
        if not seeds:  # of other means than those of a sweep
            return ""
        span = f"{seeds[0]} to {seeds[-1]} seeds" if len(seeds) > 1 else count(seeds[0], "seed")
        over = "one flight each" if seeds == [1] and not self.others else f"mean over {span}"
        known = self.kind == "lines" and any(point.method == "t" for point in shown)
        return over + (f"; bars: its {100 * self.confidence:g} % interval (Student's t)" if known else "")

    def title(self, keys: Sequence[str], values: Place) -> str:
        """Such as "circle, 8 m/s, payload 0.1 kg"."""
        return ", ".join(self._text(key, value) for key, value in zip(keys, values, strict=True))

    def _text(self, key: str, value: Any) -> str:
        """A value in words with its unit."""
        text = value_text(key, value)
        if text in self.names or key in FLOWN:
            return self.names.get(text, text)
        if key == "trajectory.speed":
            return f"{text} m/s"
        return setting_text(key, value)


def view(
    frame: SweepFrame,
    *,
    y: str = "mean_error",
    x: str | None = None,
    by: Sequence[str] | None = None,
    facet: Sequence[str] | None = None,
    kind: Kind | None = None,
) -> View:
    """The view that is asked for, completed by what was swept, with the confidence of the results' record. by, facet:
    None to choose.

    Raises UsageError for a key that is none, a key that is given twice, or where nothing can be drawn.
    """
    metrics = [*filter(is_metric, frame.names), SUCCESS]
    confidence = float(frame.record.get("confidence", 0.95))
    if y not in metrics:
        raise UsageError(f"--y {y}: no number of a flight{suggestion(y, metrics)}")
    if x is None and kind is None and not by and not facet:
        return automatic(frame, y, confidence)[0]
    given_x = checked_keys(frame, [x] if x else [])
    given_by = checked_keys(frame, by or [])
    given_facet = checked_keys(frame, facet or [])
    stated = [*given_x, *given_by, *given_facet]
    for key in stated:
        if stated.count(key) > 1:
            raise UsageError(f"{key}: stands twice among --x, --by and --facet")
    free = _beside(frame, stated)
    x = given_x[0] if given_x else _longest(frame, free)
    free = [key for key in free if key != x]
    who = [key for key in free if of_contestant(key)]
    if kind == "heat":
        given_by = given_by or ([_longest(frame, free)] if free else [])
        if len(given_by) != 1:
            raise UsageError("--kind heat: needs two keys: one for --x, one for --by")
        who = [key for key in who if key not in given_by]
    elif by is None:
        given_by = who
        who = []
    given_facet += who
    if facet is None:
        given_facet += [key for key in free if key not in (*given_by, *given_facet) and key in _names(free)]
    return _made(frame, kind or "lines", x, given_by, given_facet, y, confidence)


def automatic(frame: SweepFrame, y: str = "mean_error", confidence: float = 0.95) -> list[View]:
    """The views that show what was swept, the first one first of all."""
    swept = [key for key in frame.swept if key != "seed"]
    names = _names(swept)
    who = [key for key in names if of_contestant(key)]
    course = [key for key in names if key not in who]
    axes = [key for key in swept if key not in names]
    if "trajectory.speed" in axes:  # plants and vehicles are panels beside it
        course += [key for key in ("plant", "vehicle") if key in axes]
        axes = [key for key in axes if key not in course]
    x = _longest(frame, axes) if axes else [*who, *course, "seed"][0]
    who, course, rest = ([key for key in keys if key != x] for keys in (who, course, axes))
    if not rest:
        return [_made(frame, "lines", x, who, course, y, confidence)]
    few = not who and len(frame.values(rest[0])) <= MOST_LINES
    by, facet = (rest[:1], [*course, *rest[1:]]) if few else (who, [*course, *rest])
    views = [_made(frame, "lines", x, by, facet, y, confidence)]
    if len(axes) == 2 and all(len(frame.values(key)) > 2 for key in axes):
        views.append(_made(frame, "heat", x, rest, [*who, *course], y, confidence))
    return views


def _made(
    frame: SweepFrame, kind: Kind, x: str, by: Sequence[str], facet: Sequence[str], y: str, confidence: float
) -> View:
    """The view of these keys."""
    others = _beside(frame, [*by, *facet, x])
    facet = [*facet, *(key for key in others if of_contestant(key))]  # the mean of two contestants is the error of none
    others = [key for key in others if not of_contestant(key)]
    keys = [*facet, *by, x]
    places = points(frame, keys, y, others=others, confidence=confidence)
    if not any(point.is_shown for point in places.values()):
        if any(row["outcome"] == "ok" for row in frame.rows):
            raise UsageError(f"no completed flight has {y} and a value of {listed(keys)}")
        flights = count(len(frame.rows), "flight")
        raise UsageError(f"none of the {flights} was completed: there is no {y} to draw (--y success draws that)")
    values = distinct(shown_column(frame, x, keys)) if x in WHO else frame.values(x)
    alone = {}  # what all flights share of who flew and what, without what the figure shows
    for key in ("controller", "trajectory", "trajectory.speed"):
        column = frame.controllers([*keys, *others]) if key == "controller" else frame.column(key)
        if key not in (*keys, *others) and len(set(column)) == 1 and column[0] is not None:
            alone[key] = column[0]
    axes = (tuple(by), tuple(facet), tuple(others))
    notes = tuple(_notes(frame, keys, others, y, places))
    return View(kind, y, Axis.of(x, values), *axes, confidence, notes, places, alone)


def _beside(frame: SweepFrame, keys: Sequence[str]) -> list[str]:
    """What was swept beside these keys; a setting of the fit tells the checkpoints apart."""
    aside = {"seed", *keys, *(["model"] if any(key.startswith("model.") for key in keys) else [])}
    return [key for key in frame.swept if key not in aside]


def _notes(
    frame: SweepFrame, keys: Sequence[str], others: Sequence[str], y: str, places: Mapping[Place, Point]
) -> list[str]:
    notes = []
    for key in keys:
        values = frame.values(key)
        if len(values) == 1 and key not in ("seed", *FLOWN):
            notes.append(f"{key} is {value_text(key, values[0])} in all flights that have it")
        column = shown_column(frame, key, keys)
        lacking = []
        for row, value in zip(frame.rows, column, strict=True):
            if value is None:
                lacking.append(row["controller"])
        if lacking:
            names = listed(distinct(lacking))
            notes.append(f"not drawn: {count(len(lacking), 'flight')} without {key} ({names})")
    for key in others:
        texts = [value_text(key, value) for value in frame.values(key)]
        rest = f", ... ({len(texts)} values)" if len(texts) > MOST_VALUES else ""
        notes.append(f"mean over {key}: {', '.join(texts[:MOST_VALUES])}{rest}")
    trials, ended = (sum(getattr(point, name) for point in places.values()) for name in ("trials", "ended"))
    if y != SUCCESS and ended < trials:
        notes.append(f"{trials - ended} of {trials} flights were not completed: marked k/n where k of n were")
    if invalid := sum(bool(point.invalid) for point in places.values()):
        notes.append(f"{count(invalid, 'place')} invalid: settings that contradict each other")
    return notes


def _names(keys: Sequence[str]) -> list[str]:
    """Those of some keys that name who flew and along what."""
    return [key for key in keys if key in FLOWN or key.endswith(f".{OPTION}")]


def checked_keys(frame: SweepFrame, keys: Sequence[str]) -> list[str]:
    """The full names of keys; UsageError for what is none."""
    keys = [ALIASES.get(key, key) for key in keys]
    for key in keys:
        if is_metric(key):
            raise UsageError(f"{key}: is a result of a flight, not a setting: it can be --y")
        if not frame.has(key):
            raise UsageError(f"{key}: no such key{suggestion(key, frame.names, frame.swept)}")
    return keys


def _longest(frame: SweepFrame, keys: Sequence[str]) -> str:
    """The key with most values, numbers first; who flew and what only where there is no other."""
    keys = [key for key in keys if key not in FLOWN] or list(keys) or ["controller"]
    return max(keys, key=lambda key: (all(map(is_number, frame.values(key))), len(frame.values(key)), -keys.index(key)))


def value_text(key: str, value: Any) -> str:
    """A value of a key: numbers without superfluous digits, a checkpoint by the end of its path."""
    if key == "model":
        return str(value).rstrip("/").rpartition("/")[2]
    return plain(value)
