"""The plants of other programs have these programs' equations and numbers, which is seen where they are installed.

What needs no package: motors, limits, the controllers' view of the equations, refusals.
"""

import importlib.util
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.experiment.build import build_plant, build_vehicle, build_world, unshared
from quadexp.experiment.evaluate import fly_one
from quadexp.models.residual import feature_names
from quadexp.parts.compose import compose
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.state import ATTITUDE, RATE, STATE_COLUMNS, VELOCITY
from quadexp.world.constant_wind import ConstantWind
from quadexp.world.world import World
from tests.states import random_state

ROOT = Path(__file__).parents[3]
RPM = np.pi / 30  # rad/s
SAME = 1e-9
PAIRS = {"rotorpy": "hummingbird", "drone_models": "cf2x_L250", "drone_models_brushless": "cf21B_500"}
needs_rotorpy = pytest.mark.skipif(
    importlib.util.find_spec("rotorpy") is None, reason="RotorPy is not installed: pip install 'quadexp[rotorpy]'"
)
needs_drone_models = pytest.mark.skipif(
    importlib.util.find_spec("drone_models") is None,
    reason="drone-models is not installed: pip install 'quadexp[drone-models]'",
)


def plant(name: str, *overrides: str):
    config = compose([f"plant={name}", f"vehicle={PAIRS[name]}", "plant.backend=interpreted", *overrides])
    with unshared():
        return build_plant(build_vehicle(config.vehicle), config.plant)


def slope(truth):
    """s' of a step (s, u): its derivative by the length of the step, at zero; the quaternion keeps its length there."""
    step = truth.equations.step
    s, u, h = ca.SX.sym("s", step.size1_in(0)), ca.SX.sym("u", step.size1_in(1)), ca.SX.sym("h")
    after, reading = step(s, u, ca.SX(0, 1), ca.DM(truth.parameters(0.0)), h)
    return ca.Function("slope", [s, u], [ca.substitute(ca.jacobian(after, h), h, 0), ca.substitute(reading, h, 0)])


def random_points(truth, count: int = 200):
    """States with rotor speeds (count, 17), and commands (count, 4), some beyond the limits."""
    rng, vehicle = np.random.default_rng(0), truth.vehicle
    fastest = np.sqrt(vehicle.thrust_max / vehicle.thrust_coefficient)
    states = np.array([np.r_[random_state(rng), rng.uniform(0, fastest, 4)] for _ in range(count)])
    commands = rng.uniform(vehicle.thrust_min, vehicle.thrust_max, (count, 4))
    return states, commands


def scaled(error: np.ndarray, expected: np.ndarray) -> float:
    """The largest of every column's error over its typical size, or over 1."""
    return float(np.max(np.abs(error) / np.maximum(1.0, np.abs(expected).max(axis=0))))


def some_flight(name: str):
    """State, rotor speeds, commands: 2 s of a flight in their fast part, (101, 17) and (100, 4), and the period (s)."""
    flight = fly_one(
        compose(
            [f"plant={name}", f"vehicle={PAIRS[name]}", "trajectory=circle", "trajectory.speed=4", "plant.step=1e-4"]
            + ["controller=nominal_mpc", "controller.motor_lag=0.1", "controller.backend=interpreted"]
            + ["plant.backend=interpreted"]
        )
    )
    assert flight.outcome == "ok"
    rows = slice(200, 301)
    names = [*STATE_COLUMNS, *(f"rotor_speed_{i}" for i in range(4))]
    states = np.stack([flight[name][rows] for name in names], axis=1)
    commands = np.stack([flight[f"u_{i}"][rows] for i in range(4)], axis=1)[:-1]
    assert np.linalg.norm(states[:, VELOCITY], axis=1).min() > 2.5 and np.ptp(commands) > 0
    return states, commands, float(flight.t[1])


# ------------------------------------------------------------------------------------------------------------ RotorPy
def rotorpy_itself(**others):
    from rotorpy.vehicles.hummingbird_params import quad_params
    from rotorpy.vehicles.multirotor import Multirotor

    exact = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
    vehicle = Multirotor({**quad_params, **others}, control_abstraction="cmd_motor_thrusts", integrator_kwargs=exact)
    return vehicle, quad_params


def as_rotorpy(s: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "x": s[:3], "q": np.roll(s[ATTITUDE], -1), "v": s[VELOCITY], "w": s[RATE], "wind": np.zeros(3),
        "rotor_speeds": s[13:],
    }  # fmt: skip


@needs_rotorpy
def test_rotorpy_has_the_numbers_of_the_package():
    truth, (_, given) = plant("rotorpy"), rotorpy_itself()
    vehicle, keys = truth.vehicle, truth.keys
    assert vehicle.mass == given["mass"] and vehicle.gravity == 9.81
    assert np.array_equal(vehicle.inertia_matrix, np.diag([given["Ixx"], given["Iyy"], given["Izz"]]))
    assert not any(given[name] for name in ("Ixy", "Iyz", "Ixz", "motor_noise_std"))
    assert np.allclose(vehicle.rotor_position, [*given["rotor_pos"].values()], rtol=1e-12, atol=0)
    assert np.array_equal(vehicle.rotor_spin, given["rotor_directions"])
    assert vehicle.thrust_coefficient == given["k_eta"]
    assert vehicle.torque_coefficient == pytest.approx(given["k_m"] / given["k_eta"], rel=1e-14)
    assert vehicle.thrust_max == pytest.approx(given["k_eta"] * given["rotor_speed_max"] ** 2, rel=1e-14)
    assert keys.parasitic_drag == (given["c_Dx"], given["c_Dy"], given["c_Dz"])
    assert (keys.rotor_drag, keys.inflow_drag) == (given["k_d"], given["k_z"])
    assert (keys.translational_lift, keys.flapping, keys.motor_lag) == (given["k_h"], given["k_flap"], given["tau_m"])
    assert (keys.rotor_speed_min, keys.rotor_speed_max) == (given["rotor_speed_min"], given["rotor_speed_max"])


@needs_rotorpy
@pytest.mark.parametrize("aero", [True, False])
def test_rotorpy_has_the_equations_of_the_package(aero):
    """At random states and commands; flapping, which the Hummingbird has none of, with a number of its own."""
    flapping = ["plant.flapping=3e-5"] if aero else []  # without effect, and refused, where there is no air
    truth = plant("rotorpy", f"plant.aero={aero}", *flapping, "plant.rotor_speed_min=200")
    native, _ = rotorpy_itself(k_flap=3e-5, rotor_speed_min=200)
    native.aero = aero
    f, found, expected = slope(truth), [], []
    for s, u in zip(*random_points(truth), strict=True):
        found.append(f(s, u)[0].full().ravel())
        state = as_rotorpy(s)
        command = np.clip(native.get_cmd_motor_speeds(state, {"cmd_motor_thrusts": u}), 200, 1500)
        dot = native._s_dot_fn(0.0, native._pack_state(state), command)
        expected.append(np.r_[dot[:3], np.roll(dot[6:10], 1), dot[3:6], dot[10:13], dot[16:]])
    assert scaled(np.array(found) - expected, np.array(expected)) < SAME


@needs_rotorpy
@pytest.mark.parametrize("wind", [None, (4.0, -3.0, 1.0)])
def test_rotorpy_flies_as_the_package_does(wind):
    """Two seconds of a flight, flown again by the package's own step from one control period to the next.

    In wind, too: the package subtracts it from the velocity, the world around an airframe moves the frame with it.
    """
    native, _ = rotorpy_itself()
    states, commands, period = some_flight("rotorpy")
    if wind is not None:
        world = World(plant("rotorpy", "plant.step=1e-4"), [ConstantWind(velocity=wind)])
        streams = world.begin(states[0, :13], period, 10.0, np.random.default_rng(0))
        world.inner[:4] = states[0, 13:]
        for k, u in enumerate(commands):
            states[k + 1, :13], _ = world.advance(states[k, :13], u, period, streams)
            states[k + 1, 13:] = world.rotor_speed
    state = as_rotorpy(states[0])
    for u, expected in zip(commands, states[1:], strict=True):
        state["wind"] = np.zeros(3) if wind is None else np.array(wind)
        state = native.step(state, {"cmd_motor_thrusts": u}, period)
        mine, theirs = as_rotorpy(expected), state
        for name in ("x", "v", "w"):
            assert np.abs(mine[name] - theirs[name]).max() < SAME, name
        assert np.abs(mine["q"] * np.sign(mine["q"] @ theirs["q"]) - theirs["q"]).max() < SAME
        assert np.abs(mine["rotor_speeds"] / theirs["rotor_speeds"] - 1).max() < SAME


# -------------------------------------------------------------------------------------------------------- drone-models
def parameter_file() -> dict:
    places = importlib.util.find_spec("drone_models").submodule_search_locations
    return tomllib.loads((Path(places[0]) / "data" / "params.toml").read_text(encoding="utf-8"))


@needs_drone_models
@pytest.mark.parametrize("name", ["drone_models", "drone_models_brushless"])
def test_drone_models_has_the_numbers_of_the_package(name):
    truth, given = plant(name), parameter_file()[PAIRS[name]]
    vehicle, keys = truth.vehicle, truth.keys
    assert (vehicle.mass, -vehicle.gravity) == (given["mass"], given["gravity_vec"][2])
    assert np.array_equal(vehicle.inertia_matrix, given["J"])
    x, y, z = np.array(vehicle.rotor_position).T
    assert np.array_equal([y, -x, 0 * z], given["L"] * np.array(given["mixing_matrix"]) * [[1], [1], [0]])
    assert np.array_equal(vehicle.rotor_spin, given["mixing_matrix"][2])
    assert vehicle.torque_coefficient == given["thrust2torque"]
    assert (vehicle.thrust_min, vehicle.thrust_max) == (given["thrust_min"], given["thrust_max"])
    assert [keys.thrust_curve, keys.torque_curve] == [tuple(given["rpm2thrust"]), tuple(given["rpm2torque"])]
    assert [*keys.spin_up, *keys.spin_down] == given["rotor_dyn_coef"]
    assert np.array_equal(-np.diag(keys.linear_drag), given["drag_matrix"])
    assert keys.propeller_inertia == given["prop_inertia"]


@needs_drone_models
@pytest.mark.parametrize("name", ["drone_models", "drone_models_brushless"])
def test_drone_models_has_the_equations_of_the_package(name, tmp_path):
    """At random states and commands, and over two seconds of a flight that the package flies again."""
    truth = plant(name)
    k_0, k_1, k_2 = truth.keys.thrust_curve

    def rpm(u: np.ndarray) -> np.ndarray:
        return (np.sqrt(k_1**2 + 4 * k_2 * (u - k_0)) - k_1) / (2 * k_2)

    def theirs(s: np.ndarray) -> np.ndarray:
        return np.concatenate([s[..., :3], np.roll(s[..., ATTITUDE], -1, -1), s[..., 7:13], s[..., 13:] / RPM], -1)

    states, commands = random_points(truth)
    flown, held, period = some_flight(name)
    given, out = tmp_path / "given.npz", tmp_path / "out.npz"
    np.savez(
        given, drone=PAIRS[name], s=theirs(states), cmd=rpm(commands), start=theirs(flown[0]), held=rpm(held),
        period=period,
    )  # fmt: skip
    command = [sys.executable, "-m", "tests.world.drone_models_native", given, out]
    subprocess.run(command, check=True, cwd=ROOT, env={**os.environ, "SCIPY_ARRAY_API": "1"})
    answer, f = np.load(out), slope(truth)
    found = theirs(np.array([f(s, u)[0].full().ravel() for s, u in zip(states, commands, strict=True)]))
    assert scaled(found - answer["slopes"], answer["slopes"]) < SAME
    again = answer["flown"]
    again[:, 3:7] /= np.linalg.norm(again[:, 3:7], axis=1, keepdims=True)
    assert scaled(theirs(flown) - again, again) < SAME


# ------------------------------------------------------------------------------------------------- without the packages
@pytest.mark.parametrize("name", PAIRS)
def test_what_a_controller_believes_is_the_plant_with_settled_rotors(name):
    """residual(): x' of the corrected rigid body is the plant's at rotor speeds that the commands have reached."""
    truth = plant(name)
    believed, residual, f = corrected_function(truth.vehicle, truth.residual()), truth.residual(), slope(truth)
    states, commands = random_points(truth, 50)
    settled = plant(name)
    for s, u in zip(states, np.maximum(commands, 0.2 * truth.vehicle.hover_thrust), strict=True):
        for _ in range(60 if settled.loop_lag else 10):  # of 0.1 s each
            settled.advance(s[:13], u, 0.1)
        expected = f(np.r_[s[:13], settled.rotor_speed], u)[0].full().ravel()[:13]
        found = believed(s[:13], u, residual.theta).full().ravel()
        assert np.abs(found - expected).max() < SAME * max(1.0, np.abs(expected).max())


@pytest.mark.parametrize("name", PAIRS)
def test_the_nominal_vehicle_is_the_plant_at_rest(name):
    """In still air, not moving, thrusts are the commanded ones; so is the torque of RotorPy's rotors."""
    truth = plant(name)
    z = np.r_[np.zeros(6), np.full(4, truth.vehicle.hover_thrust)]
    assert len(z) == len(feature_names(4)) and np.abs(truth.residual()(z)[0]).max() < 1e-12
    uneven = np.r_[np.zeros(6), truth.vehicle.hover_thrust * np.array([0.8, 1.1, 1.2, 0.9])]
    y = truth.residual()(uneven)[0]
    assert np.abs(y[:5]).max() < 1e-12
    assert abs(y[5]) < (1e-12 if name == "rotorpy" else 0.02 * truth.vehicle.torque_coefficient)


@pytest.mark.parametrize("name", PAIRS)
def test_slopes_of_the_residual_are_finite_at_the_limits(name):
    truth = plant(name)
    for thrust in (0.0, truth.vehicle.thrust_min, truth.vehicle.thrust_max):
        for v in (np.zeros(3), np.array([3.0, -2.0, 1.0])):
            values = truth.residual().function(np.r_[v, 0.1, 0.2, 0.3, np.full(4, thrust)], truth.residual().theta)
            assert all(np.isfinite(value.full()).all() for value in values)


@pytest.mark.parametrize(
    ("name", "up", "down"), [("drone_models", 0.136, 0.108), ("drone_models_brushless", 0.057, 0.062)]
)
def test_rotors_of_a_crazyflie_spin_up_as_slowly_as_said(name, up, down):
    """After its time constant 1 - 1/e of a small change of the command has been followed; the longer is loop_lag."""
    truth = plant(name)
    hover = truth.vehicle.hover_thrust
    x = np.r_[np.zeros(3), 1, np.zeros(9)]
    for sign, lag in ((1, up), (-1, down)):
        truth.reset()
        before = truth.rotor_speed.copy()
        target = plant(name)
        for _ in range(40):
            target.advance(x, np.full(4, hover * (1 + 1e-4 * sign)), 0.1)
        truth.advance(x, np.full(4, hover * (1 + 1e-4 * sign)), lag)
        share = (truth.rotor_speed - before) / (target.rotor_speed - before)
        assert share == pytest.approx(np.full(4, 1 - np.exp(-1)), abs=0.005)
    assert truth.loop_lag == pytest.approx(max(up, down), abs=1e-3)


@pytest.mark.parametrize("name", PAIRS)
def test_hover_is_hover(name):
    """A flight begins with rotors that carry the vehicle: it stays where it is."""
    truth = plant(name)
    x = np.r_[np.zeros(3), 1, np.zeros(9)]
    for _ in range(20):
        x, reading = truth.advance(x, np.full(4, truth.vehicle.hover_thrust), 0.02)
    assert np.abs(x - np.r_[np.zeros(3), 1, np.zeros(9)]).max() < 1e-12
    assert reading == pytest.approx([0, 0, 9.81], abs=1e-12)


@pytest.mark.parametrize("name", PAIRS)
def test_steps_converge_with_the_fourth_order(name):
    ends = []
    for step in (4e-3, 2e-3, 2.5e-4):
        truth, x = plant(name, f"plant.step={step}"), np.r_[np.zeros(3), 1, 0, 0, 0, 5, -3, 2, 1, 2, 3]
        for share in (1.3, 0.7):
            x, _ = truth.advance(x, truth.vehicle.hover_thrust * share * np.array([1.0, 1.05, 0.98, 1.01]), 0.04)
        ends.append(x)
    coarse, fine = (np.abs(end - ends[2]).max() for end in ends[:2])
    assert 11 < coarse / fine < 23


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["plant=rotorpy", "vehicle=torrente"], "vehicle=hummingbird has"),
        (["plant=rotorpy", "vehicle=hummingbird", "plant.rotor_speed_max=400"], "hovers at 469.2 rad/s"),
        (["plant=drone_models", "vehicle=crazyflie"], "another vehicle's"),
        (["plant=drone_models", "vehicle=torrente"], "another vehicle's"),
        (["plant=drone_models", "vehicle=cf2x_L250", "plant.thrust_curve=[0,0,-1e-10]"], "must rise with the speed"),
        (["plant=drone_models", "vehicle=cf2x_L250", "plant.thrust_curve=[0.1,0,1e-10]"], "must rise with the speed"),
    ],
)
def test_a_vehicle_that_does_not_fit_is_refused(overrides, words):
    config = compose(overrides)
    with pytest.raises(UsageError, match=words):
        build_plant(build_vehicle(config.vehicle), config.plant)


def test_rotors_without_a_lag_have_the_commanded_speed_at_once():
    """Which leaves the lag to an actuator of the world; what is flown is the limit of shorter and shorter lags."""
    u = np.array([1.0, 1.2, 1.4, 1.1])
    ends = []
    for lag in (0.0, 1e-3, 5e-4):
        truth = plant("rotorpy", f"plant.motor_lag={lag}")
        x, _ = truth.advance(np.r_[np.zeros(3), 1, 0, 0, 0, 3, 0, 0, 0, 0, 0], u, 0.02)
        ends.append(x)
        if not lag:
            assert truth.rotor_speed == pytest.approx(np.sqrt(u / truth.vehicle.thrust_coefficient), rel=1e-15)
    longer, shorter = (np.abs(end - ends[0]).max() for end in ends[1:])
    assert longer / shorter == pytest.approx(2, rel=0.02)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (
            ["plant=rotorpy", "vehicle=hummingbird"],
            r"both let the rotors lag, the plant's own by 5 ms; set plant\.motor_lag=0, or actuator",
        ),
        (["plant=drone_models", "vehicle=cf2x_L250"], "the plant's own by 136 ms; set actuator\.time_constant_up=0"),
    ],
)
def test_rotors_do_not_lag_twice(overrides, words):
    config = compose([*overrides, "world=race"])
    with pytest.raises(UsageError, match=words):
        build_world(config, build_vehicle(config.vehicle))
