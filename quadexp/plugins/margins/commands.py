"""`quadexp show --margins`. Only light modules are imported at the top."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from quadexp.cli.command import Answer, Ask, Conf, Overrides

# Of a row: factor and digits of each column that is shown, delay and lag in milliseconds.
SHOWN = {"t": (1.0, 2), "speed": (1.0, 2), "delay": (1e3, 0), "lag": (1e3, 0), "growth": (1.0, 2)}
HEADING = ["t (s)", "speed (m/s)", "more delay (ms)", "more motor lag (ms)", "growth (1/s)"]


def show_margins(
    path: Annotated[Path, Ask("A flight.")],
    overrides: Overrides = (),
    margins: Annotated[bool, Ask("What delay and motor lag the loop tolerates along the path, from settings.")] = False,
    conf: Conf = (),
) -> Answer:
    """\b
    quadexp show --margins runs/a.parquet
    quadexp show --margins controller=nominal_mpc trajectory=circle trajectory.speed=8
    """
    from quadexp.plugins.margins import requests
    from quadexp.report.table import Table

    rows = requests.margins([str(path), *overrides], conf)
    texts = [[f"{factor * row[name]:.{digits}f}" for name, (factor, digits) in SHOWN.items()] for row in rows]
    return Answer({"margins": rows}, rows, [Table(HEADING, texts, left=frozenset())])
