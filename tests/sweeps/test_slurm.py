"""A sweep in jobs of a real Slurm; a check by hand: QUADEXP_SLURM=1 python -m pytest tests/sweeps/test_slurm.py"""

from __future__ import annotations

import os
import signal
import sys

import pytest

pytest.importorskip("dask_jobqueue", reason="the extra `cluster` is not installed")
if not os.environ.get("QUADEXP_SLURM"):
    pytest.skip("a check by hand: set QUADEXP_SLURM=1", allow_module_level=True)

from quadexp.config.compose import compose, expand
from quadexp.errors import QuadexpError
from quadexp.sweeps.cluster.engines import build_engine
from quadexp.sweeps.sweep import run_sweep
from tests.experiment.same import same_results
from tests.sweeps import cells
from tests.sweeps.dask_cluster import ROOT, descendants
from tests.sweeps.slurm import Slurm, missing

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing() or "there is a Slurm")

INTERPRETED = ["controller.backend=interpreted", "plant.backend=interpreted"]
SHORT = ["trajectory=step", "trajectory.duration=0.4", "trajectory.step_time=0.2", *INTERPRETED]


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    slurm = Slurm(tmp_path_factory.mktemp("slurm"))
    yield slurm
    slurm.stop()


@pytest.fixture
def engine(slurm, monkeypatch, tmp_path):
    for name in ("SLURM_CONF", "PATH"):
        monkeypatch.setenv(name, f"{slurm.environment[name]}")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.chdir(tmp_path)

    def build(*overrides):
        options = [f"engine.shared={tmp_path}/shared", f"engine.python={sys.executable}", "engine.interface=lo"]
        return build_engine(compose(["engine=slurm", "evaluate.workers=2", "engine.wait=60", *options, *overrides]))

    return build


@pytest.mark.parametrize("tls", ["engine.tls=false", "engine.tls=true"])
def test_the_same_results_as_at_home(slurm, engine, tmp_path, tls):
    grid = [*SHORT, "controller=nominal_mpc,perfect_mpc", "seed=range(3)"]
    away = run_sweep(expand(grid), tmp_path / "away", engine=engine(tls))
    assert away.flown == 6 and not away.not_flown
    same_results(run_sweep(expand(grid), tmp_path / "home", workers=1), away)


def test_a_job_that_slurm_refuses(engine, tmp_path):
    with pytest.raises(QuadexpError, match="engine=slurm: Slurm takes no such job: .*artition"):
        run_sweep(expand(SHORT), tmp_path / "r", engine=engine("engine.queue=nowhere"))


def test_a_worker_killed_and_a_job_cancelled_under_way(slurm, engine, tmp_path):
    jobs = []

    def disturb(done, total):
        if done == 4:
            jobs.extend(slurm.jobs())
            slurm.say("scancel", jobs[0])
        if done == 10:
            workers = [pid for pid, command in descendants(1) if "multiprocessing.spawn" in command]
            os.kill(workers[0], signal.SIGKILL)

    result = run_sweep(
        expand(["seed=range(24)"]), tmp_path / "r", function=cells.slow_cell, engine=engine(), progress=disturb
    )
    assert len(jobs) == 2 and not result.not_flown and len(result.rows) == 24
    undisturbed = run_sweep(expand(["seed=range(24)"]), tmp_path / "home", function=cells.quick_cell, workers=2)
    same_results(undisturbed, result)
