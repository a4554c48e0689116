"""The tables of a sweep: errors, comparisons, flights.

The error table has trajectory and speed down and controllers across; every setting that was swept is a column of its
own, with its unit above and its values down, and so are many plants or worlds. The first row counts the flights that
completed; cells are means over the common flights of a trajectory and speed (pairing.py), or say "invalid" where
settings contradict each other. The comparison table has one row per contestant and condition, against the baseline.
The table of flights has any columns of the results and any keys, for the terminal, as CSV and as a sortable page.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any, NamedTuple

from quadexp.report.document import sortable_page
from quadexp.report.frame import SweepFrame, is_metric, is_number, setting_column, setting_text, with_unit
from quadexp.report.metrics import NUMBERS, SHOWN
from quadexp.report.notes import notes as row_notes
from quadexp.report.notes import table_notes
from quadexp.report.pairing import (
    Contestant,
    Flights,
    condition_of,
    contestant_labels,
    contestant_of,
    is_invalid,
    setting_pairs,
)  # fmt: skip
from quadexp.report.statistics import BASELINE, CONFIDENCE, Statistic, compute_statistics, overall
from quadexp.report.table import Table, csv_text
from quadexp.report.text import p_value, shown, speed_text, with_interval
from quadexp.report.winner import verdicts

MOST_ACROSS = 6  # columns of an error table; with more, several plants are told apart by rows
TITLES = {name: NUMBERS[name].title for name in SHOWN}
NAN = math.nan

Line = tuple[str, ...]  # of an error table: trajectory with what else varies, speed, values of swept keys


def value_text(s: Statistic) -> tuple[str, str]:
    """Mean over the common flights and its interval, in the unit that tables show; ("", "") without such flights."""
    values = (SHOWN[s.metric][0] * value for value in (s.common_mean, s.common_low, s.common_high))
    return ("", "") if math.isnan(s.common_mean) else with_interval(*values)


def own_text(s: Statistic) -> str:
    """Such as "own 13.1 of 19", over all own completed flights; "" if all of them are common ones."""
    mean = with_interval(SHOWN[s.metric][0] * s.mean, NAN, NAN)[0]
    return f"own {mean} of {s.n}" if s.n > s.common else ""


def lost_text(s: Statistic) -> str:
    """Such as "1 lost, 2 solver_failed"."""
    return ", ".join(f"{count} {outcome}" for outcome, count in s.failures.items())


def cell_text(s: Statistic) -> str:
    """Such as "12.3", "**240.6** [239.9, 241.2]*", "12.3 (own 13.1 of 19; 1 lost)" or "3 lost"."""
    beside = "; ".join(filter(None, (own_text(s), lost_text(s))))
    mean, limits = value_text(s)
    if not mean:
        return beside or "-"
    mean = f"**{mean}**" if s.best else mean
    return mean + limits + ("*" if s.significant else "") + (f" ({beside})" if beside else "")


@dataclass(frozen=True)
class ErrorTable:
    """rows: (trajectory and what else varies, speed text, a value of each of `keys`). columns: controller labels.
    flown: column -> how many of its flights it completed. entries: (row, column) -> statistic. notes: lines below.
    keys: settings that were swept. headings: of their columns. invalid: (row, column) of settings that contradict each
    other."""

    metric: str
    unit: str
    rows: tuple[Line, ...]
    columns: tuple[str, ...]
    entries: Mapping[tuple[Line, str], Statistic]
    flown: Mapping[str, Flights]
    notes: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()
    headings: tuple[str, ...] = ()
    invalid: Set[tuple[Line, str]] = frozenset()

    def table(self, *, speed: str = "m/s") -> Table:
        """As texts. speed: heading of that column."""
        counts = (self.flown[column] for column in self.columns)
        rows = [["flown", *[""] * (1 + len(self.keys)), *(one.text() if one.trials else "-" for one in counts)]]
        rows += [[*line, *(self._text(line, column) for column in self.columns)] for line in self.rows]
        title, beside = f"{TITLES[self.metric]} ({self.unit})", 2 + len(self.keys)
        heads = ["trajectory", speed, *self.headings, *self.columns]
        return Table(heads, rows, title, head=1, over=title, notes=self.notes, beside=beside)

    def _text(self, line: Line, column: str) -> str:
        entry = self.entries.get((line, column))
        return cell_text(entry) if entry else "invalid" if (line, column) in self.invalid else "-"

    def markdown(self) -> str:
        return self.table().markdown(bullets=True)

    def latex(self) -> str:
        return self.table(speed="speed (m/s)").latex()

    __str__ = markdown

    def _repr_html_(self) -> str:
        return self.table().html()


def column_labels(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The column of each result row: the controller with its settings; plant and vehicle if there are several.

    Other settings belong to the condition: they stand beside the trajectory, see `course_labels`.
    """
    labels = contestant_labels(list(dict.fromkeys(map(contestant_of, rows))))
    several = [name for name in ("plant", "vehicle") if len({row[name] for row in rows}) > 1]
    return [" ".join([labels[contestant_of(row)], *(f"@{row[name]}" for name in several)]) for row in rows]


def plant_labels(statistics: Sequence[Statistic]) -> list[str]:
    """The contestant of each statistic, told apart from the others on its plant: the same controller has checkpoints of
    its own on another one."""
    there: dict[str, dict[Contestant, None]] = {}
    for s in statistics:
        there.setdefault(s.plant, {})[s.contestant] = None
    labels = {plant: contestant_labels(list(contestants)) for plant, contestants in there.items()}
    return [labels[s.plant][s.contestant] for s in statistics]


def course_labels(conditions: Iterable[tuple[str, str]]) -> dict[tuple[str, str], str]:
    """(trajectory, other settings) -> label of a line, such as "circle, payload 0.1 kg"; no two are the same."""
    conditions = list(dict.fromkeys(conditions))
    labels = {at: ", ".join([at[0], *(setting_text(*pair) for pair in setting_pairs(at[1]))]) for at in conditions}
    count = Counter(labels.values())
    return {at: " ".join(filter(None, at)) if count[label] > 1 else label for at, label in labels.items()}


def row_of(s: Statistic) -> dict[str, Any]:
    """What a statistic tells of the rows it is made from."""
    names = ("plant", "vehicle", "trajectory", "speed", "controller", "model")
    return {**{n: getattr(s, n) for n in names}, "variant": f"{s.variant} {s.setting}".strip()}


def error_table(
    results: Sequence[Mapping[str, Any]],
    metric: str = "mean_error",
    *,
    baseline: str = BASELINE,
    confidence: float = CONFIDENCE,
) -> ErrorTable:
    """The error table of one metric from result rows."""
    options: dict[str, Any] = {"baseline": baseline, "confidence": confidence}
    statistics = compute_statistics(results, metrics=(metric,), **options)
    best = verdicts(results, metric=metric, confidence=confidence)
    notes = table_notes(statistics, overall(results, metric=metric, **options), best)
    rows = [*map(row_of, statistics), *filter(is_invalid, results)]
    settings = [dict(setting_pairs(row.get("variant") or "")) for row in rows]
    values: dict[str, list[str]] = {}
    for own in settings:
        for key, value in own.items():
            values.setdefault(key, []).append(value)
    keys = [key for key, several in values.items() if len(set(several)) > 1]
    keys.sort(key=lambda key: key.startswith("controller."))  # those of the conditions first
    kept = (" ".join(f"{key}={value}" for key, value in own.items() if key not in keys) for own in settings)
    bare = [{**row, "variant": variant} for row, variant in zip(rows, kept, strict=True)]
    labels = column_labels(bare)
    shown_as = {key: setting_column(key, values[key], keys) for key in keys}
    if len(set(labels)) > MOST_ACROSS and len({row["plant"] for row in rows}) > 1:
        labels = column_labels([{**row, "plant": ""} for row in bare])
        shown_as = {"plant": ("plant", {row["plant"]: row["plant"] for row in rows}), **shown_as}
    order: dict[Line, tuple[str, float]] = {}
    entries: dict[tuple[Line, str], Statistic] = {}
    wrong: set[tuple[Line, str]] = set()
    flown: dict[str, Flights] = {}
    courses = course_labels((row["trajectory"], condition_of(row)[4]) for row in bare)
    for i, (row, label) in enumerate(zip(bare, labels, strict=True)):
        *_, speed, setting = condition_of(row)
        course, own = courses[row["trajectory"], setting], settings[i] | {"plant": row["plant"]}
        texts = (column[own[key]] if key in own else "" for key, (_, column) in shown_as.items())
        line = (course, speed_text(speed, ""), *texts)
        order.setdefault(line, (course, -1.0 if speed is None else speed))
        flown.setdefault(label, Flights(0, 0))
        if i < len(statistics):
            entries[line, label] = statistics[i]
            flown[label] = flown[label].plus(statistics[i].flown)
        else:
            wrong.add((line, label))
    names = list(dict.fromkeys(line[0] for line in order))
    return ErrorTable(
        metric=metric,
        unit=SHOWN[metric][1],
        rows=tuple(sorted(order, key=lambda line: (names.index(order[line][0]), order[line][1]))),
        columns=tuple(flown),
        entries=entries,
        flown=flown,
        notes=(*notes, *row_notes(results)),
        keys=tuple(shown_as),
        headings=tuple(heading for heading, _ in shown_as.values()),
        invalid=wrong - entries.keys(),
    )


def comparison_table(statistics: Sequence[Statistic]) -> Table | None:
    """Every contestant against the baseline, condition by condition; None if nobody is compared."""
    metric = statistics[0].metric
    factor, unit = SHOWN[metric]
    heading = ["trajectory", "speed (m/s)", "controller", "seeds", f"difference ({unit})"]
    heading += ["reduction (%)", "effect", "p", "p (Holm)", "left out"]
    courses = course_labels((s.trajectory, s.setting) for s in statistics)
    rows = []
    for s, label in zip(statistics, column_labels([*map(row_of, statistics)]), strict=True):
        if not s.baseline:
            continue
        change = ["-", "-"]
        if s.pairs:
            values = (s.difference, s.difference_low, s.difference_high)
            change = ["".join(with_interval(*(factor * value for value in values)))]
            change += ["".join(with_interval(s.reduction, s.reduction_low, s.reduction_high))]
        effect = "-" if math.isnan(s.effect) else f"{s.effect:.2f}"
        tests = [effect, p_value(s.p), p_value(s.p_holm), s.left_out or "-"]
        course = courses[s.trajectory, s.setting]
        rows.append([course, speed_text(s.speed, ""), label, str(s.pairs), *change, *tests])
    if not rows:
        return None
    baselines = dict.fromkeys(s.baseline for s in statistics if s.baseline)
    note = (
        "difference: contestant less baseline over the seeds; reduction: positive where better; effect: matched-pairs"
        " rank-biserial in [-1, 1]; p: paired permutation test, then corrected by Holm over"
        f" {max(s.comparisons for s in statistics)} comparisons"
    )
    title = f"{TITLES[metric]} against {', '.join(baselines)}"
    return Table(heading, rows, title, left=frozenset({0, 2, len(heading) - 1}), notes=(note,))


class FlightsTable(NamedTuple):
    """names: of the columns that are shown."""

    names: list[str]
    table: Table


def flights_table(frame: SweepFrame, names: Sequence[str], *, all_of_them: bool = True) -> FlightsTable:
    """Flights with these columns, in the units in which tables show them. all_of_them: also empty columns.

    Raises UsageError for a name that is no column and no key.
    """
    columns = {name: frame.column(name) for name in names}
    columns = {name: own for name, own in columns.items() if all_of_them or any(value is not None for value in own)}
    texts = [[_flight_text(name, value) for value in own] for name, own in columns.items()]
    left = (i for i, own in enumerate(columns.values()) if not all(is_number(v) for v in own if v is not None))
    rows = [*map(list, zip(*texts, strict=True))]
    return FlightsTable(list(columns), Table([*map(heading, columns)], rows, left=frozenset(left)))


def csv_of(frame: SweepFrame, names: Sequence[str]) -> str:
    """Flights as CSV: SI units, every digit."""
    return csv_text(names, zip(*(frame.column(name) for name in names), strict=True))


def page_of(frame: SweepFrame, names: Sequence[str], title: str) -> str:
    """Flights as a page that sorts and filters, and opens without a network."""
    return sortable_page(title, flights_table(frame, names).table, notes=[f"{len(frame.rows)} flights of {title}"])


def heading(name: str) -> str:
    """The name with the unit in which its numbers are shown."""
    unit = shown(name)[1]
    return with_unit(name, name) if not is_metric(name) else f"{name} ({unit})" if unit else name


def _flight_text(name: str, value: Any) -> str:
    if value is None:
        return ""
    if not is_number(value):
        return str(value).lower() if isinstance(value, bool) else str(value)
    if is_metric(name):
        return f"{shown(name)[0] * value:.4g}"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
