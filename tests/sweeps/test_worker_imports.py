"""Workers import what the driver imports: nothing that lies where the user stands, no other quadexp."""

import csv
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from quadexp import provenance
from quadexp.errors import QuadexpError
from quadexp.log.cell_store import CellStore
from quadexp.parts.compose import expand
from quadexp.parts.user_modules import own_folders
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.sweeps import cells
from tests.sweeps.test_sweep import files

ROOT = Path(__file__).resolve().parents[2]
FIXED = ["controller.backend=interpreted", "plant.backend=interpreted", "--no-figures"]
SHORT = ["trajectory=step", "trajectory.duration=0.4", "trajectory.step_time=0.2"]
PART = """
from quadexp.reference.hover import Hover
class Short(Hover):
    pass
"""
SHADOWS = ("casadi", "random", "socket", "numpy", "pyarrow", "signal", "pickle", "distributed", "pebble")


def copy_of_the_package(folder, *, drag=False):
    """Another checkout. drag: in which what is called drag is three times as much."""
    shutil.copytree(ROOT / "quadexp", folder / "quadexp", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "conf", folder / "conf")
    if drag:
        file = folder / "quadexp" / "world" / "simplified.py"
        assert "drag" in file.read_text()
        file.write_text(file.read_text() + "\n_simplified_step = SimplifiedPlant.__init__\n")
    return folder


@pytest.fixture
def standing(tmp_path, monkeypatch):
    """A folder that holds modules by the names of others, each of which says that it was executed."""
    folder = tmp_path / "here"
    folder.mkdir()
    for name in SHADOWS:
        (folder / f"{name}.py").write_text(
            f"open({str(folder / 'executed')!r}, 'a').write('{name} ')\nraise SystemExit(7)\n"
        )
    copy_of_the_package(folder)
    for module in ("__init__", "provenance", "world/simplified"):
        file = folder / "quadexp" / f"{module}.py"
        file.write_text(f"open({str(folder / 'executed')!r}, 'a').write('{module} ')\n" + file.read_text())
    monkeypatch.chdir(folder)
    return folder


def command(*arguments, python=(), **environment):
    """The command as its script runs it, which has the script's folder on its path and not the current one."""
    script = Path(sys.executable).with_name("quadexp")
    start = [sys.executable, *python, str(script)] if script.exists() else [sys.executable, "-P", "-m", "quadexp"]
    known = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    return subprocess.run([*start, *map(str, arguments)], capture_output=True, text=True, env=known)


def table(out):
    """Rows of a results.csv without measured times."""
    with open(out / "results.csv") as file:
        return [{k: v for k, v in row.items() if not k.startswith("solve_time")} for row in csv.DictReader(file)]


ENGINES = [
    pytest.param(["engine=local"], id="local"),
    pytest.param(["engine=dask", "evaluate.workers=1"], id="dask", marks=pytest.mark.slow),
]


@pytest.mark.parametrize("engine", ENGINES)
def test_nothing_that_lies_where_the_user_stands_is_executed(standing, tmp_path, engine):
    if "dask" in engine[0]:
        pytest.importorskip("distributed")
        pytest.importorskip("cryptography")
    mine = tmp_path / "mine"
    (mine / "trajectory").mkdir(parents=True)
    (mine / "my_parts.py").write_text(PART)
    (mine / "trajectory" / "mine.yaml").write_text("_target_: my_parts.Short\n")
    given = ["trajectory=mine", "controller=nominal_mpc", "seed=0,1", "--conf", mine, *FIXED]
    done = command("evaluate", "--sweep", *engine, *given, "--out", tmp_path / "r")
    assert not (standing / "executed").exists(), (standing / "executed").read_text()
    assert done.returncode == 0, done.stderr
    rows = table(tmp_path / "r")
    assert [row["outcome"] for row in rows] == ["ok", "ok"]
    assert {row["sources"] for row in rows} == {provenance.sources()}


def test_workers_of_a_checkout_that_is_run_from_its_folder_are_of_that_checkout(tmp_path):
    """`python -m quadexp` imports from the current folder, and so then do the workers."""
    copy = copy_of_the_package(tmp_path / "copy", drag=True)
    given = ["evaluate", "--sweep", *SHORT, "seed=0,1", *FIXED, "--out", str(tmp_path / "r")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    environment.pop("PYTHONSAFEPATH", None)
    run = {"cwd": copy, "env": environment, "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-m", "quadexp", *given], **run)
    assert done.returncode == 0, done.stderr
    said = subprocess.run(
        [sys.executable, "-c", "from quadexp.provenance import sources; print(sources())"], **run
    ).stdout.strip()
    assert said != provenance.sources()
    assert {row["sources"] for row in table(tmp_path / "r")} == {said}
    # And this checkout notices whose cells they are.
    done = command("evaluate", "--sweep", *SHORT, "seed=0,1", *FIXED, "--out", tmp_path / "r")
    assert done.returncode == 2 and f"2 by quadexp 0.1.0, sources {said}" in done.stderr


def test_children_have_the_path_and_the_environment_of_their_parent(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", "mine")
    (found,) = dict(cells.run_cells(cells.surroundings, {"a": ()}, workers=1)).values()
    given = [folder for folder in own_folders() if folder not in sys.path]  # with --conf, by tests before this one
    assert found["path"] == [*sys.path, *given] and found["PYTHONPATH"] == "mine"
    assert os.environ["PYTHONPATH"] == "mine" and os.environ.get("PYTHONSAFEPATH") is None


class TestRows:
    def test_a_row_of_another_program_is_refused_by_name_and_flown_again(self, tmp_path):
        result = run_sweep(expand(["seed=0,1"]), tmp_path / "r", SweepRequest(function=cells.foreign_cell, workers=1))
        causes = {row["seed"]: row["cause"] for row in result.rows if row["outcome"] == "failed"}
        assert list(causes) == [1]
        assert causes[1].startswith("flown by quadexp 9.9.9, sources abcdef123456, not by this one (quadexp")
        assert provenance.sources() in causes[1]
        assert len(CellStore(tmp_path / "r").done()) == 1
        again = run_sweep(expand(["seed=0,1"]), tmp_path / "r", SweepRequest(function=cells.quick_cell, workers=1))
        assert again.flown == 1 and not again.not_flown


class TestDask:
    @pytest.fixture(autouse=True)
    def needs_it(self):
        pytest.importorskip("distributed", reason="the extra `cluster` is not installed")

    def test_a_worker_of_another_quadexp_is_refused_by_name(self, tmp_path):
        from tests.plugins.cluster.dask_cluster import Cluster
        from tests.plugins.cluster.test_dask import on

        copy = copy_of_the_package(tmp_path / "copy", drag=True)
        cluster = Cluster(tmp_path / "cluster", workers=0)
        cluster.add_worker(PYTHONPATH=str(copy))
        try:
            with pytest.raises(QuadexpError, match="this worker has sources .*, the driver "):
                run_sweep(expand([*SHORT, "seed=0"]), tmp_path / "r", SweepRequest(engine=on(cluster)))
        finally:
            cluster.stop()
        assert not [name for name in files(tmp_path / "r") if name.endswith(".parquet")]

    def test_a_worker_with_another_part_of_the_users_is_refused_by_name(self, tmp_path, monkeypatch):
        from tests.plugins.cluster.dask_cluster import Cluster
        from tests.plugins.cluster.test_dask import on

        for name, more in (("mine", ""), ("theirs", "# theirs\n")):
            (tmp_path / name / "trajectory").mkdir(parents=True)
            (tmp_path / name / "parts_of_test.py").write_text(PART + more)
        (tmp_path / "mine" / "trajectory" / "mine.yaml").write_text("_target_: parts_of_test.Short\nduration: 0.4\n")
        monkeypatch.syspath_prepend(str(tmp_path / "mine"))
        cluster = Cluster(tmp_path / "cluster", workers=0)
        cluster.add_worker(PYTHONPATH=f"{ROOT}{os.pathsep}{tmp_path / 'theirs'}")
        overrides = ["trajectory=mine", "controller.backend=interpreted", "plant.backend=interpreted", "seed=0"]
        try:
            result = run_sweep(expand(overrides, tmp_path / "mine"), tmp_path / "r", SweepRequest(engine=on(cluster)))
        finally:
            cluster.stop()
        (row,) = result.rows
        assert row["outcome"] == "failed"
        assert f"the name parts_of_test is taken by {tmp_path / 'theirs' / 'parts_of_test.py'}" in row["cause"]
