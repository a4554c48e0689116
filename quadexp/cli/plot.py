"""`quadexp plot`: a figure of one's own from results. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from quadexp.cli.options import Force, Format, Json, Out
from quadexp.cli.terminal import answered, format_of, guarded, print_lines, say

Keys = list[str] | None


@guarded
def plot(
    results: Annotated[Path, typer.Argument(metavar="DIR", help="A folder of `quadexp evaluate`.")],
    x: Annotated[str | None, typer.Option("--x", metavar="KEY", help="The key along x.")] = None,
    y: Annotated[
        str, typer.Option("--y", metavar="COLUMN", help="A number of the flights, such as rmse; or success.")
    ] = "mean_error",
    by: Annotated[Keys, typer.Option("--by", metavar="KEY", help="A line for each value; repeatable.")] = None,
    facet: Annotated[Keys, typer.Option("--facet", metavar="KEY", help="A panel for each value; repeatable.")] = None,
    where: Annotated[
        str | None, typer.Option("--where", metavar="CONDITION", help="Only these flights, such as 'speed > 6'.")
    ] = None,
    kind: Annotated[
        str | None, typer.Option("--kind", metavar="KIND", help="lines, heat (a map of --x and --by) or parallel.")
    ] = None,
    out: Out = Path("plot.png"),
    force: Force = False,
    format: Format = None,
    json: Json = False,
) -> None:
    """Draw results with any keys of the configuration as axes; without keys, what was swept chooses them.

    The value of a key is that of the configuration stored with each flight, also of one that was not swept. Means are
    over the common flights, and bars their intervals, as in tables; k/n: only k of n flights were completed.
    The suffix of --out chooses the format: png, pdf, svg, or html, a page that opens offline with the numbers.

    \b
    quadexp plot results/x --x controller.horizon --y mean_error --by controller.nodes --out a.png
    quadexp plot results/x --x controller.horizon --by controller.nodes --kind heat --out map.pdf
    quadexp plot results/x --x vehicle.mass --facet trajectory --where "controller like '*_mpc'" --out b.html
    """
    from quadexp.errors import UsageError
    from quadexp.report.checked import check_flights
    from quadexp.report.draw import FIGURES, check_path, records, save_view
    from quadexp.report.frame import SweepFrame
    from quadexp.report.query import chosen
    from quadexp.report.view import view

    form = format_of(format, json)
    if kind is not None and kind not in FIGURES:
        raise UsageError(f"--kind {kind}: must be one of {', '.join(FIGURES)}")
    path = check_path(out, force)
    frame = SweepFrame.read(results)
    if where:
        frame = frame.where(chosen(frame, where))
        if not frame.rows:
            raise UsageError(f"--where {where!r}: no flight fulfils it")
    options: Any = {"kind": kind, "confidence": float(frame.record.get("confidence", 0.95))}
    made = view(frame, y=y, x=x, by=_keys(by), facet=_keys(facet), **options)
    save_view(made, path, title=f"{results.name}: {made.y_label}", force=force)
    numbers = records(made)
    about = {"kind": made.kind, "x": made.x.key, "by": made.by, "facet": made.facet, "y": made.y}
    checked = check_flights(frame.root, frame.rows)
    notes = [made.caption, *made.notes, f"{checked.text()}.", *checked.lines()]
    record = {"path": path, **about, "notes": notes, "points": numbers}
    if answered(form, record, lambda: numbers, "plot"):
        return
    for note in made.notes:
        say(f"note: {note}")
    for line in checked.lines():
        say(f"warning: {line}")
    print_lines([path])


def _keys(given: Keys) -> list[str] | None:
    """Keys of an option that is repeatable; also with commas between."""
    return None if given is None else [key.strip() for text in given for key in text.split(",") if key.strip()]
