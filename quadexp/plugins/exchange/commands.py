"""The command `quadexp export`. Only light modules are imported at the top."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from quadexp.cli.command import Answer, Ask, Conf, Force, OptionalOut, command, file_rows
from quadexp.errors import UsageError

HEADING = "Look"


@command
def export(
    source: Annotated[str, Ask("A flight; or a model of `quadexp identify` or `fit`; or vehicle=NAME.", "SOURCE")],
    to: Annotated[str, Ask("A flight: csv, tum, rerun. A model or a vehicle: see above.", "FORMAT", "--to")],
    out: OptionalOut = None,
    vehicle: Annotated[str | None, Ask("Vehicle of a model that does not say it.", "NAME")] = None,
    voltage: Annotated[float | None, Ask("Battery voltage at which the numbers hold.", "V")] = None,
    motor_lag: Annotated[float | None, Ask("Time constant of the motors.", "S")] = None,
    firmware: Annotated[str | None, Ask("Version of the autopilot's firmware.", "VERSION")] = None,
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Write a flight, or the numbers of a model or vehicle, for other programs.

    A flight: csv, tum, rerun (extra [viz]). A model or a vehicle: px4, px4_sih, ardupilot, betaflight; sdf, rotorpy,
    crazyflow, gym_pybullet, mjcf, agilicious; casadi, c. Their files say the origin and the 95 % interval of every
    number, and what the program cannot represent.

    \b
    quadexp export runs/a.parquet --to csv --out a.csv
    quadexp export models/crazyflie --to px4 --voltage 3.9 --out crazyflie.params
    quadexp export vehicle=hummingbird --to rotorpy --motor-lag 0.005
    """
    from quadexp.plugin import brought, places
    from quadexp.plugins.exchange.flights import FORMATS, export_flight

    options = {"vehicle": vehicle, "voltage": voltage, "motor_lag": motor_lag, "firmware": firmware}
    others = ", ".join(places("exports"))
    form = brought("exports", to)
    if form is not None:
        if source.endswith(".parquet"):
            of_flight = ", ".join(FORMATS)
            raise UsageError(f"--to {to}: is for a model's folder or vehicle=NAME; flights are written as {of_flight}")
        files, record, lines = form(source, out=out, conf=conf, force=force, **options)
        return Answer(record, record["numbers"], [*lines, *files.values()])
    if to not in FORMATS:
        of_model = f"; a model or a vehicle as {others}" if others else ""
        raise UsageError(f"--to {to}: no such format; a flight is written as {', '.join(FORMATS)}{of_model}")
    if source.startswith("vehicle=") or (Path(source) / "model.json").is_file():
        raise UsageError(f"--to {to}: is for flights; {source} is none: {others or 'no plug-in writes it'}")
    for name, value in options.items():
        if value is not None:
            raise UsageError(f"--{name.replace('_', '-')}: --to {to} does not use it")
    files = export_flight(source, to, out, force=force)
    return Answer({"format": to, "files": files}, file_rows(files), list(files.values()))
