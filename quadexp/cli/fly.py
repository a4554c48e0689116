"""Commands that fly: `quadexp simulate`, `evaluate`, `tune`, `bench`. Only light modules are imported at the top."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from quadexp.bench import Bench
from quadexp.cli.command import Answer, Ask, Conf, Force, OptionalOut, Overrides, command, complete
from quadexp.cli.terminal import say
from quadexp.errors import UsageError
from quadexp.names import named
from quadexp.progress import Progress
from quadexp.tune import Tune


@command
def simulate(overrides: Overrides = (), out: OptionalOut = None, conf: Conf = (), force: Force = False) -> Answer:
    """Fly one configuration and write the flight.

    \b
    quadexp simulate controller=gp_mpc trajectory=circle trajectory.speed=8 model=models/gp seed=0 --out runs/a.parquet
    """
    from quadexp import requests
    from quadexp.report.summary import flight_lines

    flight, path, notes = requests.simulate(overrides, out, conf, force=force, keep=True)
    about = flight.metadata
    record = {"path": path, **about["row"], "residual": about["residual"]}
    return Answer(record, [{**about["row"], "path": path}], [*flight_lines(about), path], notes)


@command
def evaluate(
    overrides: Overrides = (),
    sweep: Annotated[bool, Ask("Fly every combination of the values given.", flag="--sweep --multirun -m")] = False,
    out: OptionalOut = None,
    figures: Annotated[
        bool | None, Ask("Draw figures (default: only for a sweep).", flag="--figures/--no-figures")
    ] = None,
    conf: Conf = (),
    refly: Annotated[bool, Ask("Fly cells again that another version of the sources has flown.")] = False,
    keep_old: Annotated[bool, Ask("Keep them in the table, beside new ones.")] = False,
    force: Force = False,
    watch: Annotated[bool, Ask("Show the sweep while it runs: a table here, and a page in a file.")] = False,
) -> Answer:
    """Fly one cell, or every cell of a sweep, and write the table of results.

    An interrupted sweep continues where it stopped; a finished one only prints its table. If cells were flown by
    another version of the program's sources, the command stops and asks for --keep-old or --refly.

    \b
    quadexp evaluate --sweep trajectory=circle,lemniscate trajectory.speed=4,8,12 \\
        controller=nominal_mpc,linear_drag_mpc,gp_mpc,perfect_mpc seed='range(3)' --out results/table1
    quadexp evaluate --sweep controller='nominal_mpc,dfbc inner=indi,pid adaptive=l1' trajectory=circle
    quadexp evaluate --sweep experiment=torrente_table1
    quadexp evaluate --sweep experiment=torrente_table1 --watch
    """
    from quadexp import requests

    if refly and keep_old:
        raise UsageError("--refly and --keep-old: give one of them")
    if watch and not sweep:
        raise UsageError("--watch is for a sweep: add --sweep")
    swept = requests.evaluate(
        overrides, out, conf, sweep=sweep, figures=figures, old="refly" if refly else "keep" if keep_old else "ask",
        force=force, watch=watch, progress=lambda below: Progress("flights", below), say=say,
    )  # fmt: skip
    result, metric = swept.result, swept.metric
    record = {
        "out": swept.out,
        "files": swept.files,
        "flown": result.flown,
        "notes": result.notes,
        "not_flown": len(result.not_flown),
        "rows": list(result.rows),
        "statistics": result.statistics.record(metric),
    }

    def csv() -> str:
        from quadexp.report.statistics import statistics_csv

        return statistics_csv(result.statistics.of(metric))

    texts = {"csv": csv, "markdown": result.table.markdown, "latex": result.table.latex}
    invalid = (
        [f"{swept.invalid}; all of them: quadexp results {shlex.quote(str(swept.out))} --failures"]
        if swept.invalid
        else []
    )
    shown = swept.lines or [result.table]
    return Answer(record, [], [*shown, swept.out], [*swept.notes, *invalid], swept.failed, texts)


VARY = Ask("A setting to tune; `:log` after it for a log scale; repeatable.", "KEY=LOW..HIGH", complete=complete)
SEARCH_SEED = Ask("Seed of the search's own draws.", flag="--seed", least=0)


@partial(command, vary=VARY, search_seed=SEARCH_SEED)
def tune(
    asked: Tune, overrides: Overrides = (), out: OptionalOut = None, conf: Conf = (), force: Force = False
) -> Answer:
    """Tune settings of a controller over worlds, trajectories, speeds and seeds, with a budget of flights.

    A trial flies every combination of the values given; its worth is the mean logarithm of the error (evaluate.metric),
    and lost flights count more than any error, the earlier the more. The first trial is the option as it is. Without
    --vary, the space is that of docs/tuning.md. What is found is written as an option,
    DIR/controller/NAME_tuned.yaml, for `--conf DIR controller=NAME_tuned`. An interrupted search continues where
    it stopped, and so does one whose budget is raised; --force begins anew.

    \b
    quadexp tune controller=gp_mpc model=models/gp world=clean,only_wind trajectory=circle,lemniscate \\
        trajectory.speed=8 --flights 200 --out tuned/gp_mpc
    quadexp tune controller=nominal_mpc trajectory=circle --vary controller.position_weight=1..1000:log \\
        --vary controller.nodes=5..20 --delay-margin 0.04
    """
    from quadexp.tune.call import tune as tuned_by

    with Progress("flights") as progress:
        tuned = tuned_by(overrides, asked, out=out, conf=conf, force=force, progress=progress)
    folders = [Path(folder).absolute() for folder in (tuned.record["out"], *conf)]
    given = [word for folder in folders for word in ("--conf", str(folder))]
    fly = f"fly it: {shlex.join(['quadexp', 'simulate', *given, *tuned.flown])}"
    return Answer(tuned.record, tuned.rows, [*tuned.lines, fly])


def _controllers(context: typer.Context, incomplete: str) -> list[str]:
    from quadexp.parts.options import groups

    return [name for name in groups(context.params.get("conf"))["controller"] if name.startswith(incomplete)]


CONTROLLER = Ask("Takes part too, as 'NAME observer=...'; repeatable.", "NAME", "--controller", _controllers)


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
    from quadexp.bench.run import bench as ranked_by

    with Progress("flights") as progress:
        board = ranked_by(overrides, asked, out=out, conf=conf, progress=progress, say=say)
    boards = {name: [named(t.columns, row) for row in t.rows] for name, t in board.tables.items()}
    record = {"protocol": board.protocol.name, "size": asked.size, "boards": boards}
    record["files"] = dict(board.files)
    tables = list(board.tables.values())
    return Answer(record, tables, [*tables, *board.files.values()], board.notes, board.failed)
