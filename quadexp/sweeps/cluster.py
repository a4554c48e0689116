"""Sweeps on several machines with Dask (extra `cluster`): how clusters are started, the worker, the driver.

A worker needs no access to the driver's file system: checkpoints and trajectory files are sent to it once, and the file
of a cell is sent back with its row and is written by the driver alone. With a single writer on one file system it is
simple to write a file completely or not at all, and a worker may run on any machine that has this program.

What is started here talks over TLS with a certificate made for it, which never appears on a command line: processes of
this machine receive it through their pipes, jobs in files that only the user may read.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import multiprocessing
import os
import queue
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import dask
from distributed import Client, Future, LocalCluster, WorkerPlugin, get_worker
from distributed.security import Security

from quadexp.cache import cache_folder
from quadexp.errors import QuadexpError, UsageError
from quadexp.experiment.build import input_files, source_hashes
from quadexp.experiment.checkpoints import MODEL_FILE
from quadexp.experiment.inputs import use_copies
from quadexp.parts.part import own_folders
from quadexp.provenance import identity
from quadexp.sweeps.engine import CellFailed, Task, Workers
from quadexp.sweeps.engine_settings import CERTIFICATES, DaskConfig, JobsConfig
from quadexp.sweeps.server import SAFE, THREADS, safe_path
from quadexp.writer import written

# The web server of a scheduler and of a worker, which Dask starts with or without a dashboard.
LOOPBACK = "127.0.0.1:0"
CONNECT = 20.0  # s to wait for a scheduler
SYSTEMS = {"slurm": "SLURMCluster", "pbs": "PBSCluster", "lsf": "LSFCluster", "sge": "SGECluster"}
ENVIRONMENT = {"DASK_DISTRIBUTED__WORKER__DAEMON": "False", SAFE: "1", **dict.fromkeys(THREADS, "1")}
# Cells run in children with a memory limit of their own; the worker must neither pause nor end because of their memory.
SETTINGS = {
    "distributed.worker.daemon": False,
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
    "distributed.nanny.pre-spawn-environ": dict.fromkeys((SAFE, *THREADS), "1"),
}


@contextlib.contextmanager
def open_cluster(config: DaskConfig | JobsConfig, workers: int) -> Iterator[Client]:
    """A client of the configured cluster; everything that was started for it ends with the context.

    workers: number of processes to start. Raises UsageError for a wrong configuration, QuadexpError where the cluster
    cannot be reached.
    """
    if not os.environ.get("QUADEXP_DEBUG"):
        for name in ("distributed", "dask_jobqueue"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    connect = {"distributed.comm.timeouts.connect": f"{CONNECT:g}s"}
    address = getattr(config, "address", None)
    with contextlib.ExitStack() as stack:
        stack.enter_context(safe_path())
        stack.enter_context(dask.config.set({**SETTINGS, **connect}))
        try:
            security = _certificates(config) if address else Security.temporary()
            cluster = address or stack.enter_context(_started(config, workers, security))
            client = Client(cluster, security=security, timeout=CONNECT, set_as_default=False)
        except QuadexpError:
            raise
        except Exception as error:
            where = f"engine.address={address}" if address else f"engine={config.name}"
            said = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
            raise QuadexpError(f"{where} cannot be had: {said[-1]}") from error
        stack.enter_context(client)
        yield client


def _certificates(config: Any) -> Security | None:
    """The certificates of a scheduler that somebody else started; None where it is not encrypted, which is said.

    Raises UsageError for a missing file, or a key that others may read.
    """
    files = {name: getattr(config, name) for name in CERTIFICATES}
    if None in files.values():
        said = "is not encrypted. Anybody who can reach the scheduler or a worker can run code as you"
        print(f"warning: engine.address={config.address}: {said}", file=sys.stderr, flush=True)
        return None
    for name, file in files.items():
        if not Path(file).is_file():
            raise UsageError(f"engine.{name}={file}: no such file")
    if Path(files["tls_key"]).stat().st_mode & 0o077:
        raise UsageError(f"engine.tls_key={config.tls_key}: others may read or change it: chmod go= it")
    own = {"tls_client_cert": files["tls_cert"], "tls_client_key": files["tls_key"]}
    return Security(tls_ca_file=files["tls_ca"], require_encryption=True, **own)


def _started(config: DaskConfig | JobsConfig, workers: int, security: Security | None) -> Any:
    """A cluster of this machine, or of jobs, as a context."""
    if isinstance(config, JobsConfig):
        return _of_jobs(config, workers, security)
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
def _of_jobs(config: JobsConfig, workers: int, security: Security | None) -> Iterator[Any]:
    """Jobs of one worker each. Raises what the queue says where it refuses one."""
    import dask_jobqueue

    usual = {"memory": "2GB", "walltime": "01:00:00", "python": shlex.quote(sys.executable)}
    options = {**usual, "shared_temp_directory": str(cache_folder().path), **config.options}
    folder = Path(options["shared_temp_directory"])
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if folder.stat().st_uid != os.getuid() or folder.stat().st_mode & 0o022:
        raise UsageError(
            f"engine={config.name}: others may write to {folder}, where certificates lie: give another folder that all"
            " nodes see, as engine.options={shared_temp_directory: FOLDER}"
        )
    exported = [f"export {name}={value}" for name, value in ENVIRONMENT.items()]
    options["job_script_prologue"] = [*exported, *options.get("job_script_prologue", ())]
    fixed = {
        "cores": 1,
        "processes": 1,
        "worker_extra_args": ["--memory-limit", "0", "--no-dashboard", "--dashboard-address", LOOPBACK],
        "security": security,
        "protocol": "tls://",
        "scheduler_options": {"dashboard": False, "dashboard_address": LOOPBACK},
        "silence_logs": "critical",
    }
    if taken := sorted(fixed.keys() & options.keys()):
        raise UsageError(f"engine.options={{{taken[0]}: ...}}: is set by this program; leave it out")
    cluster = getattr(dask_jobqueue, SYSTEMS[config.system])(**options, **fixed)
    try:
        for _ in range(workers):
            cluster.worker_spec.update(cluster.new_worker_spec())
        cluster.sync(cluster._correct_state)  # `scale` would only log that the queue refuses a job
        yield cluster
    finally:
        with suppress(AssertionError):  # of jobs that never were
            cluster.close()


# ------------------------------------------------------------------------------------------------------------- worker
FOLDER = "quadexp-"  # prefix of the names of a worker's temporary folders


class CellRunner(WorkerPlugin):
    """The child processes of a worker, as many as it has threads, and a folder for the files of their cells.

    timeout: s a cell may take. memory: limit of a child in GB. expected: versions and hash of the sources that a worker
    must have, because results must not depend on the worker.
    """

    def __init__(self, name: str, timeout: float | None, memory: float | None, expected: Mapping[str, str]) -> None:
        self.name, self._timeout, self._memory, self._expected = name, timeout, memory, dict(expected)
        self._folders = own_folders()  # of the driver; a worker imports no other modules under `_target_`

    def setup(self, worker: Any) -> None:
        other = {name: there for name, there in identity().items() if self._expected.get(name, there) != there}
        if other:
            name, there = next(iter(other.items()))
            raise RuntimeError(f"this worker has {name} {there}, the driver {self._expected[name]}")
        if multiprocessing.current_process().daemon:
            raise RuntimeError(
                "this worker may not have children: start it with DASK_DISTRIBUTED__WORKER__DAEMON=False in its"
                " environment, or with --no-nanny"
            )
        threads = worker.state.nthreads
        self._folder = tempfile.mkdtemp(prefix=FOLDER, dir=worker.local_directory)
        self._processes = Workers(threads, self._memory, calls=threads, folders=self._folders)

    def teardown(self, worker: Any) -> None:
        """End the cells that still fly: of a sweep whose driver was killed. Their threads must not wait for ever."""
        self._processes.end()
        shutil.rmtree(self._folder, ignore_errors=True)

    def fly(self, function: Callable[..., Any], task: Task, copies: Mapping[str, str], parts: Mapping[str, str]) -> Any:
        """(row, content of the cell's file), or CellFailed."""
        arguments = (function, task.config, task.model, task.key, self._folder, copies, parts)
        try:
            return self._processes.result(child_cell, *arguments, timeout=self._timeout)
        except Exception as error:
            return CellFailed.of(error, self._timeout)


class InputFile(WorkerPlugin):
    """A file that flights read, copied to every worker, also to those that join later.

    name: of the plugin, from the hash of the content. file: name of the copy.
    """

    def __init__(self, name: str, file: str, content: bytes) -> None:
        self.name, self._file, self._content = name, file, content

    def setup(self, worker: Any) -> None:
        self.folder = tempfile.mkdtemp(prefix=FOLDER, dir=worker.local_directory)
        self.path = str(Path(self.folder) / self._file)
        Path(self.path).write_bytes(self._content)

    def teardown(self, worker: Any) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


def run_cell(
    runner: str,
    function: Callable[..., Any],
    task: Task,
    inputs: Mapping[str, tuple[str, bool]],
    parts: Mapping[str, str],
) -> Any:
    """A Dask task: fly one cell in a child of this worker.

    inputs: path as configured -> name of the InputFile, and whether the path means its folder. parts: hashes of the
    driver's sources of what the user wrote, see build_custom.source_hashes.
    """
    plugins: Any = get_worker().plugins
    copies = {
        path: plugins[name].folder if is_folder else plugins[name].path for path, (name, is_folder) in inputs.items()
    }
    return plugins[runner].fly(function, task, copies, parts)


def child_cell(
    function: Callable[..., Any],
    config: Any,
    model: Any,
    key: str,
    folder: str,
    copies: Mapping[str, str],
    parts: Mapping[str, str],
) -> Any:
    """In the child process: fly; returns the row and the content of the file (None if there is no file)."""
    use_copies(copies)
    for name, found in source_hashes(config).items():
        if found != parts.get(name):
            raise QuadexpError(f"{name}: this worker has another one than the driver")
    path = Path(folder) / f"{key}.{os.getpid()}.parquet"
    try:
        row = function(config, model, str(path), key)
        return row, path.read_bytes() if path.is_file() else None
    finally:
        path.unlink(missing_ok=True)


# ------------------------------------------------------------------------------------------------------------- driver
QUEUED = 3  # cells submitted per thread of the cluster
LOSSES = 4  # times that the worker of a cell may be lost before the cell is taken for the cause
GONE = "the scheduler is gone: run the same command to continue"
CHECKED = 1.0  # s between checks of the cluster
PREFIX = "quadexp/"  # of the names of everything that a sweep keeps on workers; followed by the client's name


@dataclass
class DaskEngine:
    """A cluster, opened when the first cell is flown. open: a context with its client.

    timeout: s a cell may take. memory: limit of its process in GB. wait: s to wait while there is no worker.
    """

    open: Callable[[], AbstractContextManager[Client]]
    timeout: float | None = None
    memory: float | None = None
    wait: float = 60.0

    def fly(self, function: Callable[..., Any], tasks: Iterable[Task]) -> Generator[tuple[str, Any]]:
        """See engine.Engine."""
        with self.open() as client:
            try:
                yield from _Flights(client, self, function).run(tasks)
            except OSError as error:  # of the connection: errors of files are WriteErrors
                raise QuadexpError(GONE) from error


@dataclass
class _Flights:
    """The cells that are submitted."""

    client: Client
    engine: DaskEngine
    function: Callable[..., Any]
    running: dict[str, tuple[Task, Future[Any], int]] = field(default_factory=dict)
    shipped: dict[str, str] = field(default_factory=dict)
    landed: queue.SimpleQueue[Any] = field(default_factory=queue.SimpleQueue)

    @property
    def prefix(self) -> str:
        """Of the names of what this sweep keeps on the workers; several sweeps may share a cluster."""
        return f"{PREFIX}{self.client.id}/"

    @property
    def runner(self) -> str:
        return f"{self.prefix}cells"

    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[str, Any]]:
        plugin = CellRunner(self.runner, self.engine.timeout, self.engine.memory, identity())
        self._await_workers(time.monotonic())
        self._remove_abandoned()
        self._register(plugin)
        waiting = iter(tasks)
        try:
            threads, looked, alive = self._threads(), time.monotonic(), time.monotonic()
            more = True
            while True:
                while more and len(self.running) < QUEUED * max(threads, 1):
                    task = next(waiting, None)
                    more = task is not None
                    if task is not None:
                        self._submit(task, LOSSES)
                if not self.running:
                    return
                yield from self._land(CHECKED)
                if time.monotonic() - looked > CHECKED:
                    threads, looked = self._threads(), time.monotonic()
                    alive = looked if threads else alive
                    if not threads:
                        self._await_workers(alive)
        finally:
            self._leave()

    def _submit(self, task: Task, losses: int) -> None:
        inputs = self._ship(task)
        name = f"{self.prefix}{task.key}-{losses}"
        given = self.runner, self.function, task, inputs, source_hashes(task.config)
        future = self.client.submit(run_cell, *given, key=name, pure=False)
        self.running[name] = task, future, losses
        future.add_done_callback(self.landed.put)

    def _land(self, seconds: float) -> Iterator[tuple[str, Any]]:
        """Wait for a result; yield (key, row or CellFailed) of all that have arrived."""
        futures = []
        with suppress(queue.Empty):
            futures.append(self.landed.get(timeout=seconds))
            while True:
                futures.append(self.landed.get_nowait())
        good = [future for future in futures if future.status == "finished"]
        results = dict(zip([f.key for f in good], self.client.gather(good, errors="skip"), strict=False))
        if len(results) < len(good):  # a worker died before its result was fetched
            results = {}
            for future in good:
                with suppress(Exception):
                    results[future.key] = future.result(timeout=10)
        for future in futures:
            task, _, losses = self.running.pop(future.key)
            if future.key in results:
                yield task.key, self._settle(task, results[future.key])
            elif losses > 1:
                self._check_connection()
                self._submit(task, losses - 1)
            else:
                yield task.key, CellFailed("every worker that flew it was lost")
            future.release()

    def _settle(self, task: Task, result: Any) -> Any:
        if isinstance(result, CellFailed):
            return result
        row, content = result
        if content is not None:
            with written(task.path) as file:
                file.write(content)
        return row

    def _ship(self, task: Task) -> dict[str, tuple[str, bool]]:
        """Send every worker the files that the task reads; path as configured -> (plugin's name, whether a folder)."""
        inputs = {}
        for model in task.model.files if task.model is not None else ():
            inputs[model.path] = self._shipped(Path(model.path) / MODEL_FILE, model.sha256), True
        truth = getattr(task.config.plant, "model", None)
        if truth is not None:
            inputs[truth] = self._shipped(Path(truth) / MODEL_FILE), True
        for path in input_files(task.config).values():
            inputs[path] = self._shipped(Path(path)), False
        return inputs

    def _shipped(self, path: Path, sha256: str = "") -> str:
        where = f"{path} {sha256}"
        if where not in self.shipped:
            content = path.read_bytes()
            found = hashlib.sha256(content).hexdigest()
            if sha256 and found != sha256:
                raise QuadexpError(f"{path}: has changed since this run began")
            name = f"{self.prefix}{found[:20]}"
            if name not in self.shipped.values():
                self._register(InputFile(name, path.name, content))
            self.shipped[where] = name
        return self.shipped[where]

    def _register(self, plugin: Any) -> None:
        try:
            self.client.register_plugin(plugin)
        except Exception as error:
            raise QuadexpError(f"the cluster cannot fly this: {str(error).splitlines()[0]}") from error

    def _remove_abandoned(self) -> None:
        """Remove from the workers the plugins of sweeps whose driver was killed."""
        with suppress(Exception):  # no flight depends on it
            for name in self.client.run_on_scheduler(abandoned):
                self.client.unregister_worker_plugin(name)

    def _threads(self) -> int:
        with suppress(Exception):
            return sum(self.client.nthreads().values())
        self._check_connection()
        return 0

    def _await_workers(self, since: float) -> None:
        """Wait for a worker until `wait` seconds after `since`; raises QuadexpError where none comes."""
        while not self._threads():
            if time.monotonic() - since > self.engine.wait:
                raise QuadexpError(
                    f"no worker for {self.engine.wait:g} s (engine.wait): run the same command to continue"
                )
            time.sleep(min(0.2, self.engine.wait / 10))

    def _check_connection(self) -> None:
        if self.client.status != "running":
            raise QuadexpError(GONE)

    def _leave(self) -> None:
        """Cancel the cells that were not flown and remove this sweep's plugins."""
        if self.client.status != "running":
            return
        with suppress(Exception):
            if self.running:
                self.client.cancel([future for _, future, _ in self.running.values()], force=True)
            for name in {self.runner, *self.shipped.values()}:
                self.client.unregister_worker_plugin(name)


def abandoned(dask_scheduler: Any) -> list[str]:
    """Run on the scheduler: names of the plugins whose client is gone."""
    ours = [name for name in dask_scheduler.worker_plugins if name.startswith(PREFIX)]
    return [name for name in ours if name.removeprefix(PREFIX).partition("/")[0] not in dask_scheduler.clients]
