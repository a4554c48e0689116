"""`quadexp tune`: settings of a controller chosen by flights. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadexp.cli.options import Conf, Force, Format, Json, OptionalOut, Overrides
from quadexp.cli.terminal import answered, format_of, guarded
from quadexp.config.completion import complete


@guarded
def tune(
    overrides: Overrides = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            "--vary",
            metavar="KEY=LOW..HIGH",
            help="A setting to tune; `:log` after it for a log scale; repeatable.",
            autocompletion=complete,
        ),
    ] = None,
    flights: Annotated[int, typer.Option("--flights", min=1, help="Budget: flights of all trials.")] = 200,
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Seeds of a trial, unless seed=... is given.")] = 2,
    delay_margin: Annotated[
        float, typer.Option("--delay-margin", metavar="S", min=0, help="Least delay margin of the loop, for an MPC.")
    ] = 0.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the search's own draws.")] = 0,
    batch: Annotated[int, typer.Option("--batch", min=1, help="Trials drawn together, to fill many workers.")] = 1,
    name: Annotated[str | None, typer.Option("--name", help="Of the option to write; default: NAME_tuned.")] = None,
    out: OptionalOut = None,
    conf: Conf = None,
    force: Force = False,
    format: Format = None,
    json: Json = False,
) -> None:
    """Tune settings of a controller over worlds, trajectories, speeds and seeds, with a budget of flights.

    A trial flies every combination of the values given; its worth is the mean logarithm of the error (evaluate.metric),
    and lost flights count more than any error, the earlier the more. The first trial is the option as it is. Without
    --vary, the space is that of conf/tune. What is found is written as an option, DIR/controller/NAME_tuned.yaml, for
    `--conf DIR controller=NAME_tuned`. An interrupted search continues where it stopped, and so does one whose budget
    is raised; --force begins anew.

    \b
    quadexp tune controller=gp_mpc model=models/gp world=clean,only_wind trajectory=circle,lemniscate \\
        trajectory.speed=8 --flights 200 --out tuned/gp_mpc
    quadexp tune controller=nominal_mpc trajectory=circle --vary controller.position_weight=1..1000:log \\
        --vary controller.nodes=5..20 --delay-margin 0.04
    """
    from quadexp.config.compose import session
    from quadexp.progress import Progress
    from quadexp.sweeps.cluster.engines import open_engine
    from quadexp.sweeps.engine import Workers
    from quadexp.tune.result import clear, trials_of
    from quadexp.tune.result import tune as search
    from quadexp.tune.search import Request, cells_of, with_seeds
    from quadexp.tune.space import read_axes

    form = format_of(format, json)
    with session(conf) as composer:
        given = with_seeds(overrides or [], seeds)
        cells = cells_of(composer, given)
        first = cells[0].config
        trials_of(flights, len(cells))
        axes = tuple(read_axes(vary or [], first, conf))
        settings = first.evaluate
        request = Request(tuple(given), axes, settings.metric, delay_margin, seed, batch)
        out = out or Path("tuned") / first.controller.name
        if force:
            clear(out)
        with (
            Workers(settings.workers, settings.memory or None, calls=len(cells)) as processes,
            open_engine(first, processes) as engine,
            Progress("flights") as progress,
        ):
            found = search(composer, request, out, flights, name=name, engine=engine, progress=progress)
    if answered(form, dict(found.record), found.rows, "tune"):
        return
    print("\n".join(found.lines))
    options = " ".join(found.options)
    if conf is None:
        print(f"fly it: quadexp simulate --conf {out} {options}")
    else:
        print(f"copy the file to {conf}/controller to fly it: quadexp simulate --conf {conf} {options}")
