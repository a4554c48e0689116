"""A sweep: every cell flown once, however often the sweep is started, and one table of results at the end.

<out>/cells/...          one flight a cell, named by the hash of all that decides it (log/cell_store.py)
<out>/results.parquet    the rows of this sweep, also as results.csv
<out>/statistics.parquet means, intervals and comparisons with the baseline, also as statistics.csv
<out>/table.md, .tex     the error table; comparison.tex the comparisons
"""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import quadexp
from quadexp.errors import DataError, QuadexpError, UsageError, WriteError
from quadexp.experiment.build import build_trajectory, build_vehicle
from quadexp.experiment.evaluate import check_feasible, evaluate_cell, failed_row
from quadexp.experiment.identity import digest
from quadexp.log.cell_store import CellStore
from quadexp.log.outcome import UNFLOWN
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, read_metadata
from quadexp.names import named, without
from quadexp.parts.cells import Cell, Cells
from quadexp.provenance import libraries, provenance, sources
from quadexp.report.checked import differing_libraries, flown_by, program_name, programs_text
from quadexp.report.frame import RESULTS
from quadexp.report.metrics import is_measured, measured, own_record
from quadexp.report.pairing import BASELINE
from quadexp.report.statistics import CONFIDENCE, Statistics
from quadexp.report.table import Table
from quadexp.sweeps.engine import CellFailed, CellFunction, Engine, LocalEngine, Progress, Task
from quadexp.sweeps.plan import INVALID, Job, check_jobs, flying_order, plan_cells
from quadexp.sweeps.sweep_table import Row, table_row, write_results
from quadexp.writer import flush

Old = Literal["ask", "refly", "keep"]  # what to do with cells that other sources have flown


@dataclass(frozen=True)
class SweepResult:
    """rows: one a cell, in the order asked for. flown: how many were not there before. table: of the chosen metric.
    notes: what a reader of the table should know, a line each."""

    out: Path
    rows: Sequence[Row]
    flown: int
    table: Table
    statistics: Statistics
    files: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def not_flown(self) -> list[Row]:
        return [row for row in self.rows if row["outcome"] in UNFLOWN]

    @property
    def invalid(self) -> list[Row]:
        """Cells whose settings contradict each other."""
        return [row for row in self.rows if row["outcome"] == INVALID]


class SweepInterrupted(QuadexpError):
    """Ctrl-C: what is done is kept."""

    exit_code = 130


@dataclass(frozen=True, kw_only=True)
class SweepRequest:
    """How a sweep is flown, and what its tables show.

    metric: of the table. baseline: controller that the others are compared with. confidence: of the intervals.
    engine: where to fly; None for `workers` processes of this machine (0: one a core). force: fly everything again, and
    replace another sweep's table. old: of cells that are there and were flown by other sources than those that run:
    "refly", "keep", or refuse to go on. isolate: False flies in this process. flown: called with the rows and the
    record of the results once all cells are flown, before the tables are made. on_result: called with every row as it
    is there. function: flies one cell. conf: the user's configuration folders, for the record.
    """

    metric: str = "mean_error"
    baseline: str = BASELINE
    confidence: float = CONFIDENCE
    engine: Engine | None = None
    workers: int = 0
    force: bool = False
    old: Old = "ask"
    isolate: bool = True
    progress: Progress = lambda done, total: None
    flown: Callable[[Sequence[Row], Mapping[str, Any]], None] = lambda rows, record: None
    on_result: Callable[[Row], None] = lambda row: None
    function: CellFunction = evaluate_cell
    conf: Sequence[Path] = ()


AS_USUAL = SweepRequest()


def run_sweep(cells: Sequence[Cell], out: str | Path, asked: SweepRequest = AS_USUAL) -> SweepResult:
    """Fly the cells that are not done, and write the table of all.

    A cell whose settings contradict each other is not flown: the outcome of its row is "invalid", `cause` says why.

    Raises UsageError before anything is flown, also where every cell is invalid, SweepInterrupted on Ctrl-C,
    QuadexpError at the first file that cannot be written; what is done is kept.
    """
    store = CellStore(out)
    jobs = plan_cells(cells)
    done = set() if asked.force else store.done()
    wrong = check_jobs(job for job in jobs.values() if job.key not in done and not job.invalid)
    jobs |= {key: replace(jobs[key], invalid=why) for key, why in wrong.items()}
    if wrong and all(job.invalid for job in jobs.values()):
        raise UsageError(next(iter(wrong.values())))
    if not asked.isolate:
        for config in (job.cell.config for job in jobs.values() if not job.invalid):
            vehicle = build_vehicle(config.vehicle)
            check_feasible(config, build_trajectory(config.trajectory, vehicle), vehicle)
    flown_before = not asked.force and done.issuperset(job.key for job in jobs.values() if not job.invalid)
    frozen = flown_before and store.is_frozen  # its table can be shown all the same
    state = flying(store, lambda: f"{len(store.done().intersection(jobs))} of {len(jobs)} done")
    with contextlib.nullcontext() if frozen else state:
        if asked.force:
            store.remove(jobs)
        else:
            _refuse_another_sweep(store, jobs)
        rows, notes = recall(store, jobs, asked.old)
        for job in (job for job in jobs.values() if job.invalid):
            rows[job.key] = _row_of(job, failed_row(job.cell.config, None, job.invalid, INVALID), store)
        todo = len(jobs) - len(rows)
        for row in rows.values():
            asked.on_result(row)
        for row in fly_missing(jobs, rows, store, asked):
            asked.on_result(row)
        in_order = [rows[key] for key in jobs]
        if all(row["outcome"] == INVALID for row in in_order):
            raise UsageError(in_order[0]["cause"])
        unflown = [row["key"] for row in in_order if row["outcome"] in ("failed", INVALID)]
        record = {
            "metric": asked.metric, **own_record(), "baseline": asked.baseline, "confidence": asked.confidence,
            "grids": list(cells.grids) if isinstance(cells, Cells) else [[[o] for o in c.overrides] for c in cells],
            "files": {path: text for job in jobs.values() for path, text in job.files.items()},
            "conditions": sorted({job.condition for job in jobs.values()}),
            "without_flight": {key: list(jobs[key].cell.overrides) for key in unflown},
            "flown_by": flown_by(in_order), "provenance": provenance(),
            "folder": str(Path.cwd()), "conf": [str(folder.absolute()) for folder in asked.conf],
        }  # fmt: skip
        if frozen:
            notes.append(f"{store.root}: cannot be written: tables and figures in it are as they were")
        else:
            asked.flown(in_order, record)
        statistics, shown, files, altered = write_results(store.root, in_order, record, write=not frozen)
        if not frozen:
            store.listed(jobs)
    return SweepResult(store.root, in_order, todo, shown, statistics, files, [*notes, *altered])


@contextlib.contextmanager
def flying(store: CellStore, state: Callable[[], str]) -> Iterator[None]:
    """A folder of cells, made and locked while flights are written there; removed again where there were none.

    state: what is done so far. Raises SweepInterrupted on Ctrl-C, QuadexpError at a file that cannot be written.
    """
    store.open()
    with store.emptied(), store.lock():
        store.clean()
        try:
            yield
        except KeyboardInterrupt:
            raise SweepInterrupted(
                f"{state()}; run the same command to continue (what is done is kept in {store.root})"
            ) from None
        except WriteError as error:
            again = "run the same command to continue once it can be written"
            raise QuadexpError(f"{error}: {state()}; {again}") from None
        finally:
            store.clean()


def recall(store: CellStore, jobs: Mapping[str, Job], old: Old) -> tuple[dict[str, Row], list[str]]:
    """Key -> row of the cells that are there and stay, each taken from its file, whose bytes are compared with their
    hash; and notes on those that have changed or hold too few samples, and on those of other sources or libraries.

    Raises UsageError where there are some of other sources and `old` does not say what to do with them.
    """

    def read(key: str) -> Row | QuadexpError:
        try:
            return store.row(key, jobs[key].cell.config.evaluate.log_period)
        except (DataError, UsageError) as error:
            return error

    done = store.done()
    there = [key for key in jobs if key in done]
    with ThreadPoolExecutor(2) as readers:  # hashing needs no interpreter lock
        read_rows = named(there, readers.map(read, there))
    changed = [str(row) for row in read_rows.values() if isinstance(row, QuadexpError)]
    stored = {key: row for key, row in read_rows.items() if not isinstance(row, QuadexpError)}
    rows = {key: _row_of(jobs[key], row, store) for key, row in stored.items()}
    what = "cells have changed since they were flown, or lack samples, and are flown again"
    notes = [f"{len(changed)} {what}: {changed[0]}"] if changed else []
    others = {key: rows[key] for key, row in stored.items() if not _same_program(row, jobs[key])}
    programs = programs_text(others.values())
    differing = differing_libraries((row["libraries"] for row in rows.values()), libraries())
    if others and old == "ask":
        programs += f" ({differing})" if differing else ""
        raise UsageError(
            f"{store.root}: {len(others)} of its cells were flown by other sources than these (quadexp"
            f" {quadexp.__version__}, sources {sources()}): {programs}; pass --refly to fly them again or --keep-old to"
            f" keep them beside new ones (`quadexp results {shlex.quote(str(store.root))} sources=HASH` lists them)"
        )
    if others and old == "refly":
        store.remove(others)
        rows = without(rows, others)
        notes.append(f"{len(others)} cells of other sources are flown again: {programs}")
    elif others:
        notes.append(f"{len(others)} cells of other sources are kept: {programs}; these are {sources()}")
    return rows, [*notes, *filter(None, [differing])]


def _same_program(row: Mapping[str, Any], job: Job) -> bool:
    """Whether a cell was flown by what would fly it now: the same sources behind this flight, whatever else has changed
    in the program, and the same libraries."""
    code = row.get("code")
    return code == digest([row.get("sources"), job.program]) if code else row.get("sources") == sources()


def _row_of(job: Job, row: Mapping[str, Any], store: CellStore) -> Row:
    """The row of a cell with the user's metrics of its stored flight, by their code as it is now."""
    measured_values = measured(flight_of(store.path(job.key), row)) if is_measured() else {}
    return table_row({**row, **measured_values, "key": job.key, "variant": job.variant})


def flight_of(path: Path, row: Mapping[str, Any]) -> Flight:
    """The flight of a row; one without samples where it was not flown."""
    if row.get("outcome") in UNFLOWN or not path.is_file():
        return Flight({}, {"outcome": row.get("outcome")})
    return read_flight(path, check=False)


def fly_missing(jobs: Mapping[str, Job], rows: dict[str, Row], store: CellStore, asked: SweepRequest) -> Iterator[Row]:
    """Fly the cells that have no row, and give them one; yield each as it ends, also of those that failed."""
    todo = [job for job in jobs.values() if job.key not in rows]
    for folder in {store.path(job.key).parent for job in todo}:
        folder.mkdir(parents=True, exist_ok=True)
    asked.progress(len(rows), len(jobs))
    if not todo:
        return
    store.ask(jobs)
    tasks = [
        Task(job.key, job.cell.config, job.model, str(store.path(job.key)), job.inputs) for job in flying_order(todo)
    ]
    flown: Generator[tuple[str, Any]]
    if not asked.isolate:
        flown = ((t.key, asked.function(t.config, t.model, t.path, t.key)) for t in tasks)
    else:
        flown = (asked.engine or LocalEngine(asked.workers)).fly(asked.function, tasks)
    with contextlib.closing(flown):
        for key, row in flown:
            if not isinstance(row, CellFailed) and row.get("sources") != sources():
                here = f"quadexp {quadexp.__version__}, {sources()}"
                row = CellFailed(f"flown by {program_name(row)}, not by this one ({here})")
            if isinstance(row, CellFailed):
                if row.all:
                    raise WriteError(row.cause)
                store.remove([key])
                cell = jobs[key].cell.config, jobs[key].model
                row = failed_row(*cell, row.cause, INVALID if row.contradiction else "failed")
            rows[key] = _row_of(jobs[key], row, store)
            yield rows[key]
            asked.progress(len(rows), len(jobs))
    flush(store.folder)  # all at once: flushing each would take as long as flying it


def _refuse_another_sweep(store: CellStore, jobs: Mapping[str, Job]) -> None:
    path = store.root / RESULTS
    if not path.exists():
        return
    try:
        earlier = set(read_metadata(path, "results").get("conditions", []))
    except DataError:  # a damaged table says nothing; the flights are kept whosever they are
        return
    dropped = earlier - {job.condition for job in jobs.values()}
    if dropped:
        raise UsageError(
            f"{store.root}: holds the results of another sweep ({len(dropped)} of its {len(earlier)} cells are not in"
            " this one): choose another --out, or pass --force to replace them"
        )
