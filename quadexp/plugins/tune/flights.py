"""Flights in several rounds, without a table: cells that are flown where they are not there."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

from quadexp.errors import UsageError
from quadexp.experiment.evaluate import evaluate_cell
from quadexp.log.cell_store import CellStore
from quadexp.parts.cells import Cell
from quadexp.parts.schema import Config
from quadexp.sweeps.engine import CellFunction, Engine, LocalEngine, Progress, Workers
from quadexp.sweeps.plan import check_jobs, plan_cells
from quadexp.sweeps.sweep import SweepRequest, fly_missing, recall
from quadexp.sweeps.sweep_table import Row


def fly_cells(
    cells: Iterable[Cell],
    store: CellStore,
    engine: Engine | None = None,
    *,
    function: CellFunction = evaluate_cell,
    isolate: bool = True,
    progress: Progress = lambda done, total: None,
) -> list[Row]:
    """Rows of some cells in their order, flown where they are not in the store; no table is written.

    progress: called with the numbers of cells done and of all. Cells of other sources are flown again. The caller
    holds the lock of the store. Raises as `run_sweep` does, and UsageError for a cell that contradicts itself.
    """
    jobs = plan_cells(cells)
    if wrong := check_jobs(jobs.values()):
        raise UsageError(next(iter(wrong.values())))
    rows, _ = recall(store, jobs, "refly")
    asked = SweepRequest(engine=engine, function=function, isolate=isolate, progress=progress)
    list(fly_missing(jobs, rows, store, asked))
    return [rows[key] for key in jobs]


@contextlib.contextmanager
def opened(config: Config, calls: int) -> Iterator[Engine]:
    """The engine for several rounds of flights: its processes, or its cluster, are started once and end with the
    context. calls: flights at least."""
    settings = config.evaluate
    with Workers(settings.workers, settings.memory or None, calls=calls) as processes:
        engine: Any = config.engine.build(settings, processes)
        if isinstance(engine, LocalEngine):
            yield engine
            return
        with engine.open() as client:
            yield replace(engine, open=lambda: contextlib.nullcontext(client))
