"""A disturbance, a wind and a thrust scale that are assumed: against simulations of a world that has them."""

import os
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from quadexp.control.base import Belief, Measurement, Window
from quadexp.control.control_step import InputArrays, run
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.prediction import node_function
from quadexp.control.mpc.settings import MPCSettings
from quadexp.errors import QuadexpError
from quadexp.experiment.rollout import SampledReference
from quadexp.physics.integrator import rk4_step
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.sensitivity import rk4_sensitivity_function
from quadexp.reference.circle import Circle
from tests.models.residuals import RESIDUALS, make_residual
from tests.states import random_state

DISTURBANCE = np.array([1.2, -0.7, 2.1, 0.9, -1.4, 0.3])


def controller_of(vehicle, residual, disturbed=True, backend="interpreted", **settings) -> PredictiveController:
    mpc = ModelPredictiveController(vehicle, residual, MPCSettings(**settings), backend=backend, disturbed=disturbed)
    return PredictiveController(mpc)


def in_a_world(vehicle, residual, x, u, duration, force, torque, wind, lag=0.0, thrust=None):
    """Newton and Euler by SciPy, nothing shared with the model but the residual: state after a held command."""
    inertia = np.array(vehicle.inertia)
    start = np.concatenate([x, u if thrust is None else thrust])

    def slope(_, z):
        p, q, v, w, acting = np.split(z, [3, 7, 10, 13])
        R = Rotation.from_quat(q, scalar_first=True).as_matrix()
        y = residual(np.concatenate([R.T @ (v - wind), w, acting]))[0]
        wrench = vehicle.allocation @ acting
        acceleration = R @ (np.array([0, 0, wrench[0] / vehicle.mass]) + y[:3]) + force / vehicle.mass
        spin = np.linalg.solve(inertia, wrench[1:] + y[3:] + torque - np.cross(w, inertia @ w))
        turn = np.concatenate([[-w @ q[1:]], q[0] * w + np.cross(q[1:], w)])
        thrusts = (u - acting) / lag if lag else np.zeros(len(u))
        return np.concatenate([v, turn / 2, acceleration - [0, 0, vehicle.gravity], spin, thrusts])

    return solve_ivp(slope, (0, duration), start, rtol=1e-11, atol=1e-12).y[:, -1]


@pytest.mark.parametrize("scalar", [True, False])
@pytest.mark.parametrize("name", ["none", "gp_with_mean", "plant"])
def test_the_sensitivities_with_a_disturbance(vehicle, rng, name, scalar):
    """Against automatic differentiation, and finite differences of the step for good measure."""
    residual, dt, h = make_residual(name, vehicle), 0.08, 1e-5
    corrected = corrected_function(vehicle, residual)
    x, u, d = ca.MX.sym("x", 13), ca.MX.sym("u", 4), ca.MX.sym("d", 6)
    x_next = rk4_step(lambda s: corrected(s, u, residual.theta) + ca.vertcat(ca.MX.zeros(7), d), x, dt)
    whole = ca.Function("whole", [x, u, d], [x_next, ca.jacobian(x_next, x), ca.jacobian(x_next, u)])
    chained = rk4_sensitivity_function(vehicle, residual, scalar=scalar, disturbed=True)
    x0, u0 = random_state(rng), rng.uniform(0.5, 10, 4)

    def step(x, u):
        return chained(x, u, residual.theta, dt, DISTURBANCE)[0].full().ravel()

    found = [np.array(part) for part in chained(x0, u0, residual.theta, dt, DISTURBANCE)]
    for one, other in zip(whole(x0, u0, DISTURBANCE), found, strict=True):
        assert np.allclose(one, other, rtol=1e-11, atol=1e-11)
    by_x = np.stack([(step(x0 + h * e, u0) - step(x0 - h * e, u0)) / (2 * h) for e in np.eye(13)], axis=1)
    by_u = np.stack([(step(x0, u0 + h * e) - step(x0, u0 - h * e)) / (2 * h) for e in np.eye(4)], axis=1)
    assert np.allclose(by_x, found[1], atol=1e-6) and np.allclose(by_u, found[2], atol=1e-6)


@pytest.mark.parametrize("name", RESIDUALS)
def test_the_prediction_is_the_world_with_force_torque_and_wind(vehicle, rng, name):
    """In the frame of the air, 50 ms in steps of 2 ms, against SciPy in the world."""
    residual = make_residual(name, vehicle)
    force, torque, wind = rng.normal(size=3) * 2, rng.normal(size=3) * 0.05, rng.normal(size=3) * 4
    node = node_function(vehicle, residual, disturbed=True)
    x, u = random_state(rng, speed=3.0, rate=1.0), rng.uniform(1, 5, 4)
    d = np.concatenate([force / vehicle.mass, np.linalg.solve(vehicle.inertia_matrix, torque)])
    inside = x - np.concatenate([np.zeros(7), wind, np.zeros(3)])
    for _ in range(25):
        inside = node(inside, u, residual.theta, 0.002, d).full().ravel()
    expected = in_a_world(vehicle, residual, x, u, 0.05, force, torque, wind)[:13]
    found = inside + np.concatenate([wind * 0.05, np.zeros(4), wind, np.zeros(3)])
    assert found == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize("lag", [0.0, 0.03])
def test_the_dead_time_is_predicted_in_the_believed_world(vehicle, rng, lag):
    residual, scale = make_residual("linear_drag", vehicle), 0.9
    belief = Belief(np.array([1.0, -2.0, 0.5]), np.array([0.02, 0.01, -0.01]), np.array([3.0, -4.0, 1.0]), scale)
    controller = controller_of(vehicle, residual, dead_time=0.02, motor_lag=lag)
    x, window = a_window(controller, rng)
    controller.reset(x, window)
    controller.believe(belief)
    inside = entered(controller, x, window)
    thrust, u = np.full(4, 3.0), rng.uniform(1, 4, 4)
    controller.predictor.reset(thrust)
    controller.predictor.memory.of_now["sent"][...] = u
    found = controller.predictor.predict(inside)
    expected = in_a_world(
        vehicle, residual, x, u, 0.02, belief.force, belief.torque, belief.wind, lag, thrust if lag else u
    )
    back = found[:13] + np.concatenate([belief.wind * 0.02, np.zeros(4), belief.wind, np.zeros(3)])
    assert back == pytest.approx(expected[:13], abs=2e-5)


def entered(controller, x, window) -> np.ndarray:
    """The state (13,) in the plan's frame, where all that stands before the plan has been done."""
    told = InputArrays(4)
    told.set_measurement(Measurement(0.0, x, None, None), window)
    calls, inside = controller.believed.before(told, told.state)
    run(calls, window=window)
    return inside


def a_window(controller, rng) -> tuple[np.ndarray, Window]:
    """A state near a circle, and the window there."""
    reference = SampledReference(Circle(speed=5.0), controller)
    window = reference.window(200)
    x = window.state[0] + rng.normal(size=13) * 0.02
    x[3:7] /= np.linalg.norm(x[3:7])
    return x, window


def test_nothing_believed_is_the_controller_without(vehicle, rng):
    """To rounding: zeros are added where there was nothing."""
    residual = make_residual("gp_with_mean", vehicle)
    plain, told = (controller_of(vehicle, residual, disturbed) for disturbed in (False, True))
    x, window = a_window(plain, rng)
    for controller in (plain, told):
        controller.reset(x, window)
    told.believe(Belief(np.zeros(3), np.zeros(3), np.zeros(3)))
    measurement = Measurement(0.0, x, None, None)
    for _ in range(2):
        one, other = (controller.step(measurement, window)[0] for controller in (plain, told))
        assert one == pytest.approx(other, abs=1e-9)


def test_a_wind_is_a_frame_that_moves(vehicle, rng):
    """The controller in a wind answers as one in still air that meets everything with the wind's velocity taken off."""
    residual, wind = make_residual("gp_with_mean", vehicle), np.array([3.0, -2.0, 0.5])
    moving, still = (controller_of(vehicle, residual) for _ in range(2))
    x, window = a_window(moving, rng)
    for controller in (moving, still):
        controller.reset(x, window)
    for k in range(3):
        moving.believe(Belief(np.zeros(3), np.zeros(3), wind))
        thrust, _ = moving.step(Measurement(0.02 * k, x, None, None), window)
        at, states = x.copy(), window.state.copy()
        at[7:10] -= wind
        states[:, 7:10] -= wind
        states[:, :3] -= wind * (still.node_times[:, None] + 0.02 * k)  # one frame for the whole flight
        at[:3] -= wind * 0.02 * k
        expected, _ = still.step(Measurement(0.0, at, None, None), window._replace(state=states))
        assert thrust == pytest.approx(expected, abs=1e-4)


def test_a_wind_that_changes_moves_the_plan_with_it(vehicle, rng):
    """In the world the last plan stays where it was: the frame's origin went with the first wind for a period."""
    controller = controller_of(vehicle, make_residual("none", vehicle), dead_time=0.01)
    x, window = a_window(controller, rng)
    controller.reset(x, window)
    times = 0.01 + controller.settings.node_times[:, None]
    first, second = np.array([3.0, -2.0, 0.5]), np.array([2.0, 1.0, 0.0])
    controller.believe(Belief(np.zeros(3), np.zeros(3), first))
    controller.step(Measurement(0.0, x, None, None), window)
    X = controller.mpc.prediction[0].copy()
    controller.believe(Belief(np.zeros(3), np.zeros(3), second))
    entered(controller, x, window)
    moved = controller.mpc.prediction[0]
    assert moved[:, 7:10] + second == pytest.approx(X[:, 7:10] + first)
    assert moved[:, :3] + 0.02 * first + second * (times - 0.02) == pytest.approx(X[:, :3] + first * times)


def test_a_thrust_scale_asks_for_more_of_the_rotors(vehicle, rng):
    """s = 0.8: the thrusts of the plan are those with limits at 0.8 of the rotors', the command is 1 / 0.8 of them."""
    residual = make_residual("none", vehicle)
    plain, scaled = (controller_of(vehicle, residual, position_weight=(200.0, 200.0, 200.0)) for _ in range(2))
    x, window = a_window(plain, rng)
    x[2] -= 3.0  # far below: the rotors meet their limit
    for controller in (plain, scaled):
        controller.reset(x, window)
    scaled.believe(Belief(np.zeros(3), np.zeros(3), np.zeros(3), 0.8))
    plain.mpc.step.arguments["u_max"][...] *= 0.8
    one, other = (controller.step(Measurement(0.0, x, None, None), window)[0] for controller in (plain, scaled))
    assert other * 0.8 == pytest.approx(one)
    assert vehicle.thrust_max * (1 - 1e-14) < other.max() <= vehicle.thrust_max
    scaled.reset(x, window)  # and with the flight the belief ends
    assert np.array_equal(scaled.mpc.step.arguments["u_max"], np.full(4, vehicle.thrust_max))


def test_a_thrust_scale_moves_the_lower_limit_too(vehicle, rng):
    """Far above, with rotors that cannot give less than a newton: the command is at that limit."""
    vehicle = replace(vehicle, thrust_min=1.0)
    scaled = controller_of(vehicle, make_residual("none", vehicle), position_weight=(200.0, 200.0, 200.0))
    x, window = a_window(scaled, rng)
    x[2] += 3.0
    scaled.reset(x, window)
    scaled.believe(Belief(np.zeros(3), np.zeros(3), np.zeros(3), 0.8))
    thrust = scaled.step(Measurement(0.0, x, None, None), window)[0]
    assert 1.0 <= thrust.min() < 1.0 * (1 + 1e-14)


def test_a_flight_begins_without_a_belief(vehicle, rng):
    controller = controller_of(vehicle, make_residual("none", vehicle), dead_time=0.02)
    x, window = a_window(controller, rng)

    def first_thrust():
        controller.reset(x, window)
        return controller.step(Measurement(0.0, x, None, None), window)[0]

    before = first_thrust()
    controller.believe(Belief(np.ones(3), np.full(3, 0.1), np.ones(3), 0.9))
    controller.step(Measurement(0.02, x, None, None), window)
    assert first_thrust() == pytest.approx(before, abs=1e-9)


def test_a_belief_compiles_nothing_again(vehicle, rng):
    """Beliefs of every kind after the first are numbers in arrays."""
    controller = controller_of(vehicle, make_residual("linear_drag", vehicle), backend="auto", dead_time=0.02)
    x, window = a_window(controller, rng)
    controller.reset(x, window)
    controller.believe(Belief(np.zeros(3), np.zeros(3), np.zeros(3)))
    controller.step(Measurement(0.0, x, None, None), window)
    before = {*Path(os.environ["QUADEXP_CACHE"]).rglob("*.so")}
    thrusts = []
    for _ in range(3):
        controller.believe(Belief(*(rng.normal(size=3) * [[2], [0.05], [3]]), 1 + 0.1 * rng.normal()))
        thrusts.append(controller.step(Measurement(0.02, x, None, None), window)[0])
    assert {*Path(os.environ["QUADEXP_CACHE"]).rglob("*.so")} == before
    assert np.abs(np.diff(thrusts, axis=0)).min() > 0


def test_a_model_without_a_disturbance_says_so(vehicle, rng):
    controller = controller_of(vehicle, make_residual("none", vehicle), disturbed=False)
    with pytest.raises(QuadexpError, match="disturbed=True"):
        controller.believe(Belief(np.ones(3), np.zeros(3), np.zeros(3)))


@pytest.mark.parametrize("deviation", ["command", "deviation"])
def test_back_ends_agree_on_a_belief(vehicle, rng, deviation):
    thrusts = []
    belief = Belief(np.array([1.0, -2.0, 0.5]), np.array([0.02, 0.01, -0.01]), np.array([3.0, -4.0, 1.0]), 1.05)
    for backend in ("interpreted", "auto"):
        controller = controller_of(
            vehicle, make_residual("linear_drag", vehicle), backend=backend, input_hold=deviation, dead_time=0.03
        )
        x, window = a_window(controller, np.random.default_rng(3))
        controller.reset(x, window)
        controller.believe(belief)
        thrusts.append([controller.step(Measurement(0.0, x, None, None), window)[0] for _ in range(2)])
    assert thrusts[0] == pytest.approx(np.array(thrusts[1]), abs=1e-7)
