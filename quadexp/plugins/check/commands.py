"""The command `quadexp check`. Only light modules are imported at the top."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from quadexp.cli.command import Answer, Ask, Conf, command

HEADING = "Learn"


@command
def check(
    flights: Annotated[tuple[Path, ...], Ask("Flights of `quadexp import`.", "FLIGHT")],
    vehicle: Annotated[str | None, Ask("Vehicle of the configuration, instead of the flight's.", "NAME")] = None,
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
    from quadexp.plugins.check import requests
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
    from quadexp.plugins.check.figures import consistency_figure
    from quadexp.report.style import save

    drawn: dict[str, Path] = {}
    for flight in checked:
        stem = Path(flight.path).stem
        more = (f"{stem}_{k}" for k in range(2, len(checked) + 2))
        names = (stem, f"{Path(flight.path).parent.name}_{stem}", *more)
        file = next(folder / f"{name}.png" for name in names if folder / f"{name}.svg" not in drawn.values())
        drawn[flight.path] = save(consistency_figure(stem, flight.flight, flight.findings), file)
    return drawn
