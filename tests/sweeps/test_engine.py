"""The engine: a cell that dies, raises or never ends costs itself one or two attempts and nobody else anything."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from pebble.pool.base_pool import PoolStatus

from quadexp.sweeps.engine import CellFailed, Workers
from tests.sweeps import cells

ROOT = Path(__file__).resolve().parents[2]


def run(function, jobs, **options):
    return dict(cells.run_cells(function, jobs, **options))


def test_every_job_has_its_result():
    assert run(cells.add, {f"{i}": (i, 1) for i in range(30)}, workers=2) == {f"{i}": i + 1 for i in range(30)}


def test_workers_use_one_thread_and_the_environment_is_left_alone(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    assert run(cells.threads, {"a": (0,)}, workers=1)["a"] == ("1", "1")
    assert os.environ["OMP_NUM_THREADS"] == "7" and "OPENBLAS_NUM_THREADS" not in os.environ


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


def test_leaving_early_stops_the_workers():
    results = cells.run_cells(cells.add, {f"{i}": (i, 1) for i in range(200)}, workers=2)
    next(results)
    results.close()


CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>

/* The wall clock, QUADEXP_TEST_RATE times as fast as the monotonic one. */
static int (*real)(clockid_t, struct timespec *);
static double begun, wall;

static double seconds(clockid_t clock) {
    struct timespec now;
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    real(clock, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

int clock_gettime(clockid_t clock, struct timespec *now) {
    if (!begun) { begun = seconds(CLOCK_MONOTONIC); wall = seconds(CLOCK_REALTIME); }
    if (clock != CLOCK_REALTIME) return real(clock, now);
    double t = wall + atof(getenv("QUADEXP_TEST_RATE")) * (seconds(CLOCK_MONOTONIC) - begun);
    now->tv_sec = (time_t)t;
    now->tv_nsec = (long)(1e9 * (t - (double)now->tv_sec));
    return 0;
}
"""
DRIVER = """
import sys, time
from tests.sweeps import cells

if __name__ == "__main__":
    begun, there = time.time(), time.monotonic()
    jobs = {kind: (kind, sys.argv[1]) for kind in ("nap", "loop")}
    for key, result in cells.run_cells(cells.misbehave, jobs, workers=2, timeout=5.0):
        print(key, getattr(result, "cause", result), sep=": ")
    print((time.time() - begun) / (time.monotonic() - there))
"""


@pytest.fixture(scope="module")
def wall_clock(tmp_path_factory):
    """A library that lets the wall clock of a process run at another rate, backwards too."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("needs Linux and a C compiler")
    folder = tmp_path_factory.mktemp("clock")
    (folder / "clock.c").write_text(CLOCK)
    subprocess.run([compiler, "-shared", "-fPIC", "-o", folder / "clock.so", folder / "clock.c", "-ldl"], check=True)
    return folder / "clock.so"


def test_time_limits_do_not_follow_the_wall_clock(wall_clock, tmp_path):
    """Days pass by the wall clock, as over a suspended night, or it is set back: a call that is in time comes to its
    end, and one that never ends is stopped."""
    (tmp_path / "driver.py").write_text(DRIVER)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "LD_PRELOAD": str(wall_clock)}
    drivers = {}
    for rate in (100_000.0, -100_000.0):  # both at once: they wait most of the time
        folder = tmp_path / f"{rate}"
        folder.mkdir()
        drivers[rate] = subprocess.Popen(
            [sys.executable, tmp_path / "driver.py", folder], env=environment | {"QUADEXP_TEST_RATE": f"{rate}"},
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
    for rate, driver in drivers.items():
        out, error = driver.communicate(timeout=900)
        lines = out.splitlines()
        assert sorted(lines[:2]) == ["loop: took longer than 5 s", "nap: nap"], error
        assert float(lines[2]) == pytest.approx(rate, rel=0.01), "the clock was not shifted, so nothing was shown"
        assert (tmp_path / f"{rate}" / "nap").read_text() == "x", "the call in time was tried twice"


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
