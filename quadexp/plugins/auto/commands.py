"""`quadexp show --beliefs`. Only light modules are imported at the top."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from quadexp.cli.command import Answer, Ask, Force
from quadexp.names import named


def show_beliefs(
    path: Annotated[Path, Ask("A flight.")],
    beliefs: Annotated[bool, Ask("Of a flight with remedies=auto: what it assumed, and what was true.")] = False,
    out: Annotated[Path | None, Ask("Draw the beliefs too: a png, pdf or svg.", "PATH", "--out -o")] = None,
    force: Force = False,
) -> Answer:
    """\b
    quadexp show runs/a.parquet --beliefs --out beliefs.png
    """
    from quadexp.log.store import read_flight
    from quadexp.plugins.auto.beliefs import beliefs_figure, beliefs_table
    from quadexp.plugins.drawing.style import check_path, save_figure

    figure = None if out is None else check_path(out, force)
    flight = read_flight(path)
    table = beliefs_table(flight)
    if figure is not None:
        save_figure(beliefs_figure(flight), figure, force=force)
    records = [named(table.columns, row) for row in table.rows]
    drawn = [] if figure is None else [str(figure)]
    return Answer({"beliefs": records}, [table], [table, *drawn])
