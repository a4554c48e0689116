"""Worker processes: pools of them, what each does at its start, and the message for one that ended without a result.

A worker ends with the process that started it, even if that is killed, and has a memory limit. It imports from the same
places as its parent and from no others, so not from the current folder; a pool whose workers import another quadexp is
refused.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, TimeoutError, wait
from multiprocessing import forkserver, resource_tracker
from pathlib import Path

from pebble import ProcessExpired, ProcessPool
from pebble.pool.base_pool import Task
from pebble.pool.process import TaskManager

from quadexp.config.plugins import import_from, own_folders
from quadexp.errors import QuadexpError, UsageError
from quadexp.provenance import identity, package_folder

PRELOAD = ("casadi", "numpy", "scipy.spatial.transform", "pyarrow.parquet")
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
SAFE, PATH = "PYTHONSAFEPATH", "PYTHONPATH"
STARTING = 60.0  # s to wait for the first process of a pool
GONE = (ProcessExpired, TimeoutError)  # exceptions of a call whose process died or took too long
_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of linux/prctl.h


def start_pool(
    workers: int, memory: float | None, preload: Sequence[str], folders: Sequence[str] | None = None
) -> ProcessPool:
    """A pool whose processes are forked from one server that has imported `preload`.

    memory: limit of the data of a process (heap and private maps) in GB, None for no limit. folders: those in which
    `_target_` may name modules, None for those of this process.
    Raises QuadexpError where the processes import another quadexp than this one.
    """
    path, pool = os.environ.get(PATH), None
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(dict.fromkeys(preload)))
    try:
        with _undisturbed(), same_imports():
            resource_tracker.ensure_running()  # unblocks what it blocked, so it goes first
            # Inherited: the server and its children end with this process, not by the Ctrl-C that reaches the group.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                forkserver.ensure_running()
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
            given = own_folders() if folders is None else tuple(folders)
            pool = ProcessPool(max_workers=workers, context=context, initializer=begin, initargs=(memory, path, given))
            manager = pool._pool_manager
            manager.task_manager = _MonotonicTasks(manager.task_manager.task_done_callback)
            asked = pool.schedule(identity)
            wait([asked], timeout=STARTING)
        if asked.done():
            _check_program(asked)
    except (KeyboardInterrupt, QuadexpError):
        if pool is not None:
            pool.stop()
            pool.join()
        raise
    return pool


def _check_program(asked: Future[dict[str, str]]) -> None:
    """Raise QuadexpError if the workers run another program than this process."""
    try:
        child = asked.result()
    except GONE:  # every cell will report it
        return
    except Exception as error:  # another program may have no such function
        raise QuadexpError(f"worker processes do not run the quadexp of {package_folder()} ({error})") from None
    for name, mine in identity().items():
        if child.get(name) != mine:
            raise QuadexpError(f"worker processes have {name} {child.get(name)}, this process has {mine}")


@contextlib.contextmanager
def safe_path() -> Iterator[None]:
    """Python processes started inside do not import from the folder where they are started.

    Raises UsageError where Python was started with the option to ignore the environment variables that ask for it.
    """
    if sys.flags.ignore_environment and not sys.flags.safe_path:
        raise UsageError(
            "Python was started with -E, so that its children would import from the current folder: add -P"
        )
    with environment({SAFE: "1"}):
        yield


@contextlib.contextmanager
def same_imports() -> Iterator[None]:
    """Python processes started inside search for modules in the same places as this one, and in no others."""
    places = [str(Path(place).absolute()) for place in sys.path if isinstance(place, str)]
    known = os.pathsep.join(place for place in places if os.pathsep not in place)
    with safe_path(), environment({PATH: known}):
        yield


@contextlib.contextmanager
def without_main() -> Iterator[None]:
    """Processes started inside do not import this program's main module: a script may start them without a guard.

    What they call lies in modules of quadexp, so they have no need of it.
    """
    main = sys.modules["__main__"]
    names = [name for name in ("__file__", "__spec__") if hasattr(main, name)]
    saved = {name: getattr(main, name) for name in names}
    for name in names:
        setattr(main, name, None)
    try:
        yield
    finally:
        for name, value in saved.items():
            setattr(main, name, value)


class _MonotonicTasks(TaskManager):
    """Pebble's tasks with time limits by the monotonic clock, which a suspended computer or a changed clock does not
    affect. (Pebble 5 uses wall time.)"""

    def task_start(self, task_id: int, worker_id: int | None) -> None:
        super().task_start(task_id, worker_id)
        task = self.tasks.get(task_id)
        if task is not None:
            task.timestamp = time.monotonic()

    @staticmethod
    def timeout(task: Task) -> bool:
        return bool(task.timeout and task.started and time.monotonic() - task.timestamp > task.timeout)


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Delay SIGINT and SIGTERM to the end of the block: workers interrupted while they start print long tracebacks."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked: list[int] = []
    usual = {
        number: signal.signal(number, lambda number, frame: asked.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler or signal.SIG_DFL)
        for first in asked[:1]:
            os.kill(os.getpid(), first)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Processes started inside use one thread of linear algebra each."""
    with environment(dict.fromkeys(THREADS, "1")):
        yield


@contextlib.contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for processes started inside; restored afterwards."""
    saved = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in saved.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def begin(memory: float | None, path: str | None, folders: Sequence[str]) -> None:
    """Called first in a worker: it shall end with its parent, keep to its memory limit, and import the user's modules
    from `folders` (those given with --conf).

    path: PYTHONPATH for programs that the worker itself starts.
    """
    if path is None:
        os.environ.pop(PATH, None)
    else:
        os.environ[PATH] = path
    for folder in folders:
        import_from(Path(folder))
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if memory:
        limit = int(memory * 1e9)
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        if hard == resource.RLIM_INFINITY or limit < hard:
            resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))


def cause(error: BaseException, timeout: float | None) -> str:
    """One line for a call that has no result."""
    if isinstance(error, TimeoutError):
        return f"took longer than {timeout:g} s"
    if isinstance(error, ProcessExpired):
        return f"its process died (exit code {error.exitcode})"
    if isinstance(error, MemoryError):
        return "took more memory than evaluate.memory allows"
    text = str(error).strip().splitlines()
    if isinstance(error, QuadexpError):
        return text[0] if text else type(error).__name__
    return f"{type(error).__name__}: {text[0] if text else ''}"[:300].rstrip(": ")
