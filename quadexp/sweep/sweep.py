"""A sweep: every cell flown once, however often it is started, and one table of results at the end.

<out>/cells/...          one flight a cell, named by the hash of all that decides it (store.py)
<out>/results.parquet    the rows of this sweep, also as results.csv
<out>/statistics.parquet means, intervals and comparisons with the baseline, also as statistics.csv
<out>/table.md, .tex     the error table; comparison.tex the comparisons
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import quadexp
from quadexp.config.cells import Cell, Cells
from quadexp.errors import DataError, QuadexpError, UsageError, WriteError, write_error
from quadexp.experiment.build import build_trajectory, build_vehicle
from quadexp.experiment.evaluate import check_feasible, evaluate_cell, failed_row
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_metadata
from quadexp.provenance import libraries, provenance, sources
from quadexp.report.flown_by import counted, differing_libraries, flown_by, program_name, programs_of
from quadexp.report.statistics import BASELINE, CONFIDENCE
from quadexp.report.statistics_file import Statistics
from quadexp.report.tables import ErrorTable
from quadexp.sweep.engine import CellFailed, CellFunction, Engine, LocalEngine, Task
from quadexp.sweep.plan import Plan
from quadexp.sweep.sweep_table import RESULTS, SweepTable, write_results

Old = Literal["ask", "refly", "keep"]  # what to do with cells that other sources have flown
COUNTED = ("failed", "infeasible")  # outcomes that make a sweep end with exit code 1


@dataclass(frozen=True)
class SweepResult:
    """rows: one a cell, in the order asked for. flown: how many were not there before. table: of the chosen metric.
    notes: what a reader of the table should know, a line each."""

    out: Path
    rows: Sequence[dict[str, Any]]
    flown: int
    table: ErrorTable
    statistics: Statistics
    files: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def not_flown(self) -> list[dict[str, Any]]:
        return [row for row in self.rows if row["outcome"] in COUNTED]


class SweepInterrupted(QuadexpError):
    """Ctrl-C: what is done is kept."""


def run_sweep(
    cells: Sequence[Cell],
    out: str | Path,
    *,
    metric: str = "mean_error",
    baseline: str = BASELINE,
    confidence: float = CONFIDENCE,
    engine: Engine | None = None,
    workers: int = 0,
    timeout: float | None = None,
    force: bool = False,
    old: Old = "ask",
    isolate: bool = True,
    progress: Callable[[int, int], None] = lambda done, total: None,
    function: CellFunction = evaluate_cell,
) -> SweepResult:
    """Fly the cells that are not done, and write the table of all.

    metric: of the table. baseline: controller that the others are compared with. confidence: of the intervals.
    engine: where to fly; None for `workers` processes of this machine (0: one a core), each cell for at most `timeout`
    seconds. force: fly everything again, and replace another sweep's table. old: of cells that are there and were flown
    by other sources than those that run: "refly", "keep", or refuse to go on. isolate: False flies in this process.
    progress: called with the numbers of cells done and of all.

    Raises UsageError before anything is flown, SweepInterrupted on Ctrl-C, QuadexpError at the first file that cannot
    be written; what is done is kept.
    """
    store, plan = CellStore(out), Plan(cells)
    done = set() if force else store.done()
    plan.check(key for key in plan.places if key not in done)
    if not isolate:
        for job in plan:
            config = job.cell.config
            vehicle = build_vehicle(config.vehicle)
            check_feasible(config, build_trajectory(config.trajectory, vehicle), vehicle)
    store.open()
    with store.emptied(), store.lock():
        if not force:
            _refuse_another_sweep(store, plan)
        store.clean()
        if force:
            store.remove(plan.places)
        table = SweepTable(store, plan)
        table.recall()
        notes = _settle_old(store, table, old)
        todo = table.lacking()
        before = len(plan) - len(todo)
        progress(before, len(plan))
        engine = engine or LocalEngine(workers, timeout)
        try:
            for count, (key, row) in enumerate(_fly(todo, store, plan, engine, function, isolate), before + 1):
                table.add(key, row)
                progress(count, len(plan))
        except KeyboardInterrupt:
            raise SweepInterrupted(f"{_done(store, plan)}; run the same command to continue") from None
        except WriteError as error:
            raise QuadexpError(
                f"{error}: {_done(store, plan)}; run the same command to continue once it can be written"
            ) from None
        finally:
            store.clean()
        record = {
            "metric": metric,
            "baseline": baseline,
            "confidence": confidence,
            "grids": list(cells.grids) if isinstance(cells, Cells) else [[[o] for o in c.overrides] for c in cells],
            "conditions": sorted(plan.conditions()),
            "flown_by": flown_by(table.rows),
            "provenance": provenance(),
        }
        statistics, shown, files, altered = write_results(store.root, table.rows, record)
        table.settled()
    return SweepResult(store.root, table.rows, len(todo), shown, statistics, files, [*notes, *altered])


def _settle_old(store: CellStore, table: SweepTable, old: Old) -> list[str]:
    """Decide on recalled cells that are not of this program; returns what is to be said of the recalled ones.

    Raises UsageError where there are some and `old` does not say what to do with them.
    """
    notes = []
    if table.changed:
        first = next(iter(table.changed.values()))
        notes.append(f"{len(table.changed)} cells have changed since they were flown and are flown again: {first}")
    others = table.flown_elsewhere()
    found = counted(programs_of(others.values()))
    if others and old == "ask":
        raise UsageError(
            f"{store.root}: {len(others)} of its cells were flown by other sources than these (quadexp"
            f" {quadexp.__version__}, sources {sources()}): {found}; pass --refly to fly them again or --keep-old to"
            f" keep them beside new ones (`quadexp results {store.root} sources=HASH` lists them)"
        )
    if others and old == "refly":
        table.forget(others)
        notes.append(f"{len(others)} cells of other sources are flown again: {found}")
    elif others:
        notes.append(f"{len(others)} cells of other sources are kept: {found}; these are {sources()}")
    return [*notes, *filter(None, [differing_libraries(table.libraries(), libraries())])]


def _done(store: CellStore, plan: Plan) -> str:
    return f"{len(store.done().intersection(plan.places))} of {len(plan)} done"


def _fly(
    todo: Sequence[str], store: CellStore, plan: Plan, engine: Engine, function: CellFunction, isolate: bool
) -> Iterator[tuple[str, dict[str, Any]]]:
    if not todo:
        return
    for folder in {store.path(key).parent for key in todo}:
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise write_error(folder, error) from error
    if not isolate:
        for job in map(plan.job, todo):
            yield job.key, _own(function(job.cell.config, job.model, str(store.path(job.key)), job.key))
        return

    def tasks() -> Iterator[Task]:
        for job in map(plan.job, plan.flying_order(todo)):
            yield Task(job.key, job.cell.config, job.model, str(store.path(job.key)))

    with contextlib.closing(engine.fly(function, tasks())) as flown:
        for key, row in flown:
            row = _own(row)
            if isinstance(row, CellFailed):
                if row.all:
                    raise WriteError(row.cause)
                job = plan.job(key)
                store.remove([key])
                row = failed_row(job.cell.config, job.model, row.cause)
            yield key, row


def _own(row: Any) -> Any:
    """A row that comes in, or CellFailed where another program than this one made it."""
    if isinstance(row, CellFailed) or row.get("sources") == sources():
        return row
    return CellFailed(f"flown by {program_name(row)}, not by this one (quadexp {quadexp.__version__}, {sources()})")


def _refuse_another_sweep(store: CellStore, plan: Plan) -> None:
    path = store.root / RESULTS
    if not path.exists():
        return
    try:
        earlier = set(read_metadata(path, "results").get("conditions", []))
    except DataError:  # of no use to anybody; the flights are kept whosever they are
        return
    dropped = earlier - plan.conditions()
    if dropped:
        raise UsageError(
            f"{store.root}: holds the results of another sweep ({len(dropped)} of its {len(earlier)} cells are not in"
            " this one): choose another --out, or pass --force to replace them"
        )
