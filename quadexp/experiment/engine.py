"""Many cells on the processes of this machine; a crash or an endless loop costs one cell one attempt, never the sweep.

The pool starts its workers from one server process that has the heavy imports ready (forkserver), so that a worker
costs a fork and a replaced one is there at once. Every worker uses one thread of linear algebra.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, TimeoutError, wait
from dataclasses import dataclass
from typing import Any

from pebble import ProcessExpired, ProcessPool

from quadexp.errors import QuadexpError

ATTEMPTS = 2  # for a cell whose process died or took too long
QUEUED = 4  # cells handed out per worker, so that no worker waits
PRELOAD = ("casadi", "numpy", "scipy.spatial.transform", "pyarrow.parquet")
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class CellFailed:
    """Why a cell has no result."""

    cause: str


def default_workers() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_cells(
    function: Callable[..., Any],
    jobs: Mapping[str, tuple],
    *,
    workers: int = 0,
    timeout: float | None = None,
    preload: Sequence[str] = PRELOAD,
) -> Iterator[tuple[str, Any]]:
    """Call `function(*arguments)` for every job in worker processes; yield (key, result or CellFailed) as they end.

    jobs: key -> arguments, handed out in this order. timeout: s of wall time a call may take.
    A call that raises fails at once (it would raise again); one whose process dies or that takes too long is tried
    once more. Leaving the iterator early, or an interrupt, stops every worker.
    """
    jobs = dict(jobs)
    attempts_left = dict.fromkeys(jobs, ATTEMPTS)
    waiting = iter(jobs)
    again: list[str] = []
    workers = min(workers or default_workers(), max(1, len(jobs)))
    saved = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*preload, function.__module__])
    pool = ProcessPool(max_workers=workers, context=context)
    running: dict[Future, str] = {}

    def hand_out() -> None:
        while len(running) < QUEUED * workers:
            key = again.pop() if again else next(waiting, None)
            if key is None:
                return
            attempts_left[key] -= 1
            running[pool.schedule(function, args=jobs[key], timeout=timeout)] = key

    try:
        hand_out()
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                key = running.pop(future)
                try:
                    yield key, future.result()
                except (ProcessExpired, TimeoutError) as error:
                    if attempts_left[key] > 0:
                        again.append(key)
                    else:
                        yield key, CellFailed(_cause(error, timeout))
                except Exception as error:
                    yield key, CellFailed(_cause(error, timeout))
            hand_out()
    finally:
        if running:
            pool.stop()
        else:
            pool.close()
        pool.join()
        for name, value in saved.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _cause(error: Exception, timeout: float | None) -> str:
    if isinstance(error, TimeoutError):
        return f"took longer than {timeout:g} s"
    if isinstance(error, ProcessExpired):
        return f"its process died (exit code {error.exitcode})"
    text = str(error).strip().splitlines()
    if isinstance(error, QuadexpError):
        return text[0] if text else type(error).__name__
    return f"{type(error).__name__}: {text[0] if text else ''}"[:300].rstrip(": ")
