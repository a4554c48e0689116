"""Commands that look at what was written: `quadexp show`, `compare`, `results`, `plot`, `report`, `animate`, `export`.

Only light modules are imported at the top.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from quadexp.cli.command import Answer, Ask, Conf, Force, OptionalOut, Out, Overrides, command, single_values
from quadexp.cli.terminal import say
from quadexp.errors import UsageError
from quadexp.names import named, without
from quadexp.progress import Progress
from quadexp.writer import check_output, write_text

COLUMNS = ("trajectory", "speed", "plant", "controller", "model", "variant", "seed", "outcome", "mean_error", "rmse")
FAILED_COLUMNS = (*COLUMNS[:-2], "cause")
Folder = Annotated[Path, Ask("A folder of `quadexp evaluate`.", "DIR")]


@command
def results(
    folder: Folder,
    filters: Annotated[
        tuple[str, ...], Ask("Only these rows, such as controller='gp_*' or seed=0,1", "KEY=VALUE", word=True)
    ] = (),
    where: Annotated[str | None, Ask("Only these rows: 'speed > 6'; see above.", "CONDITION")] = None,
    sort: Annotated[str | None, Ask("Sort by these columns; -KEY for descending order.", "KEYS")] = None,
    columns: Annotated[str | None, Ask("Show these columns or keys, commas between.", "KEYS")] = None,
    limit: Annotated[int | None, Ask("Show at most this many rows.", flag="--limit -n", least=1)] = None,
    failures: Annotated[bool, Ask("Show only flights that were not completed, with the cause.")] = False,
    html: Annotated[Path | None, Ask("Write a sortable table as a page that opens offline.", "FILE")] = None,
    prune: Annotated[bool, Ask("Remove cells (see above).")] = False,
    yes: Annotated[bool, Ask("Really remove them.", flag="--yes -y")] = False,
    verify: Annotated[bool, Ask("Read every file and list those that were changed since they were written.")] = False,
    force: Force = False,
) -> Answer:
    """List, filter, sort and prune the flights of a sweep.

    A column is one of the table or any key of the configuration (controller.nodes). KEY=VALUE takes patterns (gp_*)
    and null. --where knows == != < <= > >=, and, or, not, in [A, B], and brackets; a number has the unit of the table's
    column, or its own: mean_error < 5mm.

    --verify compares every flight and table with its hashes, rows with their flights, and texts with their rows; exit
    code 1 if something is wrong. The next run of the sweep flies such cells again and writes such tables again.

    --prune removes the cells that are not part of the last sweep, nor of one that has not ended, or, with KEY=VALUE,
    those that match; without --yes it only lists them.

    \b
    quadexp results results/table1 --where "controller == gp_mpc and speed > 6" --sort mean_error --limit 10
    quadexp results results/table1 --columns controller,controller.nodes,seed,mean_error --format csv
    quadexp results results/table1 --html table.html
    quadexp results results/table1 controller=gp_mpc trajectory.speed=8 --json
    quadexp results results/table1 --failures
    quadexp results results/table1 sources=78f30eeaa2be
    quadexp results results/table1 --prune --yes
    quadexp results results/table1 --verify
    """
    from quadexp.log.outcome import RULE
    from quadexp.report.checked import check_flights, flown_by, flown_by_lines
    from quadexp.report.tables import csv_of, flights_table, page_of
    from quadexp.sweeps.results import select

    if verify:
        if filters or prune or where:
            raise UsageError("--verify looks at the whole folder: give it alone")
        return _verify(folder)
    if prune:
        if where:
            raise UsageError("--prune: name the cells by KEY=VALUE, not by --where")
        return _prune(folder, filters, yes)
    frame = select(folder, filters, where=where, sort=sort, failures=failures)
    total = frame.rows
    frame = frame.taken(range(min(len(total), limit or len(total))))
    several = len(flown_by(total)) > 1
    names = [name.strip() for name in columns.split(",") if name.strip()] if columns else []
    usual = (*(FAILED_COLUMNS if failures else COLUMNS), *(("sources",) if several else ()))
    if html is not None:
        page = page_of(frame, names or [*usual, "key"], folder.name)
        write_text(check_output(html, force=force), page, force=force)
        return Answer({"path": html}, [{"path": html}], [html])
    checked = check_flights(frame.root, [row for row in total if row["wanted"]])
    for line in checked.lines(beside=False):
        say(f"warning: {line}")
    shown = names or [name for name in usual if any(value is not None for value in frame.column(name))]
    table = flights_table(frame, shown)
    outcomes = [row["outcome"] for row in total]
    counts = {outcome: outcomes.count(outcome) for outcome in sorted(set(outcomes))}
    unwanted = sum(not row["wanted"] for row in total)
    said = ", ".join([f"{len(total)} cells", *(f"{count} {outcome}" for outcome, count in counts.items())])
    said += f"; {unwanted} of earlier sweeps (--prune)" if unwanted else ""
    remarks = [f"{said}; {checked.text()}"]
    remarks += [RULE] if counts.keys() - {"ok"} else []
    remarks += flown_by_lines(total) if several else []
    chosen = [named(names, values) for values in zip(*map(frame.column, names), strict=True)]
    record = {"count": len(total), "checked": checked.text(), "rows": chosen if names else frame.rows}
    return Answer(record, [table], [table], remarks=remarks, texts={"csv": lambda: csv_of(frame, shown)})


def _prune(folder: Path, filters: Sequence[str], remove: bool) -> Answer:
    from quadexp.report.tables import flights_table
    from quadexp.sweeps.results import prune

    done = prune(folder, filters, remove=remove)
    record = {"keys": done.keys, "bytes": done.size, "removed": done.removed}
    state = "removed" if done.removed else "would be removed (--yes removes them)"
    rows = [{"key": key, "removed": done.removed} for key in done.keys]
    lines: list[Any] = [f"{len(done.keys)} cells, {done.size / 1e6:.1f} MB, {state}"]
    if done.keys:
        names = ("key", *(name for name in COLUMNS if any(value is not None for value in done.frame.column(name))))
        lines.append(flights_table(done.frame, names))
    return Answer(record, rows, lines)


def _verify(folder: Path) -> Answer:
    from quadexp.sweeps.verify import verify_results

    with Progress("files") as progress:
        checked = verify_results(folder, progress)
    count = len(checked.wrong)
    rows = [{"file": path, "what": what} for path, what in checked.wrong.items()]
    lines = [f"{path}: {what}" for path, what in checked.wrong.items()]
    return Answer(
        {"files": checked.files, "wrong": checked.wrong},
        rows or [{"files": checked.files, "wrong": 0}],
        [*lines, f"{checked.files} files, {count} wrong"],
        failed=[f"{folder}: {count} files do not hold what was written there"] if count else [],
    )


WIDTHS = {"column": 3.5, "page": 7.16}  # inches, of the IEEE


@command
def plot(
    results: Annotated[Path, Ask("A folder of `quadexp evaluate`.", "DIR")],
    x: Annotated[str | None, Ask("The key along x.", "KEY")] = None,
    y: Annotated[str, Ask("A number of the flights, such as rmse; or success.", "COLUMN")] = "mean_error",
    by: Annotated[tuple[str, ...], Ask("A line for each value; repeatable.", "KEY")] = (),
    facet: Annotated[tuple[str, ...], Ask("A panel for each value; repeatable.", "KEY")] = (),
    where: Annotated[str | None, Ask("Only these flights, such as 'speed > 6'.", "CONDITION")] = None,
    kind: Annotated[Literal["lines", "heat"] | None, Ask("lines, or heat (a map of --x and --by).", "KIND")] = None,
    width: Annotated[Literal["column", "page"] | None, Ask("For a paper: 3.5 or 7.16 inches wide.")] = None,
    label: Annotated[
        tuple[str, ...], Ask("A text of your own for a key, a value or --y; repeatable.", "KEY=TEXT")
    ] = (),
    color: Annotated[tuple[str, ...], Ask("A colour of your own for a value; repeatable.", "NAME=COLOR")] = (),
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

    from quadexp.report.checked import check_flights
    from quadexp.report.draw import check_path, records, save_view
    from quadexp.report.frame import SweepFrame, chosen
    from quadexp.report.view import view

    names = dict(text.partition("=")[::2] for text in label)
    if not all(names.values()):
        raise UsageError(f"--label {next(name for name in names if not names[name])}: give KEY=TEXT")
    path = check_path(out, force)
    frame = whole = SweepFrame.read(results)
    if where:
        frame = whole.where(chosen(whole, where))
        if not frame.rows:
            raise UsageError(f"--where {where!r}: no flight fulfils it")
    figure = view(frame, y=y, x=x, by=_keys(by), facet=_keys(facet), kind=kind).named(names)
    if height is not None and not 1 <= height <= 20:
        raise UsageError(f"--height {height:g}: must be in [1, 20] inches")
    figure = replace(
        figure.coloured(_colours(color)), heading=title, width=WIDTHS[width] if width else None, height=height
    )
    save_view(figure, path, title=f"{results.name}: {figure.y_label}", force=force)
    numbers = records(figure)
    about = {"kind": figure.kind, "x": figure.x.key, "by": figure.by, "facet": figure.facet, "y": figure.y}
    checked = check_flights(frame.root, frame.rows, whole.rows)
    notes = [figure.caption, *figure.notes, f"{checked.text()}.", *checked.lines()]
    record = {"path": path, **about, "notes": notes, "points": numbers}
    said = [*((figure.caption,) if width else ()), *figure.notes]
    return Answer(record, numbers, [path], said, remarks=[f"warning: {line}" for line in checked.lines()])


def _colours(given: Sequence[str]) -> dict[str, str]:
    """NAME=COLOR texts as name -> "#rrggbb"."""
    from matplotlib.colors import is_color_like, to_hex

    colours = {}
    for text in given:
        name, _, colour = text.rpartition("=")
        if not name or not is_color_like(colour):
            raise UsageError(f"--color {text}: give NAME=COLOR, a colour by name or as #rrggbb")
        colours[name] = to_hex(colour)
    return colours


def _keys(given: Sequence[str]) -> list[str] | None:
    """Keys of an option that is repeatable, also with commas between; None where there are none."""
    return [key.strip() for text in given for key in text.split(",") if key.strip()] or None


@command
def show(
    path: Annotated[Path, Ask("A flight, data set, checkpoint folder, or results.")],
    overrides: Overrides = (),
    margins: Annotated[bool, Ask("What delay and motor lag the loop tolerates along the path, from settings.")] = False,
    beliefs: Annotated[bool, Ask("Of a flight with remedies=auto: what it believed, and what was true.")] = False,
    cite: Annotated[bool, Ask("BibTeX of the methods that flew, and of this program.")] = False,
    out: Annotated[Path | None, Ask("Draw the beliefs too: a png, pdf or svg.", "PATH", "--out -o")] = None,
    force: Force = False,
    conf: Conf = (),
) -> Answer:
    """Show what a file holds: its kind, configuration, units, seed, versions, commit, size.

    \b
    quadexp show runs/a.parquet
    quadexp show models/gp
    quadexp show --margins runs/a.parquet
    quadexp show --margins controller=nominal_mpc trajectory=circle trajectory.speed=8
    quadexp show runs/a.parquet --beliefs --out beliefs.png
    quadexp show --cite results/table1
    """
    if cite:
        from quadexp.report.cite import bibtex

        text = bibtex(path, conf)
        return Answer({"bibtex": text}, [{"bibtex": text}], text.splitlines())
    if out is not None and not beliefs:
        raise UsageError(f"--out {out}: only beliefs are drawn: give --beliefs")
    if margins and beliefs:
        raise UsageError("show: --margins and --beliefs: one at a time")
    if margins:
        return _margins([str(path), *overrides], conf)
    if overrides or conf:
        raise UsageError("show: settings are for --margins")
    if beliefs:
        return _beliefs(path, out, force)
    from quadexp.report.summary import summarise

    summary = summarise(path)
    record = without(summary, ("lines", "tables"))
    return Answer(record, summary.get("tables", []), summary["lines"])


def _beliefs(path: Path, out: Path | None, force: bool) -> Answer:
    from quadexp.report.beliefs import beliefs_figure, beliefs_table, read_beliefs
    from quadexp.report.draw import check_path
    from quadexp.report.style import save_figure

    figure = None if out is None else check_path(out, force, ("png", "pdf", "svg"))
    flight = read_beliefs(path)
    table = beliefs_table(flight)
    if figure is not None:
        save_figure(beliefs_figure(flight), figure, force=force)
    drawn = [] if figure is None else [str(figure)]
    record = {"beliefs": [named(table.columns, row) for row in table.rows]}
    return Answer(record, [table], [table, *drawn])


def _margins(words: Sequence[str], conf: Sequence[Path]) -> Answer:
    from quadexp import requests
    from quadexp.report.table import Table

    rows = requests.margins(words, conf)
    units = {"t": (1.0, 2), "speed": (1.0, 2), "delay": (1e3, 0), "lag": (1e3, 0), "growth": (1.0, 2)}
    texts = [[f"{factor * row[name]:.{digits}f}" for name, (factor, digits) in units.items()] for row in rows]
    heading = ["t (s)", "speed (m/s)", "more delay (ms)", "more motor lag (ms)", "growth (1/s)"]
    return Answer({"margins": rows}, rows, [Table(heading, texts, left=frozenset())])


@command
def compare(
    first: Annotated[Path, Ask("A flight, results folder, or checkpoint folder.")],
    others: Annotated[tuple[Path, ...], Ask("Others of the same kind, each compared with the first.", "FILE")],
    out: Annotated[Path | None, Ask("Draw them too: a png, pdf or svg.", "PATH", "--out -o")] = None,
    force: Force = False,
) -> Answer:
    """Show how flights, results or checkpoints differ: configuration, outcome, figures.

    \b
    quadexp compare runs/a.parquet runs/b.parquet runs/c.parquet --out compare.png
    quadexp compare results/table1 results/table1_again
    """
    from quadexp.report.checked import check_flights
    from quadexp.report.compare import compare as compared
    from quadexp.report.frame import read_results

    if out is not None:
        from quadexp.report.draw import check_path

        out = check_path(out, force, ("png", "pdf", "svg"))
    report = compared(first, *others)
    if out is not None:
        from quadexp.report.draw import comparison_figure
        from quadexp.report.style import save_figure

        save_figure(comparison_figure(report["kind"], [first, *others]), out, force=force)
    checked = {str(p): check_flights(*read_results(p)[:2]) for p in (first, *others) if report["kind"] == "results"}
    wrong = [f"{folder}: {line}" for folder, files in checked.items() for line in files.lines(beside=False)]
    for line in wrong:
        say(f"warning: {line}")
    record = without(report, ("lines", "tables"))
    record |= {"picture": out} if out else {}
    record |= {"checked": [f"{folder}: {files.text()}" for folder, files in checked.items()] + wrong}
    return Answer(record, report["tables"], [*report["lines"], *([out] if out else [])])


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
    from quadexp.report.page import make_report

    page = make_report(results, out, figures=figures, baseline=baseline, force=force)
    checked = page["checked"]
    said = [*page["answer"], page["note"], f"{checked['text']}.", *checked["lines"]]
    files = _files({"page": page["path"], **page["figures"]})
    return Answer(page, files, [*said, *page["figures"].values(), page["path"]])


@command
def export(
    flight: Annotated[Path, Ask("A flight of `quadexp simulate` or of a sweep.")],
    to: Annotated[str, Ask("csv, tum, rerun.", "FORMAT", "--to")],
    out: OptionalOut = None,
    force: Force = False,
) -> Answer:
    """Write a flight for other programs; rerun needs the extra [viz].

    \b
    quadexp export runs/a.parquet --to rerun --out a.rrd
    quadexp export runs/a.parquet --to csv --out a.csv
    """
    from quadexp.log.exporters import export_flight

    files = export_flight(flight, to, out, force=force)
    return Answer({"format": to, "files": files}, _files(files), list(files.values()))


def _files(files: Mapping[str, Path]) -> list[dict[str, Any]]:
    """A row a file that was written."""
    return [{"file": name, "path": path} for name, path in files.items()]


@command
def animate(
    flights: Annotated[tuple[Path, ...], Ask("Flights over one reference, such as those of one sweep.", "FILE")],
    out: Out = Path("replay.gif"),
    rate: Annotated[float, Ask("Frames a second, 1 to 50.", "HZ")] = 20.0,
    begin: Annotated[float, Ask("Time of the first frame.", "S", "--from")] = 0.0,
    end: Annotated[float | None, Ask("Time of the last frame.", "S", "--to")] = None,
    force: Force = False,
) -> Answer:
    """Draw flights over one reference as a moving picture in real time: GIF, or MP4 by ffmpeg.

    \b
    quadexp animate runs/nominal.parquet runs/gp.parquet --out replay.gif
    """
    from quadexp.report.animation import animate as draw

    movie = draw(flights, out, rate=rate, begin=begin, end=end, force=force)
    return Answer(
        movie, [single_values(movie)], [f"{movie['frames']} frames, {movie['duration']:.1f} s", movie["path"]]
    )
