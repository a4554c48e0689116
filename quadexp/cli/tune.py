"""`quadexp tune`: settings of a controller chosen by flights. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

import shlex
from typing import Annotated

import typer

from quadexp.cli.options import Conf, Force, Format, Json, OptionalOut, Overrides
from quadexp.cli.terminal import answered, format_of, guarded, print_lines
from quadexp.parts.completion import complete


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
    --vary, the space is that of docs/tuning.md. What is found is written as an option,
    DIR/controller/NAME_tuned.yaml, for `--conf DIR controller=NAME_tuned`. An interrupted search continues where
    it stopped, and so does one whose budget is raised; --force begins anew.

    \b
    quadexp tune controller=gp_mpc model=models/gp world=clean,only_wind trajectory=circle,lemniscate \\
        trajectory.speed=8 --flights 200 --out tuned/gp_mpc
    quadexp tune controller=nominal_mpc trajectory=circle --vary controller.position_weight=1..1000:log \\
        --vary controller.nodes=5..20 --delay-margin 0.04
    """
    from quadexp.progress import Progress
    from quadexp.tune.call import tune as search
    from quadexp.tune.preset import hidden

    form = format_of(format, json)
    with Progress("flights") as progress:
        found = search(
            overrides or [],
            vary=vary or [],
            flights=flights,
            seeds=seeds,
            delay_margin=delay_margin,
            seed=seed,
            batch=batch,
            name=name,
            out=out,
            conf=conf,
            force=force,
            progress=progress,
        )
    if answered(form, dict(found.record), found.rows, "tune"):
        return
    print_lines(found.lines)
    where = found.record["out"] if conf is None else conf
    if hidden(found.option):
        print_lines([f"{found.choice.split()[-1]} is an option already, which comes first: give --name, and run again"])
        return
    if conf is not None:
        print_lines([f"copy the file to {conf}/{found.option.parent.name} to fly it:"])
    print_lines([f"fly it: {shlex.join(['quadexp', 'simulate', '--conf', str(where), *found.choice.split()])}"])
