"""`quadexp tune`: settings of a controller chosen by flights. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

import shlex
from functools import partial

from quadexp.cli.command import Answer, Ask, command
from quadexp.cli.options import Conf, Force, OptionalOut, Overrides
from quadexp.parts.completion import complete
from quadexp.tune import Tune

VARY = Ask("A setting to tune; `:log` after it for a log scale; repeatable.", "KEY=LOW..HIGH", complete=complete)
SEARCH_SEED = Ask("Seed of the search's own draws.", flag="--seed", least=0)


@partial(command, vary=VARY, search_seed=SEARCH_SEED)
def tune(
    asked: Tune, overrides: Overrides = None, out: OptionalOut = None, conf: Conf = None, force: Force = False
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
    from quadexp.progress import Progress
    from quadexp.tune.call import tune as search
    from quadexp.tune.preset import hidden

    with Progress("flights") as progress:
        tuned = search(overrides or [], asked, out=out, conf=conf, force=force, progress=progress)
    lines, where = list(tuned.lines), tuned.record["out"] if conf is None else conf
    if hidden(tuned.option):
        lines.append(f"{tuned.choice.split()[-1]} is an option already, which comes first: give --name, and run again")
    else:
        if conf is not None:
            lines.append(f"copy the file to {conf}/{tuned.option.parent.name} to fly it:")
        words = ["quadexp", "simulate", "--conf", str(where), *tuned.choice.split()]
        lines.append(f"fly it: {shlex.join(words)}")
    return Answer(tuned.record, tuned.rows, lines)
