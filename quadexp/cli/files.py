"""Commands that read what was written: `quadexp show`, `compare`, `report`, `export`, `animate`.

Only light modules are imported here; see cli/app.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadexp.cli.options import Force, Json, OptionalOut, Out
from quadexp.cli.terminal import emit, guarded, print_lines


@guarded
def show(
    path: Annotated[Path, typer.Argument(help="A flight, data set, checkpoint folder, or results.")],
    json: Json = False,
) -> None:
    """Show what a file holds: its kind, configuration, units, seed, versions, size.

    \b
    quadexp show runs/a.parquet
    quadexp show models/gp
    """
    from quadexp.report.summary import summarise

    summary = summarise(path)
    if json:
        emit({key: value for key, value in summary.items() if key != "lines"})
    else:
        print_lines(summary["lines"])


@guarded
def compare_two(
    first: Annotated[Path, typer.Argument(help="A flight, results folder, or checkpoint folder.")],
    others: Annotated[list[Path], typer.Argument(help="Others of the same kind, each compared with the first.")],
    json: Json = False,
) -> None:
    """Show how flights, results or checkpoints differ: configuration, outcome, figures.

    \b
    quadexp compare runs/a.parquet runs/b.parquet runs/c.parquet
    quadexp compare results/table1 results/table1_again
    """
    from quadexp.report.compare import compare

    report = compare(first, *others)
    if json:
        emit({key: value for key, value in report.items() if key != "lines"})
    else:
        print_lines(report["lines"])


@guarded
def report(
    results: Annotated[Path, typer.Argument(help="Results folder of `quadexp evaluate --sweep`.")],
    out: Out = Path("report.html"),
    figures: Annotated[
        Path | None, typer.Option("--figures", metavar="DIR", help="Write the figures as PDF too, for a paper.")
    ] = None,
    baseline: Annotated[
        str | None,
        typer.Option("--baseline", metavar="CONTROLLER", help="Controller to compare the others with."),
    ] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Write a comparison as one page that opens without a network: answer, tables, figures, replay, provenance.

    \b
    quadexp report results/table1 --out report.html
    quadexp report results/table1 --out report.html --figures paper/figures
    """
    from quadexp.report.page import make_report

    made = make_report(results, out, figures=figures, baseline=baseline, force=force)
    if json:
        emit(made)
        return
    print_lines([*made["answer"], made["note"]])
    print("\n".join([*map(str, made["figures"].values()), str(made["path"])]))


@guarded
def export(
    flight: Annotated[Path, typer.Argument(help="A flight of `quadexp simulate`, or of a sweep.")],
    to: Annotated[str, typer.Option("--to", metavar="FORMAT", help="csv, tum, px4csv, mcap or rerun.")],
    out: OptionalOut = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Write a flight for other programs; mcap and rerun need the extra [viz].

    \b
    quadexp export runs/a.parquet --to rerun --out a.rrd
    quadexp export runs/a.parquet --to px4csv --out a_px4
    """
    from quadexp.log.exporters import export_flight

    files = export_flight(flight, to, out, force=force)
    if json:
        emit({"format": to, "files": files})
        return
    print("\n".join(map(str, files.values())))


@guarded
def animate(
    flights: Annotated[list[Path], typer.Argument(help="Flights over one reference, such as those of one sweep.")],
    out: Out = Path("replay.gif"),
    rate: Annotated[float, typer.Option("--rate", metavar="HZ", help="Frames a second, 1 to 50.")] = 20.0,
    begin: Annotated[float, typer.Option("--from", metavar="S", help="Time of the first frame.")] = 0.0,
    end: Annotated[float | None, typer.Option("--to", metavar="S", help="Time of the last frame.")] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Draw flights over one reference as a moving picture in real time, a GIF or WebP file.

    \b
    quadexp animate runs/nominal.parquet runs/gp.parquet --out replay.gif
    """
    from quadexp.report.animation import animate as draw

    made = draw(flights, out, rate=rate, begin=begin, end=end, force=force)
    if json:
        emit(made)
        return
    print(f"{made['frames']} frames, {made['duration']:.1f} s\n{made['path']}")
