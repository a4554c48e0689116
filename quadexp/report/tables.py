"""The error table: trajectory and speed down, controllers across; first how many flights ended well, then the mean over
the flights of a line that all who are compared ended well (common.py) and its interval in each cell.

One table, four forms: terminal (rich), Markdown, LaTeX (booktabs), and the rows behind it as CSV and Parquet.
"""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.report.common import Flights
from quadexp.report.metrics import SHOWN
from quadexp.report.notes import notes as row_notes
from quadexp.report.overall import Overall, overall
from quadexp.report.pairing import contestant_labels, contestant_of, variant_parts
from quadexp.report.statistics import BASELINE, CONFIDENCE, Statistic, compute_statistics
from quadexp.report.winner import Verdict, verdicts
from quadexp.report.wording import notes, with_interval

# Columns of a result row, in the order they are written.
ROW_COLUMNS = (
    "plant",
    "vehicle",
    "trajectory",
    "speed",
    "controller",
    "model",
    "variant",
    "seed",
    "rmse",
    "mean_error",
    "max_error",
    "attitude_rmse",
    "solve_time_median",
    "solve_time_p99",
    "solve_time_max",
    "saturated_share",
    "peak_speed",
    "duration",
    "last_resort_count",
    "unconverged_count",
    "reference_residual",
    "outside_data",
    "outcome",
    "backend",
    "cause",
    "program",
    "sources",
    "libraries",
    "key",
)
TEXT_COLUMNS = (
    "plant", "vehicle", "trajectory", "controller", "model", "variant", "outcome", "backend", "cause",
    "program", "sources", "libraries", "key",
)  # fmt: skip
INTEGER_COLUMNS = ("seed", "last_resort_count", "unconverged_count")

_LATEX = str.maketrans({c: f"\\{c}" for c in "&%$#_{}"} | {"\\": r"\textbackslash{}", "<": "$<$"})

TITLES = {"rmse": "RMSE", "mean_error": "mean error", "max_error": "largest error"}


@dataclass(frozen=True)
class Entry:
    """One cell of the table.

    mean, low, high, spread: over the `flights` that all who are compared ended well, with its interval and standard
    deviation (shown unit); NaN where there is none. own, own_flights: mean over all that it ended well itself, and
    their number. lost: outcome -> count of those that did not end well. best: marked, see winner.py. significant:
    differs from the baseline.
    """

    mean: float
    spread: float
    flights: int
    lost: Mapping[str, int]
    low: float = math.nan
    high: float = math.nan
    own: float = math.nan
    own_flights: int = 0
    success: float = math.nan
    best: bool = False
    significant: bool = False

    def text(self, emphasis: str = "{}") -> str:
        """Such as "12.3", "240.6 [239.9, 241.2]*", "12.3 (own 13.1 of 19; 1 lost)" or "3 lost".

        emphasis: of the mean if it is best.
        """
        lost = ", ".join(f"{count} {outcome}" for outcome, count in self.lost.items())
        beside = "; ".join(part for part in (self.own_text(), lost) if part)
        if math.isnan(self.mean):
            return beside or "-"
        mean, limits = with_interval(self.mean, self.low, self.high)
        mean = emphasis.format(mean) if self.best else mean
        return mean + limits + ("*" if self.significant else "") + (f" ({beside})" if beside else "")

    def own_text(self) -> str:
        """Such as "own 13.1 of 19"; "" where it flew nothing beyond the common flights."""
        if self.own_flights <= self.flights:
            return ""
        return f"own {with_interval(self.own, math.nan, math.nan)[0]} of {self.own_flights}"


@dataclass(frozen=True)
class ErrorTable:
    """rows: (trajectory and what else varies, speed text). columns: controller labels. flown: column -> how many of its
    flights ended well. entries: (row, column) -> Entry. notes: lines below, what the numbers are, how they compare over
    all, and what else to know."""

    metric: str
    unit: str
    rows: tuple[tuple[str, str], ...]
    columns: tuple[str, ...]
    entries: Mapping[tuple[tuple[str, str], str], Entry]
    flown: Mapping[str, Flights]
    notes: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        return f"{TITLES[self.metric]} ({self.unit})"


def column_labels(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """What stands over each row's column: the controller with its settings; plant and vehicle if there are several.

    What else varies is of the condition: it stands beside the trajectory, see `course_labels`.
    """
    labels = contestant_labels(list(dict.fromkeys(map(contestant_of, rows))))
    plants = {row["plant"] for row in rows}
    vehicles = {row["vehicle"] for row in rows}
    made = []
    for row in rows:
        parts = [labels[contestant_of(row)]]
        parts += [f"@{row['plant']}"] if len(plants) > 1 else []
        parts += [f"@{row['vehicle']}"] if len(vehicles) > 1 else []
        made.append(" ".join(parts))
    return made


def course_labels(conditions: Iterable[tuple[str, str]]) -> dict[tuple[str, str], str]:
    """(trajectory, other settings) -> label of a line, such as "circle payload=0.1"; no two are the same."""
    conditions = list(dict.fromkeys(conditions))
    labels = {one: " ".join([one[0], *variant_parts(one[1])]) for one in conditions}
    count = Counter(labels.values())
    return {one: f"{one[0]} {one[1]}".strip() if count[label] > 1 else label for one, label in labels.items()}


def table_rows(statistics: Sequence[Statistic]) -> list[dict[str, Any]]:
    """What `column_labels` asks of a row, of statistics."""
    names = ("plant", "vehicle", "controller", "model")
    return [
        {**{name: getattr(s, name) for name in names}, "variant": f"{s.variant} {s.setting}".strip()}
        for s in statistics
    ]


def error_table(
    rows: Sequence[Mapping[str, Any]],
    metric: str = "mean_error",
    *,
    baseline: str = BASELINE,
    confidence: float = CONFIDENCE,
) -> ErrorTable:
    """The table of one metric from result rows; see `table_of`."""
    options: dict[str, Any] = {"baseline": baseline, "confidence": confidence}
    statistics = compute_statistics(rows, metrics=(metric,), **options)
    found = verdicts(rows, metric=metric, confidence=confidence)
    return table_of(statistics, overall(rows, metric=metric, **options), found, row_notes(rows))


def table_of(
    statistics: Sequence[Statistic],
    pooled: Sequence[Overall] = (),
    found: Sequence[Verdict] = (),
    more: Sequence[str] = (),
) -> ErrorTable:
    """The table of one metric's statistics. pooled, found, more: said in the notes, over all conditions."""
    metric = statistics[0].metric
    factor, unit = SHOWN[metric]
    courses = course_labels((s.trajectory, s.setting) for s in statistics)
    order: dict[tuple[str, float], tuple[str, str]] = {}
    entries: dict[tuple[tuple[str, str], str], Entry] = {}
    flown: dict[str, Flights] = {}
    for statistic, label in zip(statistics, column_labels(table_rows(statistics)), strict=True):
        speed, course = statistic.speed, courses[statistic.trajectory, statistic.setting]
        line = (course, "" if math.isnan(speed) else f"{speed:g}")
        order.setdefault((course, -1.0 if math.isnan(speed) else speed), line)
        before, here = flown.get(label, Flights(0, 0)), statistic.flown
        flown[label] = Flights(before.ended + here.ended, before.trials + here.trials)
        entries[line, label] = Entry(
            mean=factor * statistic.common_mean,
            spread=factor * statistic.common_std,
            flights=statistic.common,
            lost=statistic.failures,
            low=factor * statistic.common_low,
            high=factor * statistic.common_high,
            own=factor * statistic.mean,
            own_flights=statistic.n,
            success=statistic.success,
            best=statistic.best,
            significant=statistic.significant,
        )
    names = list(dict.fromkeys(name for name, _ in order))
    lines = tuple(order[key] for key in sorted(order, key=lambda key: (names.index(key[0]), key[1])))
    said = (*notes(statistics, pooled, found), *more)
    return ErrorTable(metric, unit, lines, tuple(flown), entries, flown, said)


def to_rich(table: ErrorTable, *, stacked: bool = False) -> Any:
    """A rich Table for the terminal. stacked: intervals below their means, for a narrow one."""
    from rich.markup import escape as plain
    from rich.table import Table

    shown = Table(title=table.title, title_justify="left")
    for heading in ("trajectory", "m/s"):
        shown.add_column(heading, justify="left" if heading == "trajectory" else "right")
    for heading in table.columns:
        shown.add_column(plain(heading), justify="right", overflow="fold")
    shown.add_row(*flown_cells(table), end_section=True)
    for line in table.rows:
        cells = [_decorated(table, line, column, "[bold]{}[/bold]") for column in table.columns]
        shown.add_row(*map(plain, line), *(cell.replace(" [", "\n[") if stacked else cell for cell in cells))
    return shown


def to_markdown(table: ErrorTable) -> str:
    """A Markdown table."""
    head = ["trajectory", "m/s", *table.columns]
    lines = [
        table.title,
        "",
        pipes(head),
        pipes(["---", "---:"] + ["---:"] * len(table.columns)),
        pipes(flown_cells(table)),
    ]
    lines += [
        pipes([*line, *(_decorated(table, line, column, "**{}**") for column in table.columns)]) for line in table.rows
    ]
    # A star would begin a list.
    lines += ["", *(f"- {note.replace('* ', '&ast; ')}" for note in table.notes)]
    return "\n".join(lines) + "\n"


def to_latex(table: ErrorTable) -> str:
    """A LaTeX tabular with booktabs rules."""
    last = len(table.columns) + 2
    lines = [
        r"% needs \usepackage{booktabs}",
        *(f"% {note}" for note in table.notes),
        r"\begin{tabular}{lr" + "r" * len(table.columns) + "}",
        r"\toprule",
        rf" & & \multicolumn{{{last - 2}}}{{c}}{{{escape(table.title)}}} \\ \cmidrule(l){{3-{last}}}",
        " & ".join(map(escape, ["trajectory", "speed (m/s)", *table.columns])) + r" \\",
        r"\midrule",
        " & ".join(flown_cells(table)) + r" \\",
        r"\midrule",
    ]
    previous = None
    for line in table.rows:
        if previous not in (None, line[0]):
            lines.append(r"\addlinespace")
        previous = line[0]
        cells = [_decorated(table, line, column, r"\textbf{{{}}}") for column in table.columns]
        lines.append(" & ".join([*map(escape, line), *cells]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def flown_cells(table: ErrorTable) -> list[str]:
    """The first line of every form: how many flights of each column ended well."""
    return ["flown", "", *(table.flown[column].text() for column in table.columns)]


def _decorated(table: ErrorTable, line: tuple[str, str], column: str, best: str) -> str:
    entry = table.entries.get((line, column))
    if entry is None:
        return "-"
    if not best.startswith("\\"):
        return entry.text(best)
    return entry.text(best).replace("_", r"\_").replace("*", "$^*$")


def pipes(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def escape(text: str) -> str:
    """Text for LaTeX."""
    return text.translate(_LATEX)


def to_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows behind the table, numbers in full precision."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, ROW_COLUMNS, lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: csv_value(row.get(name)) for name in ROW_COLUMNS})
    return stream.getvalue()


def csv_value(value: Any) -> str:
    """Shortest digits that give the number back; nothing for what is not there."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return repr(value) if isinstance(value, float) else str(value)


def to_columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The rows as columns with settled types, for Parquet."""
    columns: dict[str, Any] = {}
    for name in ROW_COLUMNS:
        values = [row.get(name) for row in rows]
        if name in TEXT_COLUMNS:
            columns[name] = np.array(["" if v is None else str(v) for v in values], dtype=object)
        elif name in INTEGER_COLUMNS:
            columns[name] = np.array([0 if v is None else int(v) for v in values], dtype=np.int64)
        else:
            columns[name] = np.array([math.nan if v is None else float(v) for v in values], dtype=float)
    return columns


def from_columns(columns: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rows from the columns of a results file."""
    names = list(columns)
    lists = [columns[name].tolist() for name in names]
    return [dict(zip(names, values, strict=True)) for values in zip(*lists, strict=True)]
