"""`quadexp results`: list and check a folder of results. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from quadexp.cli.options import Force, Format, Json
from quadexp.cli.terminal import answered, console, emit, format_of, guarded, print_lines, say

COLUMNS = ("trajectory", "speed", "plant", "controller", "model", "variant", "seed", "outcome", "mean_error", "rmse")
FAILED_COLUMNS = ("trajectory", "speed", "plant", "controller", "model", "variant", "seed", "outcome", "cause")


@guarded
def results(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder of `quadexp evaluate`.")],
    filters: Annotated[
        list[str] | None,
        typer.Argument(metavar="KEY=VALUE", help="Only these rows, such as controller='gp_*' or seed=0,1"),
    ] = None,
    where: Annotated[
        str | None,
        typer.Option("--where", metavar="CONDITION", help="Only these rows: 'speed > 6'; see above."),
    ] = None,
    sort: Annotated[
        str | None, typer.Option("--sort", metavar="KEYS", help="Sort by these columns; -KEY for descending order.")
    ] = None,
    columns: Annotated[
        str | None, typer.Option("--columns", metavar="KEYS", help="Show these columns or keys, commas between.")
    ] = None,
    limit: Annotated[int | None, typer.Option("--limit", "-n", min=1, help="Show at most this many rows.")] = None,
    failures: Annotated[
        bool, typer.Option("--failures", help="Show only flights that were not completed, with the cause.")
    ] = False,
    html: Annotated[
        Path | None, typer.Option("--html", metavar="FILE", help="Write a sortable table as a page that opens offline.")
    ] = None,
    opened: Annotated[bool, typer.Option("--open", help="Open that page in the browser.")] = False,
    prune: Annotated[bool, typer.Option("--prune", help="Remove cells (see above).")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Really remove them.")] = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="Read every file and list those that were changed since they were written.")
    ] = False,
    force: Force = False,
    format: Format = None,
    json: Json = False,
) -> None:
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
    from quadexp.report.checked import check_flights
    from quadexp.report.flights_table import csv_of, flights_table
    from quadexp.report.flown_by import flown_by, flown_by_lines
    from quadexp.sweeps.results import prune as prune_results
    from quadexp.sweeps.results import select

    form = format_of(format, json)
    if verify:
        if filters or prune or where:
            raise UsageError("--verify looks at the whole folder: give it alone")
        return _verify(folder, form)
    if prune:
        if where:
            raise UsageError("--prune: name the cells by KEY=VALUE, not by --where")
        return _prune(prune_results(folder, filters or [], remove=yes), form)
    frame = select(folder, filters or [], where=where, sort=sort, failures=failures)
    total = frame.rows
    frame = frame.taken(range(min(len(total), limit or len(total))))
    several = len(flown_by(total)) > 1
    names = [name.strip() for name in columns.split(",") if name.strip()] if columns else []
    usual = (*(FAILED_COLUMNS if failures else COLUMNS), *(("sources",) if several else ()))
    table = flights_table(frame, names or usual, all_of_them=bool(names))
    if html or opened:
        path = html or Path(f"{folder.name}.html")
        _page(frame, names or [*usual, "key"], path, folder.name, force, opened, form)
        return
    checked = check_flights(frame.root, [row for row in total if row["wanted"]])
    for line in checked.lines(beside=False):
        say(f"warning: {line}")
    if form == "json":
        chosen = [dict(zip(names, values, strict=True)) for values in zip(*map(frame.column, names), strict=True)]
        emit({"count": len(total), "checked": checked.text(), "rows": chosen if names else frame.rows})
        return
    if form == "csv":
        shown = names or [name for name in usual if name in table.names]
        sys.stdout.write(csv_of(frame, shown))
        return
    if form != "text":
        sys.stdout.write(table.table.rendered(form))
        return
    console().print(table.table.rich())
    counts: dict[str, int] = {}
    for row in total:
        counts[row["outcome"]] = counts.get(row["outcome"], 0) + 1
    unwanted = sum(not row["wanted"] for row in total)
    say(
        f"{len(total)} cells"
        + "".join(f", {count} {outcome}" for outcome, count in sorted(counts.items()))
        + (f"; {unwanted} not of the last sweep (--prune)" if unwanted else "")
        + f"; {checked.text()}"
    )
    if counts.keys() - {"ok"}:
        say(RULE)
    if several:
        for line in flown_by_lines(total):
            say(line)


def _prune(done: Any, form: str) -> None:
    record = {"keys": done.keys, "bytes": done.size, "removed": done.removed}
    if not answered(form, record, lambda: [{"key": key, "removed": done.removed} for key in done.keys], "--prune"):
        state = "removed" if done.removed else "would be removed (--yes removes them)"
        print_lines([f"{len(done.keys)} cells, {done.size / 1e6:.1f} MB, {state}"])


def _page(frame: Any, names: list[str], path: Path, title: str, force: bool, opened: bool, form: str) -> None:
    from quadexp.files.writer import check_output, write_text
    from quadexp.report.flights_table import page_of

    write_text(check_output(path, force=force), page_of(frame, names, title), force=force)
    if not answered(form, {"path": path}, lambda: [{"path": path}], "--html"):
        print_lines([path])
    if opened:
        import webbrowser

        if not webbrowser.open(path.resolve().as_uri()):
            say("note: no browser was found; open the file by hand")


def _verify(folder: Path, form: str) -> None:
    from quadexp.errors import QuadexpError
    from quadexp.progress import Progress
    from quadexp.sweeps.verify import verify_results

    with Progress("files") as progress:
        found = verify_results(folder, progress)
    record = {"files": found.files, "wrong": found.wrong, "unhashed": found.unhashed}
    rows = [{"file": path, "what": what} for path, what in found.wrong.items()]
    if not answered(form, record, lambda: rows or [{"files": found.files, "wrong": 0}], "--verify"):
        print_lines(f"{path}: {what}" for path, what in found.wrong.items())
        if found.unhashed:
            earlier = f"{len(found.unhashed)} files are of an earlier version, without a hash"
            print_lines([f"{earlier}: an edit would not be noticed there; the first: {found.unhashed[0]}"])
        print_lines([f"{found.files} files, {len(found.wrong)} wrong"])
    if found.wrong:
        raise QuadexpError(f"{folder}: {len(found.wrong)} files do not hold what was written there")
