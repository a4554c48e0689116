"""Tables: one model with renderers for text, Markdown, LaTeX, the terminal (rich) and HTML; and the tables of a sweep.

Cells are texts. In a cell, `**x**` marks the best value and a final `*` a significant difference; every renderer
translates these two marks.

The error table has trajectory and speed down and controllers across; a key of the controller that was swept is a column
of its own, with its values down, and so are many plants or worlds. The first row counts the flights that ended well;
cells are means over the common flights of a trajectory and speed (pairing.py), or say "invalid" where settings
contradict each other. The comparison table has one row per contestant and condition, against the baseline.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quadexp.messages import clean
from quadexp.report.metrics import SHOWN
from quadexp.report.notes import notes as row_notes
from quadexp.report.notes import table_notes
from quadexp.report.pairing import (
    Flights,
    condition_of,
    contestant_labels,
    contestant_of,
    is_invalid,
    setting_pairs,
    variant_parts,
)  # fmt: skip
from quadexp.report.statistics import BASELINE, CONFIDENCE, Overall, Statistic, compute_statistics, overall
from quadexp.report.text import p_value, speed_text, with_interval
from quadexp.report.winner import Verdict, verdicts

# Columns of a result row, in the order they are written.
ROW_COLUMNS = (
    "plant", "vehicle", "trajectory", "speed", "controller", "model", "variant", "seed", "rmse", "mean_error",
    "max_error", "attitude_rmse", "heading_rmse", "solve_time_median", "solve_time_p99", "solve_time_max",
    "saturated_share", "peak_speed", "duration", "unconverged_count", "reference_residual", "outside_data", "outcome",
    "backend", "cause", "program", "sources", "libraries", "key",
)  # fmt: skip
TEXT_COLUMNS = (
    "plant", "vehicle", "trajectory", "controller", "model", "variant", "outcome", "backend", "cause",
    "program", "sources", "libraries", "key",
)  # fmt: skip
INTEGER_COLUMNS = ("seed", "unconverged_count")
MOST_ACROSS = 6  # columns of an error table; with more, several plants are told apart by rows
TITLES = {"rmse": "RMSE", "mean_error": "mean error", "max_error": "largest error"}
NAN = math.nan

_LATEX = str.maketrans({c: f"\\{c}" for c in "&%$#_{}"} | {"\\": r"\textbackslash{}", "<": "$<$"})
_BEST = re.compile(r"\*\*(.+?)\*\*")


@dataclass(frozen=True)
class Table:
    """columns: headings, with units in parentheses. rows: texts. left: indices of left-aligned columns. head: number
    of rows that belong to the heading. over: a heading above all columns but the first `beside`. notes: lines below.
    groups: index of a column -> text above the columns that begin there, in plain text."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    left: Set[int] = frozenset({0})
    head: int = 0
    over: str = ""
    beside: int = 2
    notes: Sequence[str] = ()
    groups: Mapping[int, str] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """Plain text, columns aligned."""
        widths = [max(map(len, column)) for column in zip(self.columns, *self.rows, strict=True)]
        lines = [self.title] if self.title else []
        above = ""
        for (i, text), end in zip(self.groups.items(), [*list(self.groups)[1:], len(widths)], strict=False):
            widths[i] += max(0, len(text) - sum(widths[i:end]) - 2 * (end - i - 1))
            above = above.ljust(sum(widths[:i]) + 2 * i) + text
        lines += [above] if above else []
        for row in (self.columns, *self.rows):
            cells = (
                c.ljust(w) if i in self.left else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))
            )
            lines.append("  ".join(cells).rstrip())
        return lines + list(self.notes)

    def markdown(self, *, bullets: bool = False) -> str:
        """Markdown. bullets: notes as a list."""
        rule = ["---" if i in self.left else "---:" for i in range(len(self.columns))]
        lines = [self.title, ""] if self.title else []
        lines += ["| " + " | ".join(row) + " |" for row in (self.columns, rule, *self.rows)]
        notes = [f"- {note}".replace("* ", "&ast; ") if bullets else note for note in self.notes]  # "* " begins a list
        return "\n".join([*lines, *(["", *notes] if notes or bullets else [])]) + "\n"

    def latex(self) -> str:
        """A LaTeX tabular with booktabs rules; with `over`, rows of different first cells are set apart."""
        columns = "".join("l" if i in self.left else "r" for i in range(len(self.columns)))
        lines = [rf"% {'' if self.over else f'{self.title}; '}needs \usepackage{{booktabs}}"]
        lines += [*(f"% {note}" for note in self.notes), rf"\begin{{tabular}}{{{columns}}}", r"\toprule"]
        if self.over:
            span = rf"\multicolumn{{{len(columns) - self.beside}}}{{c}}{{{escape(self.over)}}}"
            lines.append(rf"{' &' * self.beside} {span} \\ \cmidrule(l){{{self.beside + 1}-{len(columns)}}}")
        lines += [_latex_row(self.columns), r"\midrule", *map(_latex_row, self.rows[: self.head])]
        lines += [r"\midrule"] if self.head else []
        for before, row in zip([None, *self.rows[self.head :]], self.rows[self.head :], strict=False):
            lines += [r"\addlinespace"] if self.over and before and before[0] != row[0] else []
            lines.append(_latex_row(row))
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"

    def csv(self) -> str:
        """CSV of the texts, without the marks of the best and of significance."""
        rows = ([re.sub(r"\*$", "", _BEST.sub(r"\1", cell)) for cell in row] for row in self.rows)
        return csv_text(self.columns, rows)

    def rendered(self, form: str) -> str:
        """As csv, markdown or latex."""
        return {"csv": self.csv, "markdown": self.markdown, "latex": self.latex}[form]()

    def rich(self, *, stacked: bool = False) -> Any:
        """A rich Table for the terminal. stacked: intervals below their values, for a narrow terminal."""
        from rich import markup, table

        shown = table.Table(title=self.title, title_justify="left")
        for i, heading in enumerate(self.columns):
            shown.add_column(markup.escape(heading), justify="left" if i in self.left else "right", overflow="fold")
        for k, row in enumerate(self.rows):
            cells = [_BEST.sub(r"[bold]\1[/bold]", markup.escape(cell)) for cell in row]
            shown.add_row(
                *(re.sub(r" \[(?=[-\d])", "\n[", c) if stacked else c for c in cells), end_section=k + 1 == self.head
            )
        return shown

    def html(self) -> str:
        """An HTML table without style; also what a notebook shows."""
        from html import escape

        def plain(text: str) -> str:
            return escape(clean(text))

        def line(cells: Sequence[str], tag: str) -> str:
            texts = (_BEST.sub(r"<b>\1</b>", plain(cell)) for cell in cells)
            sides = ("left" if i in self.left else "right" for i in range(len(cells)))
            cells = [f'<{tag} style="text-align:{s}">{t}</{tag}>' for s, t in zip(sides, texts, strict=True)]
            return f"<tr>{''.join(cells)}</tr>"

        rows = "".join(line(row, "td") for row in self.rows)
        notes = "".join(f"<p>{plain(note)}</p>" for note in self.notes)
        caption = f"<caption>{plain(self.title)}</caption>"
        return f"<table>{caption}<thead>{line(self.columns, 'th')}</thead><tbody>{rows}</tbody></table>{notes}"

    _repr_html_ = html


def _latex_row(cells: Sequence[str]) -> str:
    texts = (_BEST.sub(r"\\textbf{\1}", escape(cell)).replace("*", "$^*$") for cell in cells)
    return " & ".join(texts) + r" \\"


def escape(text: str) -> str:
    """Text for LaTeX."""
    return text.translate(_LATEX)


Line = tuple[str, ...]  # of an error table: trajectory with what else varies, speed, values of swept keys


@dataclass(frozen=True)
class Entry:
    """One cell of the error table.

    mean, low, high, spread: over the common `flights`, with its interval and standard deviation (shown unit); NaN if
    there are none. own, own_flights: mean over all own flights that ended well, and their number. lost: outcome ->
    number of those that did not end well. best: see winner.py. significant: differs from the baseline.
    """

    mean: float
    spread: float
    flights: int
    lost: Mapping[str, int]
    low: float
    high: float
    own: float
    own_flights: int
    best: bool
    significant: bool

    @classmethod
    def of(cls, s: Statistic) -> Entry:
        """The cell of one statistic, in the unit that tables show."""
        factor = SHOWN[s.metric][0]
        values = (factor * v for v in (s.common_mean, s.common_std, s.common_low, s.common_high, s.mean))
        mean, spread, low, high, own = values
        return cls(mean, spread, s.common, s.failures, low, high, own, s.n, s.best, s.significant)

    @property
    def value(self) -> tuple[str, str]:
        """Mean and interval as text, ("", "") without common flights."""
        return ("", "") if math.isnan(self.mean) else with_interval(self.mean, self.low, self.high)

    def text(self) -> str:
        """Such as "12.3", "**240.6** [239.9, 241.2]*", "12.3 (own 13.1 of 19; 1 lost)" or "3 lost"."""
        beside = "; ".join(part for part in (self.own_text(), self.lost_text()) if part)
        mean, limits = self.value
        if not mean:
            return beside or "-"
        mean = f"**{mean}**" if self.best else mean
        return mean + limits + ("*" if self.significant else "") + (f" ({beside})" if beside else "")

    def own_text(self) -> str:
        """Such as "own 13.1 of 19"; "" if all own flights are common ones."""
        own = self.own_flights > self.flights
        return f"own {with_interval(self.own, NAN, NAN)[0]} of {self.own_flights}" if own else ""

    def lost_text(self) -> str:
        return ", ".join(f"{count} {outcome}" for outcome, count in self.lost.items())


@dataclass(frozen=True)
class ErrorTable:
    """rows: (trajectory and what else varies, speed text, a value of each of `keys`). columns: controller labels.
    flown: column -> how many of its flights ended well. entries: (row, column) -> Entry. notes: lines below the table.
    keys: swept keys of the controllers. invalid: (row, column) of settings that contradict each other."""

    metric: str
    unit: str
    rows: tuple[Line, ...]
    columns: tuple[str, ...]
    entries: Mapping[tuple[Line, str], Entry]
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
        heads = ["trajectory", speed, *short_keys(self.keys), *self.columns]
        beside = 2 + len(self.keys)
        return Table(heads, rows, self.title, head=1, over=self.title if over else "", notes=self.notes, beside=beside)

    def _text(self, line: Line, column: str) -> str:
        entry = self.entries.get((line, column))
        return entry.text() if entry else "invalid" if (line, column) in self.invalid else "-"

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


def course_labels(conditions: Iterable[tuple[str, str]]) -> dict[tuple[str, str], str]:
    """(trajectory, other settings) -> label of a line, such as "circle payload=0.1"; no two are the same."""
    conditions = list(dict.fromkeys(conditions))
    labels = {one: " ".join([one[0], *variant_parts(one[1])]) for one in conditions}
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
    pooled: Sequence[Overall] = (),
    found: Sequence[Verdict] = (),
    more: Sequence[str] = (),
    invalid: Sequence[Mapping[str, Any]] = (),
) -> ErrorTable:
    """The error table of one metric's statistics. pooled, found, more: for the notes, over all conditions. invalid:
    rows of results whose settings contradict each other."""
    metric = statistics[0].metric
    rows = [*map(row_of, statistics), *invalid]
    keys = swept_settings(rows)
    labels = column_labels([without_settings(row, keys) for row in rows])
    if len(set(labels)) > MOST_ACROSS and len({row["plant"] for row in rows}) > 1:
        keys = ["plant", *keys]
        labels = column_labels([{**without_settings(row, keys), "plant": ""} for row in rows])
    order: dict[Line, tuple[str, float]] = {}
    entries: dict[tuple[Line, str], Entry] = {}
    wrong: set[tuple[Line, str]] = set()
    flown: dict[str, Flights] = {}
    courses = course_labels((row["trajectory"], condition_of(row)[4]) for row in rows)
    for s, row, label in zip([*statistics, *(None for _ in invalid)], rows, labels, strict=True):
        *_, speed, setting = condition_of(row)
        course = courses[row["trajectory"], setting]
        own = settings_of(row) | {"plant": row["plant"]}
        line = (course, speed_text(speed, ""), *(own.get(key, "") for key in keys))
        order.setdefault(line, (course, -1.0 if speed is None else speed))
        flown[label] = flown.get(label, Flights(0, 0)).plus(s.flown if s else Flights(0, 0))
        if s is None:
            wrong.add((line, label))
        else:
            entries[line, label] = Entry.of(s)
    names = list(dict.fromkeys(line[0] for line in order))
    lines = tuple(sorted(order, key=lambda line: (names.index(order[line][0]), order[line][1])))
    notes = (*table_notes(statistics, pooled, found), *more)
    return ErrorTable(
        metric, SHOWN[metric][1], lines, tuple(flown), entries, flown, notes, tuple(keys), wrong - entries.keys()
    )


def settings_of(row: Mapping[str, Any]) -> dict[str, str]:
    """Key -> value, as text, of the controller's settings that vary within the sweep."""
    return dict(setting_pairs(contestant_of(row)[2]))


def swept_settings(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """The keys of the controllers that take several values."""
    values: dict[str, set[str]] = {}
    for row in rows:
        for key, value in settings_of(row).items():
            values.setdefault(key, set()).add(value)
    return [key for key, several in values.items() if len(several) > 1]


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
    heading = ["trajectory", "speed (m/s)", "controller", "pairs", f"difference ({unit})"]
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
        "difference: contestant less baseline over the pairs; reduction: positive where better; effect: matched-pairs"
        " rank-biserial in [-1, 1]; p: paired permutation test, then corrected by Holm over"
        f" {max(s.comparisons for s in statistics)} comparisons"
    )
    title = f"{TITLES[metric]} against {', '.join(baselines)}"
    return Table(heading, rows, title, left=frozenset({0, 2, len(heading) - 1}), notes=(note,))


def records_table(records: Sequence[Mapping[str, Any]], title: str = "") -> Table:
    """A table of records, a row each: numbers in full precision, nothing for what is missing."""
    names = list(dict.fromkeys(name for record in records for name in record))
    rows = [[_exact(record.get(name)) for name in names] for record in records]
    left = {i for i, name in enumerate(names) if any(isinstance(record.get(name), str) for record in records)}
    return Table(names, rows, title, left=frozenset(left))


def _exact(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return repr(float(value)) if isinstance(value, float) else str(value)


def csv_text(names: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """CSV with the shortest digits that give every number back; empty for None and NaN."""

    def text(value: Any) -> str:
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return ""
        return repr(value) if isinstance(value, float) else str(value)

    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(names)
    writer.writerows(map(text, row) for row in rows)
    return stream.getvalue()


def to_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Result rows as CSV, numbers in full precision."""
    return csv_text(ROW_COLUMNS, ([row.get(name) for name in ROW_COLUMNS] for row in rows))


def to_columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Result rows as columns of fixed types, for Parquet."""
    columns: dict[str, Any] = {}
    for name in ROW_COLUMNS:
        kind: Any = object if name in TEXT_COLUMNS else np.int64 if name in INTEGER_COLUMNS else float
        empty = {object: "", np.int64: 0, float: NAN}[kind]
        values = [empty if (value := row.get(name)) is None else value for row in rows]
        columns[name] = np.array([str(v) for v in values] if kind is object else values, dtype=kind)
    return columns


def from_columns(columns: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Result rows from the columns of a results file."""
    lists = [column.tolist() for column in columns.values()]
    return [dict(zip(columns, values, strict=True)) for values in zip(*lists, strict=True)]
