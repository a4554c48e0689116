"""`quadexp bench`: the leaderboard. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadexp.cli.options import Conf, Format, Json, OptionalOut, Overrides
from quadexp.cli.terminal import answered, console, format_of, guarded, print_lines, say
from quadexp.parts.option_files import groups

SIZES = ("quick", "standard", "full")


def _sizes(incomplete: str) -> list[str]:
    return [size for size in SIZES if size.startswith(incomplete)]


def _controllers(ctx: typer.Context, incomplete: str) -> list[str]:
    return [
        name
        for name in groups(Path(ctx.params["conf"]) if ctx.params.get("conf") else None)["controller"]
        if name.startswith(incomplete)
    ]


@guarded
def bench(
    overrides: Overrides = None,
    size: Annotated[
        str,
        typer.Option(
            "--size", help="quick: minutes; standard: an hour; full: a night, on two cores.", autocompletion=_sizes
        ),
    ] = "quick",
    controller: Annotated[
        list[str] | None,
        typer.Option(
            "--controller",
            metavar="NAME",
            help="Takes part too, as 'NAME observer=...'; repeatable.",
            autocompletion=_controllers,
        ),
    ] = None,
    only: Annotated[bool, typer.Option("--only", help="Without the field of this program.")] = False,
    add: Annotated[
        list[Path] | None, typer.Option("--add", metavar="FILE", help="Rank rows of another leaderboard with these.")
    ] = None,
    seeds: Annotated[
        int,
        typer.Option("--seeds", min=0, help="Only the first seeds of the size; 0: all. A later run flies more."),
    ] = 0,
    protocol: Annotated[
        int | None, typer.Option("--protocol", help="Version of the protocol; the latest by default.")
    ] = None,
    markdown: Annotated[
        Path | None, typer.Option("--markdown", metavar="FILE", help="Write the tables between the marks of this file.")
    ] = None,
    page: Annotated[Path | None, typer.Option("--page", metavar="FILE", help="Where to write the page.")] = None,
    out: OptionalOut = None,
    conf: Conf = None,
    format: Format = None,
    json: Json = False,
) -> None:
    """Rank controllers by a protocol that does not change: the same tasks, worlds and seeds for all.

    Settings after the command are those of the engine and its limits (engine=..., evaluate.workers=...). Models that
    controllers need are made by the protocol, in still air. An interrupted run continues; results of different versions
    of the protocol are not ranked together. Writes DIR/leaderboard.parquet and DIR/leaderboard.html.

    \b
    quadexp bench --size quick --out results/bench
    quadexp bench --controller geometric --conf examples --out results/mine
    quadexp bench --size standard --only --controller my_controller --conf my_conf --add docs/leaderboard.parquet
    """
    from quadexp.bench.run import bench as fly
    from quadexp.errors import QuadexpError
    from quadexp.progress import Progress

    form = format_of(format, json)
    with Progress("flights") as progress:
        made = fly(
            overrides or [],
            size=size,
            controllers=controller or [],
            only=only,
            add=add or [],
            seeds=seeds,
            version=protocol,
            page=page,
            target=markdown,
            out=out,
            conf=conf,
            progress=progress,
            say=say,
        )
    for note in made.notes:
        say(f"note: {note}")
    boards = {name: [dict(zip(t.columns, row, strict=True)) for row in t.rows] for name, t in made.tables.items()}
    record = {"protocol": made.protocol.name, "size": size, "boards": boards, "files": dict(made.files)}
    if not answered(form, record, lambda: list(made.tables.values()), "bench"):
        for table in made.tables.values():
            console().print(table.rich())
            print_lines(table.notes)
        print_lines(made.files.values())
    if made.failed:
        raise QuadexpError(f"{len(made.failed)} flights failed; the first: {made.failed[0]['cause']}")
