"""Cells on processes of this machine; a crash or an endless loop costs one cell one attempt and never ends the sweep.

The workers are forked from one server process that has the slow imports done (forkserver), so that a worker starts, or
is replaced, quickly. Every worker uses one thread of linear algebra, has a memory limit, and ends with the process that
started it, even if that is killed. It imports from the same places as its parent and from no others, so not from the
current folder.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import pickle
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, TimeoutError, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from typing import Any, Protocol

from pebble import ProcessExpired, ProcessPool

from quadexp.compile.signals import undisturbed
from quadexp.errors import DataError, ModuleError, QuadexpError, UsageError, WriteError, stops_all
from quadexp.experiment.identity import ModelFile, flight_identity
from quadexp.parts.schema import Config
from quadexp.parts.user_modules import import_from, own_folders
from quadexp.sweeps.server import PATH, PRELOAD, start_server, without_main

ATTEMPTS = 2  # for a cell whose process died or took too long
STARTING = 60.0  # s to wait for the processes of a pool
PAUSE = 0.05  # s that a process sleeps first, so that each one is given a call while the others start
QUEUED = 4  # cells handed out per worker, so that no worker waits
CHECKED = 1.0  # s between checks of the pool
# Exceptions of a call whose process died or took too long, or whose pool was given up.
GONE = (ProcessExpired, TimeoutError, BrokenProcessPool, CancelledError)
_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of linux/prctl.h

ENDED = 256  # beyond all exit codes: of a process that ended with 0, which pebble takes for asked to

Progress = Callable[[int, int], None]  # called with the numbers of cells done and of all


@dataclass(frozen=True)
class CellFailed:
    """Why a cell has no result. all: whether the same will happen to every other cell, as on a full disk.
    contradiction: whether its settings contradict each other, which showed only where its parts were built."""

    cause: str
    all: bool = False
    contradiction: bool = False

    @classmethod
    def of(cls, error: BaseException, timeout: float | None) -> CellFailed:
        """Of what a call raised."""
        wrong = isinstance(error, UsageError) and not isinstance(error, ModuleError | WriteError)
        return cls(cause(error, timeout), stops_all(error), wrong)


@dataclass(frozen=True, slots=True)
class Task:
    """A cell to fly and the path of the file to write. inputs: of its identity when it was planned, None for any."""

    key: str
    config: Config
    model: ModelFile | None
    path: str
    inputs: Mapping[str, str] | None = None


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
        """See Engine."""
        jobs = {task.key: (function, pickle.dumps(task)) for task in tasks}
        shared = contextlib.nullcontext(self.processes) if self.processes else None
        with shared or Workers(self.workers, self.memory) as processes:
            yield from processes.run(fly_as_planned, jobs, timeout=self.timeout)


def fly_as_planned(function: CellFunction, packed: bytes, path: str | Path | None = None) -> dict[str, Any]:
    """In a worker: fly a task, which is unpacked here, where an error is one of this cell. path: of the file to write,
    instead of the task's.

    Raises DataError where this process would fly another thing than was planned.
    """
    task: Task = pickle.loads(packed)
    if task.inputs is not None:
        try:
            here = flight_identity(task.config).inputs
        except UsageError as error:
            raise DataError(f"{error}: a worker must see the files of the driver") from None
        other = sorted(name for name in {**here, **task.inputs} if here.get(name) != task.inputs.get(name))
        if other:
            raise DataError(f"{', '.join(other)}: has changed since this run began, or is another one for this worker")
    return function(task.config, task.model, str(path or task.path), task.key)


def default_workers() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Worker(ForkServerProcess):
    """A process of a pool."""

    @property
    def exitcode(self) -> int | None:
        """Never 0, see ENDED."""
        return ENDED if super().exitcode == 0 else super().exitcode


class Forkserver(ForkServerContext):
    """Starts such processes."""

    Process = Worker


class Workers:
    """Processes for calls of functions, started with the first call; a context, at whose end they are gone.

    workers: how many at most, 0 for one a core. memory: GB that each may take, None for no limit. preload: modules that
    their server imports once (server.py), if it does not run yet. calls: how many there will be at least; no more
    processes start than there are calls. folders: those in which `_target_` may name modules, None for those of this
    process.
    """

    def __init__(
        self,
        workers: int = 0,
        memory: float | None = None,
        preload: Sequence[str] = PRELOAD,
        calls: int = 1,
        folders: Sequence[str] | None = None,
    ) -> None:
        self._most = workers or default_workers()
        self._memory = memory
        self._preload = preload
        self._calls = calls
        self._folders = folders
        self._pool: ProcessPool | None = None
        self._hidden = contextlib.ExitStack()

    def __enter__(self) -> Workers:
        self._hidden.enter_context(without_main())
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        self._hidden.close()

    def stop(self) -> None:
        """End the processes, with whatever they are doing."""
        pool = self._pool
        self._pool = None
        if pool is not None:
            pool.stop()
            pool.join()

    def call(
        self, function: Callable[..., Any], *arguments: Any, timeout: float | None = None, calls: int = 1
    ) -> Future[Any]:
        """Begin a call. timeout: s it may take. calls: how many there will be."""
        if self._pool is not None and not self._pool.active:
            self.stop()
        if self._pool is None:
            folders = own_folders() if self._folders is None else tuple(self._folders)
            most = min(self._most, max(calls, self._calls))
            multiprocessing.current_process().daemon = False  # which might have no children: one of a pool, or a nanny
            with undisturbed():  # processes whose parent ends while they start print long tracebacks
                start_server([*self._preload, function.__module__])
                surroundings = self._memory, os.environ.get(PATH), folders
                self._pool = ProcessPool(
                    max_workers=most, context=Forkserver(), initializer=begin, initargs=surroundings
                )
                wait([self._pool.schedule(time.sleep, args=(PAUSE,)) for _ in range(most)], timeout=STARTING)
        return self._pool.schedule(function, args=arguments, timeout=timeout)

    def run(
        self, function: Callable[..., Any], jobs: Mapping[str, tuple[Any, ...]], *, timeout: float | None = None
    ) -> Generator[tuple[str, Any]]:
        """Call `function(*arguments)` for every job; yield (key, result or CellFailed) as they end.

        jobs: key -> arguments, handed out in this order. timeout: s a call may take.
        A call that raises fails at once (it would raise again); one whose process dies or that takes too long is tried
        once more. Leaving the iterator early, or an interrupt, stops every process.
        """
        waiting = [(key, ATTEMPTS) for key in jobs][::-1]  # the next one last
        running: dict[Future[Any], tuple[str, int, ProcessPool | None]] = {}
        try:
            while waiting or running:
                while waiting and len(running) < QUEUED * min(self._most, len(jobs)):
                    key, attempts = waiting.pop()
                    future = self.call(function, *jobs[key], timeout=timeout, calls=len(jobs))
                    running[future] = key, attempts, self._pool
                ended = wait(running, timeout=CHECKED, return_when=FIRST_COMPLETED).done
                # A thread of a pool ends where the server dies while it forks: then no call of that pool comes back.
                lost = {f for f, (*_, pool) in running.items() if not (pool and pool is self._pool and pool.active)}
                for future in ended | lost:
                    key, attempts, _ = running.pop(future)
                    error = future.exception() if future.done() else BrokenProcessPool()
                    if attempts > 1 and isinstance(error, GONE):
                        waiting.append((key, attempts - 1))
                    else:
                        yield key, CellFailed.of(error, timeout) if error else future.result()
        except BaseException:
            self.stop()
            raise


def begin(memory: float | None, path: str | None, folders: Sequence[str]) -> None:
    """Called first in a worker: it shall end with its parent, keep to its memory limit (of heap and private maps), and
    import the user's modules from `folders` (those given with --conf).

    path: PYTHONPATH for programs that the worker itself starts.
    """
    os.environ[PATH] = path or ""
    sys.stdout = sys.stderr  # what a part of the user's prints is no result
    import_from(*folders)
    threading.Thread(target=_end_with_driver, daemon=True).start()
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if memory:
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        limit = int(memory * 1e9)
        if hard == resource.RLIM_INFINITY or limit < hard:
            resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))


def _end_with_driver() -> None:
    """End at once when the process that started this one has ended, whatever is flown. The death of the server, to
    which the signal above belongs, is no sign of that: it lives as long as any of its workers."""
    driver = multiprocessing.parent_process()
    if driver is not None:
        driver.join()
        os._exit(1)


def cause(error: BaseException, timeout: float | None) -> str:
    """One line for a call that has no result."""
    if isinstance(error, TimeoutError):
        return f"took longer than {timeout:g} s"
    if isinstance(error, (BrokenProcessPool, CancelledError)):
        return "its process died"
    if isinstance(error, ProcessExpired):
        return f"its process died (exit code {0 if error.exitcode == ENDED else error.exitcode})"
    if isinstance(error, MemoryError):
        return "took more memory than evaluate.memory allows"
    text = str(error).strip().splitlines()
    if isinstance(error, QuadexpError):
        return text[0] if text else type(error).__name__
    return f"{type(error).__name__}: {text[0] if text else ''}"[:300].rstrip(": ")
