"""Make the page: read, draw, pack, render; and write the figures as PDF."""

from __future__ import annotations

import base64
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from quadexp import __version__
from quadexp.errors import QuadexpError
from quadexp.files.names import file_name
from quadexp.files.writer import check_output, write_text, written
from quadexp.log.outcome import RULE
from quadexp.messages import clean, script
from quadexp.report.page import palette
from quadexp.report.page.answer import answer
from quadexp.report.page.learned import estimate_sheets, fit_sheets
from quadexp.report.page.pareto import pareto_sheets
from quadexp.report.page.power import MAX_FLIGHTS, power_sheets
from quadexp.report.page.provenance import LOOKED_AT, origin, portable
from quadexp.report.page.replay import BUDGET, MAX_TRACKS, Case, case_of, choose_cases, pack_replay
from quadexp.report.page.sections import scoreboard, tables, worlds, worst, worst_rows
from quadexp.report.page.sheet import Sheet
from quadexp.report.page.source import TABLED, Comparison, read_comparison, spoken
from quadexp.report.page.swept import Swept, swept_figures, swept_paper
from quadexp.report.pairing import condition_of
from quadexp.report.result_rows import to_csv
from quadexp.report.statistics_file import statistics_csv
from quadexp.report.style import LOOKS, Figure
from quadexp.report.tables import TITLES
from quadexp.report.text import typeset

LIMIT = 2_000_000  # bytes of the page
DATA_LIMIT = 250_000  # bytes of a CSV inside it
CARRIED = ("statistics.csv", "results.csv")
LEARNED = {name: f"{LOOKS[key][0]}-0" for name, key in (("gp", "gp_mpc"), ("drag", "linear drag"), ("data", "nominal"))}
TEMPLATES = files("quadexp.report.page") / "templates"


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
    drawn = PageFigures.of(comparison)
    page, left_out = render(comparison, drawn, _report_command(comparison, out, figures, baseline))
    write_text(out, page, force=force)
    drawings = {} if figures is None else _write_paper(Path(figures), drawn.paper(comparison))
    made = answer(comparison)
    record = {"path": out, "bytes": len(page.encode()), "answer": list(made.sentences), "note": made.note}
    return {**record, "left_out": left_out, "figures": drawings}


@dataclass(frozen=True)
class PageFigures:
    """swept: over the keys that were swept. sheets: of each section. power_left: worlds that power leaves out."""

    swept: Swept
    sheets: Mapping[str, Sequence[Sheet]]
    power_left: int

    @classmethod
    def of(cls, comparison: Comparison) -> PageFigures:
        power, left = power_sheets(comparison)
        learned = {"fits": fit_sheets(comparison), "estimates": estimate_sheets(comparison)}
        return cls(swept_figures(comparison), {"pareto": pareto_sheets(comparison), "power": power, **learned}, left)

    def records(self) -> dict[str, list[dict[str, Any]]]:
        """For the template."""
        return {
            section: [sheet.record(f"{section}{i}") for i, sheet in enumerate(sheets)]
            for section, sheets in self.sheets.items()
        }

    def paper(self, comparison: Comparison) -> dict[str, Figure]:
        """The same figures for a paper, by name."""
        sheets = [sheet for own in self.sheets.values() for sheet in own if sheet.draws]
        return swept_paper(self.swept) | {sheet.name: sheet.figure(comparison.look) for sheet in sheets}


def _write_paper(folder: Path, figures: Mapping[str, Figure]) -> dict[str, Path]:
    """Figures as PDF; the same figures give the same bytes."""
    paths = {name: folder / f"{file_name(name)}.pdf" for name in figures}
    for name, figure in figures.items():
        with written(paths[name]) as file:
            figure.savefig(file, format="pdf", metadata={"CreationDate": None})
    return paths


@dataclass(frozen=True)
class Extent:
    """The amount of data on the page. replay: characters of packed flights. metrics: of tables and of figures over
    what was swept. lines: of the tables."""

    replay: int = BUDGET
    metrics: int = len(TABLED)
    lines: int | None = None

    @property
    def carries_data(self) -> bool:
        return self.replay > 0


EXTENTS = (Extent(), Extent(BUDGET // 3), Extent(0), Extent(0, 1), Extent(0, 1, 200), Extent(0, 1, 40))


def environment() -> Any:
    """The settings of a page's template: what it prints passes through the escaper of HTML."""
    from jinja2 import Environment

    made = Environment(autoescape=True, finalize=lambda value: clean(value) if type(value) is str else value)
    made.filters["typeset"] = typeset
    return made


def render(comparison: Comparison, drawn: PageFigures, command: str) -> tuple[str, list[str]]:
    """The page, with less data if it would be too large, and what was left out.

    First fewer flights to replay, then none and no CSV inside, then only the main metric, then fewer conditions.
    """
    template = environment().from_string(_template("report.html.j2"))
    light, dark = palette.css_blocks()
    bad = worst_rows(comparison)
    cases, every, downloads = choose_cases(comparison, bad), tables(comparison), _downloads(comparison)
    content = {
        "version": __version__,
        "title": comparison.root.resolve().name,
        "answer": answer(comparison),
        "metric_title": TITLES.get(comparison.metric, comparison.metric),
        "baseline": comparison.reference,
        "board": scoreboard(comparison),
        "worlds": worlds(comparison),
        "alpha": 1 - comparison.confidence,
        "looks": comparison.look,
        "shapes": {marker: palette.SHAPE_PATHS[name] for marker, name in palette.SHAPES.items()},
        "learned": LEARNED,
        "row_notes": comparison.notes,
        "spoken": spoken,
        "css_light": light,
        "css_dark": dark,
        "style": _safe(_template("style.css")),
        "page_script": _template("page.js"),
        "replay_script": _template("replay.js").replace("@@SHAPES@@", json.dumps(palette.SHAPE_PATHS)),
        **drawn.records(),
        "most_powered": MAX_FLIGHTS,
        "flights": len(comparison.rows),
        "bad": sum(row["outcome"] != "ok" for row in comparison.rows),
        "rule": RULE,
        "bad_shown": sum(row["outcome"] != "ok" for row in bad),
        "many_worlds": len(comparison.worlds) > 1,
        "origin": origin(comparison),
        "report_command": command,
    }
    for extent in EXTENTS:
        packed, kept = pack_replay(comparison, cases, extent.replay) if extent.replay else ([], [])
        numbers = [{**table, "lines": table["lines"][: extent.lines]} for table in every[: extent.metrics]]
        carried = downloads if extent.carries_data else []
        tabs = drawn.swept.tabs[: None if extent.metrics == len(TABLED) else extent.metrics]
        left_out = _left_out(comparison, drawn, packed, kept, every, numbers, carried)
        left_out += [f"figures of the {title}" for _, title, _ in drawn.swept.tabs[len(tabs) :]]
        left_out += [f"battery and rotors of {drawn.power_left} more worlds"] if drawn.power_left else []
        page = template.render(
            content,
            left_out=left_out,
            sections=_sections(drawn, bool(packed), len(comparison.worlds) > 1),
            tables=numbers,
            swept=tabs,
            replay=bool(packed),
            winds=any("wind" in track for case in packed for track in case["tracks"]),
            told=any("estimate" in track for case in packed for track in case["tracks"]),
            replay_json=script(packed),
            worst=worst(comparison, bad, {case: i for i, case in enumerate(kept)}),
            downloads=carried,
        )
        if len(page.encode()) < LIMIT:
            return page, left_out
    raise QuadexpError(
        f"the report would be {len(page.encode()) / 1e6:.1f} MB, more than {LIMIT / 1e6:g}: report on fewer conditions"
    )


def _left_out(
    comparison: Comparison,
    drawn: PageFigures,
    packed: Sequence[Mapping[str, Any]],
    replayed: Sequence[Case],
    every: Sequence[Mapping[str, Any]],
    numbers: Sequence[Mapping[str, Any]],
    downloads: Sequence[tuple[str, str]],
) -> list[str]:
    """What is not on the page for its size, one entry each."""
    conditions = len({condition_of(row) for row in comparison.rows if row["outcome"] != "infeasible"})
    shown = len({condition for condition, _ in replayed})
    left = [f"the replay of {conditions - shown} of {conditions} conditions"] if shown < conditions else []
    all_lines, lines = len(every[0]["lines"]), len(numbers[0]["lines"])
    left += [f"{all_lines - lines} of {all_lines} lines of the tables"] if lines < all_lines else []
    left += [f"the table of the {table['title']}" for table in every[len(numbers) :]]
    every_case = len({case_of(row) for row in comparison.rows if row["outcome"] != "infeasible"})
    if shown == conditions and len(replayed) < every_case:
        left.append(f"the replay of {every_case - len(replayed)} of {every_case} pairs of condition and seed")
    if (looked := len(comparison.sampled(LOOKED_AT))) < len(comparison.rows):
        left.append(f"settings of flights beyond {looked} of {len(comparison.rows)}, evenly chosen")
    left += drawn.swept.left
    crowd = max((len(case["left_out"]) for case in packed), default=0)
    left += [f"in the replay, up to {crowd} controllers of a flight beyond the first {MAX_TRACKS}"] if crowd else []
    there = {name for name, _ in downloads}
    left += [f"{name}, which is in the results folder" for name in CARRIED if name not in there]
    return left


def _template(name: str) -> str:
    return (TEMPLATES / name).read_text(encoding="utf-8")


def _safe(text: str) -> Any:
    from markupsafe import Markup

    return Markup(text)


def _sections(drawn: PageFigures, replay: bool, several_worlds: bool) -> list[tuple[str, str]]:
    wanted = [
        ("replay", "Replay", replay),
        ("tables", "Numbers", True),
        ("worlds", "Worlds", several_worlds),
        ("swept", "Swept", bool(drawn.swept.tabs)),
        ("time", "Time", bool(drawn.sheets["pareto"])),
        ("power", "Power", bool(drawn.sheets["power"])),
        ("learned", "Learned", bool(drawn.sheets["fits"] or drawn.sheets["estimates"])),
        ("worst", "Worst", True),
        ("provenance", "Provenance", True),
    ]
    return [(anchor, name) for anchor, name, there in wanted if there]


def _downloads(comparison: Comparison) -> list[tuple[str, str]]:
    """CSV tables as data links, those that are small enough."""
    made = zip(CARRIED, (statistics_csv(comparison.statistics), to_csv(comparison.rows)), strict=True)
    return [
        (name, "data:text/csv;base64," + base64.b64encode(text.encode()).decode())
        for name, text in made
        if len(text) <= DATA_LIMIT
    ]


def _report_command(comparison: Comparison, out: Path, figures: str | Path | None, baseline: str | None) -> str:
    words = ["quadexp", "report", portable(comparison.root), "--out", portable(out)]
    words += ["--baseline", baseline] if baseline else []
    words += ["--figures", portable(Path(figures))] if figures else []
    return " ".join(map(shlex.quote, words))
