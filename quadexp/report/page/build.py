"""Make the page: read, draw, pack, render; and write the figures as PDF."""

from __future__ import annotations

import base64
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from quadexp import __version__
from quadexp.errors import QuadexpError
from quadexp.files.names import file_name
from quadexp.files.writer import check_output, write_text, written
from quadexp.messages import script
from quadexp.report.document import Block, PageTable, Section, document, template_text
from quadexp.report.metrics import to_csv
from quadexp.report.page.answer import answer
from quadexp.report.page.learned import fit_sheets
from quadexp.report.page.over_time import MAX_FLIGHTS, MAX_GROUPS, estimate_sheets, power_sheets
from quadexp.report.page.pareto import pareto_sheets
from quadexp.report.page.provenance import LOOKED_AT, facts, machines, portable, records, settings, sweep_command
from quadexp.report.page.replay import BUDGET, MAX_TRACKS, Case, case_of, choose_cases, pack_replay
from quadexp.report.page.sections import (
    figure_section,
    numbers,
    scoreboard,
    swept_section,
    worlds,
    worst,
    worst_rows,
)  # fmt: skip
from quadexp.report.page.sheet import SHAPES, TOKENS, Sheet
from quadexp.report.page.source import TABLED, Comparison, read_comparison
from quadexp.report.page.swept import Swept, swept_figures
from quadexp.report.pairing import condition_of
from quadexp.report.statistics import statistics_csv
from quadexp.report.style import Figure
from quadexp.report.table import Table

LIMIT = 2_000_000  # bytes of the page
DATA_LIMIT = 250_000  # bytes of a CSV inside it
CARRIED = ("statistics.csv", "results.csv")
METHODS = (
    "Means are over the flights that all compared controllers completed; intervals ({}) are Student's t over the seeds."
    " Differences are taken seed by seed (the same noise for all), over several conditions as the mean of"
    " a seed; p-values come from a paired permutation test of the seeds, corrected by Holm over all comparisons."
    " Ratios over several conditions are geometric means, every condition with the same weight; their interval is for"
    " new seeds, not for new trajectories. Lost flights are counted."
)
TIME = (
    "For a controller on the line, no other one has both a shorter step and a smaller error. Bounds are left out. Wall"
    " time of the control step{}: medians over the flights of their median and 99th percentile. Other load on the"
    " machine increases the latter."
)
POWER = (
    "For every world with a battery or motors, its fastest condition, and of these the one with the largest error; at"
    f" most {MAX_FLIGHTS} controllers. Rotors: their mean (line), and the range from the lowest to the highest (band)."
)


def make_report(
    results: str | Path,
    out: str | Path,
    *,
    figures: str | Path | None = None,
    baseline: str | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Write the report of a results folder as one HTML file; returns its answer and the paths of the files.

    figures: folder for the same figures as PDF. baseline: a controller.
    Raises UsageError or DataError, before anything is written.
    """
    out = check_output(out, force=force)
    if figures is not None:
        check_output(figures, force=True, folder=True)
    comparison = read_comparison(results, baseline=baseline)
    swept, sheets = swept_figures(comparison), _sheets(comparison)
    page, left_out = render(comparison, swept, sheets, _report_command(comparison, out, figures, baseline))
    write_text(out, page, force=force)
    drawn = [sheet for several in sheets.values() for sheet in several if sheet.draws or sheet.whole]
    named = swept.paper() | {sheet.name: sheet.figure(comparison.look) for sheet in drawn} if figures else {}
    said, checked = answer(comparison), comparison.checked
    return {
        "path": out,
        "bytes": len(page.encode()),
        "answer": list(said.sentences),
        "note": said.note,
        "checked": checked._asdict() | {"text": checked.text(), "lines": checked.lines()},
        "left_out": left_out,
        "figures": _write_paper(Path(figures), named) if figures else {},
    }


def _sheets(comparison: Comparison) -> dict[str, list[Sheet]]:
    """Anchor of a section -> its figures."""
    learned = fit_sheets(comparison) + estimate_sheets(comparison)
    return {"time": pareto_sheets(comparison), "power": power_sheets(comparison), "learned": learned}


def _write_paper(folder: Path, figures: Mapping[str, Figure]) -> dict[str, Path]:
    """Figures as PDF; the same figures give the same bytes."""
    paths = {name: folder / f"{file_name(name)}.pdf" for name in figures}
    for name, figure in figures.items():
        with written(paths[name]) as file:
            figure.savefig(file, format="pdf", metadata={"CreationDate": None})
    return paths


class Extent(NamedTuple):
    """The amount of data on the page. replay: characters of packed flights. metrics: of tables and of figures over
    what was swept. lines: of the tables."""

    replay: int = BUDGET
    metrics: int = len(TABLED)
    lines: int | None = None


EXTENTS = (Extent(), Extent(BUDGET // 3), Extent(0), Extent(0, 1), Extent(0, 1, 200), Extent(0, 1, 40))


def render(
    comparison: Comparison, swept: Swept, sheets: Mapping[str, Sequence[Sheet]], command: str
) -> tuple[str, list[str]]:
    """The page, with less data if it would be too large, and what was left out.

    First fewer flights to replay, then none and no CSV inside, then only the main metric, then fewer conditions.
    """
    bad, flights, power = worst_rows(comparison), records(comparison), sheets["power"]
    cases, downloads, every = choose_cases(comparison, bad), _downloads(comparison), numbers(comparison)
    about: dict[str, Any] = {
        "answer": answer(comparison),
        "board": scoreboard(comparison),
        "looks": comparison.look,
        "shapes": SHAPES,
    }
    about |= {"row_notes": [*comparison.checked.lines(), *comparison.notes], "version": __version__, "theme": TOKENS}
    backends = sorted({row["backend"] for row in comparison.rows if row["backend"]})
    on = ", ".join(filter(None, (" and ".join(backends), "; ".join(machines(flights)))))
    lead = TIME.format(f" ({on})" if on else "")
    figures = [
        worlds(comparison),
        figure_section("time", "Time", "Error against computing time", lead, sheets["time"]),
        figure_section("power", "Power", "Battery and rotors", POWER, power[:MAX_GROUPS]),
        figure_section("learned", "Learned", "Learned models", "", sheets["learned"]),
    ]
    player = template_text("replay.js").replace("@@SHAPES@@", json.dumps(SHAPES))
    for extent in EXTENTS:
        packed, kept = pack_replay(comparison, cases, extent.replay) if extent.replay else ([], [])
        shown, carried = _shortened(every, extent), downloads if extent.replay else []
        tabs = swept_section(swept, None if extent.metrics == len(TABLED) else extent.metrics)
        left_out = _left_out(comparison, packed, kept, every, shown) + swept.left
        left_out += [f"figures of the {title}" for _, title, _ in swept.tabs[len(tabs.blocks) :]]
        more = len(power) - MAX_GROUPS
        left_out += [f"battery and rotors of {more} more worlds"] if more > 0 else []
        left_out += [f"{name}, which is in the results folder" for name in CARRIED if name not in dict(carried)]
        sections = [_replay_section(packed), shown, tabs, *figures]
        sections.append(worst(comparison, bad, {case: i for i, case in enumerate(kept)}))
        sections.append(_origin(comparison, flights, command, carried, left_out))
        there = [section for section in sections if section.blocks]
        data: dict[str, Any] = {
            "left_out": left_out,
            "replay_json": script(packed),
            "replay_script": player if packed else "",
        }
        page = document(f"{comparison.root.resolve().name} – quadexp report", there, **about, **data)
        if len(page.encode()) < LIMIT:
            return page, left_out
    size = len(page.encode()) / 1e6
    raise QuadexpError(f"the report would be {size:.1f} MB, more than {LIMIT / 1e6:g}: report on fewer conditions")


def _replay_section(packed: Sequence[Mapping[str, Any]]) -> Section:
    tracks = [track for case in packed for track in case["tracks"]]
    wind = " Arrow: the wind that blows on the vehicle, longer where stronger."
    told = " Ring and dotted line: the position that the controller was told."
    note = (
        "Drones are drawn larger than in reality; bars on the rotors show thrust as a share of its range; the grid is"
        f" at the lowest point.{wind if any('wind' in track for track in tracks) else ''}"
        f"{told if any('estimate' in track for track in tracks) else ''} Keys, with the picture in focus: space plays,"
        " ← → move by 0.1 s (with shift: turn), + − change the speed, 1 to 9 show and hide, Home and End."
    )
    lead = "All controllers on the same reference with the same noise. Errors can be magnified."
    return Section("replay", "Replay", "Replay", lead, [Block(replay=True, notes=[note])] if packed else [])


def _origin(
    comparison: Comparison,
    flights: Sequence[Mapping[str, Any]],
    command: str,
    downloads: Sequence[tuple[str, str]],
    left_out: Sequence[str],
) -> Section:
    varied, common = settings(flights)
    about = facts(comparison, flights) + ([("Left out", "; ".join(left_out))] if left_out else [])
    sweep = sweep_command(comparison.grids, portable(comparison.root))
    blocks = [Block(facts=about, downloads=downloads, code=[*filter(None, (sweep, command))])]
    titles = {"Settings that differ between the flights": varied, "Settings of all flights": common}
    for i, (title, rows) in enumerate(titles.items()):
        table = PageTable.of(Table(["setting", "value"], rows), f"settings-{i}")
        blocks += [Block(title, tables=[table], folded=True)] if rows else []
    blocks.append(Block("Statistical methods", lead=METHODS.format(f"{comparison.confidence:.0%}"), folded=True))
    lead = "Data, versions and commands that make every figure again."
    return Section("provenance", "Provenance", "Provenance", lead, blocks)


def _shortened(every: Section, extent: Extent) -> Section:
    """The section of numbers with fewer tabs and lines."""
    blocks = [
        replace(block, tables=[replace(table, lines=table.lines[: extent.lines]) for table in block.tables])
        for block in every.blocks[: extent.metrics]
    ]
    return replace(every, blocks=blocks)


def _left_out(
    comparison: Comparison,
    packed: Sequence[Mapping[str, Any]],
    replayed: Sequence[Case],
    every: Section,
    shown: Section,
) -> list[str]:
    """What is not on the page for its size, one entry each."""
    flown = [row for row in comparison.rows if row["outcome"] != "infeasible"]
    conditions, cases = len({*map(condition_of, flown)}), len({*map(case_of, flown)})
    seen = len({condition for condition, _ in replayed})
    entries = [f"the replay of {conditions - seen} of {conditions} conditions"] if seen < conditions else []
    all_lines, lines = (len(section.blocks[0].tables[0].lines) for section in (every, shown))
    entries += [f"{all_lines - lines} of {all_lines} lines of the tables"] if lines < all_lines else []
    entries += [f"the table of the {block.title}" for block in every.blocks[len(shown.blocks) :]]
    if seen == conditions and len(replayed) < cases:
        entries.append(f"the replay of {cases - len(replayed)} of {cases} pairs of condition and seed")
    if (looked := len(comparison.sampled(LOOKED_AT))) < len(comparison.rows):
        entries.append(f"settings of flights beyond {looked} of {len(comparison.rows)}, evenly chosen")
    crowd = max((len(case["left_out"]) for case in packed), default=0)
    return entries + (
        [f"in the replay, up to {crowd} controllers of a flight beyond the first {MAX_TRACKS}"] if crowd else []
    )


def _downloads(comparison: Comparison) -> list[tuple[str, str]]:
    """CSV tables as data links, those that are small enough."""
    texts = zip(CARRIED, (statistics_csv(comparison.statistics), to_csv(comparison.rows)), strict=True)
    return [
        (name, "data:text/csv;base64," + base64.b64encode(text.encode()).decode())
        for name, text in texts
        if len(text) <= DATA_LIMIT
    ]


def _report_command(comparison: Comparison, out: Path, figures: str | Path | None, baseline: str | None) -> str:
    words = ["quadexp", "report", portable(comparison.root), "--out", portable(out)]
    words += ["--baseline", baseline] if baseline else []
    words += ["--figures", portable(Path(figures))] if figures else []
    return shlex.join(words)
