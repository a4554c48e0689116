"""The engine: a cell that dies, raises or never ends costs itself one or two attempts and nobody else anything."""

from __future__ import annotations

from pebble.pool.base_pool import PoolStatus

from quadexp.sweeps.engine import CellFailed, Workers
from tests.sweeps import cells


def run(function, jobs, **options):
    return dict(cells.run_cells(function, jobs, **options))


def test_poisoned_cells_cost_themselves_only(tmp_path):
    kinds = ["fine", "raise", "kill", "exit", "loop", "kill_once", "also_fine", "still_fine"]
    results = run(cells.misbehave, {kind: (kind, str(tmp_path)) for kind in kinds}, workers=2, timeout=5.0)
    assert set(results) == set(kinds)
    for kind in ("fine", "also_fine", "still_fine", "kill_once"):
        assert results[kind] == kind
    assert results["raise"] == CellFailed("ValueError: a bad")
    assert "died (exit code -9)" in results["kill"].cause
    assert "died (exit code 3)" in results["exit"].cause
    assert results["loop"].cause == "took longer than 5 s"
    tries = {kind: len((tmp_path / kind).read_text()) for kind in kinds}
    assert tries["raise"] == 1, "an exception would come again"
    assert tries["kill"] == tries["exit"] == tries["loop"] == 2
    assert tries["kill_once"] == 2


def test_a_pool_that_breaks_is_replaced():
    """As where the server dies while it forks a process: a thread of the pool ends, and its calls never would."""
    with Workers(2) as processes:
        found = {}
        for key, result in processes.run(cells.add, {str(i): (i, 1) for i in range(40)}):
            found[key] = result
            if len(found) in (3, 20):
                processes._pool._context.status = PoolStatus.ERROR
        assert found == {str(i): i + 1 for i in range(40)}
        assert processes.call(cells.add, 2, 3).result(60) == 5
