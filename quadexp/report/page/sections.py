"""The sections of the page as records, each made by one function; one template shows them all."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from quadexp.log.outcome import RULE
from quadexp.log.schema import Flight
from quadexp.report.document import Block, Cell, PageTable, Section
from quadexp.report.metrics import position_error
from quadexp.report.notes import table_notes
from quadexp.report.page.provenance import redo_command
from quadexp.report.page.replay import Case, case_of, case_title
from quadexp.report.page.sheet import Sheet, figure_html
from quadexp.report.page.source import TABLED, Comparison
from quadexp.report.page.swept import Swept
from quadexp.report.pairing import Condition, Flights, condition_of
from quadexp.report.statistics import Statistic
from quadexp.report.style import Figure, Look
from quadexp.report.tables import TITLES, comparison_table, error_table
from quadexp.report.text import duration, number, percent, probability, shown

WORST = 9
MOST_WORLDS = 30
EACH = 2  # flights of one contestant among the worst, of those that were completed
ENDS = ("failed", "solver_failed", "lost", "left_corridor", "infeasible", "ok")  # the worst first


def scoreboard(comparison: Comparison) -> PageTable:
    """Every contestant in the main world: completed flights, error, difference to the baseline, computing time; by the
    share of completed flights, then by the error over the common flights."""
    factor, unit = shown(comparison.metric)
    base, verdict = comparison.reference, comparison.verdict
    lines = []
    for label in comparison.order:
        pooled, flights = comparison.overall.get(label), comparison.success(label)
        mean, own = (factor * comparison.geometric_mean(label, own=own) for own in (False, True))
        beyond = flights.ended > (verdict.common if mean == mean else 0)
        role = "best" if verdict.best and label == verdict.least else ""
        role = role or ("baseline" if label == base else "bound" if label in comparison.bounds else "")
        ended = flights.text()
        cells = [Cell(label, (role,), best=role == "best", mark=label)]
        cells += [Cell(ended) if flights.ended == flights.trials else Cell(lost=ended)]
        cells += [Cell(f"{number(mean)} {unit}", (f"own {number(own)} of {flights.ended}" if beyond else "",))]
        if base:
            change, limits = _change(pooled)
            p = probability(pooled.p_holm) if pooled and pooled.testable else ""
            cells += [Cell(change or "-", (f"{limits} {p}".strip(),))]
        times = (duration(comparison.time(label, which)) for which in ("median", "p99"))
        lines.append([*cells, *map(Cell, times)])
    heads = ["controller", "completed", TITLES.get(comparison.metric, comparison.metric)]
    heads += [f"against {base}"] if base else []
    return PageTable("scoreboard", "", [*map(Cell, [*heads, "step, median", "step, 99 %"])], lines)


def _change(pooled: Statistic | None) -> tuple[str, str]:
    """A reduction as a change, and its interval: a reduction by 98.6 % is -98.6 %."""
    if pooled is None or not math.isfinite(pooled.reduction):
        return "", ""
    text, limits = percent(-pooled.reduction, -pooled.reduction_high, -pooled.reduction_low)
    return text if text.startswith("-") else f"+{text}", limits.strip()


def numbers(comparison: Comparison) -> Section:
    """A tab a metric: means and paired differences over common flights; the main metric first."""
    metrics = [comparison.metric, *(m for m in TABLED if m != comparison.metric)]
    blocks = [_number_block(comparison, metric) for metric in metrics if comparison.select(metric)]
    lead = (
        f"Means over the flights of a line that all compared controllers completed, with {comparison.confidence:.0%}"
        " intervals in brackets; bold: the best of a line, if it differs significantly from all others and nobody"
        " completed more. Beside them: the mean over all own completed flights (own), and the number of lost flights."
    )
    return Section("tables", "Numbers", "Numbers", lead, blocks)


def _number_block(comparison: Comparison, metric: str) -> Block:
    """The error table, with the counts of completed flights in its heading, and the paired differences."""
    statistics, marks = comparison.select(metric), comparison.look
    options: Any = {"baseline": comparison.baseline, "confidence": comparison.confidence}
    table = error_table(comparison.rows, metric, **options)
    means = PageTable.of(table, metric)
    heads = [
        Cell(name, (f"{flown} completed",), mark=name if name in marks else "") if flown and i else Cell(name)
        for i, (name, flown) in enumerate(zip(table.columns, table.rows[0], strict=True))
    ]
    tables = [replace(means, heads=heads, lines=means.lines[1:], notes=())]
    if (differences := comparison_table(statistics)) is not None:
        tables.append(PageTable.of(differences, f"{metric}-differences"))
    return Block(TITLES[metric], metric, tables=tables, notes=table_notes(statistics, ()))


def worlds(comparison: Comparison) -> Section:
    """Success and error of every contestant in each plant, vehicle and world; empty where there is only one."""
    factor, unit = shown(comparison.metric)
    lines, columns = [], list(comparison.look)
    for plant, vehicle in comparison.worlds[:MOST_WORLDS] if len(comparison.worlds) > 1 else ():
        rows = [row for row in comparison.rows if (row["plant"], row["vehicle"]) == (plant, vehicle)]
        there = replace(comparison, rows=rows)
        labels = {comparison.labels[contestant]: label for contestant, label in there.labels.items()}
        cells = []
        for label in (labels.get(column) for column in columns):
            flights = there.success(label) if label else Flights(0, 0)
            mean = factor * there.geometric_mean(label) if label else math.nan
            completed = f"{flights.text()} completed" if flights.trials else ""
            text, lost = number(mean) if math.isfinite(mean) else "", flights.ended < flights.trials
            cells.append(Cell(text, lost=completed) if lost else Cell(text, (completed,)))
        sample = next((f for row in rows if row["outcome"] == "ok" and (f := comparison.flight(row)) is not None), None)
        lines.append([Cell(f"{plant}, {vehicle}"), Cell("", surroundings(sample) if sample else ()), *cells])
    heads = [Cell("world"), Cell("wind, estimate"), *(Cell(label, mark=label) for label in columns)]
    metric = TITLES.get(comparison.metric, comparison.metric)
    left = len(comparison.worlds) - MOST_WORLDS
    notes = [f"{left} more worlds are in the results, not here"] if left > 0 else []
    lead = (
        f"Each plant, vehicle and world by itself: completed flights, and the {metric}, a geometric mean over the"
        " flights that all compared controllers completed there. Wind and estimate: of one flight of that world."
    )
    table = PageTable("worlds", f"{metric} ({unit})", heads, lines)
    return Section("worlds", "Worlds", "Worlds", lead, [Block(tables=[table], notes=notes)] if lines else [])


def surroundings(flight: Flight) -> list[str]:
    """Mean and largest wind of a flight, and how far its estimated position is off, in words."""
    lines = []
    if flight.wind is not None and flight.wind.any():
        speed = np.linalg.norm(flight.wind, axis=1)
        lines.append(f"wind {speed.mean():.1f} m/s, most {speed.max():.1f} m/s")
    if "est_p_x" in flight.columns:
        off = flight.stack([f"est_p_{i}" for i in "xyz"]) - flight.stack([f"p_{i}" for i in "xyz"])
        if off.any():
            lines.append(f"told {number(1e3 * float(np.sqrt((off**2).sum(axis=1).mean())))} mm off (rms)")
    return lines


def swept_section(swept: Swept, most: int | None) -> Section:
    """most: tabs."""
    lead = (
        "The axes are the keys that take several values. Means are over the flights that all compared settings"
        " completed; k/n: only k of n flights were completed; a cross: none was, or the settings contradict each other."
        " `quadexp plot` draws other axes."
    )
    blocks = [Block(title, name, figures=figures) for name, title, figures in swept.tabs[:most]]
    return Section("swept", "Swept", "What was swept", lead, blocks)


def figure_section(anchor: str, name: str, title: str, lead: str, sheets: Sequence[Sheet]) -> Section:
    """A block a sheet."""
    blocks = []
    for i, sheet in enumerate(sheets):
        tables = [PageTable.of(sheet.scores, f"{anchor}-scores-{i}")] if sheet.scores else []
        key = [] if sheet.lines else sheet.labels
        figures = sheet.panels(f"{anchor}{i}")
        blocks.append(Block(sheet.title, "", sheet.text, key, figures, sheet.lines, tables))
    return Section(anchor, name, title, lead, blocks)


def worst_rows(comparison: Comparison, most: int = WORST) -> list[Mapping[str, Any]]:
    """Flights that were not completed, then the largest errors: the worst seed of each contestant and condition, at
    most EACH per contestant."""

    def badness(row: Mapping[str, Any]) -> tuple[Any, ...]:
        order = ENDS.index(row["outcome"]) if row["outcome"] in ENDS else 0
        error = row["max_error"]
        return order, -(error if error is not None and math.isfinite(error) else 0.0)

    chosen: list[Mapping[str, Any]] = []
    conditions: dict[str, list[Condition]] = {}
    for row in sorted(comparison.rows, key=badness):
        seen = conditions.setdefault(comparison.label(row), [])
        if row["outcome"] == "ok" and (condition_of(row) in seen or len(seen) >= EACH):
            continue
        seen.append(condition_of(row))
        chosen.append(row)
    return chosen[:most]


def worst(comparison: Comparison, rows: Sequence[Mapping[str, Any]], cases: Mapping[Case, int]) -> Section:
    """A card a flight. cases: condition and seed -> number in the replay."""
    bad, bad_shown = (sum(row["outcome"] != "ok" for row in flights) for flights in (comparison.rows, rows))
    hidden = bad - bad_shown
    more = f"; {hidden} more were not completed (`quadexp results DIR --failures` lists them)" if hidden else ""
    lead = (
        f"Flights that were not completed, then the largest errors of every controller: {len(rows)} of"
        f" {len(comparison.rows)} flights{more}. {RULE[:1].upper()}{RULE[1:]}. The line shows the error over the"
        " flight, each on its own scale."
    )
    cards = [_card(comparison, row, cases) for row in rows]
    return Section("worst", "Worst", "Worst flights", lead, [Block(cards=cards)])


def _card(comparison: Comparison, row: Mapping[str, Any], cases: Mapping[Case, int]) -> dict[str, Any]:
    """where: the conditions in words with units."""
    label, flight, where = comparison.label(row), comparison.flight(row), case_title(comparison, case_of(row))
    card = {"label": label, "where": where, "largest": "", "spark": "", "lost": ""}
    if row["outcome"] != "ok":
        card["lost"] = ": ".join(filter(None, (row["outcome"].replace("_", " "), row.get("cause"))))
    if flight is not None and "ref_p_x" in flight.columns:
        error = position_error(flight)
        card["largest"] = f"{number(1e3 * row['max_error'])} mm"
        if "thinned" not in flight.metadata:
            card["where"] += f"; worst at {flight.t[int(np.argmax(error))]:.1f} s"
        draw = partial(spark, flight.t, error, comparison.look[label])
        card["spark"] = figure_html(draw, f"spark-{row['key']}", f"error of {label} over time")
    return card | {"case": cases.get(case_of(row)), "command": redo_command(comparison.asked(row))}


def spark(t: np.ndarray, error: np.ndarray, look: Look) -> Figure:
    """The error over the flight, from zero up, without axes."""
    figure = Figure(figsize=(3.2, 0.6))
    panel = figure.add_axes((0, 0, 1, 1))
    panel.set_axis_off()
    every = max(1, len(t) // 200)
    panel.plot(t[::every], error[::every], color=look.colour, linewidth=1.2)
    panel.set_ylim(bottom=0.0)
    return figure
