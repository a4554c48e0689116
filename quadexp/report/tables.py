"""The tables of a sweep: errors, comparisons, flights; and the files of the first two.

The error table has trajectory and speed down and controllers across; every setting that was swept is a column of its
own, with its unit above and its values down, and so are many plants or worlds. The first row counts the flights that
completed; cells are means over the common flights of a trajectory and speed (pairing.py), or say "invalid" where
settings contradict each other. The comparison table has one row per contestant and condition, against the baseline.
The table of flights has any columns of the results and any keys, for the terminal, as CSV and as a sortable page.

<results>/statistics.parquet, .csv    every metric, long
<results>/table.md, .tex              one metric: the error table, and in table.md the comparisons
<results>/table.tex, comparison.tex   fit a column or a page of the IEEE (fitted.py)
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError
from quadexp.log.outcome import COMPLETED
from quadexp.log.store import read_table, read_text, write_table
from quadexp.names import distinct
from quadexp.parts.cells import OPTION
from quadexp.parts.schema import of_contestant
from quadexp.report.fitted import WIDTHS, fitted_latex, tabulars
from quadexp.report.frame import SweepFrame, is_metric, is_number, setting_column, setting_text, with_unit
from quadexp.report.metrics import metric_of
from quadexp.report.notes import notes as row_notes
from quadexp.report.notes import table_notes
from quadexp.report.pairing import (
    BASELINE,
    Flights,
    Groups,
    condition_of,
    contestant_labels,
    contestant_of,
    is_invalid,
    setting_pairs,
)  # fmt: skip
from quadexp.report.paper_cells import Intervals, compact_cell
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
    beside = [f"{count} {outcome}" for outcome, count in s.failures.items()]
    beside = [", ".join(beside)] if beside else []
    if s.n > s.common:
        beside = [f"all {s.n}: {with_interval(factor * s.mean)[0]}", *beside]
    if math.isnan(s.common_mean):
        return "; ".join(beside) or "-"
    mean, limits = with_interval(factor * s.common_mean, factor * s.common_low, factor * s.common_high)
    mean = f"**{mean}**" if s.best else mean
    return mean + limits + ("*" if s.significant else "") + (f" ({'; '.join(beside)})" if beside else "")


def column_labels(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The column of each result row: the controller with its settings; plant and vehicle if there are several.

    Other settings belong to the condition: they stand beside the trajectory, see `course_labels`.
    """
    labels = contestant_labels(distinct(map(contestant_of, rows)))
    several = [name for name in ("plant", "vehicle") if len({row[name] for row in rows}) > 1]
    return [" ".join([labels[contestant_of(row)], *(f"@{row[name]}" for name in several)]) for row in rows]


def course_labels(conditions: Iterable[tuple[str, str]]) -> dict[tuple[str, str], str]:
    """(trajectory, other settings) -> label of a line, such as "circle, payload 0.1 kg"; no two are the same."""
    conditions = distinct(conditions)
    labels = {at: ", ".join([at[0], *(setting_text(*pair) for pair in setting_pairs(at[1]))]) for at in conditions}
    count = Counter(labels.values())
    return {at: " ".join(filter(None, at)) if count[label] > 1 else label for at, label in labels.items()}


def _row_of(s: Statistic) -> dict[str, Any]:
    """What a statistic tells of the rows it is made from."""
    names = ("plant", "vehicle", "trajectory", "speed", "controller", "model")
    return {**{n: getattr(s, n) for n in names}, "variant": f"{s.variant} {s.setting}".strip()}


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
    every = dict.fromkeys(key for pairs in settings for key in pairs)
    values = {key: [pairs[key] for pairs in settings if key in pairs] for key in every}
    keys = [key for key, several in values.items() if len(set(several)) > 1 and not key.endswith(f".{OPTION}")]
    keys.sort(key=of_contestant)  # those of the conditions first
    kept = (" ".join(f"{key}={value}" for key, value in pairs.items() if key not in keys) for pairs in settings)
    bare = [{**row, "variant": variant} for row, variant in zip(rows, kept, strict=True)]
    labels = column_labels(bare)
    shown_as = {key: setting_column(key, values[key], keys) for key in keys}
    if len(set(labels)) > MOST_ACROSS and len({row["plant"] for row in rows}) > 1:
        labels = column_labels([{**row, "plant": ""} for row in bare])
        shown_as = {"plant": ("plant", {row["plant"]: row["plant"] for row in rows}), **shown_as}
    courses = course_labels((row["trajectory"], condition_of(row).setting) for row in bare)
    places: dict[tuple[str, ...], tuple[int, float]] = {}  # texts that begin a line -> its place
    cells: dict[tuple[tuple[str, ...], str], str] = {}
    flown: dict[str, Flights] = {}
    order: dict[str, int] = {}  # of the courses
    for row, pairs, label, s in zip(bare, settings, labels, [*statistics, *[None] * len(rows)], strict=False):
        *_, speed, setting = condition_of(row)
        course, values_of = courses[row["trajectory"], setting], pairs | {"plant": row["plant"]}
        texts = (column[values_of[key]] if key in values_of else "" for key, (_, column) in shown_as.items())
        line = (course, speed_text(speed, ""), *texts)
        places.setdefault(line, (order.setdefault(course, len(order)), -1.0 if speed is None else speed))
        flown[label] = flown.get(label, Flights(0, 0)).plus(s.flown if s else Flights(0, 0))
        if s is not None or (line, label) not in cells:
            cells[line, label] = cell(s) if s else "invalid"
    title, beside = f"{metric_of(metric).title} ({shown(metric)[1]})", 2 + len(shown_as)
    counts = ["flown", *[""] * (beside - 1), *(count.text() if count.trials else "-" for count in flown.values())]
    lines = [
        [*line, *(cells.get((line, label), "-") for label in flown)]
        for line in sorted(places, key=lambda line: places[line])
    ]
    heads = ["trajectory", "m/s", *(heading for heading, _ in shown_as.values()), *flown]
    notes = (*notes, *without_number(results, metric), *row_notes(results))
    return Table(heads, [counts, *lines], title, head=1, over=title, notes=notes, beside=beside)


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
            difference = (factor * value for value in (s.difference, s.difference_low, s.difference_high))
            reduction = (s.reduction, s.reduction_low, s.reduction_high)
            line[-2:] = ["".join(with_interval(*values)) for values in (difference, reduction)]
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
    files = {"table.md": table.markdown(), "statistics.csv": statistics.csv}
    files["table.tex"] = _for_a_paper(statistics, metric)
    if (comparison := comparison_table(statistics.of(metric))) is not None:
        files["table.md"] += f"\n{comparison.markdown()}"
        files["comparison.tex"] = fitted_latex(replace(comparison, beside=3), WIDTHS["page"])
    return table, files


def _for_a_paper(statistics: Statistics, metric: str) -> str:
    """The error table as one tabular in a column, or a page, without intervals where it takes that; else as several."""
    choices: tuple[tuple[str, Intervals], ...] = (("column", "brackets"), ("page", "brackets"), ("page", "none"))
    for width, intervals in choices:
        cell = compact_cell(intervals)
        options: dict[str, Any] = {"baseline": statistics.baseline, "confidence": statistics.confidence}
        table = error_table(statistics.flights, metric, **options, cell=cell)
        table = replace(table, rows=table.rows[table.head :], head=0)  # cells say how many were completed
        if len(tabulars(table, WIDTHS[width])) == 1:
            break
    return fitted_latex(table, WIDTHS[width])


def write_comparison(root: Path, statistics: Statistics, texts: Mapping[str, str]) -> dict[str, str]:
    """Write the statistics and the texts of `comparison_texts`, unless they are there; returns name -> path."""
    for name, text in texts.items():
        if read_text(root / name) != text:
            write_text(root / name, text)
    if "comparison.tex" not in texts:
        (root / "comparison.tex").unlink(missing_ok=True)
    record = {name: getattr(statistics, name) for name in ("baseline", "confidence", "fingerprint")}
    try:
        there = read_table(root / STATISTICS, "statistics")[1].get("fingerprint") == statistics.fingerprint
    except QuadexpError:
        there = False
    if not there:
        columns = {
            name: np.array([getattr(row, name) for row in statistics.rows], kind) for name, kind in KINDS.items()
        }
        write_table(root / STATISTICS, columns, record, "statistics")
    return {NAMES[name]: str(root / name) for name in texts} | {"statistics": str(root / STATISTICS)}


def flights_table(frame: SweepFrame, names: Sequence[str]) -> Table:
    """Flights with these columns, in the units in which tables show them.

    Raises UsageError for a name that is no column and no key.
    """
    columns = {name: frame.column(name) for name in names}
    texts = [
        [f"{shown(name)[0] * x:.4g}" if is_metric(name) and is_number(x) else plain(x) for x in values]
        for name, values in columns.items()
    ]
    numbers = [all(is_number(value) for value in values if value is not None) for values in columns.values()]
    rows = [*map(list, zip(*texts, strict=True))]
    return Table([*map(heading, columns)], rows, left=frozenset(i for i, right in enumerate(numbers) if not right))


def csv_of(frame: SweepFrame, names: Sequence[str]) -> str:
    """Flights as CSV: SI units, every digit."""
    return csv_text(names, zip(*(frame.column(name) for name in names), strict=True))


def heading(name: str) -> str:
    """The name with the unit in which its numbers are shown."""
    unit = shown(name)[1]
    return with_unit(name, name) if not is_metric(name) else f"{name} ({unit})" if unit else name
