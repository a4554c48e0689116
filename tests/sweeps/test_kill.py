"""kill -9 of a driver or of its workers: the same command again ends as if nothing had been, to the last bit."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from quadexp.log.cell_store import CellStore
from quadexp.parts.compose import expand
from quadexp.sweeps.sweep import run_sweep
from tests.experiment.same import same_results
from tests.sweeps import cells
from tests.sweeps.dask_cluster import descendants
from tests.sweeps.driver import kill, start, wait_for
from tests.sweeps.test_sweep import files

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")

GRID = ["seed=range(24)"]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    return run_sweep(expand(GRID), tmp_path_factory.mktemp("r") / "r", function=cells.quick_cell, workers=2)


def gone(pids):
    deadline = time.time() + 300
    while time.time() < deadline:
        alive = [pid for pid in pids if Path(f"/proc/{pid}").exists() and _state(pid) != "Z"]
        if not alive:
            return True
        time.sleep(0.05)
    return False


def _state(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


def test_the_driver_alone(tmp_path, undisturbed):
    process = start(tmp_path, *GRID)
    wait_for(process, 6)
    children = [pid for pid, _ in descendants(process.pid)]
    assert len(children) >= 3
    kill(process)
    assert gone(children), "workers outlive their driver"
    left = len(CellStore(tmp_path / "r").done())
    assert 6 <= left < 24
    (tmp_path / "r/counts").mkdir()
    result = run_sweep(expand(GRID), tmp_path / "r", function=cells.quick_cell, workers=2)
    assert result.flown == 24 - left == len(list((tmp_path / "r/counts").iterdir()))
    same_results(undisturbed, result)
    assert not [name for name in files(tmp_path) if name.endswith((".tmp", ".lock"))]


def test_a_worker_and_the_server_it_was_forked_from(tmp_path, undisturbed):
    killed = []

    def disturb(done, total):
        if done in (4, 9) and done not in killed:
            killed.append(done)
            workers = [pid for pid, command in descendants(os.getpid()) if "forkserver" in command]
            os.kill(workers[0 if done == 9 else -1], signal.SIGKILL)

    result = run_sweep(expand(GRID), tmp_path / "r", function=cells.slow_cell, workers=2, progress=disturb)
    assert killed == [4, 9] and [row["cause"] for row in result.not_flown] == []
    same_results(undisturbed, result)
    assert not [name for name in files(tmp_path) if name.endswith((".tmp", ".lock"))]
