"""`quadexp bench`: the leaderboard. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import typer

from quadexp.bench import Bench
from quadexp.cli.command import Answer, Ask, command
from quadexp.cli.options import Conf, OptionalOut, Overrides
from quadexp.cli.terminal import say
from quadexp.parts.option_files import groups


def _controllers(ctx: typer.Context, incomplete: str) -> list[str]:
    names = groups(Path(ctx.params["conf"]) if ctx.params.get("conf") else None)["controller"]
    return [name for name in names if name.startswith(incomplete)]


CONTROLLER = Ask("Takes part too, as 'NAME observer=...'; repeatable.", "NAME", "--controller", _controllers)


@partial(command, controllers=CONTROLLER)
def bench(asked: Bench, overrides: Overrides = None, out: OptionalOut = None, conf: Conf = None) -> Answer:
    """Rank controllers by a protocol that does not change: the same tasks, worlds and seeds for all.

    Settings after the command are those of the engine and its limits (engine=..., evaluate.workers=...). Models that
    controllers need are made by the protocol, in still air. An interrupted run continues; results of different versions
    of the protocol are not ranked together. Writes DIR/leaderboard.parquet.

    \b
    quadexp bench --size quick --out results/bench
    quadexp bench --controller geometric --conf examples --out results/mine
    quadexp bench --size standard --only --controller my_controller --conf my_conf --add docs/leaderboard.parquet
    """
    from quadexp.bench.run import bench as fly
    from quadexp.progress import Progress

    with Progress("flights") as progress:
        made = fly(overrides or [], asked, out=out, conf=conf, progress=progress, say=say)
    boards = {name: [dict(zip(t.columns, row, strict=True)) for row in t.rows] for name, t in made.tables.items()}
    record = {"protocol": made.protocol.name, "size": asked.size, "boards": boards, "files": dict(made.files)}
    tables = list(made.tables.values())
    failed = [f"{len(made.failed)} flights failed; the first: {made.failed[0]['cause']}"] if made.failed else []
    return Answer(record, tables, [*tables, *made.files.values()], made.notes, failed)
