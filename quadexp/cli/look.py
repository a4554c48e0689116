"""Commands that look at what was written: `quadexp show`, `results`. Only light modules are imported at the top."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from quadexp.cli.command import Answer, Ask, Conf, command
from quadexp.cli.terminal import say
from quadexp.errors import UsageError
from quadexp.names import named, without

if TYPE_CHECKING:
    from quadexp.report.frame import SweepFrame

HEADING = "Look"

COLUMNS = ("trajectory", "speed", "plant", "controller", "model", "variant", "seed", "outcome", "mean_error", "rmse")
FAILED_COLUMNS = (*COLUMNS[:-2], "cause")
Folder = Annotated[Path, Ask("A folder of `quadexp evaluate`.", "DIR")]
Filters = Annotated[
    tuple[str, ...], Ask("Only these rows, such as controller='*_mpc' or seed=0,1", "KEY=VALUE", word=True)
]
Where = Annotated[str | None, Ask("Only these rows: 'speed > 6'; see above.", "CONDITION")]
Sort = Annotated[str | None, Ask("Sort by these columns; -KEY for descending order.", "KEYS")]
Columns = Annotated[str | None, Ask("Show these columns or keys, commas between.", "KEYS")]
Limit = Annotated[int | None, Ask("Show at most this many rows.", flag="--limit -n", least=1)]
Failures = Annotated[bool, Ask("Show only flights that were not completed, with the cause.")]


class Selected(NamedTuple):
    """Rows of a sweep. frame: those that are shown. total: those before the limit. named: the columns that were asked
    for, usual: those that are shown otherwise. several: whether flights of several programs are among them."""

    frame: SweepFrame
    total: Sequence[Any]
    named: list[str]
    usual: list[str]
    several: bool


def selected(
    folder: Path, filters: Sequence[str], where: str | None, sort: str | None, columns: str | None, limit: int | None,
    failures: bool,
) -> Selected:  # fmt: skip
    """The rows and columns that the options of `quadexp results` choose."""
    from quadexp.report.checked import flown_by
    from quadexp.sweeps.results import select

    frame = select(folder, filters, where=where, sort=sort, failures=failures)
    total = frame.rows
    several = len(flown_by(total)) > 1
    asked = [name.strip() for name in columns.split(",") if name.strip()] if columns else []
    usual = [*(FAILED_COLUMNS if failures else COLUMNS), *(["sources"] if several else [])]
    return Selected(frame.taken(range(min(len(total), limit or len(total)))), total, asked, usual, several)


@command
def results(
    folder: Folder,
    filters: Filters = (),
    where: Where = None,
    sort: Sort = None,
    columns: Columns = None,
    limit: Limit = None,
    failures: Failures = False,
    prune: Annotated[bool, Ask("Remove cells (see above).")] = False,
    yes: Annotated[bool, Ask("Really remove them.", flag="--yes -y")] = False,
) -> Answer:
    """List, filter, sort and prune the flights of a sweep.

    A column is one of the table or any key of the configuration (controller.nodes). KEY=VALUE takes patterns (*_mpc)
    and null. --where knows == != < <= > >=, and, or, not, in [A, B], and brackets; a number has the unit of the table's
    column, or its own: mean_error < 5mm.

    --prune removes the cells that are not part of the last sweep, nor of one that has not ended, or, with KEY=VALUE,
    those that match; without --yes it only lists them.

    \b
    quadexp results results/table1 --where "controller == linear_drag_mpc and speed > 6" --sort mean_error --limit 10
    quadexp results results/table1 --columns controller,controller.nodes,seed,mean_error --format csv
    quadexp results results/table1 controller=linear_drag_mpc trajectory.speed=8 --json
    quadexp results results/table1 --failures
    quadexp results results/table1 sources=78f30eeaa2be
    quadexp results results/table1 --prune --yes
    """
    from quadexp.log.outcome import RULE
    from quadexp.report.checked import check_flights, flown_by_lines
    from quadexp.report.tables import csv_of, flights_table

    if prune:
        if where:
            raise UsageError("--prune: name the cells by KEY=VALUE, not by --where")
        return _prune(folder, filters, yes)
    frame, total, names, usual, several = selected(folder, filters, where, sort, columns, limit, failures)
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


@command
def show(path: Annotated[Path, Ask("A flight, data set, checkpoint folder, or results.")], conf: Conf = ()) -> Answer:
    """Show what a file holds: its kind, configuration, units, seed, versions, commit, size.

    \b
    quadexp show runs/a.parquet
    quadexp show models/gp
    """
    from quadexp.report.summary import summarise

    summary = summarise(path)
    record = without(summary, ("lines", "tables"))
    return Answer(record, summary.get("tables", []), summary["lines"])
