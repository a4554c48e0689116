"""Commands that look at what was written: `quadexp show`, `compare`, `results`, `export`. Only light modules are
imported at the top."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from quadexp.cli.command import Answer, Ask, Conf, Force, Overrides, command
from quadexp.cli.terminal import say
from quadexp.errors import UsageError
from quadexp.names import named, without
from quadexp.plugin import service
from quadexp.progress import Progress
from quadexp.writer import check_output, write_text

HEADING = "Look"

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
    from quadexp.report.tables import csv_of, flights_table
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
        page_of = service("sortable_page", "--html")
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
    verify_results = service("verify_results", "--verify")

    with Progress("files") as progress:
        checked = verify_results(folder, progress)
    count = len(checked.wrong)
    rows = [{"file": path, "what": what} for path, what in checked.wrong.items()]
    lines = [f"{path}: {what}" for path, what in checked.wrong.items()]
    return Answer(
        {"files": checked.files, "wrong": checked.wrong},
        rows or [{"files": checked.files, "wrong": 0}],
        [*lines, f"{checked.files} files, {count} wrong"],
        failed=[f"{folder}: {count} files have changed since they were written"] if count else [],
    )


@command
def show(
    path: Annotated[Path, Ask("A flight, data set, checkpoint folder, or results.")],
    overrides: Overrides = (),
    margins: Annotated[bool, Ask("What delay and motor lag the loop tolerates along the path, from settings.")] = False,
    beliefs: Annotated[bool, Ask("Of a flight with remedies=auto: what it assumed, and what was true.")] = False,
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
        text = service("bibtex", "--cite")(path, conf)
        return Answer({"bibtex": text}, [{"bibtex": text}], text.splitlines())
    if out is not None and not beliefs:
        raise UsageError(f"--out {out}: only beliefs are drawn: give --beliefs")
    if margins and beliefs:
        raise UsageError("show: --margins and --beliefs: one at a time")
    from quadexp.parts.options import given_folders

    if margins:
        return _margins([str(path), *overrides], conf)
    if overrides:
        raise UsageError("show: settings are for --margins")
    given_folders(conf)
    if beliefs:
        return _beliefs(path, out, force)
    from quadexp.report.summary import summarise

    summary = summarise(path)
    record = without(summary, ("lines", "tables"))
    return Answer(record, summary.get("tables", []), summary["lines"])


def _beliefs(path: Path, out: Path | None, force: bool) -> Answer:
    from quadexp.report.style import check_path, save_figure

    beliefs = service("beliefs", "--beliefs")
    figure = None if out is None else check_path(out, force)
    flight = beliefs.read_beliefs(path)
    table = beliefs.beliefs_table(flight)
    if figure is not None:
        save_figure(beliefs.beliefs_figure(flight), figure, force=force)
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
