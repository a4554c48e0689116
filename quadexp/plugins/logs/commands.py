"""The command that takes recorded flights in: `quadexp import`. Only light modules are imported at the top."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from quadexp.cli.command import Answer, Ask, Conf, Force, command
from quadexp.cli.terminal import print_lines
from quadexp.errors import UsageError
from quadexp.plugin import service
from quadexp.plugins.logs import BRINGS

HEADING = "Learn"
LOG_FORMATS = ("auto", *sorted(BRINGS["readers"]), "nanobench", "blackbird")
BAD_ROWS = (
    "Repeated rows, outliers, stretches of a dead logger: refuse the log, drop them (bridged where short), or make each"
    " a gap."
)


@command
def import_(
    logs: Annotated[tuple[Path, ...], Ask("Log files (or folders of ROS 2).", "LOG")],
    form: str,
    log_format: Annotated[str, Ask(f"Of the log: {', '.join(LOG_FORMATS)}, or a plug-in's.", "FORMAT")] = "auto",
    vehicle: Annotated[str | None, Ask("The vehicle that flew, an option of the configuration.", "NAME")] = None,
    out: Annotated[Path, Ask("Where to write.", "DIR", "--out -o")] = Path("flights"),
    mapping: Annotated[Path | None, Ask("Meaning of a table's columns (YAML).")] = None,
    rate: Annotated[float | None, Ask("Rate of the flight; by default the log's.", "HZ")] = None,
    describe: Annotated[bool, Ask("Propose a mapping for a table, and say how sure it is.")] = False,
    crop: Annotated[bool, Ask("Leave out phases on the ground.", flag="--crop/--no-crop")] = True,
    align: Annotated[bool, Ask("Move streams that are late by the offsets found.")] = False,
    mounting: Annotated[str | None, Ask("Roll, pitch, yaw of the accelerometer in the body (deg).", "R,P,Y")] = None,
    gyro_mounting: Annotated[str | None, Ask("The same of the gyro.", "R,P,Y")] = None,
    bad_rows: Annotated[Literal["refuse", "drop", "gap"], Ask(BAD_ROWS)] = "refuse",
    keep: Annotated[bool, Ask("Write flights with blocking findings too.")] = False,
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Make flights from logs: one clock, SI units, ENU and FLU, ground phases left out, quality checked.

    \b
    quadexp import logs/*.ulg --vehicle crazyflie --out flights
    quadexp import --describe log.csv > mapping.yaml
    quadexp import log.csv --mapping mapping.yaml --out flights
    """
    from quadexp.plugins.logs.import_flights import import_files
    from quadexp.plugins.logs.importers import Options

    if describe:
        if len(logs) != 1:
            raise UsageError(f"--describe: {len(logs)} logs are given, one is needed")
        proposed = service("describe_log", "--describe")(logs[0])
        return Answer(proposed.record(), [], proposed.yaml().splitlines(), proposed.warnings)
    options = Options(
        format=log_format,
        mapping=mapping,
        rate=rate,
        crop=crop,
        align=align,
        mounting=_angles("--mounting", mounting),
        gyro_mounting=_angles("--gyro-mounting", gyro_mounting),
        bad_rows=bad_rows,
    )
    records: list[dict[str, Any]] = []
    for log in import_files(logs, out, options, vehicle=vehicle, conf=conf, force=force, keep=keep):
        records.append(log.record())
        if form == "text":  # as they come: a log may take minutes
            print_lines(log.lines())
            sys.stdout.flush()
    lost = sum(record["path"] is None for record in records)
    failed = [f"{lost} of {len(records)} logs were not imported"] if lost else []
    return Answer({"out": out, "logs": records}, [_of_log(record) for record in records], [], failed=failed)


def _of_log(record: dict[str, Any]) -> dict[str, Any]:
    """One log as a row: what was found in it by name."""
    findings = ", ".join(dict.fromkeys(finding["name"] for finding in record["findings"]))
    return {**record, "notes": "; ".join(record["notes"]), "findings": findings}


def _angles(option: str, text: str | None) -> tuple[float, float, float] | None:
    """Three angles (deg) with commas between."""
    if text is None:
        return None
    try:
        roll, pitch, yaw = (float(word) for word in text.split(","))
    except ValueError:
        raise UsageError(f"{option}: '{text}' must be roll,pitch,yaw in degrees, as {option}=0.5,-7.8,0") from None
    if not all(math.isfinite(x) and abs(x) <= 360 for x in (roll, pitch, yaw)):
        raise UsageError(f"{option}: '{text}' must be in [-360, 360] deg")
    return roll, pitch, yaw
