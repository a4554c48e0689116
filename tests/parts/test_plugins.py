"""Parts from outside: options of installed packages, and names under `_target_` that are wrong."""

import subprocess
import sys
from pathlib import Path

import pytest

from quadexp.errors import UsageError
from quadexp.experiment.build import build_trajectory
from quadexp.experiment.evaluate import evaluate_cell
from quadexp.parts.compose import compose
from quadexp.sweeps.engine import Task
from tests.faults.command import FLY, ROOT, apart, one_line
from tests.sweeps.cells import built_engine

TRAJECTORY = "_target_: {target}\n{keys}\n"


@pytest.fixture
def trajectory(tmp_path):
    """A function that makes the trajectory of a `_target_` and its keys."""
    (tmp_path / "trajectory").mkdir()
    (tmp_path / "mine_module.py").write_text(
        "from os import system\nfrom quadexp.reference.base import TrajectoryPart\n"
        "from quadexp.reference.circle import Circle\n"
        "class Wrong(TrajectoryPart):\n    def build(self, vehicle): return 3\n"
        "class Mine(Circle): pass\nnumber = 4\n"
    )

    def build(target, keys=""):
        (tmp_path / "trajectory" / "mine.yaml").write_text(TRAJECTORY.format(target=target, keys=keys))
        return build_trajectory(compose(["trajectory=mine"], tmp_path).trajectory)

    return build


@pytest.mark.parametrize(
    ("target", "keys", "message"),
    [
        ("Helix", "", "trajectory._target_=Helix: expected MODULE.NAME"),
        ("nowhere_at_all.Helix", "", "there is no module nowhere_at_all in the --conf folder /.*, nor in an installed"),
        ("scipy.optimize.minimize", "", "there is no module scipy in the --conf folder"),
        ("mine_module.system", "", "mine_module.system: comes from module posix, which is neither"),
        ("mine_module.Circle", "", "comes from module quadexp.reference.circle, which is neither"),
        ("mine_module.Absent", "", "module mine_module has no class or function 'Absent'"),
        ("mine_module.number", "", "mine_module.number: is no part"),
        ("mine_module.Wrong", "", "made no trajectory, a int without duration, peak_speed, flat_output"),
        ("mine_module.Wrong", "radius: 3", "trajectory.radius: no such key"),
        ("mine_module.Mine", "speed: -1.0", "trajectory.speed"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(trajectory, target, keys, message):
    with pytest.raises(UsageError, match=message) as error:
        trajectory(target, keys)
    assert "\n" not in str(error.value)


def test_what_lies_in_the_folder_is_called(trajectory):
    assert trajectory("mine_module.Mine", "speed: 3.0").peak_speed == pytest.approx(3.273, abs=1e-3)


@pytest.fixture
def foreign(tmp_path):
    """A configuration folder that names a module which lies elsewhere and writes a mark when it is imported."""
    conf, elsewhere = tmp_path / "conf", tmp_path / "elsewhere"
    (conf / "trajectory").mkdir(parents=True)
    elsewhere.mkdir()
    (conf / "trajectory" / "mine.yaml").write_text(TRAJECTORY.format(target="tool.Short", keys="duration: 0.4"))
    (elsewhere / "tool.py").write_text(
        f"open({str(tmp_path / 'mark')!r}, 'w').close()\nfrom quadexp.reference.hover import Hover\n"
        "class Short(Hover): pass\n"
    )
    return conf, elsewhere, tmp_path / "mark"


@pytest.mark.parametrize("command", [FLY, ("evaluate", "--sweep", "--no-figures", *FLY[1:])])
def test_a_module_elsewhere_is_not_even_imported(foreign, tmp_path, command):
    """Refused by name with exit code 2, although Python would find it."""
    conf, elsewhere, mark = foreign
    words = [word for word in command if not word.startswith("trajectory.")]
    words = [word.replace("trajectory=hover", "trajectory=mine") for word in words]
    environment = {"PYTHONPATH": f"{elsewhere}:{ROOT}"}
    done = apart(*words, "--conf", conf, "--out", tmp_path / "out", environment=environment)
    assert done.returncode == 2 and "trajectory._target_=tool.Short: there is no module tool in" in one_line(done)
    assert not mark.exists() and not (tmp_path / "out").exists()
    (elsewhere / "tool.py").rename(conf / "tool.py")
    done = apart(*words, "--conf", conf, "--out", tmp_path / "out", environment=environment)
    assert done.returncode == 0 and mark.exists(), done.stderr


@pytest.mark.parametrize("engine", ["local", pytest.param("dask", marks=pytest.mark.slow)])
def test_workers_obey_the_same_rule(foreign, engine, tmp_path, monkeypatch):
    """A cell that reaches a worker past the driver's own check fails there; what the --conf folder has is flown."""
    if engine == "dask":
        pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    conf, elsewhere, mark = foreign
    monkeypatch.setenv("PYTHONPATH", f"{elsewhere}:{ROOT}")
    for name in ("own_tool", "tool"):
        (conf / f"{name}.py").write_text((elsewhere / "tool.py").read_text())
    own = TRAJECTORY.format(target="own_tool.Short", keys="duration: 0.4")
    (conf / "trajectory" / "own.yaml").write_text(own)
    interpreted = ["controller.backend=interpreted", "plant.backend=interpreted"]
    good = compose(["trajectory=own", *interpreted], conf)
    bad = compose(["trajectory=mine", *interpreted], conf)
    tasks = [Task(f"{i:020d}", config, None, str(tmp_path / f"{i}.parquet")) for i, config in enumerate((bad, good))]
    (conf / "tool.py").unlink()
    mark.unlink()
    engine = built_engine(compose([f"engine={engine}", "evaluate.workers=1"]))
    results = dict(engine.fly(evaluate_cell, iter(tasks[:1])))
    assert "there is no module tool in the --conf folder" in results["0" * 20].cause
    assert not mark.exists()
    results = dict(engine.fly(evaluate_cell, iter(tasks[1:])))
    assert results[f"{1:020d}"]["outcome"] == "ok", results


def test_a_name_that_python_has_already(tmp_path):
    """Which of the two is meant would depend on what was imported before."""
    (tmp_path / "trajectory").mkdir()
    (tmp_path / "trajectory" / "mine.yaml").write_text(TRAJECTORY.format(target="random.Make", keys=""))
    (tmp_path / "random.py").write_text("def make(): pass\n")
    with pytest.raises(UsageError, match=r"the name random is taken by /.*random.py: give the module in the --conf"):
        build_trajectory(compose(["trajectory=mine"], tmp_path).trajectory)


def test_an_installed_package_brings_options(tmp_path):
    """A distribution with the entry point, on the path of a fresh process, as pip would leave it."""
    package = tmp_path / "my_lab"
    (package / "conf" / "vehicle").mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "conf" / "__init__.py").touch()
    racer = "defaults: [torrente, _self_]\nname: racer\nmass: 0.7\n"
    (package / "conf" / "vehicle" / "racer.yaml").write_text(racer)
    record = tmp_path / "my_lab-1.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: my-lab\nVersion: 1.0\n")
    (record / "entry_points.txt").write_text("[quadexp.conf]\nmy_lab = my_lab.conf\n")
    (package / "paths.py").write_text("from quadexp.reference.hover import Hover\nclass Lab(Hover): pass\n")
    (package / "conf" / "trajectory").mkdir()
    (package / "conf" / "trajectory" / "lab.yaml").write_text(
        TRAJECTORY.format(target="my_lab.paths.Lab", keys="duration: 1.5")
    )
    code = (
        "from quadexp.parts.compose import compose\nfrom quadexp.parts.options import groups\n"
        "config = compose(['vehicle=racer'])\nassert config.vehicle.mass == 0.7\n"
        "assert 'racer' in groups()['vehicle']\n"
        "from quadexp.experiment.build import build_trajectory\n"
        "assert build_trajectory(compose(['trajectory=lab']).trajectory).duration == 1.5\nprint(config.vehicle.name)"
    )
    root = str(Path(__file__).resolve().parents[1])
    environment = {"PYTHONPATH": f"{tmp_path}:{root}", "PATH": "/usr/bin:/bin"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.stdout == "racer\n", done.stderr

    (record / "entry_points.txt").write_text("[quadexp.conf]\nmy_lab = my_lab.absent\n")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert "entry point 'my_lab' of quadexp.conf: no package 'my_lab.absent'" in done.stderr
