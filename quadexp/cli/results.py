"""`quadexp results`: list and check a folder of results. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from quadexp.cli.options import Json
from quadexp.cli.terminal import console, emit, guarded, say

COLUMNS = ("trajectory", "speed", "plant", "controller", "model", "variant", "seed", "outcome", "mean_error", "rmse")
FAILED_COLUMNS = ("trajectory", "speed", "plant", "controller", "model", "variant", "seed", "outcome", "cause")


@guarded
def results(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder of `quadexp evaluate`.")],
    filters: Annotated[
        list[str] | None,
        typer.Argument(metavar="KEY=VALUE", help="Only these rows, such as controller='gp_*' or seed=0,1"),
    ] = None,
    sort: Annotated[
        str | None, typer.Option("--sort", metavar="KEY", help="Sort by this column; -KEY for descending order.")
    ] = None,
    limit: Annotated[int | None, typer.Option("--limit", "-n", min=1, help="Show at most this many rows.")] = None,
    failures: Annotated[
        bool, typer.Option("--failures", help="Show only flights that did not end well, with the cause.")
    ] = False,
    prune: Annotated[bool, typer.Option("--prune", help="Remove cells (see above).")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Really remove them.")] = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="Read every file and list those that were changed since they were written.")
    ] = False,
    json: Json = False,
) -> None:
    """List, filter, sort and prune the flights of a sweep.

    --verify compares every flight and table with its hashes, rows with their flights, and texts with their rows; exit
    code 1 if something is wrong. The next run of the sweep flies such cells again and writes such tables again.

    --prune removes the cells that are not part of the last sweep or, with KEY=VALUE, those that match; without --yes it
    only lists them.

    \b
    quadexp results results/table1 --sort -mean_error --limit 10
    quadexp results results/table1 controller=gp_mpc trajectory.speed=8 --json
    quadexp results results/table1 --failures
    quadexp results results/table1 sources=78f30eeaa2be
    quadexp results results/table1 --prune --yes
    quadexp results results/table1 --verify
    """
    from quadexp.errors import UsageError
    from quadexp.report.flown_by import flown_by, flown_by_lines
    from quadexp.sweeps.results import list_results
    from quadexp.sweeps.results import prune as prune_results

    if verify:
        if filters or prune:
            raise UsageError("--verify looks at the whole folder: give it alone")
        return _verify(folder, json)
    chosen = [text.replace("trajectory.speed=", "speed=", 1) for text in filters or []]
    if prune:
        done = prune_results(folder, chosen, remove=yes)
        if json:
            emit({"keys": done.keys, "bytes": done.size, "removed": done.removed})
        else:
            state = "removed" if done.removed else "would be removed (--yes removes them)"
            print(f"{len(done.keys)} cells, {done.size / 1e6:.1f} MB, {state}")
        return
    rows = list_results(folder, chosen, sort=sort, failures=failures)
    shown = rows[:limit]
    if json:
        emit({"count": len(rows), "rows": shown})
        return
    found = flown_by(rows)
    _print(shown, (*(FAILED_COLUMNS if failures else COLUMNS), *(("sources",) if len(found) > 1 else ())))
    counts: dict[str, int] = {}
    for row in rows:
        counts[row["outcome"]] = counts.get(row["outcome"], 0) + 1
    unwanted = sum(not row["wanted"] for row in rows)
    say(
        f"{len(rows)} cells"
        + "".join(f", {count} {outcome}" for outcome, count in sorted(counts.items()))
        + (f"; {unwanted} not of the last sweep (--prune)" if unwanted else "")
    )
    if len(found) > 1:
        for line in flown_by_lines(rows):
            say(line)


def _verify(folder: Path, json: bool) -> None:
    from quadexp.errors import QuadexpError
    from quadexp.progress import Progress
    from quadexp.sweeps.verify import verify_results

    with Progress("files") as progress:
        found = verify_results(folder, progress)
    if json:
        emit({"files": found.files, "wrong": found.wrong, "unhashed": found.unhashed})
    else:
        for path, what in found.wrong.items():
            print(f"{path}: {what}")
        if found.unhashed:
            print(
                f"{len(found.unhashed)} files are of an earlier version, without a hash: an edit would not be"
                f" noticed there; the first: {found.unhashed[0]}"
            )
        print(f"{found.files} files, {len(found.wrong)} wrong")
    if found.wrong:
        raise QuadexpError(f"{folder}: {len(found.wrong)} files do not hold what was written there")


def _print(rows: list[dict[str, Any]], columns: tuple[str, ...]) -> None:
    from rich.markup import escape
    from rich.table import Table

    from quadexp.report.metrics import SHOWN

    used = [name for name in columns if any(row[name] not in ("", None) for row in rows)]
    table = Table()
    for name in used:
        unit = f" ({SHOWN[name][1]})" if name in SHOWN else " (m/s)" if name == "speed" else ""
        table.add_column(name + unit, overflow="fold", justify="right" if name in (*SHOWN, "speed", "seed") else "left")
    for row in rows:
        cells = []
        for name in used:
            value = row[name]
            if name in SHOWN:
                value = "" if value is None or value != value else f"{SHOWN[name][0] * value:.4g}"
            elif isinstance(value, float):
                value = f"{value:g}"
            cells.append("" if value is None else escape(str(value)))
        table.add_row(*cells)
    console().print(table)
