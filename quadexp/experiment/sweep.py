"""A sweep: every cell flown once, however often it is started, and one table of results at the end.

<out>/cells/...          one flight a cell, named by the hash of all that decides it (store.py)
<out>/results.parquet    the rows of this sweep, also as results.csv
<out>/table.md, .tex     the error table
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

from quadexp.compose import Cell
from quadexp.errors import QuadexpError, UsageError
from quadexp.experiment.build import (
    ModelFile,
    build_trajectory,
    build_vehicle,
    controller_settings,
    find_model,
    input_hashes,
)
from quadexp.experiment.engine import CellFailed, run_cells
from quadexp.experiment.evaluate import check_feasible, evaluate_cell, failed_row
from quadexp.experiment.identity import canonical, digest, flight_record
from quadexp.experiment.provenance import provenance, versions
from quadexp.experiment.store import CellStore, cell_key, condition
from quadexp.flight.store import read_metadata, read_table, write_table, write_text
from quadexp.report.tables import (
    ErrorTable,
    error_table,
    from_columns,
    to_columns,
    to_csv,
    to_latex,
    to_markdown,
)

RESULTS = "results.parquet"
COUNTED = ("failed", "infeasible")  # outcomes that make a sweep end with exit code 1


@dataclass(frozen=True)
class Job:
    """A cell with all that its flight reads: key of its file, condition (what was asked for), checkpoint."""

    key: str
    condition: str
    cell: Cell
    model: ModelFile | None


@dataclass(frozen=True)
class SweepResult:
    """rows: one a cell, in the order asked for. flown: how many were not there before. table: of the chosen metric."""

    out: Path
    rows: list[dict[str, Any]]
    flown: int
    table: ErrorTable
    files: dict[str, str] = field(default_factory=dict)

    @property
    def not_flown(self) -> list[dict[str, Any]]:
        return [row for row in self.rows if row["outcome"] in COUNTED]


class SweepInterrupted(QuadexpError):
    """Ctrl-C: what is done is kept."""


def prepare(cells: Sequence[Cell]) -> list[Job]:
    """Jobs of all cells, each once.

    Raises UsageError where a cell's settings contradict each other or a file that it needs is not there.
    """
    jobs: dict[str, Job] = {}
    seen: set[str] = set()
    found: dict[str, tuple[ModelFile | None, dict[str, str]]] = {}
    for cell in cells:
        config = cell.config
        trajectory = digest(asdict(config.trajectory))
        if trajectory not in seen:
            seen.add(trajectory)
            build_trajectory(config.trajectory)
        path = getattr(config.trajectory, "path", None)
        reads = canonical([config.model, asdict(config.controller), asdict(config.vehicle), path])
        if reads not in found:
            model = find_model(config)
            found[reads] = model, input_hashes(config, model)
            controller_settings(config.controller)
            build_vehicle(config.vehicle)
        model, inputs = found[reads]
        if model is None:
            config.model = None  # a checkpoint that the controller does not use decides nothing
        key = cell_key(config, inputs)
        jobs.setdefault(key, Job(key, digest(condition(config)), cell, model))
    return list(jobs.values())


def run_sweep(
    cells: Sequence[Cell],
    out: str | Path,
    *,
    metric: str = "mean_error",
    workers: int = 0,
    timeout: float | None = None,
    force: bool = False,
    isolate: bool = True,
    progress: Callable[[int, int], None] = lambda done, total: None,
    function: Callable[..., dict[str, Any]] = evaluate_cell,
) -> SweepResult:
    """Fly the cells that are not done, and write the table of all.

    metric: of the table. workers: processes, 0 for one a core. timeout: s of wall time a cell may take.
    force: fly everything again, and replace another sweep's table. isolate: False flies in this process.
    progress: called with the numbers of cells done and of all.

    Raises UsageError before anything is flown, SweepInterrupted on Ctrl-C.
    """
    jobs = prepare(cells)
    if not isolate:
        for job in jobs:
            config = job.cell.config
            check_feasible(config, build_trajectory(config.trajectory), build_vehicle(config.vehicle))
    store = CellStore(out)
    store.open()
    rows: dict[str, dict[str, Any]] = {}
    with store.lock():
        known = _known_rows(store, jobs, force=force)
        store.clean()
        if force:
            store.remove(job.key for job in jobs)
        done = store.done()
        todo = [job for job in jobs if job.key not in done]
        rows |= {job.key: known.get(job.key) or store.row(job.key) for job in jobs if job.key in done}
        progress(len(rows), len(jobs))
        try:
            for job, row in _fly(todo, store, workers=workers, timeout=timeout, isolate=isolate, function=function):
                rows[job.key] = row
                progress(len(rows), len(jobs))
        except KeyboardInterrupt:
            count = len(store.done() & {job.key for job in jobs})
            raise SweepInterrupted(f"{count} of {len(jobs)} done; run the same command to continue") from None
        finally:
            store.clean()
        ordered = [rows[job.key] | {"key": job.key, "variant": job.cell.varied} for job in jobs]
        table = error_table(ordered, metric)
        files = _write(store.root, ordered, table, jobs)
    return SweepResult(store.root, ordered, len(todo), table, files)


def _fly(
    todo: Sequence[Job], store: CellStore, *, workers: int, timeout: float | None, isolate: bool, function: Callable
) -> Iterator[tuple[Job, dict[str, Any]]]:
    arguments = {job.key: (job.cell.config, job.model, str(store.path(job.key)), job.key) for job in todo}
    by_key = {job.key: job for job in todo}
    if not isolate:
        yield from ((job, function(*arguments[job.key])) for job in todo)
        return
    if not todo:
        return
    for folder in {store.path(key).parent for key in arguments}:
        folder.mkdir(exist_ok=True)
    order = {job.key: arguments[job.key] for job in _interleaved(todo)}
    for key, row in run_cells(function, order, workers=workers, timeout=timeout):
        job = by_key[key]
        yield job, failed_row(job.cell.config, job.model, row.cause) if isinstance(row, CellFailed) else row


def _interleaved(jobs: Sequence[Job]) -> Iterator[Job]:
    """Controllers in turn, so that two workers begin by building two controllers and not the same one."""
    groups: dict[str, list[Job]] = {}
    for job in jobs:
        groups.setdefault(canonical(flight_record(job.cell.config)["controller"]), []).append(job)
    for group in zip_longest(*groups.values()):
        yield from (job for job in group if job is not None)


def _known_rows(store: CellStore, jobs: Sequence[Job], *, force: bool) -> dict[str, dict[str, Any]]:
    """Rows of an earlier table of this sweep; refuses to replace the table of another sweep unless `force`."""
    path = store.root / RESULTS
    if not path.exists() or force:
        return {}
    earlier = set(read_metadata(path, "results").get("conditions", []))
    dropped = earlier - {job.condition for job in jobs}
    if dropped:
        raise UsageError(
            f"{store.root}: holds the results of another sweep ({len(dropped)} of its {len(earlier)} cells are not in"
            " this one): choose another --out, or pass --force to replace them"
        )
    columns, _ = read_table(path, "results")
    return {row["key"]: row for row in from_columns(columns) if row["outcome"] != "failed"}


def _write(root: Path, rows: Sequence[dict[str, Any]], table: ErrorTable, jobs: Sequence[Job]) -> dict[str, str]:
    """Write the table in all its forms; returns name -> path."""
    record = {
        "metric": table.metric,
        "overrides": [list(job.cell.overrides) for job in jobs],
        "conditions": sorted(job.condition for job in jobs),
        "versions": versions(),
        "provenance": provenance(),
    }
    files = {
        "results": write_table(root / RESULTS, to_columns(rows), record, "results"),
        "csv": write_text(root / "results.csv", to_csv(rows)),
        "markdown": write_text(root / "table.md", to_markdown(table)),
        "latex": write_text(root / "table.tex", to_latex(table)),
    }
    return {name: str(path) for name, path in files.items()}
