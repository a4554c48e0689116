"""What dies costs itself alone: cells, workers, the pool, or the driver by kill -9; the same command goes on."""

import os
import signal
import time
from pathlib import Path

import pytest
from pebble.pool.base_pool import PoolStatus

from quadexp.log.cell_store import CellStore
from quadexp.parts.compose import expand
from quadexp.sweeps.engine import CellFailed, Workers
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.experiment.same import same_results
from tests.processes import descendants
from tests.sweeps import cells
from tests.sweeps.quick import kill, start, wait_for
from tests.sweeps.test_sweep import files

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")

GRID = ["seed=range(24)"]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    return run_sweep(
        expand(GRID), tmp_path_factory.mktemp("r") / "r", SweepRequest(function=cells.quick_cell, workers=2)
    )


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
        return _stat(pid)[0]
    except OSError:
        return "Z"


def parent(pid):
    """Of a process that there is."""
    return int(_stat(pid)[1])


def _stat(pid):
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def test_the_driver_alone(tmp_path, undisturbed):
    process = start(tmp_path, *GRID)
    wait_for(process, 6)
    children = [pid for pid, _ in descendants(process.pid)]
    assert len(children) >= 3
    kill(process)
    assert gone(children), "workers outlive their driver"
    left = len(CellStore(tmp_path / "r").done())
    assert 6 <= left <= 8
    for folder in (tmp_path / "r", tmp_path / "r/cells"):
        (folder / f".quadexp-{0:016x}.tmp").write_bytes(b"half")
    (tmp_path / "r/counts").mkdir()
    result = run_sweep(expand(GRID), tmp_path / "r", SweepRequest(function=cells.quick_cell, workers=2))
    assert result.flown == 24 - left == len(list((tmp_path / "r/counts").iterdir()))
    same_results(undisturbed, result)
    assert not [name for name in files(tmp_path / "r") if name.endswith((".tmp", ".lock"))]


@pytest.mark.parametrize("seeds", [(4,), (4, 5)], ids=["a worker", "the server it was forked from"])
def test_a_process_that_is_killed(tmp_path, undisturbed, seeds):
    """Once a sweep, while one worker or both fly a cell: with the server its workers end. Between two cells a worker
    may hold the lock of the queue, and the pool that breaks for that costs all its cells a try."""
    held, killed = cells.HeldCell(str(tmp_path), seeds), []

    def disturb(done, total):
        if done >= 4 and not killed:
            flying = held.flown_by()
            killed.append(flying[0] if len(flying) == 1 else parent(flying[0]))
            os.kill(killed[0], signal.SIGKILL)

    result = run_sweep(expand(GRID), tmp_path / "r", SweepRequest(function=held, workers=2, progress=disturb))
    assert killed and [row["cause"] for row in result.not_flown] == []
    same_results(undisturbed, result)
    assert not [name for name in files(tmp_path / "r") if name.endswith((".tmp", ".lock"))]


def run(function, jobs, **options):
    return dict(cells.run_cells(function, jobs, **options))


def test_poisoned_cells_cost_themselves_only(tmp_path):
    kinds = ["fine", "raise", "kill", "exit", "end", "loop", "kill_once", "also_fine", "still_fine"]
    results = run(cells.misbehave, {kind: (kind, str(tmp_path)) for kind in kinds}, workers=2, timeout=5.0)
    assert set(results) == set(kinds)
    for kind in ("fine", "also_fine", "still_fine", "kill_once"):
        assert results[kind] == kind
    assert results["raise"] == CellFailed("ValueError: a bad")
    assert "died (exit code -9)" in results["kill"].cause
    assert "died (exit code 3)" in results["exit"].cause
    assert "died (exit code 0)" in results["end"].cause, "waited for until the timeout"
    assert results["loop"].cause == "took longer than 5 s"
    tries = {kind: len((tmp_path / kind).read_text()) for kind in kinds}
    assert tries["raise"] == 1, "an exception would come again"
    assert tries["kill"] == tries["exit"] == tries["loop"] == 2
    assert tries["kill_once"] == 2


def test_a_pool_that_breaks_is_replaced():
    """As where the server dies while it forks a process: a thread of the pool ends, and its calls never would. Once a
    run, since it costs each call that is lost a try."""
    with Workers(2) as processes:
        for broken_after in (3, 20):
            found = {}
            for key, result in processes.run(cells.add, {str(i): (i, 1) for i in range(40)}):
                found[key] = result
                if len(found) == broken_after:
                    processes._pool._context.status = PoolStatus.ERROR
            assert found == {str(i): i + 1 for i in range(40)}
        assert processes.call(cells.add, 2, 3).result(60) == 5
