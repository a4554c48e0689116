"""`quadexp import`: logs of other programs as flights. Only light modules are imported here."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from quadexp.cli.options import Conf, Force, Format, Json
from quadexp.cli.terminal import FORMATS, answered, emit, format_of, guarded, print_lines, say
from quadexp.errors import QuadexpError, UsageError

_READERS = (Path(__file__).parents[1] / "log" / "importers" / "readers").glob("[a-z]*.py")
LOG_FORMATS = ("auto", *sorted(file.stem for file in _READERS), "nanobench", "blackbird")
_FORMATS = f"Of the log: {', '.join(LOG_FORMATS[:-1])} or {LOG_FORMATS[-1]}."


@guarded
def import_flights(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Log files (or folders of ROS 2).")],
    form: Annotated[str, typer.Option("--log-format", metavar="FORMAT", help=_FORMATS)] = "auto",
    vehicle: Annotated[
        str | None, typer.Option("--vehicle", metavar="NAME", help="Which vehicle of the configuration flew.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Where to write.")] = Path("flights"),
    mapping: Annotated[
        Path | None, typer.Option("--mapping", metavar="FILE", help="What the columns of a table are (YAML).")
    ] = None,
    rate: Annotated[
        float | None, typer.Option("--rate", metavar="HZ", help="Of the flight; the log's own unless given.")
    ] = None,
    describe: Annotated[
        bool, typer.Option("--describe", help="Propose a mapping for a table, and say how sure it is.")
    ] = False,
    crop: Annotated[bool, typer.Option("--crop/--no-crop", help="Cut off what is on the ground.")] = True,
    align: Annotated[bool, typer.Option("--align", help="Move gyro and accelerometer by the offsets found.")] = False,
    mounting: Annotated[
        str | None,
        typer.Option("--mounting", metavar="R,P,Y", help="Roll, pitch, yaw of the accelerometer in the body (deg)."),
    ] = None,
    gyro_mounting: Annotated[
        str | None, typer.Option("--gyro-mounting", metavar="R,P,Y", help="The same of the gyro.")
    ] = None,
    bad_rows: Annotated[
        str,
        typer.Option(
            "--bad-rows",
            metavar="HOW",
            help="Repeated rows, outliers, stretches of a dead logger: refuse the log, drop them (bridged where short),"
            " or make each a gap.",
        ),
    ] = "refuse",
    keep: Annotated[bool, typer.Option("--keep", help="Write flights with blocking findings too.")] = False,
    conf: Conf = None,
    force: Force = False,
    format: Format = None,
    json: Json = False,
) -> None:
    """Make flights of logs: one clock, SI units, ENU and FLU, ground phases cut off, quality checked.

    \b
    quadexp import logs/*.ulg --vehicle crazyflie --out flights
    quadexp import --describe log.csv > mapping.yaml
    quadexp import log.csv --mapping mapping.yaml --out flights
    """
    if format in LOG_FORMATS and format not in FORMATS:
        raise UsageError(f"import --format {format}: is how the answer is printed; that of the log is --log-format")
    shown = format_of(format, json)
    if describe:
        from quadexp.log.importers.describe import describe_log

        if len(logs) != 1:
            raise UsageError(f"--describe: {len(logs)} logs are given, one is needed")
        proposed = describe_log(logs[0])
        if json:
            emit(proposed.record())
            return
        for line in proposed.warnings:
            say(f"note: {line}")
        print(proposed.yaml(), end="")
        return
    from quadexp.experiment.import_flights import import_files
    from quadexp.log.importers import Options

    turned = (_angles("--mounting", mounting), _angles("--gyro-mounting", gyro_mounting))
    options = Options(form, mapping, rate, crop, align, *turned, bad_rows)
    records: list[dict[str, Any]] = []
    for one in import_files(logs, out, options, vehicle=vehicle, conf=conf, force=force, keep=keep):
        records.append(one.record())
        if shown == "text":
            print_lines(one.lines())
            sys.stdout.flush()
    answered(shown, {"out": out, "logs": records}, lambda: [_row(record) for record in records], "import")
    failed = [record for record in records if record["path"] is None]
    if failed:
        raise QuadexpError(f"{len(failed)} of {len(records)} logs were not imported")


def _row(record: dict[str, Any]) -> dict[str, Any]:
    """One log as a row: what was found in it by name."""
    found = ", ".join(dict.fromkeys(one["name"] for one in record["findings"]))
    return {**record, "notes": "; ".join(record["notes"]), "findings": found}


def _angles(option: str, text: str | None) -> tuple[float, float, float] | None:
    """Three angles (deg) with commas between."""
    import math

    if text is None:
        return None
    try:
        roll, pitch, yaw = (float(word) for word in text.split(","))
    except ValueError:
        raise UsageError(f"{option}: '{text}' must be roll,pitch,yaw in degrees, as {option}=0.5,-7.8,0") from None
    if not all(math.isfinite(x) and abs(x) <= 360 for x in (roll, pitch, yaw)):
        raise UsageError(f"{option}: '{text}' must be in [-360, 360] deg")
    return roll, pitch, yaw
