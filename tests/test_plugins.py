"""Parts from outside: options of installed packages, and names under `_target_` that are wrong."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from quadexp.compose import compose
from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller, build_plant, build_trajectory, build_vehicle

TRAJECTORY = (
    "defaults: [/schema/trajectory/custom@_here_, _self_]\nname: mine\n_target_: {target}\noptions: {options}\n"
)


@pytest.fixture
def trajectory(tmp_path, monkeypatch):
    """A function that makes the trajectory of a `_target_` and its options."""
    (tmp_path / "trajectory").mkdir()
    (tmp_path / "mine_module.py").write_text(
        "def wrong(): return 3\ndef broken(): raise RuntimeError('no luck')\nnumber = 4\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))

    def build(target, options="{}"):
        (tmp_path / "trajectory" / "mine.yaml").write_text(TRAJECTORY.format(target=target, options=options))
        return build_trajectory(compose(["trajectory=mine"], tmp_path).trajectory)

    return build


@pytest.mark.parametrize(
    ("target", "options", "message"),
    [
        ("Helix", "{}", "trajectory._target_=Helix: expected MODULE.NAME"),
        ("nowhere_at_all.Helix", "{}", "No module named 'nowhere_at_all' .it must be installed"),
        ("mine_module.Absent", "{}", "module mine_module has no class or function 'Absent'"),
        ("mine_module.number", "{}", "module mine_module has no class or function 'number'"),
        ("mine_module.wrong", "{}", "made no trajectory, a int without duration, peak_speed, flat_output"),
        ("mine_module.wrong", "{radius: 3}", "cannot be called with radius"),
        ("mine_module.broken", "{}", "raised RuntimeError: no luck"),
        ("quadexp.trajectory.circle.Circle", "{speed: -1.0}", "trajectory.speed"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(trajectory, target, options, message):
    with pytest.raises(UsageError, match=message) as error:
        trajectory(target, options)
    assert "\n" not in str(error.value)


def test_any_importable_class_will_do(trajectory):
    assert trajectory("quadexp.trajectory.circle.Circle", "{speed: 3.0}").peak_speed == pytest.approx(3.273, abs=1e-3)


def test_plant_and_controller_are_checked_too(tmp_path):
    for group in ("plant", "controller"):
        (tmp_path / group).mkdir()
        (tmp_path / group / "mine.yaml").write_text(
            f"defaults: [/schema/{group}/custom@_here_, _self_]\nname: mine\n_target_: builtins.id\n"
        )
    config = compose(["plant=mine", "controller=mine"], tmp_path)
    vehicle = build_vehicle(config.vehicle)
    with pytest.raises(UsageError, match=r"plant._target_=builtins.id: cannot be called with vehicle, step"):
        build_plant(vehicle, config.plant)
    with pytest.raises(UsageError, match=r"controller._target_=builtins.id: made no controller"):
        build_controller(config, vehicle, None, None)


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
    code = (
        "from quadexp.compose import compose\nfrom quadexp.completion import groups\n"
        "config = compose(['vehicle=racer'])\nassert config.vehicle.mass == 0.7\n"
        "assert 'racer' in groups()['vehicle']\nprint(config.vehicle.name)"
    )
    root = str(Path(__file__).resolve().parents[1])
    environment = {"PYTHONPATH": f"{tmp_path}:{root}", "PATH": "/usr/bin:/bin"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.stdout == "racer\n", done.stderr

    (record / "entry_points.txt").write_text("[quadexp.conf]\nmy_lab = my_lab.absent\n")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert "entry point 'my_lab' of quadexp.conf: no package 'my_lab.absent'" in done.stderr
