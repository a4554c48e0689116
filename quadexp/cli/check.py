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
    from quadexp.log.check import check_flights

    form = format_of(format, json)
    loaded = _load(flights)
    known = {str(path): _vehicle(flight, vehicle, conf) for path, flight in loaded.items()}
    found = check_flights({str(path): flight for path, flight in loaded.items()}, known)
    found = {path: _with_import(findings, loaded[Path(path)]) for path, findings in found.items()}
    stops = ("blocking", "warning") if strict else ("blocking",)
    blocked = [path for path, findings in found.items() if any(one.severity in stops for one in findings)]
    drawn = _draw(figures, loaded, found) if figures is not None else {}
    if form != "text":
        from quadexp.report.table import Table

        records = [
            {
                "path": path,
                "rows": len(flight),
                "duration": float(flight.t[-1] - flight.t[0]) if len(flight) else 0.0,
                "vehicle": getattr(known[str(path)], "name", None),
                "blocked": str(path) in blocked,
                "findings": [one.record() for one in found[str(path)]],
                "figure": drawn.get(str(path)),
            }
            for path, flight in loaded.items()
        ]
        names = ("severity", "name", "where", "measured", "allowed", "advice")
        pairs = [(path, one) for path, own in found.items() for one in own]
        rows = [[path, *(str(getattr(one, name) or "") for name in names)] for path, one in pairs]
        record = {"flights": records, "blocked": len(blocked), "strict": strict}
        answered(form, record, lambda: [Table(("flight", *names), rows, left=frozenset(range(7)))], "check")
    else:
        _print(loaded, found, drawn)
    if blocked:
        raise QuadexpError(
            f"{len(blocked)} of {len(found)} flights have findings that block{' (--strict)' if strict else ''}"
        )


def _load(paths: list[Path]) -> dict[Path, Any]:
    from quadexp.log.schema import Flight
    from quadexp.log.store import check_whole, read_table

    loaded: dict[Path, Any] = {}
    for path in paths:
        if path in loaded:
            raise UsageError(f"{path}: given twice")
        loaded[path] = Flight(*read_table(path, "flight", required=("t",)))
        check_whole(loaded[path].metadata, str(path))
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
    from quadexp.log.finding import Finding, worst_first

    names = {one.name for one in findings}
    known = Finding.__dataclass_fields__
    added = []
    for record in flight.metadata.get("findings") or []:
        if record.get("name") in names or not set(known) - {"advice", "span", "correction"} <= set(record):
            continue
        values = {key: record[key] for key in known if key in record and key != "span"}
        # what blocked in the log was mended or accepted when the flight was made
        values["severity"] = "warning" if values["severity"] == "blocking" else values["severity"]
        added.append(Finding(**{**values, "where": f"the log, {values['where']}"}))
    return worst_first(findings + added)


def _print(loaded: dict[Path, Any], found: dict[str, list[Any]], drawn: dict[str, Path]) -> None:
    from rich.table import Table
    from rich.text import Text

    out = console()
    for path, flight in loaded.items():
        findings = found[str(path)]
        length = float(flight.t[-1] - flight.t[0]) if len(flight) else 0.0
        out.print(Text(printable(f"{path}: {len(flight)} rows, {length:.1f} s")), soft_wrap=True)
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
        if str(path) in drawn:
            out.print(Text(printable(f"  {drawn[str(path)]}")), soft_wrap=True)
        out.print()
    counts = dict.fromkeys(COLOURS, 0)
    for findings in found.values():
        for severity in {one.severity for one in findings}:
            counts[severity] += 1
    clean = sum(1 for findings in found.values() if all(one.severity == "info" for one in findings))
    flights = "1 flight" if len(found) == 1 else f"{len(found)} flights"
    out.print(f"{flights}: {clean} clean, {counts['warning']} with warnings, {counts['blocking']} blocked")


def _draw(folder: Path, loaded: dict[Path, Any], found: dict[str, list[Any]]) -> dict[str, Path]:
    from quadexp.report.figures import save
    from quadexp.report.log_figures import consistency_figure

    drawn: dict[str, Path] = {}
    for path, flight in loaded.items():
        names = (path.stem, f"{path.parent.name}_{path.stem}", *(f"{path.stem}_{k}" for k in range(2, len(loaded) + 2)))
        name = next(name for name in names if (folder / f"{name}.svg") not in drawn.values())
        drawn[str(path)] = save(consistency_figure(path.stem, flight, found[str(path)]), folder / f"{name}.png")
    return drawn
