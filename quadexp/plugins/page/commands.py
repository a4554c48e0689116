"""Commands that draw, and that write tables and pages. Only light modules are imported at the top."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from quadexp.cli.command import Answer, Ask, Conf, Force, OptionalOut, Out, Overrides, command, file_rows, single_values
from quadexp.cli.fly import Figures, KeepOld, Refly, Sweep, evaluated
from quadexp.cli.look import Columns, Failures, Filters, Limit, Sort, Where, selected
from quadexp.cli.terminal import say
from quadexp.errors import UsageError
from quadexp.names import without
from quadexp.writer import check_output, write_text

if TYPE_CHECKING:
    from quadexp.report.frame import SweepFrame

HEADING = "Look"
WIDTHS = {"column": 3.5, "page": 7.16}  # inches, of the IEEE
TABLES = {".tex": "latex", ".md": "markdown", ".csv": "csv"}  # of a table

Keys = tuple[str, ...]


@command
def plot(
    results: Annotated[Path, Ask("A folder of `quadexp evaluate`.", "DIR")],
    x: Annotated[str | None, Ask("The key along x.", "KEY")] = None,
    y: Annotated[str, Ask("A number of the flights, such as rmse; or success.", "COLUMN")] = "mean_error",
    by: Annotated[Keys, Ask("A line for each value; repeatable.", "KEY")] = (),
    facet: Annotated[Keys, Ask("A panel for each value; repeatable.", "KEY")] = (),
    where: Annotated[str | None, Ask("Only these flights, such as 'speed > 6'.", "CONDITION")] = None,
    kind: Annotated[Literal["lines", "heat"] | None, Ask("lines, or heat (a map of --x and --by).", "KIND")] = None,
    width: Annotated[Literal["column", "page"] | None, Ask("For a paper: 3.5 or 7.16 inches wide.")] = None,
    label: Annotated[Keys, Ask("A text of your own for a key, a value or --y; repeatable.", "KEY=TEXT")] = (),
    color: Annotated[Keys, Ask("A colour of your own for a value; repeatable.", "NAME=COLOR")] = (),
    height: Annotated[float | None, Ask("Height of the figure (inches).", "IN")] = None,
    title: Annotated[str, Ask("The title of the figure.", "TEXT")] = "",
    out: Out = Path("plot.png"),
    force: Force = False,
) -> Answer:
    """Draw results with any keys of the configuration as axes; without keys, what was swept chooses them.

    The value of a key is that of the configuration stored with each flight, also of one that was not swept. Means are
    over the common flights, and bars their intervals, as in tables; k/n: only k of n flights were completed.
    The suffix of --out chooses the format: png, pdf, svg, or html, a page that opens offline with the numbers.

    \b
    quadexp plot results/x --x controller.horizon --y mean_error --by controller.nodes --out a.png
    quadexp plot results/x --x controller.horizon --by controller.nodes --kind heat --out map.pdf
    quadexp plot results/x --width column --height 2.2 --label gp_mpc="GP (ours)" --color gp_mpc=navy --out figure.pdf
    quadexp plot results/x --x vehicle.mass --facet trajectory --where "seed in [0, 1]" --out b.html
    """
    from dataclasses import replace

    from quadexp.plugins.drawing.style import check_path
    from quadexp.plugins.page.draw import SUFFIXES, records, save_view
    from quadexp.plugins.page.view import view
    from quadexp.report.checked import check_flights

    names = _labels(label)
    path = check_path(out, force, SUFFIXES)
    frame, whole = _flights(results, where)
    figure = view(frame, y=y, x=x, by=_keys(by), facet=_keys(facet), kind=kind).named(names)
    if height is not None and not 1 <= height <= 20:
        raise UsageError(f"--height {height:g}: must be in [1, 20] inches")
    wide = WIDTHS[width] if width else None
    figure = figure.coloured(_colours(color))
    figure = replace(figure, heading=title, width=wide, height=height)
    save_view(figure, path, title=f"{results.name}: {figure.y_label}", force=force)
    numbers = records(figure)
    about = {"kind": figure.kind, "x": figure.x.key, "by": figure.by, "facet": figure.facet, "y": figure.y}
    checked = check_flights(frame.root, frame.rows, whole.rows)
    notes = [figure.caption, *figure.notes, f"{checked.text()}.", *checked.lines()]
    record = {"path": path, **about, "notes": notes, "points": numbers}
    said = list(figure.notes)
    if width:
        said.insert(0, figure.caption)
    return Answer(record, numbers, [path], said, remarks=[f"warning: {line}" for line in checked.lines()])


def _labels(words: Sequence[str]) -> dict[str, str]:
    """KEY=TEXT texts as key -> text."""
    names = dict(word.partition("=")[::2] for word in words)
    for name, text in names.items():
        if not text:
            raise UsageError(f"--label {name}: give KEY=TEXT")
    return names


def _flights(results: Path, where: str | None) -> tuple[SweepFrame, SweepFrame]:
    """The flights of a folder that fulfil a condition, and all of them."""
    from quadexp.report.condition import chosen
    from quadexp.report.frame import SweepFrame

    whole = SweepFrame.read(results)
    if not where:
        return whole, whole
    frame = whole.where(chosen(whole, where))
    if not frame.rows:
        raise UsageError(f"--where {where!r}: no flight fulfils it")
    return frame, whole


def _colours(words: Sequence[str]) -> dict[str, str]:
    """NAME=COLOR texts as name -> "#rrggbb"."""
    from matplotlib.colors import is_color_like, to_hex

    colours = {}
    for text in words:
        name, _, colour = text.rpartition("=")
        if not name or not is_color_like(colour):
            raise UsageError(f"--color {text}: give NAME=COLOR, a colour by name or as #rrggbb")
        colours[name] = to_hex(colour)
    return colours


def _keys(words: Sequence[str]) -> list[str] | None:
    """Keys of an option that is repeatable, also with commas between; None where there are none."""
    return list(filter(None, map(str.strip, ",".join(words).split(",")))) or None


@command
def table(
    results: Annotated[Path, Ask("A folder of `quadexp evaluate`.", "DIR")],
    rows: Annotated[Keys, Ask("Keys of the rows, with commas between; repeatable.", "KEYS")] = (),
    columns: Annotated[Keys, Ask("Keys of the columns, with commas between; repeatable.", "KEYS")] = (),
    metric: Annotated[str | None, Ask("A number of the flights, such as rmse; or success.", "NAME")] = None,
    label: Annotated[Keys, Ask("A text of your own for a key, a value or the metric; repeatable.", "KEY=TEXT")] = (),
    where: Annotated[str | None, Ask("Only these flights, such as 'speed > 6'.", "CONDITION")] = None,
    intervals: Annotated[Literal["none", "pm", "brackets"], Ask("How an interval is written.")] = "none",
    digits: Annotated[int | None, Ask("Significant digits of a mean.", "N", least=1)] = None,
    width: Annotated[Literal["column", "page"], Ask("What LaTeX fits: 252 or 516 pt of the IEEE.")] = "column",
    out: OptionalOut = None,
    force: Force = False,
    form: str = "text",
) -> Answer:
    """Print or write a table for a paper: any keys as rows and columns, one metric.

    Without keys, rows are conditions and columns controllers. A cell is the mean over the common flights, as in every
    table and figure; k/n: only k of n flights were completed. LaTeX of a table that is too wide or too long is several
    tabulars below each other. The suffix of --out (tex, md, csv) chooses the format where --format does not.

    \b
    quadexp table results/x --format latex
    quadexp table results/x --rows trajectory,speed --columns controller --intervals pm --digits 3 --out table.tex
    quadexp table results/x --metric rmse --label gp_mpc="GP (ours)" --width page --out table.md
    """
    from quadexp.plugins.page.fitted import WIDTHS as POINTS
    from quadexp.plugins.page.fitted import fitted_latex
    from quadexp.plugins.page.paper_table import paper_table
    from quadexp.plugins.page.view import check_metric

    names = _labels(label)
    if out is not None:
        out = check_output(out, force=force)
        form = TABLES.get(out.suffix, "") if form == "text" else form
        if form not in TABLES.values():
            raise UsageError(f"--out {out}: end it in .tex, .md or .csv, or give --format latex, markdown or csv")
    frame, _ = _flights(results, where)
    metric = metric or str(frame.record.get("metric", "mean_error"))
    check_metric(frame, metric, "--metric")
    rendered = paper_table(
        frame, metric, rows=_keys(rows), columns=_keys(columns), names=names, intervals=intervals, digits=digits
    )
    latex = fitted_latex(rendered, POINTS[width])
    record = {"columns": rendered.columns, "rows": rendered.rows, "title": rendered.title, "notes": rendered.notes}
    if out is None:
        return Answer(record, [rendered], [rendered], texts={"latex": lambda: latex})
    write_text(out, latex if form == "latex" else rendered.rendered(form), force=force)
    return Answer(record | {"path": out}, [rendered], [out], notes=rendered.notes)


@command
def report(
    results: Annotated[Path, Ask("Results folder of `quadexp evaluate --sweep`.")],
    out: Out = Path("report.html"),
    figures: Annotated[Path | None, Ask("Write each panel as a PDF too, for a paper's column.", "DIR")] = None,
    baseline: Annotated[str | None, Ask("Controller to compare the others with.", "CONTROLLER")] = None,
    force: Force = False,
) -> Answer:
    """Write a comparison as one page that opens without a network: answer, tables, figures, provenance.

    \b
    quadexp report results/table1 --out report.html
    quadexp report results/table1 --out report.html --figures paper/figures
    """
    from quadexp.plugins.page.report import make_report

    page = make_report(results, out, figures=figures, baseline=baseline, force=force)
    checked = page["checked"]
    said = [*page["answer"], page["note"], f"{checked['text']}.", *checked["lines"]]
    files = file_rows({"page": page["path"], **page["figures"]})
    return Answer(page, files, [*said, *page["figures"].values(), page["path"]])


@command
def animate(
    flights: Annotated[tuple[Path, ...], Ask("Flights over one reference, such as those of one sweep.", "FILE")],
    out: Out = Path("replay.gif"),
    rate: Annotated[float, Ask("Frames a second, 1 to 50.", "HZ")] = 20.0,
    begin: Annotated[float, Ask("Time of the first frame.", "S", "--from")] = 0.0,
    end: Annotated[float | None, Ask("Time of the last frame.", "S", "--to")] = None,
    force: Force = False,
) -> Answer:
    """Draw flights over one reference as a moving picture in real time, a GIF.

    \b
    quadexp animate runs/nominal.parquet runs/gp.parquet --out replay.gif
    """
    from quadexp.plugins.page.animation import animate as draw

    movie = draw(flights, out, rate=rate, begin=begin, end=end, force=force)
    text = f"{movie['frames']} frames, {movie['duration']:.1f} s"
    return Answer(movie, [single_values(movie)], [text, movie["path"]])


@command
def compare(
    first: Annotated[Path, Ask("A flight, results folder, or checkpoint folder.")],
    others: Annotated[tuple[Path, ...], Ask("Others of the same kind, each compared with the first.", "FILE")],
    out: Annotated[Path | None, Ask("Draw them too: a png, pdf or svg.", "PATH", "--out -o")] = None,
    force: Force = False,
    conf: Conf = (),
) -> Answer:
    """Show how flights, results or checkpoints differ: configuration, outcome, figures.

    \b
    quadexp compare runs/a.parquet runs/b.parquet runs/c.parquet --out compare.png
    quadexp compare results/table1 results/table1_again
    """
    from quadexp.parts.options import given_folders
    from quadexp.plugins.page.compare import compare as compared
    from quadexp.report.checked import check_flights
    from quadexp.report.frame import read_results

    if out is not None:
        from quadexp.plugins.drawing.style import check_path

        out = check_path(out, force)
    given_folders(conf)
    report = compared(first, *others)
    if out is not None:
        from quadexp.plugins.drawing.style import save_figure
        from quadexp.plugins.page.draw import comparison_figure

        save_figure(comparison_figure(report["kind"], [first, *others]), out, force=force)
    checked = []
    wrong = []
    for folder in (first, *others) if report["kind"] == "results" else ():
        files = check_flights(*read_results(folder)[:2])
        checked.append(f"{folder}: {files.text()}")
        wrong += [f"{folder}: {line}" for line in files.lines(beside=False)]
    for line in wrong:
        say(f"warning: {line}")
    record = without(report, ("lines", "tables"))
    said = [*report["lines"]]
    if out:
        record["picture"] = out
        said.append(out)
    record["checked"] = checked + wrong
    return Answer(record, report["tables"], said)


def results_html(
    folder: Annotated[Path, Ask("A folder of `quadexp evaluate`.", "DIR")],
    filters: Filters = (),
    where: Where = None,
    sort: Sort = None,
    columns: Columns = None,
    limit: Limit = None,
    failures: Failures = False,
    html: Annotated[Path | None, Ask("Write a sortable table as a page that opens offline.", "FILE")] = None,
    force: Force = False,
) -> Answer:
    """\b
    quadexp results results/table1 --html table.html
    """
    from quadexp.plugins.page.document import page_of

    assert html is not None
    rows = selected(folder, filters, where, sort, columns, limit, failures)
    page = page_of(rows.frame, rows.named or [*rows.usual, "key"], folder.name)
    write_text(check_output(html, force=force), page, force=force)
    return Answer({"path": html}, [{"path": html}], [html])


def evaluate_watched(
    overrides: Overrides = (),
    sweep: Sweep = False,
    out: OptionalOut = None,
    figures: Figures = None,
    conf: Conf = (),
    refly: Refly = False,
    keep_old: KeepOld = False,
    force: Force = False,
    watch: Annotated[bool, Ask("Show the sweep while it runs: a table here, and a page in a file.")] = False,
) -> Answer:
    """With --watch it is shown while it runs.

    \b
    quadexp evaluate --sweep experiment=torrente_table1 --watch
    """
    from quadexp.plugins.page.watch import Watch

    if not sweep:
        raise UsageError("--watch is for a sweep: add --sweep")
    return evaluated(overrides, sweep, out, figures, conf, refly, keep_old, force, Watch)
