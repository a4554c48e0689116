"""Vehicles from files of crazyflow and RotorPy, and from what is exported to them."""

import numpy as np
import pytest
from typer.testing import CliRunner

from quadexp.cli.app import app
from quadexp.experiment.vehicle_of import vehicle_named

ROTORPY = """
import numpy as np
d = 0.2
quad_params = {
    "mass": 0.6, "Ixx": 4e-3, "Iyy": 5e-3, "Izz": 8e-3, "Ixy": 1e-5, "Iyz": 2e-5, "Ixz": 3e-5,
    "rotor_pos": {"r1": d * np.array([1.0, 0, 0]), "r2": d * np.array([0, 1.0, 0]),
                  "r3": d * np.array([-1.0, 0, 0]), "r4": d * np.array([0, -1.0, 0])},
    "rotor_directions": np.array([1, -1, 1, -1]),
    "k_eta": 6e-6, "k_m": 1.2e-7, "rotor_speed_min": 100, "rotor_speed_max": 1500,
}
"""
"""Numbers of nobody's vehicle."""


def new(*words) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["new", "vehicle", *map(str, words)])
    return done.exit_code, done.stderr or done.output


def test_a_file_of_rotorpy_is_a_vehicle(tmp_path):
    (tmp_path / "mine_params.py").write_text(ROTORPY)
    code, said = new("plus", "--from", tmp_path / "mine_params.py", "--to", tmp_path / "parts")
    assert code == 0, said
    vehicle = vehicle_named("plus", tmp_path / "parts")
    assert vehicle.mass == 0.6 and vehicle.thrust_coefficient == 6e-6
    assert vehicle.torque_coefficient == pytest.approx(0.02)
    assert vehicle.inertia_matrix == pytest.approx(
        np.array([[4e-3, 1e-5, 3e-5], [1e-5, 5e-3, 2e-5], [3e-5, 2e-5, 8e-3]])
    )
    assert vehicle.thrust_min == pytest.approx(0.06) and vehicle.thrust_max == pytest.approx(13.5)
    assert vehicle.rotor_position[1] == (0.0, 0.2, 0.0) and vehicle.rotor_spin == (1, -1, 1, -1)


@pytest.mark.parametrize(("to", "suffix"), [("crazyflow", "toml"), ("rotorpy", "py")])
@pytest.mark.parametrize("name", ["crazyflie", "hummingbird", "quad_bench"])
def test_what_is_exported_comes_back(export, tmp_path, to, suffix, name):
    """All but the limits of the rates, the shape of the rotors and, of RotorPy, a gravity of its own."""
    file = f"{name}.{suffix}"
    export(f"vehicle={name}", to, out=file)
    code, said = new("again", "--from", tmp_path / file, "--to", tmp_path / "parts")
    assert code == 0, said
    before, after = vehicle_named(name, None), vehicle_named("again", tmp_path / "parts")
    assert after.inertia_matrix == pytest.approx(before.inertia_matrix)
    for key in ("mass", "thrust_max", "thrust_min", "torque_coefficient", "thrust_coefficient"):
        assert getattr(after, key) == pytest.approx(getattr(before, key)), key
    assert np.array(after.rotor_position)[:, :2] == pytest.approx(np.array(before.rotor_position)[:, :2])
    assert after.rotor_spin == before.rotor_spin


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("a.toml", "[one]\nmass = 1\n[two]\nmass = 2\n", "it has several drones: FILE:NAME, with NAME one of one, two"),
        ("a.toml:three", "[one]\nmass = 1\n", "three is not there"),
        ("a.toml", "[one]\nmass = 1\n", "not parameters of crazyflow or RotorPy: KeyError"),
        ("a.toml", "[one\n", "not parameters of crazyflow or RotorPy: TOMLDecodeError"),
        ("a.py", "x = 3\n", "not parameters of crazyflow or RotorPy: KeyError: 'quad_params'"),
        ("a.py", "1/0\n", "ZeroDivisionError"),
        ("a.py:x", ROTORPY, "has no sections"),
        ("a.py", ROTORPY.replace('"mass": 0.6', '"mass": 600.0'), "vehicle.mass=600"),
        ("a.yaml", "mass: 1\n", "must be crazyflow's params.toml, or a .py file of RotorPy"),
        ("b.toml", "", "cannot be read"),
    ],
)
def test_what_is_no_vehicle_is_said(tmp_path, file, text, message):
    name = file.partition(":")[0]
    if name != "b.toml":
        (tmp_path / name).write_text(text)
    code, said = new("mine", "--from", tmp_path / file, "--to", tmp_path / "parts")
    assert code == 2 and message in said and said.count("\n") == 1
    assert not (tmp_path / "parts").exists()


def test_only_vehicles_are_read(tmp_path):
    done = CliRunner().invoke(app, ["new", "plant", "mine", "--from", "a.toml", "--to", str(tmp_path)])
    assert done.exit_code == 2 and "only a vehicle is read from a file" in done.stderr
