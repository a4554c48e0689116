"""The sections of words and tables of the page as records, each made by one function; one template shows them all."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from quadexp.log.outcome import RULE
from quadexp.names import distinct
from quadexp.parts.cells import Grid
from quadexp.parts.override import quoted
from quadexp.parts.settings import flat
from quadexp.plugin import brought
from quadexp.plugins.page.document import Block, Cell, Section
from quadexp.plugins.page.report.source import Comparison, Record
from quadexp.plugins.page.typeset import duration, percent
from quadexp.report.checked import versions_of
from quadexp.report.metrics import metric_of, position_error, tabled
from quadexp.report.notes import table_notes
from quadexp.report.pairing import Condition, Groups, Row, condition_of, grouped
from quadexp.report.significance import Tests
from quadexp.report.statistics import Statistic
from quadexp.report.table import Table
from quadexp.report.tables import comparison_table, error_table
from quadexp.report.text import number, probability, shown, speed_text

WORST = 9  # rows that fit on a screen
EACH = 2  # flights of one contestant among the worst, of those that were completed
MOST_VALUES = 12  # of a setting
ENDS = ("failed", "solver_failed", "lost", "left_corridor", "infeasible", "ok")  # the worst first

METHODS = (
    "Means are over the flights that all compared controllers completed; intervals ({}) are Student's t over the seeds,"
    " for other seeds, and decide nothing. Differences are taken seed by seed (the same noise for both), on the flights"
    " that both completed, over several conditions as the mean of a seed. One test decides who is significantly"
    " different, in every"
    " line and sentence: {} Ratios over several conditions are geometric means, every condition with the same weight;"
    " their interval is for new seeds, not for new trajectories. Lost flights are counted."
)


class Page(NamedTuple):
    """What the sections of a page are made from. numbers, swept: their sections, as long as there is room for. command:
    that makes the page again. left_out: what is not on it for its size."""

    comparison: Comparison
    numbers: Section
    swept: Section
    command: str
    left_out: tuple[str, ...]


def numbers_section(page: Page) -> Section:
    return page.numbers


def swept_section(page: Page) -> Section:
    return page.swept


def scoreboard(comparison: Comparison) -> Table:
    """Every contestant in the main world: completed flights, error, difference to the baseline, computing time; by the
    share of completed flights, then by the error over the common flights."""
    factor, unit = shown(comparison.metric)
    base = comparison.reference
    verdict = comparison.verdict
    lines: list[Any] = []
    for label in comparison.order:
        pooled = comparison.overall.get(label)
        flights = comparison.success(label)
        mean = factor * comparison.geometric_mean(label)
        own_mean = factor * comparison.geometric_mean(label, over_own=True)
        beyond = flights.ended > (verdict.common if mean == mean else 0)
        role = ""
        if verdict.best and label == verdict.least:
            role = "best"
        elif label == base:
            role = "baseline"
        elif label in comparison.bounds:
            role = "bound"
        ended = flights.text()
        cells = [Cell(label, (role,), best=role == "best", mark=label)]
        cells.append(Cell(ended) if flights.ended == flights.trials else Cell(lost=ended))
        own = f"own {number(own_mean)} of {flights.ended}" if beyond else ""
        cells.append(Cell(f"{number(mean)} {unit}", (own,)))
        if base:
            change, limits = _change(pooled)
            p = probability(pooled.p_holm) if pooled and pooled.testable else ""
            cells.append(Cell(change or "-", (f"{limits} {p}".strip(),)))
        times = (duration(comparison.time(label, which)) for which in ("median", "p99"))
        lines.append([*cells, *map(Cell, times)])
    heads = ["controller", "completed", metric_of(comparison.metric).title]
    if base:
        heads.append(f"against {base}")
    return Table([*heads, "step, median", "step, 99 %"], lines)


def _change(pooled: Statistic | None) -> tuple[str, str]:
    """A reduction as a change, and its interval: a reduction by 98.6 % is -98.6 %."""
    if pooled is None or not math.isfinite(pooled.reduction):
        return "", ""
    text, limits = percent(-pooled.reduction, -pooled.reduction_high, -pooled.reduction_low)
    return text if text.startswith("-") else f"+{text}", limits.strip()


def numbers(comparison: Comparison) -> Section:
    """A tab a metric: means and paired differences over common flights; the main metric first."""
    metrics = [comparison.metric, *(m for m in tabled() if m != comparison.metric)]
    blocks = [_number_block(comparison, metric) for metric in metrics if comparison.statistics.of(metric)]
    lead = (
        f"Means over the flights of a line that all compared controllers completed, with {comparison.confidence:.0%}"
        " intervals in brackets. Beside them: the mean over all n flights that a controller completed (all n), and the"
        " number of lost flights."
    )
    return Section("tables", "Numbers", "Numbers", lead, blocks)


def _number_block(comparison: Comparison, metric: str) -> Block:
    """The error table, with the counts of completed flights in its heading, and the paired differences."""
    statistics = comparison.statistics.of(metric)
    marks = comparison.look
    table = error_table(comparison.rows, metric, baseline=comparison.baseline, confidence=comparison.confidence)
    heads: list[Any] = []
    for i, (name, flown) in enumerate(zip(table.columns, table.rows[0], strict=True)):
        if flown and i:
            heads.append(Cell(name, (f"{flown} completed",), mark=name if name in marks else ""))
        else:
            heads.append(Cell(name))
    tables: dict[str, Table] = {metric: replace(table, columns=heads, rows=table.rows[1:], notes=())}
    differences = comparison_table(statistics)
    if differences is not None:
        tables[f"{metric}-differences"] = differences
    tests = Tests(Groups(comparison.rows, comparison.baseline, (metric,)), 0, comparison.confidence)
    return Block(metric_of(metric).title, metric, tables=tables, notes=table_notes(statistics, tests))


def worst_rows(comparison: Comparison) -> list[Row]:
    """Flights that were not completed, then the largest errors: the worst seed of each contestant and condition, at
    most EACH per contestant."""

    def badness(row: Row) -> tuple[Any, ...]:
        order = ENDS.index(row["outcome"]) if row["outcome"] in ENDS else 0
        error = row["max_error"]
        if error is None or not math.isfinite(error):
            error = 0.0
        return order, -error

    chosen: list[Row] = []
    conditions: dict[str, list[Condition]] = {}
    for row in sorted(comparison.rows, key=badness):
        seen = conditions.setdefault(comparison.label(row), [])
        if row["outcome"] == "ok" and (condition_of(row) in seen or len(seen) >= EACH):
            continue
        seen.append(condition_of(row))
        chosen.append(row)
    return chosen[:WORST]


def worst_section(page: Page) -> Section:
    """A line a flight, and the commands that fly them again."""
    comparison = page.comparison
    rows = worst_rows(comparison)
    shown_keys = {row["key"] for row in rows}
    hidden = sum(row["outcome"] != "ok" and row["key"] not in shown_keys for row in comparison.rows)
    more = f"; {hidden} more were not completed (`quadexp results DIR --failures` lists them)" if hidden else ""
    lead = (
        f"Flights that were not completed, then the largest errors of every controller: {len(rows)} of"
        f" {len(comparison.rows)} flights{more}. {RULE[:1].upper()}{RULE[1:]}."
    )
    lines: list[Any] = []
    for row in rows:
        label = comparison.label(row)
        flight = comparison.flight(row)
        largest = ""
        when = ""
        if flight is not None and "ref_p_x" in flight.columns:
            largest = f"{number(1e3 * row['max_error'])} mm"
            if "thinned" not in flight.metadata:
                k = int(np.argmax(position_error(flight)))
                when = f"at {flight.t[k]:.1f} s"
        condition = condition_of(row)
        rate = "" if condition.speed is None else f" at {speed_text(condition.speed)}"
        title = f"{comparison.course_title(condition)}{rate}, seed {int(row['seed'])}"
        lost = ""
        if row["outcome"] != "ok":
            lost = ": ".join(filter(None, (row["outcome"].replace("_", " "), row.get("cause"))))
        lines.append([Cell(label, mark=label), Cell(title, lost=lost), Cell(largest, (when,))])
    commands = [*filter(None, map(comparison.command, rows))]
    blocks = [Block(tables={"worst": Table(["controller", "flight", "largest error"], lines)})]
    blocks += [Block("Commands that fly them again", code=commands, folded=True)] if commands else []
    return Section("worst", "Worst", "Worst flights", lead, blocks)


def origin_section(page: Page) -> Section:
    """Where every number comes from, and the commands that make it again."""
    comparison = page.comparison
    looked_at = map(comparison.flight_record, comparison.sampled())
    flights = [record for record in looked_at if record is not None]
    about = facts(comparison, flights)
    if page.left_out:
        about.append(("Left out", "; ".join(page.left_out)))
    grids = [tuple(tuple(map(comparison.anywhere, texts)) for texts in grid) for grid in comparison.grids]
    models = {row["model"] for row in comparison.rows if row["model"]}
    sentences = []
    if len(models) == 1:
        (model,) = models
        if "+" not in model:
            sentences.append(comparison.anywhere(f"model={quoted(model)}"))
    # With other paths they are other cells, which the folder of these does not take.
    place = comparison.place(comparison.root) + ("_again" if sentences or grids != comparison.grids else "")
    sweep = sweep_command(grids, place, [*comparison.conf, *sentences])
    blocks = [Block(facts=about, code=[*filter(None, (sweep, page.command))])]
    rows = settings(flights)
    if rows:
        tables = {"settings": Table(["setting", "value"], rows)}
        blocks.append(Block("Settings of the flights, those that differ first", tables=tables, folded=True))
    test = " ".join(f"{note}." for note in comparison.tests.notes)
    blocks.append(Block("Statistical methods", lead=METHODS.format(f"{comparison.confidence:.0%}", test), folded=True))
    lead = "Data, versions and commands that make every figure again."
    return Section("provenance", "Provenance", "Provenance", lead, blocks)


def facts(comparison: Comparison, flights: Sequence[Record]) -> list[tuple[str, str]]:
    """(term, text) of the origin; several of one term."""
    about = [flight.get("provenance", {}) for flight in flights]
    git = [written.get("git") or {} for written in about]
    commits = {f"{g['commit'][:12]}{' with changes' if g.get('dirty') else ''}" for g in git if g.get("commit")}
    machines = set()
    for written in about:
        names = [str(written[k]) for k in ("cpu", "platform") if written.get(k)]
        if names:
            machines.add(", ".join(names))
    models = {f"{f['model']}, sha256 {f.get('model_sha256', '')}" for f in flights if f.get("model")}
    created = comparison.record.get("provenance", {}).get("created", "")
    versions = ", ".join(f"{name} {version}" for name, version in versions_of(comparison.rows).items())
    texts = brought("services", "margin_texts")
    loops = []
    for flight in flights:
        line = texts.margin_line(flight.get("margins")) if texts else ""
        if line:
            loops.append(("Loop", f"{flight.get('controller', '')}: {line}"))
    entries = [
        ("Results", f"{len(comparison.rows)} flights, sha256 {comparison.digest}"),
        ("Files", " ".join(filter(None, (f"{comparison.checked.text()}.", *comparison.checked.lines())))),
        ("Seeds", ", ".join(map(str, sorted({int(row["seed"]) for row in comparison.rows})))),
        ("Made", ", commit ".join(filter(None, (created, ", ".join(sorted(commits)))))),
        ("Machine", "; ".join(sorted(machines))),
        *distinct(loops),
        *(("Checkpoint", model) for model in sorted(models)),
        ("Versions", versions),
    ]
    return [(term, text) for term, text in entries if text]


def settings(flights: Sequence[Record]) -> list[list[str]]:
    """A line a setting with its values in order of appearance; those that differ between flights first."""
    stated = []
    for flight in flights:
        for key, value in flat(flight.get("config", {})).items():
            stated.append((key, value if isinstance(value, str) else json.dumps(value)))
    values = grouped(stated)
    different = {}
    for key, texts in values.items():
        if set(texts) != {"null"}:
            different[key] = distinct(texts)
    lines = []
    for key in sorted(different, key=lambda key: len(different[key]) == 1 and len(values[key]) == len(flights)):
        shown_values = different[key][:MOST_VALUES]
        if len(different[key]) > MOST_VALUES:
            shown_values.append("…")
        lines.append([key, ", ".join(shown_values)])
    return lines


def sweep_command(grids: Sequence[Grid], out: str, others: Sequence[str] = ()) -> str:
    """The sweep in one line: its one grid, or the experiment of its grids; "" if there is neither. others: words."""
    if len(grids) == 1:
        words = []
        for texts in grids[0]:
            key = texts[0].partition("=")[0]
            values = [text.partition("=")[2] for text in texts]
            words.append(f"{key}={','.join(values)}")
    else:
        texts_of_all = chain(*chain(*grids))
        words = distinct(text for text in texts_of_all if text.startswith("experiment="))
        if len(words) > 1:
            return ""
    if words:
        return shlex.join(["quadexp", "evaluate", *others, "--sweep", *words, "--out", out])
    return ""
