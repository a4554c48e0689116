"""The command `quadexp tune`. Only light modules are imported at the top."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path

from quadexp.cli.command import Answer, Ask, Conf, Force, OptionalOut, Overrides, command, complete
from quadexp.plugins.tune.settings import Tune
from quadexp.progress import Progress

HEADING = "Fly"
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
    DIR/controller/NAME_tuned.yaml, for `--conf DIR controller=NAME_tuned`; with remedies, in DIR/remedies. An
    interrupted search continues where it stopped, and so does one whose budget is raised; --force begins anew.

    \b
    quadexp tune controller=gp_mpc model=models/gp world=clean,only_wind trajectory=circle,lemniscate \\
        trajectory.speed=8 --flights 200 --out tuned/gp_mpc
    quadexp tune controller=nominal_mpc trajectory=circle --vary controller.position_weight=1..1000:log \\
        --vary controller.nodes=5..20 --delay-margin 0.04
    """
    from quadexp.plugins.tune.call import tune as tuned_by

    with Progress("flights") as progress:
        tuned = tuned_by(overrides, asked, out=out, conf=conf, force=force, progress=progress)
    folders = [Path(folder).absolute() for folder in (tuned.record["out"], *conf)]
    words = []
    for folder in folders:
        words += ["--conf", str(folder)]
    fly = f"fly it: {shlex.join(['quadexp', 'simulate', *words, *tuned.flown])}"
    return Answer(tuned.record, tuned.rows, [*tuned.lines, fly])
