"""The command `quadexp bench`. Only light modules are imported at the top."""

from __future__ import annotations

from functools import partial

import typer

from quadexp.cli.command import Answer, Ask, Conf, OptionalOut, Overrides, command
from quadexp.cli.terminal import say
from quadexp.names import named
from quadexp.plugins.bench.settings import Bench
from quadexp.progress import Progress

HEADING = "Fly"


def _controllers(context: typer.Context, incomplete: str) -> list[str]:
    from quadexp.parts.options import groups

    return [name for name in groups(context.params.get("conf"))["controller"] if name.startswith(incomplete)]


CONTROLLER = Ask("Add this controller, such as 'NAME observer=...'; repeatable.", "NAME", "--controller", _controllers)


@partial(command, controllers=CONTROLLER)
def bench(asked: Bench, overrides: Overrides = (), out: OptionalOut = None, conf: Conf = ()) -> Answer:
    """Rank controllers by a protocol that does not change: the same tasks, worlds and seeds for all.

    Settings after the command are those of the engine and its limits (engine=..., evaluate.workers=...). Models that
    controllers need are made by the protocol, in still air. An interrupted run continues; results of different versions
    of the protocol are not ranked together. Writes DIR/leaderboard.parquet.

    \b
    quadexp bench --size quick --out results/bench
    quadexp bench --controller geometric --conf examples --out results/mine
    quadexp bench --size standard --only --controller my_controller --conf my_conf --add docs/leaderboard.parquet
    """
    from quadexp.plugins.bench.run import bench as ranked_by

    with Progress("flights") as progress:
        board = ranked_by(overrides, asked, out=out, conf=conf, progress=progress, say=say)
    boards = {}
    for name, t in board.tables.items():
        boards[name] = [named(t.columns, row) for row in t.rows]
    record = {"protocol": board.protocol.name, "size": asked.size, "boards": boards}
    record["files"] = dict(board.files)
    tables = list(board.tables.values())
    return Answer(record, tables, [*tables, *board.files.values()], board.notes, board.failed)
