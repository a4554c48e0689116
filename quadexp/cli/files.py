"""Commands that read what was written: `quadexp show`, `compare`, `report`, `export`, `animate`.

Only light modules are imported here; see cli/app.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from quadexp.cli.command import Answer, Ask, command, single_values
from quadexp.cli.options import Force, OptionalOut, Out
from quadexp.cli.terminal import say


@command
def show(path: Annotated[Path, typer.Argument(help="A flight, data set, checkpoint folder, or results.")]) -> Answer:
    """Show what a file holds: its kind, configuration, units, seed, versions, size.

    \b
    quadexp show runs/a.parquet
    quadexp show models/gp
    """
    from quadexp.report.summary import summarise

    summary = summarise(path)
    record = {key: value for key, value in summary.items() if key not in ("lines", "tables")}
    return Answer(record, summary.get("tables", []), summary["lines"])


@command
def compare_two(
    first: Annotated[Path, typer.Argument(help="A flight, results folder, or checkpoint folder.")],
    others: Annotated[list[Path], typer.Argument(help="Others of the same kind, each compared with the first.")],
    out: Annotated[Path | None, Ask("Draw them too: a png, pdf or svg.", "PATH", "--out -o")] = None,
    force: Force = False,
) -> Answer:
    """Show how flights, results or checkpoints differ: configuration, outcome, figures.

    \b
    quadexp compare runs/a.parquet runs/b.parquet runs/c.parquet --out compare.png
    quadexp compare results/table1 results/table1_again
    """
    from quadexp.report.checked import check_flights, rows_of
    from quadexp.report.compare import compare

    if out is not None:
        from quadexp.report.draw import check_path

        out = check_path(out, force, ("png", "pdf", "svg"))
    report = compare(first, *others)
    if out is not None:
        from quadexp.report.draw import comparison_figure
        from quadexp.report.style import save_figure

        save_figure(comparison_figure(report["kind"], [first, *others]), out, force=force)
    checked = {str(p): check_flights(*rows_of(p)) for p in (first, *others) if report["kind"] == "results"}
    wrong = [f"{results}: {line}" for results, found in checked.items() for line in found.lines(beside=False)]
    for line in wrong:
        say(f"warning: {line}")
    record = {key: value for key, value in report.items() if key not in ("lines", "tables")}
    record |= {"picture": out} if out else {}
    record |= {"checked": [f"{results}: {found.text()}" for results, found in checked.items()] + wrong}
    return Answer(record, report["tables"], [*report["lines"], *([out] if out else [])])


@command
def report(
    results: Annotated[Path, typer.Argument(help="Results folder of `quadexp evaluate --sweep`.")],
    out: Out = Path("report.html"),
    figures: Annotated[Path | None, Ask("Write the figures as PDF too, for a paper.", "DIR")] = None,
    baseline: Annotated[str | None, Ask("Controller to compare the others with.", "CONTROLLER")] = None,
    force: Force = False,
) -> Answer:
    """Write a comparison as one page that opens without a network: answer, tables, figures, replay, provenance.

    \b
    quadexp report results/table1 --out report.html
    quadexp report results/table1 --out report.html --figures paper/figures
    """
    from quadexp.report.page import make_report

    made = make_report(results, out, figures=figures, baseline=baseline, force=force)
    checked = made["checked"]
    said = [*made["answer"], made["note"], f"{checked['text']}.", *checked["lines"]]
    files = _files({"page": made["path"], **made["figures"]})
    return Answer(made, files, [*said, *made["figures"].values(), made["path"]])


@command
def export(
    flight: Annotated[Path, typer.Argument(help="A flight of `quadexp simulate` or of a sweep.")],
    to: Annotated[str, typer.Option("--to", metavar="FORMAT", help="csv, tum, mcap, rerun.")],
    target: Annotated[Path | None, typer.Argument(metavar="[OUT]", help="Where to write, as --out.")] = None,
    out: OptionalOut = None,
    force: Force = False,
) -> Answer:
    """Write a flight for other programs; mcap and rerun need the extra [viz].

    \b
    quadexp export runs/a.parquet --to rerun --out a.rrd
    quadexp export runs/a.parquet --to csv --out a.csv
    """
    from quadexp.errors import UsageError
    from quadexp.log.exporters import export_flight

    if target is not None and out is not None:
        raise UsageError("export: give the place to write to once, as OUT or as --out")
    files = export_flight(flight, to, out or target, force=force)
    return Answer({"format": to, "files": files}, _files(files), list(files.values()))


def _files(files: Mapping[str, Path]) -> list[dict[str, Any]]:
    """A row a file that was written."""
    return [{"file": name, "path": path} for name, path in files.items()]


@command
def animate(
    flights: Annotated[list[Path], typer.Argument(help="Flights over one reference, such as those of one sweep.")],
    out: Out = Path("replay.gif"),
    rate: Annotated[float, Ask("Frames a second, 1 to 50.", "HZ")] = 20.0,
    begin: Annotated[float, Ask("Time of the first frame.", "S", "--from")] = 0.0,
    end: Annotated[float | None, Ask("Time of the last frame.", "S", "--to")] = None,
    force: Force = False,
) -> Answer:
    """Draw flights over one reference as a moving picture in real time: GIF, or MP4 by ffmpeg.

    \b
    quadexp animate runs/nominal.parquet runs/gp.parquet --out replay.gif
    """
    from quadexp.report.animation import animate as draw

    made = draw(flights, out, rate=rate, begin=begin, end=end, force=force)
    return Answer(made, [single_values(made)], [f"{made['frames']} frames, {made['duration']:.1f} s", made["path"]])
