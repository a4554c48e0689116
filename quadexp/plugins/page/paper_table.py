"""A table for a paper: any keys down and across.

    quadexp table RESULTS --rows trajectory,speed --columns controller --width column --out table.tex

Without keys it is the error table, conditions down and contestants across. With keys, each cell is the mean over the
common flights of that place, as in a figure (view.py). Bold and stars are those of the error table (significance.py),
where a cell is one contestant in one condition.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.names import distinct
from quadexp.parts.schema import of_contestant
from quadexp.plugins.page.view import FLOWN, SUCCESS, Place, checked_keys, points, value_text
from quadexp.report.frame import SweepFrame, setting_text, with_unit
from quadexp.report.metrics import metric_of
from quadexp.report.pairing import condition_of, contestant_of, grouped
from quadexp.report.paper_cells import Intervals, cell_text, compact_cell
from quadexp.report.statistics import Statistic, compute_statistics
from quadexp.report.table import Table
from quadexp.report.tables import error_table
from quadexp.report.text import shown


def paper_table(
    frame: SweepFrame,
    metric: str = "mean_error",
    *,
    rows: Sequence[str] | None = None,
    columns: Sequence[str] | None = None,
    names: Mapping[str, str] = {},
    intervals: Intervals = "none",
    digits: int | None = None,
) -> Table:
    """A table of one metric, or of "success". rows, columns: keys down and across; None to choose by what was swept.
    names: other texts for the metric, keys and values.

    Raises UsageError for a key that is none, and a name of nothing in the table."""
    if intervals == "pm" and metric == SUCCESS:
        raise UsageError("--intervals pm: the interval of a share is not symmetric: give brackets")
    if rows is None and columns is None and metric != SUCCESS:
        table = error_table(frame.rows, metric, **_options(frame), cell=compact_cell(intervals, digits))
        return _named(replace(table, rows=table.rows[table.head :], head=0), names, metric)
    down, across = _chosen(frame, rows, columns)
    others = [key for key in frame.swept if key not in ("seed", *down, *across)]
    keys = [*down, *across]
    confidence = float(frame.record.get("confidence", 0.95))
    points_of = points(frame, keys, metric, others=others, confidence=confidence)
    single = {} if metric == SUCCESS else _statistics(frame, keys, metric)
    factor, unit = shown(metric)
    cells = {}
    for place, point in points_of.items():
        cells[place] = cell_text(factor, point, single.get(place), intervals, digits)
    n = len(down)
    lines = distinct(place[:n] for place in cells)
    heads = distinct(place[n:] for place in cells)
    title = "share of completed flights" if metric == SUCCESS else metric_of(metric).title + f" ({unit})" * bool(unit)
    notes = [*(f"mean over {key}: {', '.join(map(str, frame.values(key)))}" for key in others)]
    if any(cell.endswith("*") for cell in cells.values()):
        notes.append(f"*: significantly different from {_options(frame)['baseline']}")
    body = []
    for line in lines:
        labels = [value_text(key, value) for key, value in zip(down, line, strict=True)]
        body.append([*labels, *(cells.get(line + head, "-") for head in heads)])
    head = [", ".join(_text(key, value) for key, value in zip(across, head, strict=True)) for head in heads]
    left_columns = frozenset(
        i for i, key in enumerate(down) if not all(isinstance(v, (int, float)) for v in frame.values(key))
    )
    columns = [*(with_unit(key.rpartition(".")[2].replace("_", " "), key) for key in down), *head]
    return _named(Table(columns, body, title, left=left_columns, over=title, beside=n, notes=notes), names, metric)


def _options(frame: SweepFrame) -> dict[str, Any]:
    """Baseline and confidence of the results."""
    return {"baseline": frame.record.get("baseline", "nominal_mpc"), "confidence": frame.record.get("confidence", 0.95)}


def _chosen(
    frame: SweepFrame, rows: Sequence[str] | None, columns: Sequence[str] | None
) -> tuple[list[str], list[str]]:
    """Keys down and across. A swept setting of the controller that is in neither goes across, or else down: a mean over
    two controllers would be the error of neither."""
    down = checked_keys(frame, rows or ())
    across = checked_keys(frame, columns or ())
    twice = []
    for key in (*down, *across):
        if (*down, *across).count(key) > 1:
            twice.append(key)
    if twice:
        raise UsageError(f"{twice[0]}: stands twice among --rows and --columns")
    free = [key for key in frame.swept if key not in ("seed", *down, *across)]
    who = [key for key in free if of_contestant(key)]
    course = [key for key in free if not of_contestant(key)]
    if columns is None:
        across += who or ["controller"] * ("controller" not in down)
        down = down or course
    else:
        down += who
    down = down or course or ["trajectory"]
    return down, across or [next(key for key in FLOWN if key not in down)]


def _statistics(frame: SweepFrame, keys: Sequence[str], metric: str) -> dict[Place, Statistic]:
    """The statistic of each place that is one contestant in one condition."""
    every = compute_statistics(frame.rows, metrics=(metric,), **_options(frame))
    by_flight = {}
    for s in every:
        by_flight[s.contestant, s.plant, s.vehicle, s.trajectory, str(s.speed), s.setting] = s
    columns = [frame.controllers(keys) if key == "controller" else frame.column(key) for key in keys]
    flown = grouped((place, i) for i, place in enumerate(zip(*columns, strict=True)))
    statistics = {}
    for place, numbers in flown.items():
        asked = set()
        for i in numbers:
            condition = condition_of(frame.rows[i])
            speed = math.nan if condition.speed is None else condition.speed
            asked.add((contestant_of(frame.rows[i]), *condition[:3], str(speed), condition.setting))
        if len(asked) == 1 and (statistic := by_flight.get(asked.pop())) is not None:
            statistics[place] = statistic
    return statistics


def _text(key: str, value: object) -> str:
    """A value with its unit."""
    if key == "trajectory.speed":
        return f"{value_text(key, value)} m/s"
    if key in (*FLOWN, "world", "plant"):
        return value_text(key, value)
    return setting_text(key, value)


def _named(table: Table, names: Mapping[str, str], metric: str) -> Table:
    """The table with other texts: for the metric, a whole heading or label, or a word of one."""
    used: set[str] = set()

    def said(text: str) -> str:
        for name, replacement in names.items():
            whole = rf"(?<![\w.]){re.escape(name)}(?![\w.])"
            if re.search(whole, text):
                used.add(name)
                text = re.sub(whole, replacement.replace("\\", r"\\"), text)
        return text

    n = table.beside
    notes = [said(note) for note in table.notes]
    if any(re.search(r"\d/\d", cell) for row in table.rows for cell in row[n:]):
        notes.append("k/n: k of n flights were completed")
    columns = [said(text) for text in table.columns]
    rows = [[*map(said, row[:n]), *row[n:]] for row in table.rows]
    over = names.get(metric, said(table.over))
    for name in names:
        if name not in used | {metric}:
            known = [*table.columns, *(cell for row in table.rows for cell in row[:n] if cell), metric]
            raise UsageError(f"--label {name}: no key or value of this table{suggestion(name, distinct(known))}")
    return replace(table, columns=columns, rows=rows, over=over, title=over, notes=notes)
