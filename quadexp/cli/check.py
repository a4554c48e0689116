"""`quadexp check`: is a recorded flight what it says it is? Only light modules are imported here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from quadexp.cli.options import Conf, Format, Json
from quadexp.cli.terminal import answered, console, format_of, guarded
from quadexp.errors import DataError, QuadexpError, UsageError
from quadexp.messages import printable

COLOURS = {"blocking": "bold red", "warning": "yellow", "info": "dim"}


@guarded
def check(
    flights: Annotated[list[Path], typer.Argument(metavar="FLIGHT...", help="Flights of `quadexp import`.")],
    vehicle: Annotated[
        str | None, typer.Option("--vehicle", metavar="NAME", help="Of the configuration, not the flight's own.")
    ] = None,
    figures: Annotated[
        Path | None, typer.Option("--figures", metavar="DIR", help="Draw every flight's streams against each other.")
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Warnings block as well.")] = False,
    conf: Conf = None,
    format: Format = None,
    json: Json = False,
) -> None:
    """Check units, frames, signs, clock, sensors and commands of flights, and whether one is there twice.

    Exit code 1 where a finding blocks: what would be learned from that flight would be wrong.

    \b
    quadexp check flights/nanobench/*.parquet
    quadexp check flights/a.parquet --figures figures/check --strict
    """
    import numpy as np

    from quadexp.log.check import check_flights

    form = format_of(format, json)
    loaded = _load(flights)
    known = {path: _vehicle(flight, vehicle, conf) for path, flight in loaded.items()}
    found = {path: _with_import(own, loaded[path]) for path, own in check_flights(loaded, known).items()}
    stops = ("blocking", "warning") if strict else ("blocking",)
    blocked = [path for path, findings in found.items() if any(one.severity in stops for one in findings)]
    drawn = _draw(figures, loaded, found) if figures is not None else {}
    records = [
        {"path": path, "rows": len(flight), "duration": float(np.ptp(flight.t)) if len(flight) else 0.0,
         "vehicle": getattr(known[path], "name", None), "blocked": path in blocked,
         "findings": [one.record() for one in found[path]], "figure": drawn.get(path)}
        for path, flight in loaded.items()
    ]  # fmt: skip

    def rows() -> list[Any]:
        from quadexp.report.table import Table

        names = ("severity", "name", "where", "measured", "allowed", "advice")
        cells = [[path, *(getattr(one, name) for name in names)] for path, own in found.items() for one in own]
        return [Table(("flight", *names), cells, left=frozenset(range(7)))]

    if not answered(form, {"flights": records, "blocked": len(blocked), "strict": strict}, rows, "check"):
        _print(records, found)
    if blocked:
        by = " (--strict)" if strict else ""
        raise QuadexpError(f"{len(blocked)} of {len(found)} flights have findings that block{by}")


def _load(paths: list[Path]) -> dict[str, Any]:
    from quadexp.log.schema import Flight
    from quadexp.log.store import check_whole, read_table

    loaded: dict[str, Any] = {}
    for path in map(str, paths):
        if path in loaded:
            raise UsageError(f"{path}: given twice")
        loaded[path] = Flight(*read_table(path, "flight", required=("t",)))
        check_whole(loaded[path].metadata, path)
    return loaded


def _vehicle(flight: Any, name: str | None, conf: Path | None) -> Any:
    from quadexp.experiment.identify import configured_vehicle, own_vehicle

    if name is not None:
        return configured_vehicle(name, conf)
    try:
        return own_vehicle(flight, conf)
    except (DataError, UsageError):  # a record of another version: the limits are then not known
        return None


def _with_import(findings: list[Any], flight: Any) -> list[Any]:
    """Findings now, and those that the import made on the log itself, which the flight no longer shows."""
    from quadexp.log.check.finding import Finding, worst_first

    names = {one.name for one in findings}
    earlier = []
    for record in flight.metadata.get("findings") or []:
        if {"name", "severity", "where"} <= set(record) and record["name"] not in names:
            severity = record["severity"].replace("blocking", "warning")  # it was mended or accepted at the import
            texts = {key: record.get(key, "") for key in ("measured", "allowed", "advice")}
            earlier.append(Finding(record["name"], severity, f"the log, {record['where']}", **texts))
    return worst_first(findings + earlier)


def _print(records: list[dict[str, Any]], found: dict[str, list[Any]]) -> None:
    from rich.table import Table
    from rich.text import Text

    out = console()
    for record in records:
        findings, length = found[record["path"]], f"{record['rows']} rows, {record['duration']:.1f} s"
        out.print(Text(printable(f"{record['path']}: {length}")), soft_wrap=True)
        if findings:
            table = Table(show_edge=False, pad_edge=False, box=None, header_style="bold")
            for title in ("", "fault", "where", "measured", "allowed"):
                table.add_column(title, overflow="fold")
            for one in findings:
                measured = one.measured + (f" - {one.advice}" if one.advice else "")
                cells = (one.severity, one.name, one.where, measured, one.allowed)
                table.add_row(*(Text(printable(cell)) for cell in cells), style=COLOURS[one.severity])
            out.print(table)
        else:
            out.print("  nothing found")
        if record["figure"]:
            out.print(Text(printable(f"  {record['figure']}")), soft_wrap=True)
        out.print()
    severities = [{one.severity for one in findings} for findings in found.values()]
    warned, blocked = (sum(severity in own for own in severities) for severity in ("warning", "blocking"))
    clean = sum(own <= {"info"} for own in severities)
    flights = "1 flight" if len(found) == 1 else f"{len(found)} flights"
    out.print(f"{flights}: {clean} clean, {warned} with warnings, {blocked} blocked")


def _draw(folder: Path, loaded: dict[str, Any], found: dict[str, list[Any]]) -> dict[str, Path]:
    from quadexp.report.flight_figures import consistency_figure
    from quadexp.report.style import save

    drawn: dict[str, Path] = {}
    for name, flight in loaded.items():
        path = Path(name)
        names = (path.stem, f"{path.parent.name}_{path.stem}", *(f"{path.stem}_{k}" for k in range(2, len(loaded) + 2)))
        file = next(folder / f"{stem}.png" for stem in names if folder / f"{stem}.svg" not in drawn.values())
        drawn[name] = save(consistency_figure(path.stem, flight, found[name]), file)
    return drawn
