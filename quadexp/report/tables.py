"""The error table: trajectory and speed down, controllers across, the mean over seeds in each cell.

One table, four forms: terminal (rich), Markdown, LaTeX (booktabs), and the rows behind it as CSV and Parquet.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.report.metrics import SHOWN

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
    "outcome",
    "backend",
    "cause",
    "key",
)
TEXT_COLUMNS = (
    "plant", "vehicle", "trajectory", "controller", "model", "variant", "outcome", "backend", "cause", "key",
)  # fmt: skip
INTEGER_COLUMNS = ("seed", "last_resort_count")

TITLES = {"rmse": "RMSE", "mean_error": "mean error", "max_error": "largest error"}


@dataclass(frozen=True)
class Entry:
    """One cell of the table.

    mean, spread: over the flights that ended well (shown unit); spread is the standard deviation, NaN for one flight.
    flights: how many there were. lost: outcome -> count of those that did not end well.
    """

    mean: float
    spread: float
    flights: int
    lost: Mapping[str, int]
    best: bool = False

    def text(self) -> str:
        """Such as "12.3", "12.3 (1 lost)" or "3 lost"."""
        lost = ", ".join(f"{count} {outcome}" for outcome, count in self.lost.items())
        if math.isnan(self.mean):
            return lost or "-"
        return significant(self.mean) + (f" ({lost})" if lost else "")


@dataclass(frozen=True)
class ErrorTable:
    """rows: (trajectory, speed text). columns: controller labels. entries: (row, column) -> Entry."""

    metric: str
    unit: str
    rows: tuple[tuple[str, str], ...]
    columns: tuple[str, ...]
    entries: Mapping[tuple[tuple[str, str], str], Entry]

    @property
    def title(self) -> str:
        return f"{TITLES[self.metric]} ({self.unit})"


def significant(value: float) -> str:
    """Three significant digits or one decimal, whichever says more: 0.0123, 1.23, 12.3, 123.4."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    return f"{value:.{max(1, 2 - math.floor(math.log10(abs(value))))}f}"


def column_labels(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """What stands over each row's column: the controller, and whatever else tells two columns apart."""
    models: dict[str, set[str]] = {}
    for row in rows:
        models.setdefault(row["controller"], set()).add(row["model"])
    paths = set().union(*models.values())
    short = {path: path.rstrip("/").rpartition("/")[2] for path in paths}
    if len(set(short.values())) < len(paths):  # two checkpoints of one name: say where they lie
        short = {path: path for path in paths}
    plants = {row["plant"] for row in rows}
    vehicles = {row["vehicle"] for row in rows}
    labels = []
    for row in rows:
        label = row["controller"]
        if len(models[label]) > 1 and row["model"]:
            label += f" {short[row['model']]}"
        if row.get("variant"):  # "controller.nodes=20" is said as "nodes=20"
            label += "".join(f" {part.rpartition('.')[2]}" for part in row["variant"].split(" "))
        if len(plants) > 1:
            label += f" @{row['plant']}"
        if len(vehicles) > 1:
            label += f" @{row['vehicle']}"
        labels.append(label)
    return labels


def error_table(rows: Sequence[Mapping[str, Any]], metric: str = "mean_error") -> ErrorTable:
    """The table of one metric; the best of a row is marked among the flights on one plant and vehicle."""
    factor, unit = SHOWN[metric]
    groups: dict[tuple[tuple[str, str], str], list[Mapping[str, Any]]] = {}
    order: dict[tuple[str, float], tuple[str, str]] = {}
    columns: dict[str, tuple[str, str]] = {}
    for row, label in zip(rows, column_labels(rows), strict=True):
        speed = row["speed"]
        speed = math.nan if speed is None else float(speed)
        line = (row["trajectory"], "" if math.isnan(speed) else f"{speed:g}")
        order.setdefault((row["trajectory"], -1.0 if math.isnan(speed) else speed), line)
        columns.setdefault(label, (row["plant"], row["vehicle"]))
        groups.setdefault((line, label), []).append(row)
    entries = {at: _entry(group, metric, factor) for at, group in groups.items()}
    names = list(dict.fromkeys(name for name, _ in order))
    lines = tuple(order[key] for key in sorted(order, key=lambda key: (names.index(key[0]), key[1])))
    for line in lines:
        for world in set(columns.values()):
            rivals = [c for c in columns if columns[c] == world and (line, c) in entries]
            means = {c: entries[line, c].mean for c in rivals if not math.isnan(entries[line, c].mean)}
            if len(rivals) > 1 and means:
                best = min(means, key=lambda c: means[c])
                entry = entries[line, best]
                entries[line, best] = Entry(entry.mean, entry.spread, entry.flights, entry.lost, best=True)
    return ErrorTable(metric, unit, lines, tuple(columns), entries)


def _entry(group: Sequence[Mapping[str, Any]], metric: str, factor: float) -> Entry:
    good = [factor * row[metric] for row in group if row["outcome"] == "ok"]
    lost: dict[str, int] = {}
    for row in group:
        if row["outcome"] != "ok":
            lost[row["outcome"]] = lost.get(row["outcome"], 0) + 1
    mean = float(np.mean(good)) if good else math.nan
    spread = float(np.std(good, ddof=1)) if len(good) > 1 else math.nan
    return Entry(mean, spread, len(group), lost)


def to_rich(table: ErrorTable) -> Any:
    """A rich Table for the terminal."""
    from rich.table import Table

    shown = Table(title=table.title, title_justify="left")
    for heading in ("trajectory", "m/s"):
        shown.add_column(heading, justify="left" if heading == "trajectory" else "right")
    for heading in table.columns:
        shown.add_column(heading, justify="right", overflow="fold")
    for line in table.rows:
        shown.add_row(*line, *(_decorated(table, line, column, "[bold]{}[/bold]") for column in table.columns))
    return shown


def to_markdown(table: ErrorTable) -> str:
    """A Markdown table."""
    head = ["trajectory", "m/s", *table.columns]
    lines = [
        f"{table.title}, mean over seeds",
        "",
        _pipes(head),
        _pipes(["---", "---:"] + ["---:"] * len(table.columns)),
    ]
    lines += [
        _pipes([*line, *(_decorated(table, line, column, "**{}**") for column in table.columns)]) for line in table.rows
    ]
    return "\n".join(lines) + "\n"


def to_latex(table: ErrorTable) -> str:
    """A LaTeX tabular with booktabs rules."""
    head = ["trajectory", "m/s", *table.columns]
    lines = [
        f"% {table.title}, mean over seeds; needs \\usepackage{{booktabs}}",
        r"\begin{tabular}{lr" + "r" * len(table.columns) + "}",
        r"\toprule",
        " & ".join(map(_escape, head)) + r" \\",
        r"\midrule",
    ]
    previous = None
    for line in table.rows:
        if previous not in (None, line[0]):
            lines.append(r"\addlinespace")
        previous = line[0]
        cells = [_decorated(table, line, column, r"\textbf{{{}}}") for column in table.columns]
        lines.append(" & ".join([*map(_escape, line), *cells]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def _decorated(table: ErrorTable, line: tuple[str, str], column: str, best: str) -> str:
    entry = table.entries.get((line, column))
    if entry is None:
        return "-"
    text = entry.text().replace("_", r"\_") if best.startswith("\\") else entry.text()
    return best.format(text) if entry.best else text


def _pipes(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _escape(text: str) -> str:
    for character in "\\&%$#_{}":
        text = text.replace(character, r"\textbackslash{}" if character == "\\" else f"\\{character}")
    return text


def to_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows behind the table, numbers in full precision."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, ROW_COLUMNS, lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: _csv_value(row.get(name)) for name in ROW_COLUMNS})
    return stream.getvalue()


def _csv_value(value: Any) -> str:
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
