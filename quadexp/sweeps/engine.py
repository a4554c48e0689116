"""Cells on processes of this machine; a crash or an endless loop costs one cell one attempt and never ends the sweep.

The workers are forked from one server process that has the slow imports done (forkserver), so that a worker starts, or
is replaced, quickly. Every worker uses one thread of linear algebra.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from typing import Any, Protocol

from quadexp.config.schema import Config
from quadexp.errors import stops_all
from quadexp.experiment.build import ModelFile
from quadexp.sweeps.child import GONE, PRELOAD, cause, one_thread, start_pool

ATTEMPTS = 2  # for a cell whose process died or took too long
QUEUED = 4  # cells handed out per worker, so that no worker waits


@dataclass(frozen=True)
class CellFailed:
    """Why a cell has no result. all: whether the same will happen to every other cell, as on a full disk."""

    cause: str
    all: bool = False


@dataclass(frozen=True, slots=True)
class Task:
    """A cell to fly and the path of the file to write."""

    key: str
    config: Config
    model: ModelFile | None
    path: str


CellFunction = Callable[[Config, ModelFile | None, str, str], dict[str, Any]]  # see evaluate.evaluate_cell


class Engine(Protocol):
    """Flies the cells of a sweep; files and rows do not depend on the engine."""

    def fly(self, function: CellFunction, tasks: Iterable[Task]) -> Generator[tuple[str, dict[str, Any] | CellFailed]]:
        """Call `function(config, model, path, key)` for every task; yield (key, row or CellFailed) as they end.

        When a row is yielded, the file of its cell exists. Tasks are started in their order. Leaving the iterator
        early, or an interrupt, ends everything that the engine started.
        """
        ...


@dataclass(frozen=True)
class LocalEngine:
    """The processes of this machine. workers: 0 for one a core. timeout: s a cell may take.
    memory: GB that a process may take, None for no limit."""

    workers: int = 0
    timeout: float | None = None
    memory: float | None = None

    def fly(self, function: CellFunction, tasks: Iterable[Task]) -> Generator[tuple[str, Any]]:
        jobs = {task.key: (task.config, task.model, task.path, task.key) for task in tasks}
        return run_cells(function, jobs, workers=self.workers, timeout=self.timeout, memory=self.memory)


def default_workers() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_cells(
    function: Callable[..., Any],
    jobs: Mapping[str, tuple[Any, ...]],
    *,
    workers: int = 0,
    timeout: float | None = None,
    memory: float | None = None,
    preload: Sequence[str] = PRELOAD,
) -> Generator[tuple[str, Any]]:
    """Call `function(*arguments)` for every job in worker processes; yield (key, result or CellFailed) as they end.

    jobs: key -> arguments, handed out in this order. timeout: s a call may take (monotonic). memory: GB a worker may
    take.
    A call that raises fails at once (it would raise again); one whose process dies or that takes too long is tried
    once more. Leaving the iterator early, or an interrupt, stops every worker.
    """
    if not jobs:
        return
    workers = min(workers or default_workers(), len(jobs))
    waiting = [(key, arguments, ATTEMPTS) for key, arguments in jobs.items()][::-1]  # the next one last
    running: dict[Future[Any], tuple[str, tuple[Any, ...], int]] = {}
    with one_thread():
        pool = start_pool(workers, memory, [*preload, function.__module__])
        try:
            while waiting or running:
                while waiting and len(running) < QUEUED * workers:
                    job = waiting.pop()
                    running[pool.schedule(function, args=job[1], timeout=timeout)] = job
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    key, arguments, attempts = running.pop(future)
                    try:
                        yield key, future.result()
                    except GONE as error:
                        if attempts > 1:
                            waiting.append((key, arguments, attempts - 1))
                        else:
                            yield key, CellFailed(cause(error, timeout))
                    except Exception as error:
                        yield key, CellFailed(cause(error, timeout), stops_all(error))
        finally:
            if running:
                pool.stop()
            else:
                pool.close()
            pool.join()
