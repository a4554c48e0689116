"""`quadexp bench`: the leaderboard. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadexp.cli.options import Conf, Format, Json, OptionalOut, Overrides
from quadexp.cli.terminal import answered, console, format_of, guarded, say
from quadexp.config.completion import groups

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
    protocol: Annotated[int, typer.Option("--protocol", help="Version of the protocol.")] = 1,
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
    from quadexp.bench.run import run_bench
    from quadexp.config.compose import session
    from quadexp.errors import QuadexpError, UsageError
    from quadexp.progress import Progress
    from quadexp.sweeps.cluster.engines import open_engine
    from quadexp.sweeps.engine import Workers

    form = format_of(format, json)
    given = list(overrides or [])
    for text in given:
        if text.partition("=")[0].partition(".")[0] not in ("engine", "evaluate"):
            raise UsageError(f"{text!r}: what is flown is the protocol's; only engine and evaluate can be set")
    out = out or Path("results") / f"bench_{size}"
    with session(conf) as composer:
        config = composer.compose(given)
        settings = config.evaluate
        with (
            Workers(settings.workers, settings.memory or None, calls=64) as processes,
            open_engine(config, processes) as engine,
            Progress("flights") as progress,
        ):
            made = run_bench(
                composer,
                out,
                size=size,
                controllers=controller or [],
                only=only,
                add=add or [],
                version=protocol,
                extra=conf,
                page=page,
                target=markdown,
                engine=engine,
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
            for line in table.notes:
                print(line)
        print("\n".join(map(str, made.files.values())))
    if made.failed:
        raise QuadexpError(f"{len(made.failed)} flights failed; the first: {made.failed[0]['cause']}")
