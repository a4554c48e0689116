"""`quadexp identify`: blade-element coefficients from recorded flights. Only light modules are imported here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadexp.terminal import emit, guarded


@guarded
def identify(
    flights: Annotated[list[Path], typer.Argument(metavar="FLIGHT...", help="Flights of `quadexp simulate`.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Where to write.")] = Path("data/estimates"),
    vehicle: Annotated[
        str | None, typer.Option("--vehicle", metavar="NAME", help="Of the configuration, not the flight's own.")
    ] = None,
    paper: Annotated[bool, typer.Option("--paper", help="P_0 = 50 and unit noise, as Lei & Li, not scaled.")] = False,
    conf: Annotated[
        Path | None, typer.Option("--conf", metavar="DIR", help="A configuration folder of your own.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Replace what is there.")] = False,
    json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Identify C_d0, C_la and C_D by recursive least squares from flights with rotor speeds and specific force.

    Prints the last estimates with 95 % confidence and writes their time series, one file a flight.

    \b
    quadexp simulate vehicle=lei_li plant=blade_element sensor=lei_li trajectory=rectangle controller=rls_feedback \\
        --out runs/a.parquet
    quadexp identify runs/a.parquet --out data/estimates
    """
    from quadexp.experiment.identify import identify_files

    found = identify_files(flights, out, vehicle=vehicle, conf=conf, force=force, paper=paper)
    if json:
        emit({"out": out, "flights": [{"path": path, **one.metadata()} for path, one in found]})
        return
    for path, one in found:
        print("\n".join([*one.lines(), str(path)]))
