"""Commands that take recorded flights in: `quadexp import`, `check`. Only light modules are imported at the top."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from quadexp.cli.command import Answer, Ask, Conf, Force, command
from quadexp.cli.terminal import print_lines
from quadexp.errors import UsageError
from quadexp.plugins.logs import BRINGS

HEADING = "Learn"
LOG_FORMATS = ("auto", *sorted(BRINGS["readers"]), "nanobench", "blackbird")
BAD_ROWS = (
    "Repeated rows, outliers, stretches of a dead logger: refuse the log, drop them (bridged where short), or make each"
    " a gap."
)
Vehicle = Annotated[str | None, Ask("Of the configuration, not the flight's own.", "NAME")]


@command
def import_(
    logs: Annotated[tuple[Path, ...], Ask("Log files (or folders of ROS 2).", "LOG")],
    form: str,
    log_format: Annotated[str, Ask(f"Of the log: {', '.join(LOG_FORMATS)}, or a plug-in's.", "FORMAT")] = "auto",
    vehicle: Annotated[str | None, Ask("Which vehicle of the configuration flew.", "NAME")] = None,
    out: Annotated[Path, Ask("Where to write.", "DIR", "--out -o")] = Path("flights"),
    mapping: Annotated[Path | None, Ask("What the columns of a table are (YAML).")] = None,
    rate: Annotated[float | None, Ask("Of the flight; the log's own unless given.", "HZ")] = None,
    describe: Annotated[bool, Ask("Propose a mapping for a table, and say how sure it is.")] = False,
    crop: Annotated[bool, Ask("Cut off what is on the ground.", flag="--crop/--no-crop")] = True,
    align: Annotated[bool, Ask("Move streams that are late by the offsets found.")] = False,
    mounting: Annotated[str | None, Ask("Roll, pitch, yaw of the accelerometer in the body (deg).", "R,P,Y")] = None,
    gyro_mounting: Annotated[str | None, Ask("The same of the gyro.", "R,P,Y")] = None,
    bad_rows: Annotated[Literal["refuse", "drop", "gap"], Ask(BAD_ROWS)] = "refuse",
    keep: Annotated[bool, Ask("Write flights with blocking findings too.")] = False,
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Make flights of logs: one clock, SI units, ENU and FLU, ground phases cut off, quality checked.

    \b
    quadexp import logs/*.ulg --vehicle crazyflie --out flights
    quadexp import --describe log.csv > mapping.yaml
    quadexp import log.csv --mapping mapping.yaml --out flights
    """
    from quadexp.plugins.logs.import_flights import import_files
    from quadexp.plugins.logs.importers import Options
    from quadexp.plugins.logs.importers.describe import describe_log

    if describe:
        if len(logs) != 1:
            raise UsageError(f"--describe: {len(logs)} logs are given, one is needed")
        proposed = describe_log(logs[0])
        return Answer(proposed.record(), [], proposed.yaml().splitlines(), proposed.warnings)
    turned = (_angles("--mounting", mounting), _angles("--gyro-mounting", gyro_mounting))
    options = Options(log_format, mapping, rate, crop, align, *turned, bad_rows)
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


@command
def check(
    flights: Annotated[tuple[Path, ...], Ask("Flights of `quadexp import`.", "FLIGHT")],
    vehicle: Vehicle = None,
    figures: Annotated[Path | None, Ask("Draw every flight's streams against each other.", "DIR")] = None,
    strict: Annotated[bool, Ask("Warnings block as well.")] = False,
    conf: Conf = (),
) -> Answer:
    """Check units, frames, signs, clock, sensors and commands of flights, and whether one is there twice.

    Exit code 1 where a finding blocks: what would be learned from that flight would be wrong.

    \b
    quadexp check flights/nanobench/*.parquet
    quadexp check flights/a.parquet --figures figures/check --strict
    """
    from quadexp.plugins.logs import requests
    from quadexp.report.table import Table

    names = ("severity", "name", "where", "measured", "allowed", "advice")
    stops = {"blocking", "warning"} if strict else {"blocking"}
    checked = requests.check(flights, vehicle, conf)
    drawn = _draw(figures, checked) if figures is not None else {}
    records: list[dict[str, Any]] = []
    lines: list[Any] = []
    blocked = 0
    for flight in checked:
        stopped = not stops.isdisjoint(flight.severities)
        blocked += stopped
        records.append({
            "path": flight.path, "rows": len(flight.flight), "duration": flight.duration, "vehicle": flight.vehicle,
            "blocked": stopped, "findings": [finding.record() for finding in flight.findings],
            "figure": drawn.get(flight.path),
        })  # fmt: skip
        title = f"{flight.path}: {len(flight.flight)} rows, {flight.duration:.1f} s"
        cells = [[getattr(finding, name) for name in names] for finding in flight.findings]
        lines += [Table(names, cells, title, left=frozenset(range(6)))] if cells else [title, "  nothing found"]
        lines += [f"  {drawn[flight.path]}", ""] if flight.path in drawn else [""]
    clean = sum(flight.severities <= {"info"} for flight in checked)
    warned, stopping = (sum(name in flight.severities for flight in checked) for name in ("warning", "blocking"))
    count = "1 flight" if len(checked) == 1 else f"{len(checked)} flights"
    lines.append(f"{count}: {clean} clean, {warned} with warnings, {stopping} blocked")
    by = " (--strict)" if strict else ""
    failed = [f"{blocked} of {len(checked)} flights have findings that block{by}"] if blocked else []
    findings = [(flight.path, finding) for flight in checked for finding in flight.findings]
    cells = [[path, *(getattr(finding, name) for name in names)] for path, finding in findings]
    table = Table(("flight", *names), cells, left=frozenset(range(7)))
    return Answer({"flights": records, "blocked": blocked, "strict": strict}, [table], lines, failed=failed)


def _draw(folder: Path, checked: Sequence[Any]) -> dict[str, Path]:
    from quadexp.plugins.logs.figures import consistency_figure
    from quadexp.report.style import save

    drawn: dict[str, Path] = {}
    for flight in checked:
        stem = Path(flight.path).stem
        more = (f"{stem}_{k}" for k in range(2, len(checked) + 2))
        names = (stem, f"{Path(flight.path).parent.name}_{stem}", *more)
        file = next(folder / f"{name}.png" for name in names if folder / f"{name}.svg" not in drawn.values())
        drawn[flight.path] = save(consistency_figure(stem, flight.flight, flight.findings), file)
    return drawn
