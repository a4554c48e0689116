"""Forces and torques of simulators with the exported parameters: by their own code, and by their formulas."""

import importlib.util
import os
import re
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import yaml

from quadexp.errors import UsageError
from quadexp.experiment.vehicle_of import vehicle_named
from quadexp.models.linear_drag import LinearDrag
from quadexp.plugins.exchange.known import known_of
from quadexp.plugins.exchange.simulators import crazyflow, rotorpy
from tests.plugins.exchange.models import (
    HUMMINGBIRD,
    crazyflie,
    hummingbird,
    relative,
    rotation,
    rotorpy_force,
    specific_force,
    states,
    torque,
)

CRAZYFLIE, VEHICLE = vehicle_named("crazyflie", None), vehicle_named("hummingbird", None)
RPM = np.pi / 30


def parameters(text: str) -> dict:
    space: dict = {}
    exec(compile(text, "quad_params", "exec"), space)
    return space["quad_params"]


def speeds(k: float, model, vehicle, thrust: np.ndarray) -> np.ndarray:
    """Rotor speeds at which a rotor's thrust is sigma times that of the curve."""
    scale = 1 + model.model().coefficient("z", "thrust")[0]
    return np.sqrt(thrust * scale / k)


# ------------------------------------------------------------------------------------------------------------ RotorPy
def test_a_vehicle_in_rotorpys_air_is_exported_with_rotorpys_numbers(export):
    found = parameters(export("hb", "rotorpy"))
    for name, value in HUMMINGBIRD.items():
        assert found[name] == pytest.approx(value, rel=2e-3), name
    assert found["k_m"] == pytest.approx(1.36e-7, rel=2e-3)


def test_forces_by_rotorpys_formula(export):
    found = parameters(export("hb", "rotorpy"))
    velocity, _, _, thrust = states(hummingbird(), VEHICLE)
    w = speeds(found["k_eta"], hummingbird(), VEHICLE, thrust)
    force = rotorpy_force(velocity, w, found)
    assert relative(force / VEHICLE.mass, specific_force(hummingbird(), VEHICLE, velocity, thrust)) < 1e-4


def test_forces_and_torques_by_rotorpy_itself(export):
    multirotor = pytest.importorskip("rotorpy.vehicles.multirotor", reason="the extra `rotorpy` is not installed")
    found = parameters(export("hb", "rotorpy", "--motor-lag", "0.005"))
    vehicle = multirotor.Multirotor(found, control_abstraction="cmd_motor_thrusts")
    velocity, _, _, thrust = states(hummingbird(), VEHICLE)
    w = speeds(found["k_eta"], hummingbird(), VEHICLE, thrust)
    force = np.array([vehicle.compute_body_wrench(np.zeros(3), w[i], velocity[i])[0] for i in range(len(w))])
    assert relative(force / VEHICLE.mass, specific_force(hummingbird(), VEHICLE, velocity, thrust)) < 1e-4
    vehicle.aero = False
    moment = np.array([vehicle.compute_body_wrench(np.zeros(3), w[i], velocity[i])[1] for i in range(len(w))])
    assert relative(moment, torque(VEHICLE, found["k_eta"] * w**2)) < 1e-12
    assert vehicle.tau_m == 0.005


def test_linear_drag_on_rotors_is_that_of_hover_and_says_how_far_it_is_elsewhere(export):
    text = export("cf", "rotorpy")
    found = parameters(text)
    hover = np.sqrt(CRAZYFLIE.hover_thrust / found["k_eta"])
    velocity, _, _, thrust = states(crazyflie(), CRAZYFLIE, 4000)
    level = rotorpy_force(velocity, np.full(thrust.shape, hover), found) / CRAZYFLIE.mass
    drag = crazyflie().linear_drag.drag
    mean = np.array([drag[:2].mean()] * 2 + [drag[2]])
    assert level - [0, 0, CRAZYFLIE.gravity] == pytest.approx(-mean * velocity, rel=1e-9, abs=1e-12)
    force = rotorpy_force(velocity, np.sqrt(thrust / found["k_eta"]), found) / CRAZYFLIE.mass
    thrust = CRAZYFLIE.hover_thrust * np.random.default_rng(2).uniform(
        0.3, 1.9, thrust.shape
    )  # the range of the file's
    force = rotorpy_force(velocity, np.sqrt(thrust / found["k_eta"]), found) / CRAZYFLIE.mass
    away = 100 * relative(force, specific_force(crazyflie(), CRAZYFLIE, velocity, thrust))
    said = float(re.search(r"specific force here: (\S+) %", text)[1])
    assert said == pytest.approx(away, rel=0.15) and away > 0.1


# ---------------------------------------------------------------------------------------------------------- crazyflow
def drone(text: str, name: str) -> dict:
    found = tomllib.loads(text)[name]
    return {key: np.array(value, float) for key, value in found.items()}


def test_forces_and_torques_by_crazyflows_formula(export):
    """f of the rotor speeds, torque L mixing f and c_tau spin f, drag_matrix R' v."""
    found = drone(export("cf", "crazyflow", "--motor-lag", "0.02"), "crazyflie")
    velocity, _, _, thrust = states(crazyflie(), CRAZYFLIE)
    rpm = np.sqrt(thrust / CRAZYFLIE.thrust_coefficient) / RPM
    curve, reaction = (np.polynomial.Polynomial(found[name])(rpm) for name in ("rpm2thrust", "rpm2torque"))
    force = velocity @ found["drag_matrix"].T
    force[:, 2] += curve.sum(axis=1)
    mixing = found["mixing_matrix"]
    moment = np.column_stack([found["L"] * curve @ mixing[0], found["L"] * curve @ mixing[1], reaction @ mixing[2]])
    assert relative(force / CRAZYFLIE.mass, specific_force(crazyflie(), CRAZYFLIE, velocity, thrust)) < 1e-12
    assert relative(moment, torque(CRAZYFLIE, thrust)) < 1e-12
    assert found["rotor_dyn_coef"] == pytest.approx([50, 0, 50, 0])
    assert np.all(np.diag(found["drag_matrix"]) < 0)


def test_a_curve_on_rotor_speeds_is_crazyflows_curve(export):
    found = drone(export("hb", "crazyflow"), "hummingbird")
    assert found["rpm2thrust"][2] / RPM**2 == pytest.approx(HUMMINGBIRD["k_eta"], rel=2e-3)
    assert found["rpm2torque"][2] / RPM**2 == pytest.approx(1.36e-7, rel=2e-3)


def test_accelerations_by_crazyflow_itself(export):
    os.environ.setdefault("SCIPY_ARRAY_API", "1")
    if importlib.util.find_spec("crazyflow") is None:
        pytest.skip("crazyflow is not installed")
    try:
        from crazyflow.dynamics.first_principles import dynamics
    except (ImportError, RuntimeError) as error:
        pytest.skip(f"crazyflow cannot be imported: {error}")
    found = drone(export("cf", "crazyflow"), "crazyflie")
    given = {key: value for key, value in found.items() if key not in ("thrust_min", "thrust_max")}
    for name in ("rpm2thrust", "rpm2torque", "rotor_dyn_coef"):
        given[name] = given[name][None]
    given |= {"gravity_vec": np.array([0, 0, -CRAZYFLIE.gravity]), "J_inv": np.linalg.inv(given["J"])}
    velocity, rate, q, thrust = states(crazyflie(), CRAZYFLIE)
    R = rotation(q)
    rpm = np.sqrt(thrust / found["rpm2thrust"][2])
    force, turn = [], []
    for i in range(len(rpm)):
        _, _, v_dot, w_dot, _ = dynamics(
            np.zeros(3), q[i, [1, 2, 3, 0]], R[i] @ velocity[i], rate[i], rpm[i], rpm[i], **given
        )
        force.append(R[i].T @ (np.asarray(v_dot) + [0, 0, CRAZYFLIE.gravity]))
        turn.append(np.asarray(w_dot))
    J = CRAZYFLIE.inertia_matrix
    wanted = np.linalg.solve(J, (torque(CRAZYFLIE, thrust) - np.cross(rate, rate @ J)).T).T
    assert relative(np.array(force), specific_force(crazyflie(), CRAZYFLIE, velocity, thrust)) < 1e-6
    assert relative(np.array(turn), wanted) < 1e-6


# --------------------------------------------------------------------------------------------------------- agilicious
def test_torques_by_agilicious_allocation(export):
    """Rows: sum, y, -x, kappa times (-1, -1, 1, 1), of the rotors fr, bl, br, fl."""
    found = yaml.safe_load(export("cf", "agilicious"))
    arms = np.array([found[f"tbm_{place}"] for place in ("fr", "bl", "br", "fl")])
    matrix = np.vstack([arms[:, 1], -arms[:, 0], found["kappa"] * np.array([-1, -1, 1, 1])])
    _, _, _, thrust = states(crazyflie(), CRAZYFLIE)
    assert relative(thrust[:, [0, 2, 1, 3]] @ matrix.T, torque(CRAZYFLIE, thrust)) < 1e-12
    assert found["thrust_map"] == [CRAZYFLIE.thrust_coefficient, 0, 0]
    drag = crazyflie().linear_drag.drag
    assert found["aero_coeff_1"] == pytest.approx(CRAZYFLIE.mass * drag)


# ------------------------------------------------------------------------------------------------- what all have to say
def test_a_drag_that_would_push_is_written_as_0_and_said():
    zero = np.zeros(3)
    drag, error = np.array([0.3, -0.1, 0.2]), np.full(3, 0.02)
    model = LinearDrag(
        drag, zero, 0.0, error, zero, 0.0, zero, zero, 100, freedom=np.full(7, 20.0), flights=5,
        vehicle=VEHICLE.record, feature_range={f"v_{axis}": [-3.0, 3.0] for axis in "xyz"},
    )  # fmt: skip
    written = crazyflow(known_of(VEHICLE, model))
    assert tomllib.loads(written.text)["hummingbird"]["drag_matrix"][1] == [0, 0, 0]
    number = written.numbers["drag_y"]
    assert number.value == 0 and number.half_width is None and number.note.startswith("-0.05 +- 0.02")
    assert "would push: written as 0" in number.note


def test_without_rotor_speeds_there_is_no_k():
    vehicle = replace(VEHICLE, thrust_coefficient=None)
    with pytest.raises(UsageError, match="needs the thrust per rotor speed squared"):
        rotorpy(known_of(vehicle))


def test_the_thrusts_of_the_file_are_corrected_by_the_flights():
    """Drag that was fitted beside thrusts in N: kappa T more acceleration is a k that is m kappa larger."""
    zero = np.zeros(3)
    model = LinearDrag(
        zero, zero, -0.1, zero, zero, 0.01, zero, zero, 100, freedom=np.full(7, 20.0),
        feature_range={f"v_{axis}": [-3.0, 3.0] for axis in "xyz"},
    )  # fmt: skip
    number = rotorpy(known_of(VEHICLE, model)).numbers["k_eta"]
    assert number.value == pytest.approx(5.57e-6 * (1 - 0.1 * VEHICLE.mass))
    assert number.half_width == pytest.approx(5.57e-6 * 0.01 * VEHICLE.mass * 2.086, rel=1e-3)  # t of 20, 97.5 %


def test_every_number_says_where_it_is_from(export):
    head = [line for line in export("hb", "rotorpy", "--motor-lag", "0.005").splitlines() if line.startswith("#")]
    text = "\n".join(head)
    assert re.search(r"fingerprint 19d5180ce8cc", text) and re.search(r"model.json sha256 [0-9a-f]{64}", text)
    assert re.search(r"data sha256 [0-9a-f]{64}", text)
    rows = {line.split()[1]: line for line in head if "  " in line}
    assert rows["mass"].endswith("no interval  kg  from the vehicle file")
    assert re.search(r"\[\S+, \S+\]  kg/m  identified, with mass from the vehicle file", rows["k_h"])
    assert rows["tau_m"].endswith("s  given")
    low, high = map(float, re.search(r"\[(\S+), (\S+)\]", rows["k_d"]).groups())
    assert low < HUMMINGBIRD["k_d"] < high
