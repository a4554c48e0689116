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
import time
from collections.abc import Sequence
from concurrent.futures import CancelledError, Future, TimeoutError, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from pebble import ProcessExpired, ProcessPool
from pebble.pool.base_pool import Task
from pebble.pool.process import TaskManager

from quadexp.errors import QuadexpError
from quadexp.parts.plugins import import_from, own_folders
from quadexp.provenance import identity, package_folder
from quadexp.sweeps.server import PATH, start_server, undisturbed

STARTING = 60.0  # s to wait for the first process of a pool
# Exceptions of a call whose process died or took too long, or whose pool was given up.
GONE = (ProcessExpired, TimeoutError, BrokenProcessPool, CancelledError)
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
    try:
        with undisturbed():
            start_server(preload)
            given = own_folders() if folders is None else tuple(folders)
            context = multiprocessing.get_context("forkserver")
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
    if isinstance(error, (BrokenProcessPool, CancelledError)):
        return "its process died"
    if isinstance(error, ProcessExpired):
        return f"its process died (exit code {error.exitcode})"
    if isinstance(error, MemoryError):
        return "took more memory than evaluate.memory allows"
    text = str(error).strip().splitlines()
    if isinstance(error, QuadexpError):
        return text[0] if text else type(error).__name__
    return f"{type(error).__name__}: {text[0] if text else ''}"[:300].rstrip(": ")
