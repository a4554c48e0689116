"""The server that worker processes are forked from: how it is started, and what its children inherit.

It imports the slow modules once. Nothing heavy is imported here, so that a command can start the server first and go on
meanwhile: with two cores or more, composing the cells of a sweep and importing what flies them take place at a time.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from multiprocessing import forkserver, resource_tracker
from pathlib import Path

from quadexp.compile.signals import undisturbed
from quadexp.names import distinct

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
SAFE = "PYTHONSAFEPATH"
PATH = "PYTHONPATH"
# What nearly every flight needs.
PRELOAD = (
    "casadi", "numpy", "pyarrow.parquet", "quadexp.experiment.evaluate", "quadexp.experiment.rollout",
    "quadexp.control.mpc.controller", "quadexp.world.simplified",
)  # fmt: skip


def start_server(preload: Sequence[str] = PRELOAD) -> None:
    """Start the server, which then imports `preload`; it is not waited for. One that runs already is left as it is.

    Its children search for modules where this process does, and use one thread of linear algebra.
    """
    multiprocessing.get_context("forkserver").set_forkserver_preload(distinct(preload))
    with undisturbed(), same_imports(), environment(dict.fromkeys(THREADS, "1")):
        resource_tracker.ensure_running()  # unblocks what it blocked, so it goes first
        with deaf_children():
            try:
                forkserver.ensure_running()
            except ChildProcessError:  # that of the process which this one was forked from
                forkserver._forkserver.__init__()  # type: ignore[misc]  # to forget it
                forkserver.set_forkserver_preload(distinct(preload))
                forkserver.ensure_running()


@contextlib.contextmanager
def deaf_children() -> Iterator[None]:
    """Processes started inside, by threads too, end with this process, not by the Ctrl-C that reaches the group."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def same_imports() -> Iterator[None]:
    """Python processes started inside search for modules in the same places as this one, and in no others."""
    places = [str(Path(place).absolute()) for place in sys.path if isinstance(place, str)]
    known = os.pathsep.join(place for place in places if os.pathsep not in place)
    with environment({SAFE: "1", PATH: known}):
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
