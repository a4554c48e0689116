"""`quadexp results`: list and check a folder of results. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadexp.cli.command import Answer, Ask, command
from quadexp.cli.options import Force
from quadexp.cli.terminal import say

COLUMNS = ("trajectory", "speed", "plant", "controller", "model", "variant", "seed", "outcome", "mean_error", "rmse")
FAILED_COLUMNS = (*COLUMNS[:-2], "cause")
Folder = Annotated[Path, Ask("A folder of `quadexp evaluate`.", "DIR")]


@command
def results(
    folder: Folder,
    filters: Annotated[
        list[str] | None,
        typer.Argument(metavar="KEY=VALUE", help="Only these rows, such as controller='gp_*' or seed=0,1"),
    ] = None,
    where: Annotated[str | None, Ask("Only these rows: 'speed > 6'; see above.", "CONDITION")] = None,
    sort: Annotated[str | None, Ask("Sort by these columns; -KEY for descending order.", "KEYS")] = None,
    columns: Annotated[str | None, Ask("Show these columns or keys, commas between.", "KEYS")] = None,
    limit: Annotated[int | None, Ask("Show at most this many rows.", flag="--limit -n", least=1)] = None,
    failures: Annotated[bool, Ask("Show only flights that were not completed, with the cause.")] = False,
    html: Annotated[Path | None, Ask("Write a sortable table as a page that opens offline.", "FILE")] = None,
    opened: Annotated[bool, Ask("Open that page in the browser.", flag="--open")] = False,
    prune: Annotated[bool, Ask("Remove cells (see above).")] = False,
    yes: Annotated[bool, Ask("Really remove them.", flag="--yes -y")] = False,
    verify: Annotated[bool, Ask("Read every file and list those that were changed since they were written.")] = False,
    force: Force = False,
) -> Answer:
    """List, filter, sort and prune the flights of a sweep.

    A column is one of the table or any key of the configuration (controller.nodes). --where knows == != < <= > >=, and,
    or, not, in [A, B], like 'gp_*', is null, and brackets; numbers are in SI units, or with a unit: mean_error < 5mm.

    --verify compares every flight and table with its hashes, rows with their flights, and texts with their rows; exit
    code 1 if something is wrong. The next run of the sweep flies such cells again and writes such tables again.

    --prune removes the cells that are not part of the last sweep or, with KEY=VALUE, those that match; without --yes it
    only lists them.

    \b
    quadexp results results/table1 --where "controller == gp_mpc and speed > 6" --sort mean_error --limit 10
    quadexp results results/table1 --columns controller,controller.nodes,seed,mean_error --format csv
    quadexp results results/table1 --html table.html --open
    quadexp results results/table1 controller=gp_mpc trajectory.speed=8 --json
    quadexp results results/table1 --failures
    quadexp results results/table1 sources=78f30eeaa2be
    quadexp results results/table1 --prune --yes
    quadexp results results/table1 --verify
    """
    from quadexp.errors import UsageError
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
        return _prune(folder, filters or [], yes)
    frame = select(folder, filters or [], where=where, sort=sort, failures=failures)
    total = frame.rows
    frame = frame.taken(range(min(len(total), limit or len(total))))
    several = len(flown_by(total)) > 1
    names = [name.strip() for name in columns.split(",") if name.strip()] if columns else []
    usual = (*(FAILED_COLUMNS if failures else COLUMNS), *(("sources",) if several else ()))
    if html or opened:
        page = page_of(frame, names or [*usual, "key"], folder.name)
        return _page(page, html or Path(f"{folder.name}.html"), force, opened)
    checked = check_flights(frame.root, [row for row in total if row["wanted"]])
    for line in checked.lines(beside=False):
        say(f"warning: {line}")
    shown = names or [name for name in usual if any(value is not None for value in frame.column(name))]
    table = flights_table(frame, shown)
    outcomes = [row["outcome"] for row in total]
    counts = {outcome: outcomes.count(outcome) for outcome in sorted(set(outcomes))}
    unwanted = sum(not row["wanted"] for row in total)
    said = ", ".join([f"{len(total)} cells", *(f"{count} {outcome}" for outcome, count in counts.items())])
    said += f"; {unwanted} not of the last sweep (--prune)" if unwanted else ""
    remarks = [f"{said}; {checked.text()}"]
    remarks += [RULE] if counts.keys() - {"ok"} else []
    remarks += flown_by_lines(total) if several else []
    chosen = [dict(zip(names, values, strict=True)) for values in zip(*map(frame.column, names), strict=True)]
    record = {"count": len(total), "checked": checked.text(), "rows": chosen if names else frame.rows}
    return Answer(record, [table], [table], remarks=remarks, texts={"csv": lambda: csv_of(frame, shown)})


def _prune(folder: Path, filters: list[str], remove: bool) -> Answer:
    from quadexp.sweeps.results import prune

    done = prune(folder, filters, remove=remove)
    record = {"keys": done.keys, "bytes": done.size, "removed": done.removed}
    state = "removed" if done.removed else "would be removed (--yes removes them)"
    rows = [{"key": key, "removed": done.removed} for key in done.keys]
    return Answer(record, rows, [f"{len(done.keys)} cells, {done.size / 1e6:.1f} MB, {state}"])


def _page(page: str, path: Path, force: bool, opened: bool) -> Answer:
    from quadexp.files.writer import check_output, write_text

    write_text(check_output(path, force=force), page, force=force)
    if opened:
        import webbrowser

        if not webbrowser.open(path.resolve().as_uri()):
            say("note: no browser was found; open the file by hand")
    return Answer({"path": path}, [{"path": path}], [path])


def _verify(folder: Path) -> Answer:
    from quadexp.progress import Progress
    from quadexp.sweeps.verify import verify_results

    with Progress("files") as progress:
        checked = verify_results(folder, progress)
    count = len(checked.wrong)
    rows = [{"file": path, "what": what} for path, what in checked.wrong.items()]
    lines = [f"{path}: {what}" for path, what in checked.wrong.items()]
    if checked.unhashed:
        earlier = f"{len(checked.unhashed)} files are of an earlier version, without a hash"
        lines.append(f"{earlier}: an edit would not be noticed there; the first: {checked.unhashed[0]}")
    return Answer(
        {"files": checked.files, "wrong": checked.wrong, "unhashed": checked.unhashed},
        rows or [{"files": checked.files, "wrong": 0}],
        [*lines, f"{checked.files} files, {count} wrong"],
        failed=[f"{folder}: {count} files do not hold what was written there"] if count else [],
    )
