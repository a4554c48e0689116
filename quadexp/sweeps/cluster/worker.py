"""What runs in a Dask worker: every cell in a child process, so that a crash or an endless loop ends only that cell."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from distributed import WorkerPlugin, get_worker

from quadexp.errors import QuadexpError
from quadexp.experiment.build import source_hashes
from quadexp.experiment.inputs import use_copies
from quadexp.parts.plugins import own_folders
from quadexp.provenance import identity
from quadexp.sweeps.engine import CellFailed, Task, Workers

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
