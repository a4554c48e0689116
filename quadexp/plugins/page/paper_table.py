"""A table for a paper: any keys down and across.

    quadexp table RESULTS --rows trajectory,speed --columns controller --width column --out table.tex

Without keys it is the error table, conditions down and contestants across. With keys, each cell is the mean over the
common flights of that place, as in a figure (places.py). Bold and stars are those of the error table (significance.py),
where a cell is one contestant in one condition.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.names import distinct
from quadexp.parts.schema import of_contestant
from quadexp.plugins.page.paper_cells import Intervals, cell_text, compact_table
from quadexp.plugins.page.places import SUCCESS, Place, points, shown_column
from quadexp.plugins.page.view import FLOWN, checked_keys, value_text
from quadexp.report.frame import SweepFrame, is_number, setting_text, with_unit
from quadexp.report.metrics import metric_of
from quadexp.report.pairing import condition_of, contestant_of
from quadexp.report.statistics import Statistic, compute_statistics
from quadexp.report.table import Table
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
    baseline = frame.record.get("baseline", "nominal_mpc")
    confidence = float(frame.record.get("confidence", 0.95))
    if rows is None and columns is None and metric != SUCCESS:
        table = compact_table(frame.rows, metric, baseline, confidence, intervals, digits)
        return _named(table, names, metric)
    down, across = _chosen(frame, rows, columns)
    keys = [*down, *across]
    others = [key for key in frame.swept if key not in ("seed", *keys)]
    single: dict[Place, Statistic] = {}
    title = "share of completed flights"
    factor, unit = shown(metric)
    if metric != SUCCESS:
        statistics = compute_statistics(frame.rows, metrics=(metric,), baseline=baseline, confidence=confidence)
        single = _statistics(frame, keys, statistics)
        title = metric_of(metric).title
        if unit:
            title += f" ({unit})"
    cells = {}
    point_of = points(frame, keys, metric, others=others, confidence=confidence)
    for place, point in point_of.items():
        cells[place] = cell_text(factor, point, single.get(place), intervals, digits)
    n = len(down)
    columns_of = distinct(place[n:] for place in cells)
    lines = []
    for line in distinct(place[:n] for place in cells):
        texts = [cells.get((*line, *column), "-") for column in columns_of]
        lines.append([*map(value_text, down, line), *texts])
    heads = []
    for key in down:
        name = key.rpartition(".")[2].replace("_", " ")
        heads.append(with_unit(name, key))
    heads += [", ".join(map(_text, across, column)) for column in columns_of]
    notes = [f"mean over {key}: {', '.join(map(str, frame.values(key)))}" for key in others]
    if any(cell.endswith("*") for cell in cells.values()):
        notes.append(f"*: significantly different from {baseline}")
    left = frozenset(i for i, key in enumerate(down) if not all(map(is_number, frame.values(key))))
    return _named(Table(heads, lines, title, left=left, over=title, beside=n, notes=notes), names, metric)


def _chosen(
    frame: SweepFrame, rows: Sequence[str] | None, columns: Sequence[str] | None
) -> tuple[list[str], list[str]]:
    """Keys down and across. A swept setting of the controller that is in neither goes across, or else down: a mean over
    two controllers would be the error of neither."""
    down, across = checked_keys(frame, rows=rows, columns=columns)
    free = [key for key in frame.swept if key not in ("seed", *down, *across)]
    who = [key for key in free if of_contestant(key)]
    course = [key for key in free if not of_contestant(key)]
    if columns is not None:
        down += who
    elif who or "controller" not in down:
        across += who or ["controller"]
    down = down or course or ["trajectory"]
    return down, across or [next(key for key in FLOWN if key not in down)]


def _statistics(frame: SweepFrame, keys: Sequence[str], statistics: Sequence[Statistic]) -> dict[Place, Statistic]:
    """The statistic of each place that is one contestant in one condition."""
    by_flight: dict[Place, Statistic] = {}
    for s in statistics:
        speed = None if math.isnan(s.speed) else s.speed
        by_flight[s.contestant, (s.plant, s.vehicle, s.trajectory, speed, s.setting)] = s
    columns = [shown_column(frame, key, keys) for key in keys]
    of_place: dict[Place, set[Place]] = {}
    for row, *place in zip(frame.rows, *columns, strict=True):
        flown = of_place.setdefault(tuple(place), set())
        flown.add((contestant_of(row), condition_of(row)))
    single = {}
    for at, flown in of_place.items():
        flight = flown.pop()
        if not flown and flight in by_flight:
            single[at] = by_flight[flight]
    return single


def _text(key: str, value: object) -> str:
    """A value with its unit."""
    if key == "trajectory.speed":
        return f"{value_text(key, value)} m/s"
    if key in (*FLOWN, "world", "plant"):
        return value_text(key, value)
    return setting_text(key, value)


def _named(table: Table, names: Mapping[str, str], metric: str) -> Table:
    """The table with other texts: for the metric, a whole heading or label, or a word of one."""
    used = {metric}

    def said(text: str) -> str:
        for name, replacement in names.items():
            text, n = re.subn(rf"(?<![\w.]){re.escape(name)}(?![\w.])", replacement.replace("\\", r"\\"), text)
            used.update([name] * n)
        return text

    n = table.beside
    notes = [said(note) for note in table.notes]
    columns = [said(text) for text in table.columns]
    rows = []
    labels: list[str] = []
    numbers: list[str] = []
    for row in table.rows:
        rows.append([*map(said, row[:n]), *row[n:]])
        labels += filter(None, row[:n])
        numbers += row[n:]
    if any(re.search(r"\d/\d", cell) for cell in numbers):
        notes.append("k/n: k of n flights were completed")
    over = names.get(metric, said(table.over))
    for name in names:
        if name not in used:
            known = distinct([*table.columns, *labels, metric])
            raise UsageError(f"--label {name}: no key or value of this table{suggestion(name, known)}")
    return replace(table, columns=columns, rows=rows, over=over, title=over, notes=notes)
