"""The tables of a sweep: errors, comparisons, flights; and the files of the first two.

The error table has trajectory and speed down and controllers across; every setting that was swept is a column of its
own, with its unit above and its values down, and so are many plants or worlds. The first row counts the flights that
completed; cells are means over the common flights of a trajectory and speed (pairing.py), or say "invalid" where
settings contradict each other. The comparison table has one row per contestant and condition, against the baseline.
The table of flights has any columns of the results and any keys, for the terminal, as CSV and as a sortable page.

<results>/statistics.parquet, .csv    every metric, long
<results>/table.md, .tex              one metric: the error table, and in table.md the comparisons
<results>/table.tex, comparison.tex   the same in LaTeX, fitted to a page by the service `paper_texts`
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError
from quadexp.log.outcome import COMPLETED
from quadexp.log.store import read_table, read_text, write_table
from quadexp.names import distinct
from quadexp.parts.cells import OPTION
from quadexp.parts.schema import of_contestant
from quadexp.plugin import brought
from quadexp.report.frame import SweepFrame, is_metric, is_number, setting_column, setting_text, with_unit
from quadexp.report.metrics import metric_of
from quadexp.report.notes import notes as row_notes
from quadexp.report.notes import table_notes
from quadexp.report.pairing import (
    BASELINE,
    Flights,
    Groups,
    causes_text,
    condition_of,
    contestant_labels,
    contestant_of,
    grouped,
    is_invalid,
    setting_pairs,
    unambiguous,
)  # fmt: skip
from quadexp.report.significance import Tests
from quadexp.report.statistics import CONFIDENCE, KINDS, Statistic, Statistics, of_lines, pooled
from quadexp.report.table import Table, csv_text
from quadexp.report.text import p_value, plain, shown, speed_text, with_interval
from quadexp.report.winner import verdict
from quadexp.writer import write_text

MOST_ACROSS = 6  # columns of an error table; with more, rows tell several plants apart
STATISTICS = "statistics.parquet"
# What a text file made of statistics is called in the answer of a command.
NAMES = {
    "table.md": "markdown",
    "table.tex": "latex",
    "comparison.tex": "comparison",
    "statistics.csv": "statistics_csv",
}


def cell_text(s: Statistic) -> str:
    """Such as "12.3", "**240.6** [239.9, 241.2]*", "12.3 (all 19: 13.1; 1 lost)" or "3 lost".

    The mean over the common flights with its interval; beside it that over all own completed flights, if these are
    more, and how the others ended."""
    factor, _ = shown(s.metric)
    parts = []
    if s.n > s.common:
        mean, _ = with_interval(factor * s.mean)
        parts.append(f"all {s.n}: {mean}")
    if s.failures:
        parts.append(causes_text(s.failures))
    beside = "; ".join(parts)
    if math.isnan(s.common_mean):
        return beside or "-"
    mean, limits = with_interval(factor * s.common_mean, factor * s.common_low, factor * s.common_high)
    if s.best:
        mean = f"**{mean}**"
    if s.significant:
        limits += "*"
    return f"{mean}{limits} ({beside})" if beside else mean + limits


def column_labels(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The column of each result row: the controller with its settings; plant and vehicle if there are several.

    Other settings belong to the condition: they stand beside the trajectory, see `course_labels`.
    """
    labels = contestant_labels(distinct(map(contestant_of, rows)))
    several = [name for name in ("plant", "vehicle") if len({row[name] for row in rows}) > 1]
    columns = []
    for row in rows:
        label = labels[contestant_of(row)]
        for name in several:
            label += f" @{row[name]}"
        columns.append(label)
    return columns


def course_labels(conditions: Iterable[tuple[str, str]]) -> dict[tuple[str, str], str]:
    """(trajectory, other settings) -> label of a line, such as "circle, payload 0.1 kg"; no two are the same."""
    labels = {}
    for at in distinct(conditions):
        trajectory, variant = at
        settings = [setting_text(*pair) for pair in setting_pairs(variant)]
        labels[at] = ", ".join([trajectory, *settings])
    return unambiguous(labels)


def _row_of(s: Statistic) -> dict[str, Any]:
    """What a statistic tells of the rows it is made from."""
    row = {name: getattr(s, name) for name in ("plant", "vehicle", "trajectory", "speed", "controller", "model")}
    row["variant"] = f"{s.variant} {s.setting}".strip()
    return row


def without_number(results: Sequence[Mapping[str, Any]], metric: str) -> list[str]:
    """A line that says of how many completed flights a metric is no number; none where it is one of all."""
    completed = [row.get(metric) for row in results if row["outcome"] in COMPLETED]
    missing = sum(value in (None, "") or math.isnan(float(value)) for value in completed)
    return [f"{metric} is no number in {missing} of {len(completed)} completed flights"] if missing else []


def error_table(
    results: Sequence[Mapping[str, Any]],
    metric: str = "mean_error",
    *,
    baseline: str = BASELINE,
    confidence: float = CONFIDENCE,
    cell: Callable[[Statistic], str] = cell_text,
) -> Table:
    """The error table of one metric from result rows: counts of completed flights, then a line for each trajectory
    with what else varies, speed and swept settings, with the means."""
    tests = Tests(Groups(results, baseline, (metric,)), 0, confidence)
    statistics = of_lines([tests], (metric,))
    best = [verdict(tests, conditions) for conditions in tests.groups.worlds.values()]
    notes = table_notes(statistics, tests, pooled(tests, list(tests.groups.conditions), metric), best)
    rows = [*map(_row_of, statistics), *filter(is_invalid, results)]
    settings = [dict(setting_pairs(row.get("variant"))) for row in rows]
    values = grouped(pair for pairs in settings for pair in pairs.items())
    keys = []
    for key, several in values.items():
        if len(set(several)) > 1 and not key.endswith(f".{OPTION}"):
            keys.append(key)
    keys.sort(key=of_contestant)  # those of the conditions first
    bare = []
    for row, pairs in zip(rows, settings, strict=True):
        kept = [f"{key}={value}" for key, value in pairs.items() if key not in keys]
        bare.append({**row, "variant": " ".join(kept)})
    labels = column_labels(bare)
    shown_as = {key: setting_column(key, values[key], keys) for key in keys}
    plants = {row["plant"]: row["plant"] for row in rows}
    if len(set(labels)) > MOST_ACROSS and len(plants) > 1:
        labels = column_labels([{**row, "plant": ""} for row in bare])
        shown_as = {"plant": ("plant", plants), **shown_as}
    courses = course_labels((row["trajectory"], condition_of(row).setting) for row in bare)
    order = list(dict.fromkeys(courses.values()))
    places: dict[tuple[str, ...], tuple[int, float]] = {}  # texts that begin a line -> its place
    cells: dict[tuple[tuple[str, ...], str], str] = {}
    flown: dict[str, Flights] = {}
    for row, pairs, label, s in zip_longest(bare, settings, labels, statistics):
        *_, speed, setting = condition_of(row)
        course = courses[row["trajectory"], setting]
        values_of = pairs | {"plant": row["plant"]}
        texts = [column[values_of[key]] if key in values_of else "" for key, (_, column) in shown_as.items()]
        line = (course, speed_text(speed, ""), *texts)
        places.setdefault(line, (order.index(course), -1.0 if speed is None else speed))
        count = flown.setdefault(label, Flights(0, 0))
        if s is None:
            cells.setdefault((line, label), "invalid")
        else:
            cells[line, label] = cell(s)
            flown[label] = count.plus(s.flown)
    beside = 2 + len(shown_as)
    counts = ["flown", *[""] * (beside - 1)]
    for count in flown.values():
        counts.append(count.text() if count.trials else "-")
    lines = [counts]
    for line in sorted(places, key=places.__getitem__):
        lines.append([*line, *(cells.get((line, label), "-") for label in flown)])
    title = f"{metric_of(metric).title} ({shown(metric)[1]})"
    heads = ["trajectory", "m/s", *(heading for heading, _ in shown_as.values()), *flown]
    notes = (*notes, *without_number(results, metric), *row_notes(results))
    return Table(heads, lines, title, head=1, over=title, notes=notes, beside=beside)


def comparison_table(statistics: Sequence[Statistic]) -> Table | None:
    """Every contestant against the baseline, condition by condition; None if nobody is compared."""
    metric = statistics[0].metric
    factor, unit = shown(metric)
    heading = ["trajectory", "speed (m/s)", "controller", "seeds", f"difference ({unit})"]
    heading += ["reduction (%)", "effect", "p", "p (corrected)", "left out"]
    courses = course_labels((s.trajectory, s.setting) for s in statistics)
    rows = []
    for s, label in zip(statistics, column_labels([*map(_row_of, statistics)]), strict=True):
        if not s.baseline:
            continue
        line = [courses[s.trajectory, s.setting], speed_text(s.speed, ""), label, str(s.pairs), "-", "-"]
        if s.pairs:
            difference = with_interval(factor * s.difference, factor * s.difference_low, factor * s.difference_high)
            reduction = with_interval(s.reduction, s.reduction_low, s.reduction_high)
            line[-2:] = ["".join(difference), "".join(reduction)]
        effect = "-" if math.isnan(s.effect) else f"{s.effect:.2f}"
        rows.append([*line, effect, p_value(s.p), p_value(s.p_holm), s.left_out or "-"])
    if not rows:
        return None
    baselines = dict.fromkeys(s.baseline for s in statistics if s.baseline)
    note = (
        "over the seeds that both completed; difference: contestant less baseline; reduction: positive where better;"
        " effect: matched-pairs rank-biserial in [-1, 1]; p: of the line alone, and corrected as below the error table"
    )
    title = f"{metric_of(metric).title} against {', '.join(baselines)}"
    return Table(heading, rows, title, left=frozenset({0, 2, len(heading) - 1}), notes=(note,))


def comparison_texts(statistics: Statistics, metric: str) -> tuple[Table, dict[str, str]]:
    """The error table of one metric, and name -> content of the text files made of the statistics."""
    table = error_table(statistics.flights, metric, baseline=statistics.baseline, confidence=statistics.confidence)
    comparison = comparison_table(statistics.of(metric))
    files = {"table.md": table.markdown(), "statistics.csv": statistics.csv}
    if comparison is not None:
        files["table.md"] += f"\n{comparison.markdown()}"
    latex: Callable[..., dict[str, str]] = brought("services", "paper_texts") or _latex_texts
    return table, files | latex(statistics, metric, table, comparison)


def _latex_texts(statistics: Statistics, metric: str, table: Table, comparison: Table | None) -> dict[str, str]:
    """The tables in LaTeX as they are, where no plug-in fits them to a page."""
    texts = {"table.tex": table.latex()}
    if comparison is not None:
        texts["comparison.tex"] = comparison.latex()
    return texts


def write_comparison(root: Path, statistics: Statistics, texts: Mapping[str, str]) -> dict[str, str]:
    """Write the statistics and the texts of `comparison_texts`, unless they are there; returns name -> path."""
    for name, text in texts.items():
        if read_text(root / name) != text:
            write_text(root / name, text)
    if "comparison.tex" not in texts:
        (root / "comparison.tex").unlink(missing_ok=True)
    record = {name: getattr(statistics, name) for name in ("baseline", "confidence", "fingerprint")}
    try:
        _, stored = read_table(root / STATISTICS, "statistics")
    except QuadexpError:
        stored = {}
    if stored.get("fingerprint") != statistics.fingerprint:
        columns = {
            name: np.array([getattr(row, name) for row in statistics.rows], kind) for name, kind in KINDS.items()
        }
        write_table(root / STATISTICS, columns, record, "statistics")
    return {NAMES[name]: str(root / name) for name in texts} | {"statistics": str(root / STATISTICS)}


def flights_table(frame: SweepFrame, names: Sequence[str]) -> Table:
    """Flights with these columns, in the units in which tables show them.

    Raises UsageError for a name that is no column and no key.
    """
    names = distinct(names)
    columns = []
    left = set()
    for i, name in enumerate(names):
        values = frame.column(name)
        columns.append([_flight_text(name, value) for value in values])
        if not all(is_number(value) for value in values if value is not None):
            left.add(i)
    rows = list(map(list, zip(*columns, strict=True)))
    return Table(list(map(heading, names)), rows, left=left)


def _flight_text(name: str, value: Any) -> str:
    """A value of a column, a metric in the unit of tables."""
    if is_metric(name) and is_number(value):
        factor, _ = shown(name)
        return f"{factor * value:.4g}"
    return plain(value)


def csv_of(frame: SweepFrame, names: Sequence[str]) -> str:
    """Flights as CSV: SI units, every digit."""
    return csv_text(names, zip(*(frame.column(name) for name in names), strict=True))


def heading(name: str) -> str:
    """The name with the unit in which its numbers are shown."""
    if not is_metric(name):
        return with_unit(name, name)
    _, unit = shown(name)
    return f"{name} ({unit})" if unit else name
