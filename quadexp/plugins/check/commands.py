"""The command `quadexp check`. Only light modules are imported at the top."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from quadexp.cli.command import Answer, Ask, Conf, command

HEADING = "Learn"
FIELDS = ("severity", "name", "where", "measured", "allowed", "advice")
TEXTS = frozenset(range(1 + len(FIELDS)))  # columns that are set to the left


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

    stops = {"blocking", "warning"} if strict else {"blocking"}
    checked = requests.check(flights, vehicle, conf)
    drawn = {}
    if figures is not None:
        drawn = _draw(figures, checked)
    records: list[dict[str, Any]] = []
    lines: list[Any] = []
    rows: list[list[str]] = []
    for flight in checked:
        records.append({
            "path": flight.path, "rows": len(flight.flight), "duration": flight.duration, "vehicle": flight.vehicle,
            "blocked": not stops.isdisjoint(flight.severities),
            "findings": [finding.record() for finding in flight.findings], "figure": drawn.get(flight.path),
        })  # fmt: skip
        title = f"{flight.path}: {len(flight.flight)} rows, {flight.duration:.1f} s"
        cells = [[getattr(finding, name) for name in FIELDS] for finding in flight.findings]
        rows += [[flight.path, *cell] for cell in cells]
        lines += [Table(FIELDS, cells, title, left=TEXTS)] if cells else [title, "  nothing found"]
        if flight.path in drawn:
            lines.append(f"  {drawn[flight.path]}")
        lines.append("")
    blocked = sum(record["blocked"] for record in records)
    clean = sum(flight.severities <= {"info"} for flight in checked)
    warned = sum("warning" in flight.severities for flight in checked)
    stopping = sum("blocking" in flight.severities for flight in checked)
    count = "1 flight" if len(checked) == 1 else f"{len(checked)} flights"
    lines.append(f"{count}: {clean} clean, {warned} with warnings, {stopping} blocked")
    failed = []
    if blocked:
        by = " (--strict)" if strict else ""
        failed = [f"{blocked} of {len(checked)} flights have findings that block{by}"]
    table = Table(("flight", *FIELDS), rows, left=TEXTS)
    return Answer({"flights": records, "blocked": blocked, "strict": strict}, [table], lines, failed=failed)


def _draw(folder: Path, checked: Sequence[Any]) -> dict[str, Path]:
    """A figure a flight, under names that differ."""
    from quadexp.plugins.check.figures import consistency_figure
    from quadexp.plugins.drawing.style import save

    drawn: dict[str, Path] = {}
    for flight in checked:
        path = Path(flight.path)
        stem = path.stem
        name = stem
        others = [f"{path.parent.name}_{stem}"]
        others += [f"{stem}_{k + 2}" for k in range(len(checked))]
        for other in others:
            if folder / f"{name}.svg" in drawn.values():
                name = other
        drawn[flight.path] = save(consistency_figure(stem, flight.flight, flight.findings), folder / f"{name}.png")
    return drawn
