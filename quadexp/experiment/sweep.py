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
from typing import Any

from quadexp.cells import Cell, Cells
from quadexp.errors import DataError, QuadexpError, UsageError, WriteError, write_error
from quadexp.experiment.build import build_trajectory, build_vehicle
from quadexp.experiment.engine import CellFailed, CellFunction, Engine, LocalEngine, Task
from quadexp.experiment.evaluate import check_feasible, evaluate_cell, failed_row
from quadexp.experiment.plan import Plan
from quadexp.experiment.sweep_table import RESULTS, SweepTable, write_results
from quadexp.flight.cell_store import CellStore
from quadexp.flight.store import read_metadata
from quadexp.provenance import provenance, versions
from quadexp.report.statistics import BASELINE, CONFIDENCE
from quadexp.report.statistics_file import Statistics
from quadexp.report.tables import ErrorTable

COUNTED = ("failed", "infeasible")  # outcomes that make a sweep end with exit code 1


@dataclass(frozen=True)
class SweepResult:
    """rows: one a cell, in the order asked for. flown: how many were not there before. table: of the chosen metric."""

    out: Path
    rows: Sequence[dict[str, Any]]
    flown: int
    table: ErrorTable
    statistics: Statistics
    files: dict[str, str] = field(default_factory=dict)

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
    isolate: bool = True,
    progress: Callable[[int, int], None] = lambda done, total: None,
    function: CellFunction = evaluate_cell,
) -> SweepResult:
    """Fly the cells that are not done, and write the table of all.

    metric: of the table. baseline: controller that the others are compared with. confidence: of the intervals.
    engine: where to fly; None for `workers` processes of this machine (0: one a core), each cell for at most `timeout`
    seconds. force: fly everything again, and replace another sweep's table. isolate: False flies in this process.
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
            check_feasible(config, build_trajectory(config.trajectory), build_vehicle(config.vehicle))
    store.open()
    with store.emptied(), store.lock():
        if not force:
            _refuse_another_sweep(store, plan)
        store.clean()
        if force:
            store.remove(plan.places)
        table = SweepTable(store, plan)
        table.recall()
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
            "versions": versions(),
            "provenance": provenance(),
        }
        statistics, shown, files = write_results(store.root, table.rows, record)
        table.settled()
    return SweepResult(store.root, table.rows, len(todo), shown, statistics, files)


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
            yield job.key, function(job.cell.config, job.model, str(store.path(job.key)), job.key)
        return

    def tasks() -> Iterator[Task]:
        for job in map(plan.job, plan.flying_order(todo)):
            yield Task(job.key, job.cell.config, job.model, str(store.path(job.key)))

    with contextlib.closing(engine.fly(function, tasks())) as flown:
        for key, row in flown:
            if isinstance(row, CellFailed):
                if row.all:
                    raise WriteError(row.cause)
                job = plan.job(key)
                row = failed_row(job.cell.config, job.model, row.cause)
            yield key, row


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
