"""`quadexp new vehicle --from`: an option with the numbers of another program's file."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

from quadexp.cli.command import Answer, Ask
from quadexp.cli.extend import TEMPLATES, NewName, NewPart, To, check_name
from quadexp.errors import UsageError
from quadexp.writer import write_text


def new_from(
    part: NewPart,
    name: NewName,
    to: To = Path("my_parts"),
    from_: Annotated[
        str | None, Ask("A vehicle: the file of crazyflow (.toml) or RotorPy (.py).", "FILE[:SECTION]")
    ] = None,
) -> Answer:
    """A vehicle with --from has the numbers of another program's file; a RotorPy file is Python, and is run.

    \b
    quadexp new vehicle racer --from params.toml:racer
    """
    source = from_ or ""
    if part != "vehicle":
        raise UsageError(f"new {part} --from: only a vehicle is read from a file")
    from omegaconf import OmegaConf

    from quadexp.experiment.build import build_vehicle
    from quadexp.parts.settings import made
    from quadexp.physics.vehicle import Vehicle
    from quadexp.plugins.exchange.vehicles import vehicle_keys

    check_name(part, name, TEMPLATES[part], to)
    file, _, section = source.partition(":")
    keys = {"name": name} | vehicle_keys(Path(file), section)
    build_vehicle(made(Vehicle, keys))
    stated = {"_target_": f"{Vehicle.__module__}.{Vehicle.__name__}", **keys}
    text = f"# From {source}. SI units; rate_max, the largest body rate of a reference, is not from there.\n"
    path = write_text(to / "vehicle" / f"{name}.yaml", text + OmegaConf.to_yaml(OmegaConf.create(stated)), force=False)
    command = f"quadexp simulate --conf {shlex.quote(str(to))} vehicle={name} --out runs/{name}.parquet"
    record = {"part": part, "name": name, "option": f"vehicle={name}", "files": [path], "commands": [command]}
    return Answer(record, [{"file": str(path)}], [path, "", f"    {command}"])
