"""Arguments and options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadexp.parts.completion import complete

Overrides = Annotated[
    list[str] | None,
    typer.Argument(metavar="KEY=VALUE", help="Settings, such as trajectory.speed=8", autocompletion=complete),
]
_OUT = typer.Option("--out", "-o", metavar="PATH", help="Where to write.")
Out = Annotated[Path, _OUT]
OptionalOut = Annotated[Path | None, _OUT]
Conf = Annotated[Path | None, typer.Option("--conf", metavar="DIR", help="A configuration folder of your own.")]
Force = Annotated[bool, typer.Option("--force", "-f", help="Replace existing output.")]
Format = Annotated[
    str | None, typer.Option("--format", metavar="FORMAT", help="Print json, csv, markdown or latex instead of text.")
]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]
