"""The command `quadexp replay-test`. Only light modules are imported at the top."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from quadexp.cli.command import Answer, Ask, Conf, Force, OptionalOut, Overrides, command
from quadexp.names import without
from quadexp.progress import Progress

HEADING = "Learn"


@command
def replay_test(
    log: Annotated[Path, Ask("Of `quadexp import` or `simulate`.", "LOG")],
    model: Annotated[Path, Ask("Folder of `quadexp identify`: the plant.", "MODEL")],
    overrides: Overrides = (),
    members: Annotated[int, Ask("Number of flights in the ensemble.", "N", least=1)] = 8,
    out: OptionalOut = None,
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Fly the path of a log again, in a plant identified from other flights, and compare with the log.

    The plant has the model's forces, the dead time and lag of its thrust curve, torques of the vehicle file (or of
    the gain found), and the noise that the model leaves on the log. The flights of the ensemble differ in that noise
    and in the model's coefficients. Any controller flies, with settings as in `simulate`; of a simulated log its own
    if none is named. The path is the log's reference or, where it has none, where it flew.

    \b
    quadexp replay-test flights/c.parquet models/crazyflie controller=geometric
    quadexp replay-test flights/c.parquet models/crazyflie controller=gp_mpc model=models/gp --out results/replay
    """
    from quadexp.plugins.identification import replay

    with Progress("replay") as progress:
        report = replay.replay_test(
            log, model, overrides, conf, members=members, out=out, force=force, progress=progress
        )  # fmt: skip
    return Answer(without(report, ("lines",)), report["rows"], [*report["lines"], *([out] if out else [])])
