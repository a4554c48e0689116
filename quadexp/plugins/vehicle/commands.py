"""Commands that bring a controller onto a vehicle: `quadexp export-controller`. Only light modules are imported at the
top."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from quadexp.cli.command import Answer, Ask, Conf, Force, Out, Overrides, command

HEADING = "Extend"


@command
def export_controller(
    overrides: Overrides = (),
    out: Out = Path("controller"),
    real: Annotated[Literal["double", "float"], Ask("Precision of its numbers.")] = "double",
    prefix: Annotated[str, Ask("Of all names that a program around it sees.", "NAME")] = "qx",
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Write a controller as C that needs no library, with a proof that it flies as in the bench.

    The trajectory is the one that it is checked on; `make test` in the folder repeats the check.

    \b
    quadexp export-controller controller=gp_mpc model=models/gp trajectory=circle trajectory.speed=8 --out vehicle/gp
    quadexp export-controller controller=geometric adaptive=l1 --real float --prefix gl --out vehicle/geometric
    make -C vehicle/gp test
    """
    from quadexp.plugins.vehicle.export import export_controller as export

    made = export(overrides, out, conf, real=real, prefix=prefix, force=force)
    size = sum(made["files"].values())
    line = f"{len(made['files'])} files, {size / 1e6:.1f} MB; make -C {made['path']} test checks them"
    rows = [{"file": name, "bytes": count} for name, count in made["files"].items()]
    return Answer(made, rows, [line, Path(made["path"])])
