"""Cells on processes of this machine; a crash or an endless loop costs one cell one attempt and never ends the sweep.

The workers are forked from one server process that has the slow imports done (forkserver), so that a worker starts, or
is replaced, quickly. Every worker uses one thread of linear algebra.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, InvalidStateError, wait
from dataclasses import dataclass
from typing import Any, Protocol

from pebble import ProcessPool

from quadexp.errors import ModuleError, UsageError, WriteError, stops_all
from quadexp.experiment.checkpoints import ModelFile
from quadexp.parts.schema import Config
from quadexp.sweeps.child import GONE, cause, start_pool
from quadexp.sweeps.server import PRELOAD, without_main

ATTEMPTS = 2  # for a cell whose process died or took too long
QUEUED = 4  # cells handed out per worker, so that no worker waits
CHECKED = 1.0  # s between checks of the pool


@dataclass(frozen=True)
class CellFailed:
    """Why a cell has no result. all: whether the same will happen to every other cell, as on a full disk.
    contradiction: whether its settings contradict each other, which showed only where its parts were built."""

    cause: str
    all: bool = False
    contradiction: bool = False

    @classmethod
    def of(cls, error: Exception, timeout: float | None) -> CellFailed:
        """Of what a call raised."""
        wrong = isinstance(error, UsageError) and not isinstance(error, ModuleError | WriteError)
        return cls(cause(error, timeout), stops_all(error), wrong)


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
    memory: GB that a process may take, None for no limit. processes: to fly in, which other work shares; None for some
    of its own."""

    workers: int = 0
    timeout: float | None = None
    memory: float | None = None
    processes: Workers | None = None

    def fly(self, function: CellFunction, tasks: Iterable[Task]) -> Generator[tuple[str, Any]]:
        jobs = {task.key: (task.config, task.model, task.path, task.key) for task in tasks}
        if self.processes is not None:
            return self.processes.run(function, jobs, timeout=self.timeout)
        return run_cells(function, jobs, workers=self.workers, timeout=self.timeout, memory=self.memory)


def default_workers() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """Processes for calls of functions, started with the first call; a context, at whose end they are gone.

    workers: how many at most, 0 for one a core. memory: GB that each may take, None for no limit. preload: modules that
    their server imports once (server.py), if it does not run yet. calls: how many there will be at least; no more
    processes start than there are calls. folders: those in which `_target_` may name modules, None for those of this
    process. Threads may share it.
    """

    def __init__(
        self,
        workers: int = 0,
        memory: float | None = None,
        preload: Sequence[str] = PRELOAD,
        calls: int = 1,
        folders: Sequence[str] | None = None,
    ) -> None:
        self._most, self._memory, self._preload, self._calls = workers or default_workers(), memory, preload, calls
        self._folders = folders
        self._pool: ProcessPool | None = None
        self._under_way: set[Future[Any]] = set()
        self._hidden = contextlib.ExitStack()
        self._lock = threading.RLock()  # of the pool and the calls under way
        self._ended = False

    def __enter__(self) -> Workers:
        self._hidden.enter_context(without_main())
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        self._hidden.close()

    def stop(self) -> None:
        """End the processes, with whatever they are doing: calls under way raise CancelledError."""
        with self._lock:
            pool, self._pool = self._pool, None
            if pool is not None:
                pool.stop()
                pool.join()
            for future in self._under_way:  # a stopped pool leaves them pending
                with contextlib.suppress(InvalidStateError):  # it has ended
                    future.set_exception(CancelledError("its processes were stopped"))
            self._under_way.clear()

    def end(self) -> None:
        """Stop, and begin no other call."""
        with self._lock:
            self._ended = True
            self.stop()

    def call(
        self, function: Callable[..., Any], *arguments: Any, timeout: float | None = None, calls: int = 1
    ) -> Future[Any]:
        """Begin a call. timeout: s it may take (monotonic). calls: how many there will be.

        Raises QuadexpError where the processes import another quadexp than this one, CancelledError after the end.
        """
        with self._lock:
            if self._ended:
                raise CancelledError("its processes were ended")
            self._check()
            if self._pool is None:
                preload = [*self._preload, function.__module__]
                self._pool = start_pool(min(self._most, max(calls, self._calls)), self._memory, preload, self._folders)
            found: Future[Any] = self._pool.schedule(function, args=arguments, timeout=timeout)
            self._under_way.add(found)
            return found

    def _check(self) -> None:
        """Give up a pool that does not work any more: a thread of it ends where the server dies while it forks."""
        with self._lock:
            if self._pool is not None and not self._pool.active:
                self.stop()

    def result(self, function: Callable[..., Any], *arguments: Any, timeout: float | None = None) -> Any:
        """Of one call, which is tried once more where its process dies or it takes too long."""
        ((_, ended),) = self._calls_of(function, {"": arguments}, timeout)
        return ended.result()

    def run(
        self, function: Callable[..., Any], jobs: Mapping[str, tuple[Any, ...]], *, timeout: float | None = None
    ) -> Generator[tuple[str, Any]]:
        """Call `function(*arguments)` for every job; yield (key, result or CellFailed) as they end.

        jobs: key -> arguments, handed out in this order. timeout: s a call may take (monotonic).
        A call that raises fails at once (it would raise again); one whose process dies or that takes too long is tried
        once more. Leaving the iterator early, or an interrupt, stops every process.
        """
        ended = False
        try:
            for key, future in self._calls_of(function, jobs, timeout):
                try:
                    yield key, future.result()
                except Exception as error:
                    yield key, CellFailed.of(error, timeout)
            ended = True
        finally:
            if not ended:
                self.stop()

    def _calls_of(
        self, function: Callable[..., Any], jobs: Mapping[str, tuple[Any, ...]], timeout: float | None
    ) -> Iterator[tuple[str, Future[Any]]]:
        """Key and future of every job, as they end for good."""
        waiting = [(key, ATTEMPTS) for key in jobs][::-1]  # the next one last
        running: dict[Future[Any], tuple[str, int]] = {}
        while waiting or running:
            while waiting and len(running) < QUEUED * min(self._most, len(jobs)):
                key, attempts = waiting.pop()
                running[self.call(function, *jobs[key], timeout=timeout, calls=len(jobs))] = key, attempts
            ended = wait(running, timeout=CHECKED, return_when=FIRST_COMPLETED).done
            if not ended:
                self._check()
            with self._lock:
                self._under_way -= ended
            for future in ended:
                key, attempts = running.pop(future)
                if attempts > 1 and isinstance(future.exception(), GONE):
                    waiting.append((key, attempts - 1))
                else:
                    yield key, future


def run_cells(
    function: Callable[..., Any],
    jobs: Mapping[str, tuple[Any, ...]],
    *,
    workers: int = 0,
    timeout: float | None = None,
    memory: float | None = None,
    preload: Sequence[str] = PRELOAD,
) -> Generator[tuple[str, Any]]:
    """As Workers.run, with processes of its own. memory: GB a process may take."""
    with Workers(workers, memory, preload) as processes:
        yield from processes.run(function, jobs, timeout=timeout)
