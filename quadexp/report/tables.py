"""The tables of a sweep.

The error table has trajectory and speed down and controllers across; every setting that was swept is a column of its
own, with its unit above and its values down, and so are many plants or worlds. The first row counts the flights that
completed; cells are means over the common flights of a trajectory and speed (pairing.py), or say "invalid" where
settings contradict each other. The comparison table has one row per contestant and condition, against the baseline.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any

from quadexp.report.frame import setting_text, with_unit
from quadexp.report.metrics import SHOWN
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
from quadexp.report.table import Table
from quadexp.report.text import p_value, speed_text, with_interval
from quadexp.report.winner import Verdict, verdicts

MOST_ACROSS = 6  # columns of an error table; with more, several plants are told apart by rows
TITLES = {"rmse": "RMSE", "mean_error": "mean error", "max_error": "largest error"}
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
    keys: settings that were swept. invalid: (row, column) of settings that contradict each other."""

    metric: str
    unit: str
    rows: tuple[Line, ...]
    columns: tuple[str, ...]
    entries: Mapping[tuple[Line, str], Statistic]
    flown: Mapping[str, Flights]
    notes: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()
    invalid: Set[tuple[Line, str]] = frozenset()

    @property
    def title(self) -> str:
        return f"{TITLES[self.metric]} ({self.unit})"

    def table(self, *, speed: str = "m/s", over: bool = False) -> Table:
        """As texts. speed: heading of that column. over: title above the controllers."""
        counts = (self.flown[column] for column in self.columns)
        empty = [""] * (1 + len(self.keys))
        rows = [["flown", *empty, *(count.text() if count.trials else "-" for count in counts)]]
        rows += [[*line, *(self._text(line, column) for column in self.columns)] for line in self.rows]
        heads = ["trajectory", speed, *map(with_unit, short_keys(self.keys), self.keys), *self.columns]
        beside = 2 + len(self.keys)
        return Table(heads, rows, self.title, head=1, over=self.title if over else "", notes=self.notes, beside=beside)

    def _text(self, line: Line, column: str) -> str:
        entry = self.entries.get((line, column))
        return cell_text(entry) if entry else "invalid" if (line, column) in self.invalid else "-"

    def __str__(self) -> str:
        return to_markdown(self)

    def _repr_html_(self) -> str:
        return self.table().html()


def to_rich(table: ErrorTable, *, stacked: bool = False) -> Any:
    """The error table for the terminal, without its notes."""
    return table.table().rich(stacked=stacked)


def to_markdown(table: ErrorTable) -> str:
    """The error table in Markdown."""
    return table.table().markdown(bullets=True)


def to_latex(table: ErrorTable) -> str:
    """The error table as a LaTeX tabular."""
    return table.table(speed="speed (m/s)", over=True).latex()


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
    labels = {one: ", ".join([one[0], *(setting_text(*pair) for pair in setting_pairs(one[1]))]) for one in conditions}
    count = Counter(labels.values())
    return {one: f"{one[0]} {one[1]}".strip() if count[label] > 1 else label for one, label in labels.items()}


def statistic_labels(statistics: Sequence[Statistic]) -> list[str]:
    """`column_labels` of statistics."""
    return column_labels([row_of(s) for s in statistics])


def row_of(s: Statistic) -> dict[str, Any]:
    """What a statistic tells of the rows it is made from."""
    names = ("plant", "vehicle", "trajectory", "speed", "controller", "model")
    return {**{n: getattr(s, n) for n in names}, "variant": f"{s.variant} {s.setting}".strip()}


def short_keys(keys: Sequence[str]) -> list[str]:
    """The last part of each key, such as "nodes"; the whole key where two end alike."""
    last = [key.rpartition(".")[2] for key in keys]
    return [short if last.count(short) == 1 else key for key, short in zip(keys, last, strict=True)]


def table_of(
    statistics: Sequence[Statistic],
    pooled: Sequence[Statistic] = (),
    found: Sequence[Verdict] = (),
    more: Sequence[str] = (),
    invalid: Sequence[Mapping[str, Any]] = (),
) -> ErrorTable:
    """The error table of one metric's statistics. pooled, found, more: for the notes, over all conditions. invalid:
    rows of results whose settings contradict each other."""
    metric = statistics[0].metric
    rows = [*map(row_of, statistics), *invalid]
    keys = swept_settings(rows)
    bare = [without_settings(row, keys) for row in rows]
    labels = column_labels(bare)
    if len(set(labels)) > MOST_ACROSS and len({row["plant"] for row in rows}) > 1:
        keys = ["plant", *keys]
        labels = column_labels([{**row, "plant": ""} for row in bare])
    order: dict[Line, tuple[str, float]] = {}
    entries: dict[tuple[Line, str], Statistic] = {}
    wrong: set[tuple[Line, str]] = set()
    flown: dict[str, Flights] = {}
    courses = course_labels((row["trajectory"], condition_of(row)[4]) for row in bare)
    for s, row, lean, label in zip([*statistics, *(None for _ in invalid)], rows, bare, labels, strict=True):
        *_, speed, setting = condition_of(lean)
        course = courses[row["trajectory"], setting]
        own = settings_of(row) | {"plant": row["plant"]}
        line = (course, speed_text(speed, ""), *(own.get(key, "") for key in keys))
        order.setdefault(line, (course, -1.0 if speed is None else speed))
        flown[label] = flown.get(label, Flights(0, 0)).plus(s.flown if s else Flights(0, 0))
        if s is None:
            wrong.add((line, label))
        else:
            entries[line, label] = s
    names = list(dict.fromkeys(line[0] for line in order))
    lines = tuple(sorted(order, key=lambda line: (names.index(order[line][0]), order[line][1])))
    notes = (*table_notes(statistics, pooled, found), *more)
    return ErrorTable(
        metric, SHOWN[metric][1], lines, tuple(flown), entries, flown, notes, tuple(keys), wrong - entries.keys()
    )


def settings_of(row: Mapping[str, Any]) -> dict[str, str]:
    """Key -> value, as text, of the settings that vary within the sweep."""
    return dict(setting_pairs(row.get("variant") or ""))


def swept_settings(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """The settings that take several values, those of the conditions first."""
    values: dict[str, set[str]] = {}
    for row in rows:
        for key, value in settings_of(row).items():
            values.setdefault(key, set()).add(value)
    found = [key for key, several in values.items() if len(several) > 1]
    return sorted(found, key=lambda key: key.startswith("controller."))


def without_settings(row: Mapping[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    """The row without the settings of these keys."""
    kept = [f"{key}={value}" for key, value in setting_pairs(row.get("variant") or "") if key not in keys]
    return {**row, "variant": " ".join(kept)}


def error_table(
    rows: Sequence[Mapping[str, Any]],
    metric: str = "mean_error",
    *,
    baseline: str = BASELINE,
    confidence: float = CONFIDENCE,
) -> ErrorTable:
    """The error table of one metric from result rows; see `table_of`."""
    options: dict[str, Any] = {"baseline": baseline, "confidence": confidence}
    statistics = compute_statistics(rows, metrics=(metric,), **options)
    found = verdicts(rows, metric=metric, confidence=confidence)
    invalid = [row for row in rows if is_invalid(row)]
    return table_of(statistics, overall(rows, metric=metric, **options), found, row_notes(rows), invalid)


def comparison_table(statistics: Sequence[Statistic]) -> Table | None:
    """Every contestant against the baseline, condition by condition; None if nobody is compared."""
    metric = statistics[0].metric
    factor, unit = SHOWN[metric]
    heading = ["trajectory", "speed (m/s)", "controller", "seeds", f"difference ({unit})"]
    heading += ["reduction (%)", "effect", "p", "p (Holm)", "left out"]
    courses = course_labels((s.trajectory, s.setting) for s in statistics)
    rows = []
    for s, label in zip(statistics, statistic_labels(statistics), strict=True):
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
