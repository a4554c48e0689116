"""The Dask engine: submits cells, receives their rows and files, and writes the files.

A bounded number of cells is submitted at any time, and every future is released as soon as its result has arrived, so
that driver and scheduler need little memory and no finished cell is lost with a worker.
"""

from __future__ import annotations

import hashlib
import queue
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from distributed import Client, Future

from quadexp.errors import QuadexpError
from quadexp.experiment.build import input_files, source_hashes
from quadexp.experiment.checkpoints import MODEL_FILE
from quadexp.files.writer import written
from quadexp.provenance import identity
from quadexp.sweeps.cluster.worker import CellRunner, InputFile, run_cell
from quadexp.sweeps.engine import CellFailed, Task

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
