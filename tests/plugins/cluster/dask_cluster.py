"""A real Dask cluster for tests: scheduler, nannies and workers as processes of their own, on the loopback."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from tests.processes import descendants

ROOT = Path(__file__).resolve().parents[3]
ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": str(ROOT),
    "DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "error",
    "OMP_NUM_THREADS": "1",
}


class Cluster:
    """address: of the scheduler. workers: their nannies, each of which keeps one worker process alive.
    certificate: files by the names tls_ca, tls_cert, tls_key; None for a cluster without any."""

    def __init__(self, folder: Path, workers: int = 2, certificate: Mapping[str, Path] | None = None) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._file = folder, folder / "scheduler.json"
        self._started: list[subprocess.Popen] = []
        names = {"tls_ca": "--tls-ca-file", "tls_cert": "--tls-cert", "tls_key": "--tls-key"}
        self._tls = [word for name, path in (certificate or {}).items() for word in (names[name], str(path))]
        scheduler = ["dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", *self._tls]
        self.scheduler = self._start(*scheduler, "--scheduler-file", str(self._file))
        deadline = time.monotonic() + 300
        while not (self._file.exists() and self._file.read_text().rstrip().endswith("}")):  # written in pieces
            assert time.monotonic() < deadline and self.scheduler.poll() is None, "the scheduler does not start"
            time.sleep(0.05)
        self.address = json.loads(self._file.read_text())["address"]
        self.workers = [self.add_worker() for _ in range(workers)]

    def add_worker(self, *options: str, **environment: str) -> subprocess.Popen:
        """Start a worker of one thread; its files lie in a folder of its own."""
        usual = ["--host", "127.0.0.1", "--nthreads", "1", "--memory-limit", "0", "--no-dashboard"]
        return self._start("dask_worker", self.address, *usual, *self._tls, *options, **environment)

    def workers_of(self, nanny: subprocess.Popen) -> list[int]:
        """Process ids of the workers that a nanny keeps."""
        return [pid for pid, command in descendants(nanny.pid) if "multiprocessing.spawn" in command]

    def stop(self) -> None:
        """Workers are in the process groups of their nannies; a word of farewell would take each of them seconds."""
        for process in self._started:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def _start(self, program: str, *arguments: str, **environment: str) -> subprocess.Popen:
        process = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{program}", *arguments],
            cwd=self._folder,
            env={**ENVIRONMENT, **environment},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        self._started.append(process)
        return process
