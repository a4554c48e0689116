"""`quadexp plot`: a figure of one's own from results. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from quadexp.cli.options import Force, Format, Json, Out
from quadexp.cli.terminal import answered, format_of, guarded, print_lines, say

Keys = list[str] | None
WIDTHS = {"column": 3.5, "page": 7.16}  # inches, of the IEEE


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
        str | None, typer.Option("--kind", metavar="KIND", help="lines, or heat (a map of --x and --by).")
    ] = None,
    width: Annotated[
        str | None, typer.Option("--width", metavar="column|page", help="For a paper: 3.5 or 7.16 inches wide.")
    ] = None,
    label: Annotated[
        list[str] | None,
        typer.Option("--label", metavar="KEY=TEXT", help="A text of your own for a key, a value or --y; repeatable."),
    ] = None,
    title: Annotated[str, typer.Option("--title", metavar="TEXT", help="The title of the figure.")] = "",
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
    quadexp plot results/x --width column --label gp_mpc="GP (ours)" --title "Circle" --out figure.pdf
    quadexp plot results/x --x vehicle.mass --facet trajectory --where "controller like '*_mpc'" --out b.html
    """
    from dataclasses import replace

    from quadexp.errors import UsageError
    from quadexp.report.checked import check_flights
    from quadexp.report.draw import FIGURES, check_path, records, save_view
    from quadexp.report.frame import SweepFrame, chosen
    from quadexp.report.view import view

    form = format_of(format, json)
    if kind is not None and kind not in FIGURES:
        raise UsageError(f"--kind {kind}: must be one of {', '.join(FIGURES)}")
    if width is not None and width not in WIDTHS:
        raise UsageError(f"--width {width}: must be one of {', '.join(WIDTHS)}")
    names = dict(text.partition("=")[::2] for text in label or ())
    if not all(names.values()):
        raise UsageError(f"--label {next(name for name in names if not names[name])}: give KEY=TEXT")
    path = check_path(out, force)
    frame = SweepFrame.read(results)
    if where:
        frame = frame.where(chosen(frame, where))
        if not frame.rows:
            raise UsageError(f"--where {where!r}: no flight fulfils it")
    options: Any = {"kind": kind, "confidence": float(frame.record.get("confidence", 0.95))}
    figure = view(frame, y=y, x=x, by=_keys(by), facet=_keys(facet), **options).named(names)
    figure = replace(figure, heading=title, width=WIDTHS[width] if width else None)
    save_view(figure, path, title=f"{results.name}: {figure.y_label}", force=force)
    numbers = records(figure)
    about = {"kind": figure.kind, "x": figure.x.key, "by": figure.by, "facet": figure.facet, "y": figure.y}
    checked = check_flights(frame.root, frame.rows)
    notes = [figure.caption, *figure.notes, f"{checked.text()}.", *checked.lines()]
    record = {"path": path, **about, "notes": notes, "points": numbers}
    if answered(form, record, lambda: numbers, "plot"):
        return
    for note in ((figure.caption,) if width else ()) + figure.notes:
        say(f"note: {note}")
    for line in checked.lines():
        say(f"warning: {line}")
    print_lines([path])


def _keys(given: Keys) -> list[str] | None:
    """Keys of an option that is repeatable; also with commas between."""
    return None if given is None else [key.strip() for text in given for key in text.split(",") if key.strip()]
