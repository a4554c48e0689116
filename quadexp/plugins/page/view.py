"""What to draw of a sweep: which keys are x, lines and panels, and the number at each of their places.

Keys are chosen by what was swept where nobody says:

    one key        it is x, the controllers are lines, the trajectories panels
    two keys       the longer one is x, the other one lines, or panels beside the controllers; and a heat map of both
    more           the longest one is x, the next one lines, or a panel for each; panels of all values of the others

A place is one value of every key that the figure shows (x, lines, panels), its number that of places.py. The settings
of who flies are never averaged: they have lines or panels. A figure shows every panel, or says which it leaves out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from typing import Any, Literal

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.names import distinct
from quadexp.parts.cells import OPTION
from quadexp.parts.schema import of_contestant
from quadexp.plugins.page.places import SUCCESS, Place, Point, points, shown_column
from quadexp.report.frame import ALIASES, SweepFrame, is_metric, is_number, setting_text, with_unit
from quadexp.report.metrics import metric_of
from quadexp.report.text import count, listed, plain
from quadexp.report.text import shown as unit_shown

Kind = Literal["lines", "heat"]
WHO = ("controller", "model")
FLOWN = (*WHO, "trajectory")
MOST_LINES = 12  # in a panel, before a key makes panels instead
MOST_VALUES = 6  # of a key that is averaged, named in a note


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
        _check_known(names, known, "--label", "no key or value of this figure")
        return replace(self, names=names, x=replace(self.x, names=names))

    def coloured(self, colours: Mapping[str, str]) -> View:
        """The same with other colours for values of keys, such as {"gp_mpc": "#004fc3"}.

        Raises UsageError for a value of none of the lines."""
        _check_known(colours, self._texts(), "--color", "no value of this figure")
        return replace(self, colours=colours)

    def _texts(self) -> set[str]:
        texts = {str(value) for value in self.alone.values()}
        for place in self.places:
            texts |= set(map(value_text, self.keys, place))
        return texts

    def of_line(self, facet: Place, line: Place) -> dict[Any, Point]:
        """x -> point, of a line in a panel."""
        before = (*facet, *line)
        return {place[-1]: point for place, point in self.places.items() if place[:-1] == before}

    def parts(self) -> dict[str, View]:
        """Name of a file -> the view of one panel, of which it is the heading."""
        name = f"{self.y}_{self.file_name}"
        if not self.facet:
            return {name: self}
        parts = {}
        for facet in self.panels:
            n = len(facet)
            places = {place[n:]: point for place, point in self.places.items() if place[:n] == facet}
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
        if all(map(is_number, chain(*values))):
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
        who = self.title(tuple(self.alone), tuple(self.alone.values()))
        return "; ".join(filter(None, (who, self._bars)))

    @property
    def _bars(self) -> str:
        points = self.places.values()
        interval = f"; bars: its {100 * self.confidence:g} % interval"
        if self.y == SUCCESS:
            exact = any(math.isfinite(point.low) for point in points)
            return "share of flights" + (f"{interval} (Clopper-Pearson)" if exact else "")
        seeds = sorted({point.seeds for point in points if point.seeds})
        if not seeds:  # of other means than those of a sweep
            return ""
        over = f"mean over {count(seeds[0], 'seed')}"
        if len(seeds) > 1:
            over = f"mean over {seeds[0]} to {seeds[-1]} seeds"
        elif seeds == [1] and not self.others:
            over = "one flight each"
        known = self.kind == "lines" and any(point.method == "t" for point in points)
        return over + (f"{interval} (Student's t)" if known else "")

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
    check_metric(frame, y, "--y")
    confidence = float(frame.record.get("confidence", 0.95))
    if x is None and kind is None and not by and not facet:
        return automatic(frame, y, confidence)[0]
    given_x, given_by, given_facet = checked_keys(frame, x=[x] if x else [], by=by, facet=facet)
    free = _beside(frame, [*given_x, *given_by, *given_facet])
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
    who = [key for key in who if key != x]
    course = [key for key in course if key != x]
    rest = [key for key in axes if key != x]
    if not rest:
        return [_made(frame, "lines", x, who, course, y, confidence)]
    by = who
    facet = [*course, *rest]
    if not who and len(frame.values(rest[0])) <= MOST_LINES:
        by = rest[:1]
        facet.remove(*by)
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
    aside = {"seed", *keys}
    if any(key.startswith("model.") for key in keys):
        aside.add("model")
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
        lacking = [row["controller"] for row, value in zip(frame.rows, column, strict=True) if value is None]
        if lacking:
            names = listed(distinct(lacking))
            notes.append(f"not drawn: {count(len(lacking), 'flight')} without {key} ({names})")
    for key in others:
        texts = [value_text(key, value) for value in frame.values(key)]
        rest = f", ... ({len(texts)} values)" if len(texts) > MOST_VALUES else ""
        notes.append(f"mean over {key}: {', '.join(texts[:MOST_VALUES])}{rest}")
    trials = sum(point.trials for point in places.values())
    ended = sum(point.ended for point in places.values())
    if y != SUCCESS and ended < trials:
        notes.append(f"{trials - ended} of {trials} flights were not completed: marked k/n where k of n were")
    invalid = sum(bool(point.invalid) for point in places.values())
    if invalid:
        notes.append(f"{count(invalid, 'place')} invalid: settings that contradict each other")
    return notes


def _names(keys: Sequence[str]) -> list[str]:
    """Those of some keys that name who flew and along what."""
    return [key for key in keys if key in FLOWN or key.endswith(f".{OPTION}")]


def check_metric(frame: SweepFrame, name: str, option: str) -> None:
    """UsageError for what is no number of a flight."""
    metrics = [*filter(is_metric, frame.names), SUCCESS]
    if name not in metrics:
        raise UsageError(f"{option} {name}: no number of a flight{suggestion(name, metrics)}")


def checked_keys(frame: SweepFrame, **options: Sequence[str] | None) -> list[list[str]]:
    """The full names of the keys of each option; UsageError for what is no key, or stands twice."""
    full = []
    for keys in options.values():
        full.append([ALIASES.get(key, key) for key in keys or ()])
    every = list(chain(*full))
    for key in every:
        if is_metric(key):
            raise UsageError(f"{key}: is a result of a flight, not a setting: it can be --y")
        if not frame.has(key):
            raise UsageError(f"{key}: no such key{suggestion(key, frame.names, frame.swept)}")
        if every.count(key) > 1:
            raise UsageError(f"{key}: stands twice among {listed([f'--{option}' for option in options])}")
    return full


def _longest(frame: SweepFrame, keys: Sequence[str]) -> str:
    """The key with most values, numbers first; who flew and what only where there is no other."""
    keys = [key for key in keys if key not in FLOWN] or list(keys) or ["controller"]
    return max(keys, key=lambda key: (all(map(is_number, frame.values(key))), len(frame.values(key)), -keys.index(key)))


def value_text(key: str, value: Any) -> str:
    """A value of a key: numbers without superfluous digits, a checkpoint by the end of its path."""
    if key == "model":
        return str(value).rstrip("/").rpartition("/")[2]
    return plain(value)


def _check_known(names: Iterable[str], known: set[str], option: str, what: str) -> None:
    """UsageError for a name that is not known."""
    for name in names:
        if name not in known:
            raise UsageError(f"{option} {name}: {what}{suggestion(name, sorted(known))}")
