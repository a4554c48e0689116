"""Sweeps on a real Dask cluster: the same files and rows as at home, whatever is killed in between."""

import os
import signal
import sys
import threading
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="the extra `cluster` is not installed")

from quadexp.errors import QuadexpError, UsageError
from quadexp.log.cell_store import CellStore
from quadexp.parts.compose import compose, expand
from quadexp.plugins.cluster.cluster import DaskEngine, open_cluster
from quadexp.sweeps.engine import LocalEngine
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.experiment.same import same_results
from tests.models.by_hand import make_checkpoint
from tests.plugins.cluster.dask_cluster import Cluster
from tests.sweeps import cells
from tests.sweeps.cells import built_engine
from tests.sweeps.quick import kill, start, wait_for
from tests.sweeps.test_sweep import files

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")

INTERPRETED = ["controller.backend=interpreted", "plant.backend=interpreted"]
SHORT = ["trajectory=step", "trajectory.duration=0.4", "trajectory.step_time=0.2", *INTERPRETED]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    cluster = Cluster(tmp_path_factory.mktemp("cluster"))
    yield cluster
    cluster.stop()


@pytest.fixture
def engine(cluster):
    return on(cluster)


def on(cluster, **options):
    return at(cluster.address, **options)


def at(address, **options):
    config = compose(["engine=dask", f"engine.address={address}"]).engine
    return DaskEngine(lambda: open_cluster(config, 1), **options)


class TestSameEverywhere:
    def test_flights_equal_those_of_this_machine_bit_for_bit(self, engine, tmp_path):
        grid = [*SHORT, "controller=nominal_mpc,perfect_mpc", "seed=range(3)"]
        at_home = run_sweep(expand(grid), tmp_path / "home", SweepRequest(workers=2))
        away = run_sweep(expand(grid), tmp_path / "away", SweepRequest(engine=engine))
        assert away.flown == 6 and not away.not_flown
        same_results(at_home, away)
        assert not [name for name in files(tmp_path) if name.endswith((".tmp", ".lock"))]

    def test_files_that_flights_read_are_those_of_the_driver(self, engine, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)  # relative names, of the driver's folder
        Path("track.csv").write_text("t,p_x,p_y,p_z\n" + "".join(f"{i / 10},{i / 50},0,1\n" for i in range(12)))
        make_checkpoint(tmp_path / "models/drag")
        Path("wind.csv").write_text("t,wind_x,wind_y,wind_z\n0,1,0,0\n1,0,2,0\n")
        grid = ["trajectory=file", "trajectory.path=track.csv", "controller=linear_drag_mpc", "model=models/drag"]
        grid += ["wind=file", "wind.path=wind.csv"]
        grid = [*grid, *INTERPRETED, "seed=0,1"]
        away = run_sweep(expand(grid), "away", SweepRequest(engine=engine))
        assert not away.not_flown, away.not_flown[0]["cause"]
        same_results(run_sweep(expand(grid), "home", SweepRequest(workers=1)), away)

    def test_a_sweep_goes_on_with_another_engine(self, engine, tmp_path):
        part = run_sweep(expand([*SHORT, "seed=range(2)"]), tmp_path / "r", SweepRequest(workers=1))
        whole = run_sweep(expand([*SHORT, "seed=range(4)"]), tmp_path / "r", SweepRequest(engine=engine))
        assert (part.flown, whole.flown) == (2, 2) and len(whole.rows) == 4
        assert run_sweep(expand([*SHORT, "seed=range(4)"]), tmp_path / "r").flown == 0


class TestKill:
    GRID = "seed=range(30)"

    @pytest.fixture(scope="class")
    def undisturbed(self, tmp_path_factory):
        return run_sweep(
            expand([self.GRID]), tmp_path_factory.mktemp("r") / "r", SweepRequest(function=cells.quick_cell, workers=2)
        )

    def test_workers_and_nannies_killed_under_way(self, tmp_path, undisturbed):
        cluster = Cluster(tmp_path / "cluster")
        done = []

        def upset(count, total):
            done.append(count)
            if count in (5, 10):
                nanny = cluster.workers[count // 10]
                victims = cluster.workers_of(nanny)
                assert victims
                if count == 10:  # the nanny first, or it would start another worker
                    victims.insert(0, nanny.pid)
                threading.Timer(0.05, lambda: [os.kill(pid, signal.SIGKILL) for pid in victims]).start()

        try:
            result = run_sweep(
                expand([self.GRID]),
                tmp_path / "r",
                SweepRequest(function=cells.slow_cell, engine=on(cluster), progress=upset),
            )
        finally:
            cluster.stop()
        assert done == list(range(31)) and not result.not_flown
        same_results(undisturbed, result)
        assert not [name for name in files(tmp_path / "r") if name.endswith((".tmp", ".lock"))]

    @pytest.mark.parametrize(
        ("who", "said"), [("worker", "no worker for 1 s "), ("scheduler", "scheduler is gone|no worker")]
    )
    def test_no_worker_or_scheduler_left_is_said_and_the_same_command_goes_on(
        self, tmp_path, monkeypatch, undisturbed, who, said
    ):
        monkeypatch.setattr("quadexp.plugins.cluster.cluster.CONNECT", 2.0)
        cluster = Cluster(tmp_path / "cluster", workers=1)
        engine = on(cluster)

        def upset(count, total):
            if count == 4:
                engine.wait = 1.0  # not before: workers take their time to start
                os.killpg((cluster.workers[0] if who == "worker" else cluster.scheduler).pid, signal.SIGKILL)

        try:
            with pytest.raises(QuadexpError, match=said):
                run_sweep(
                    expand([self.GRID]),
                    tmp_path / "r",
                    SweepRequest(function=cells.slow_cell, engine=engine, progress=upset),
                )
        finally:
            cluster.stop()
        left = len(CellStore(tmp_path / "r").done())
        assert 4 <= left < 30
        result = run_sweep(expand([self.GRID]), tmp_path / "r", SweepRequest(function=cells.quick_cell, workers=2))
        assert result.flown == 30 - left
        same_results(undisturbed, result)

    def test_the_driver_killed(self, cluster, tmp_path, undisturbed):
        process = start(tmp_path, self.GRID, address=cluster.address)
        wait_for(process, 5)
        kill(process)
        before = CellStore(tmp_path / "r").done()
        assert 5 <= len(before) < 30
        done = []
        result = run_sweep(
            expand([self.GRID]),
            tmp_path / "r",
            SweepRequest(
                function=cells.slow_cell, engine=on(cluster), progress=lambda count, total: done.append(count)
            ),
        )
        assert result.flown == 30 - len(before) and done == list(range(len(before), 31))
        same_results(undisturbed, result)
        assert not [name for name in files(tmp_path / "r") if name.endswith((".tmp", ".lock"))]


class TestMistakes:
    @pytest.mark.parametrize(("engine", "package"), [("dask", "distributed"), ("jobs", "cryptography")])
    def test_the_extra_is_missing(self, monkeypatch, engine, package):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(UsageError, match=rf"needs {package}, .* pip install 'quadexp\[cluster\]'"):
            built_engine(compose([f"engine={engine}"]))

    def test_a_scheduler_that_is_not_there(self, tmp_path, monkeypatch):
        monkeypatch.setattr("quadexp.plugins.cluster.cluster.CONNECT", 0.5)
        engine = built_engine(compose(["engine=dask", "engine.address=tcp://127.0.0.1:1"]))
        with pytest.raises(QuadexpError, match="engine.address=tcp://127.0.0.1:1 is not found") as caught:
            run_sweep(expand(SHORT), tmp_path / "r", SweepRequest(engine=engine))
        assert "\n" not in str(caught.value)

    def test_nothing_is_started_for_a_finished_sweep(self, tmp_path):
        run_sweep(expand(SHORT), tmp_path / "r", SweepRequest(engine=LocalEngine(1)))
        engine = DaskEngine(lambda: pytest.fail("it started a cluster"))
        assert run_sweep(expand(SHORT), tmp_path / "r", SweepRequest(engine=engine)).flown == 0
