"""Sweeps on several machines with Dask (extra `cluster`): how a cluster is started, the worker, the driver.

What a flight reads (a checkpoint, a file of wind, the user's own parts) lies in a folder that all machines share, and
is compared by its hash. The file of a cell is sent back with its row and is written by the driver alone: with a single
writer it is simple to write a file completely or not at all.

What is started here talks over TLS with a certificate made for it, which never appears on a command line: processes of
this machine receive it through their pipes, jobs in files that only the user may read.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import shlex
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, as_completed, get_worker
from distributed.security import Security

from quadexp.cache import cache_folder
from quadexp.compile.signals import undisturbed
from quadexp.errors import QuadexpError
from quadexp.parts.user_modules import own_folders
from quadexp.provenance import identity
from quadexp.sweeps.engine import CellFailed, CellFunction, Task, Workers, fly_as_planned
from quadexp.sweeps.server import SAFE, THREADS, deaf_children, environment
from quadexp.writer import written

# The web server of a scheduler and of a worker, which Dask starts with or without a dashboard.
LOOPBACK = "127.0.0.1:0"
CONNECT = 20.0  # s to wait for a scheduler
SYSTEMS = {"slurm": "SLURMCluster", "pbs": "PBSCluster", "lsf": "LSFCluster", "sge": "SGECluster"}
ENVIRONMENT = dict.fromkeys((SAFE, *THREADS), "1")
# Cells run in children with a memory limit of their own; the worker must neither pause nor end because of their memory.
NO_LIMITS = {f"distributed.worker.memory.{what}": False for what in ("target", "spill", "pause", "terminate")}
SETTINGS = {**NO_LIMITS, "distributed.nanny.pre-spawn-environ": ENVIRONMENT}


@contextlib.contextmanager
def open_cluster(config: Any, workers: int) -> Iterator[Client]:
    """A client of the configured cluster; everything that was started for it ends with the context.

    workers: number of processes to start. Raises QuadexpError where the cluster cannot be reached.
    """
    if not os.environ.get("QUADEXP_DEBUG"):
        for name in ("distributed", "dask_jobqueue", "asyncio", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    address = getattr(config, "address", None)
    if address and not address.startswith("tls://"):
        said = "is not encrypted. Anybody who can reach the scheduler or a worker can run code as you"
        print(f"warning: engine.address={address}: {said}", file=sys.stderr, flush=True)
    with contextlib.ExitStack() as stack:
        stack.enter_context(environment({SAFE: "1"}))
        stack.enter_context(dask.config.set({**SETTINGS, "distributed.comm.timeouts.connect": f"{CONNECT:g}s"}))
        try:
            security = Security() if address else Security.temporary()  # the former as Dask's settings say
            start: Any = _of_jobs if config.kind == "jobs" else _of_this_machine
            with undisturbed(), deaf_children():  # a cluster that is interrupted while it starts prints tracebacks
                cluster = address or stack.enter_context(start(config, workers, security))
            client = Client(cluster, security=security, timeout=CONNECT, set_as_default=False)
        except QuadexpError:
            raise
        except Exception as error:
            where = f"engine.address={address}" if address else f"engine={config.name}"
            lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
            raise QuadexpError(f"{where} is not found: {lines[-1]}") from error
        stack.enter_context(client)
        yield client


def _of_this_machine(config: Any, workers: int, security: Security) -> Any:
    return LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        host="127.0.0.1",
        protocol="tls://",
        security=security,
        dashboard_address=LOOPBACK,
        memory_limit=0,
        silence_logs=logging.CRITICAL,
    )


@contextlib.contextmanager
def _of_jobs(config: Any, workers: int, security: Security) -> Iterator[Any]:
    """Jobs of one worker each. Raises what the queue says where it refuses one."""
    import dask_jobqueue

    usual = {"memory": "2GB", "walltime": "01:00:00", "python": shlex.quote(sys.executable)}
    options = {**usual, "shared_temp_directory": str(cache_folder()), **config.options}
    exported = [f"export {name}={value}" for name, value in ENVIRONMENT.items()]
    options["job_script_prologue"] = [*exported, *options.get("job_script_prologue", ())]
    Path(options["shared_temp_directory"]).mkdir(mode=0o700, parents=True, exist_ok=True)
    cluster = getattr(dask_jobqueue, SYSTEMS[config.system])(
        **options,
        cores=1,
        processes=1,
        worker_extra_args=["--memory-limit", "0", "--no-dashboard", "--dashboard-address", LOOPBACK],
        security=security,
        protocol="tls://",
        scheduler_options={"dashboard": False, "dashboard_address": LOOPBACK},
        silence_logs="critical",
    )
    try:
        for _ in range(workers):
            cluster.worker_spec.update(cluster.new_worker_spec())
        cluster.sync(cluster._correct_state)  # `scale` would only log that the queue refuses a job
        yield cluster
    finally:
        with suppress(AssertionError):  # of jobs that never were
            cluster.close()


# ------------------------------------------------------------------------------------------------------------- worker
@dataclass(frozen=True)
class Sweep:
    """What a worker is given a sweep. timeout: s a cell may take. memory: limit of its process in GB. expected:
    versions and hash of the sources that a worker must have. folders: of the user's own modules. directory: of the
    driver.
    """

    timeout: float | None
    memory: float | None
    expected: Mapping[str, str]
    folders: tuple[str, ...]
    directory: str


_own = threading.local()  # what a thread of a worker flies in: (memory, folders), and processes for these


def run_cell(sweep: Sweep, function: CellFunction, key: str, packed: bytes) -> Any:
    """A Dask task: fly one cell in a child of this worker; (row, content of its file), or CellFailed.

    packed: the task. Raises RuntimeError on a worker with other sources.
    """
    here = identity()
    for name, expected in sweep.expected.items():
        if here.get(name) != expected:
            raise RuntimeError(f"this worker has {name} {here.get(name)}, the driver {expected}")
    if getattr(_own, "limits", None) != (sweep.memory, sweep.folders):
        if hasattr(_own, "processes"):
            _own.processes.stop()
        _own.processes = Workers(1, sweep.memory, folders=sweep.folders)
        _own.limits = sweep.memory, sweep.folders
    arguments = function, packed, sweep.directory, get_worker().local_directory
    ((_, ended),) = _own.processes.run(child_cell, {key: arguments}, timeout=sweep.timeout)
    return ended


def child_cell(
    function: CellFunction, packed: bytes, directory: str, scratch: str
) -> tuple[dict[str, Any], bytes | None]:
    """In the child process: fly; returns the row and the content of the file (None if there is no file)."""
    with suppress(OSError):  # there may be nothing to read there
        os.chdir(directory)
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        path = Path(folder) / "cell.parquet"
        row = fly_as_planned(function, packed, path)
        return row, path.read_bytes() if path.is_file() else None


# ------------------------------------------------------------------------------------------------------------- driver
QUEUED = 3  # cells submitted per thread of the cluster
GONE = "the scheduler is gone: run the same command to continue"
CHECKED = 1.0  # s between checks of the cluster
LOOKED = 0.02  # s between looks at what has come back


@dataclass
class DaskEngine:
    """A cluster, opened when the first cell is flown. open: a context with its client.

    timeout: s a cell may take. memory: limit of its process in GB. wait: s to wait while there is no worker.
    """

    open: Callable[[], AbstractContextManager[Client]]
    timeout: float | None = None
    memory: float | None = None
    wait: float = 60.0

    def fly(self, function: CellFunction, tasks: Iterable[Task]) -> Generator[tuple[str, Any]]:
        """See engine.Engine. A cell whose worker is lost is flown by another, as often as Dask allows (four times)."""
        with self.open() as client:
            try:
                yield from self._fly(client, function, iter(tasks))
            except OSError as error:  # of the connection: errors of files are WriteErrors
                raise QuadexpError(GONE) from error

    def _fly(self, client: Client, function: CellFunction, tasks: Iterator[Task]) -> Iterator[tuple[str, Any]]:
        sweep = Sweep(self.timeout, self.memory, identity(), own_folders(), os.getcwd())
        completed = as_completed(with_results=True, raise_errors=False, loop=client.loop)
        submitted: dict[Future[Any], Task] = {}
        threads = _threads(client)
        looked = time.monotonic()
        alive = looked  # when there was a worker
        try:
            while True:
                while len(submitted) < QUEUED * max(threads, 1) and (task := next(tasks, None)):
                    arguments = sweep, function, task.key, pickle.dumps(task)
                    future = client.submit(run_cell, *arguments, key=f"{client.id}/{task.key}", pure=False)
                    submitted[future] = task
                    completed.add(future)
                if not submitted:
                    return
                for future, result in completed.next_batch(block=False):
                    task = submitted.pop(future)
                    yield task.key, _settled(task, future, result)
                if not completed.has_ready():
                    time.sleep(LOOKED)
                if (now := time.monotonic()) - looked > CHECKED:
                    threads = _threads(client)
                    looked = now
                    alive = now if threads else alive
                    if now - alive > self.wait:
                        why = f"no worker for {self.wait:g} s (engine.wait)"
                        raise QuadexpError(f"{why}: run the same command to continue")
        finally:
            with suppress(Exception):
                client.cancel([*submitted], force=True)


def _settled(task: Task, future: Future[Any], result: Any) -> Any:
    """The row of a cell that has come back, whose file is written, or CellFailed."""
    if future.status == "error":
        _, error, _ = result
        if isinstance(error, KilledWorker):
            return CellFailed("every worker that flew it was lost")
        raise QuadexpError(f"the cluster cannot fly this: {str(error).splitlines()[0]}") from error
    if future.status != "finished":
        raise QuadexpError(GONE)
    if isinstance(result, CellFailed):
        return result
    row, content = result
    if content is not None:
        with written(task.path, durable=False) as file:
            file.write(content)
    return row


def _threads(client: Client) -> int:
    """Of all workers; raises QuadexpError where there is no scheduler."""
    threads = 0
    with suppress(Exception):
        threads = sum(client.nthreads().values())
    if client.status != "running":
        raise QuadexpError(GONE)
    return threads
