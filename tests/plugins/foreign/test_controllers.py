"""Controllers of other programs: their own code gives the same commands, whatever the layout, and they fly."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.control.base import Measurement
from quadexp.errors import UsageError
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.physics.state import POSITION, RATE, VELOCITY
from quadexp.plugins.foreign.rotorpy_se3 import RotorPySE3
from tests.control.laws.flown import Body, at_rest, fly, hovering, rotation, vehicle_of
from tests.states import random_state


@pytest.fixture
def raptor():
    pytest.importorskip("foundation_policy")
    from quadexp.plugins.foreign import raptor

    return raptor


def test_the_policy_gives_the_actions_of_its_own_package(raptor):
    """A Crazyflie in its own frames: the package's evaluate_step on the observation of its documentation."""
    from foundation_policy import Raptor

    vehicle, rng = vehicle_of("crazyflie"), np.random.default_rng(4)
    controller = raptor.Raptor(backend="interpreted").controller(vehicle)
    own, action, window = Raptor(), np.zeros(4), hovering(vehicle, (1.0, -2.0, 3.0))
    own.reset()
    controller.reset(at_rest(), window)
    for k in range(40):
        x = random_state(rng, speed=0.6, rate=1.0)
        x[POSITION] = [1.0, -2.0, 3.0] + rng.normal(0, 0.4, 3)
        R = rotation(x).as_matrix()
        error, velocity = np.clip(x[POSITION] - [1.0, -2.0, 3.0], -0.5, 0.5), np.clip(x[VELOCITY], -1, 1)
        action = own.evaluate_step(np.array([[*error, *R.flatten(), *velocity, *x[RATE], *action]]))[0]
        u, _ = controller.step(Measurement(0.01 * k, x, None, None), window)
        assert u == pytest.approx(0.15 * np.clip((action + 1) / 2, 0, 1) ** 2, abs=1e-9)


@pytest.mark.parametrize("name", ["torrente", "blackbird", "hummingbird", "lei_li", "cf2x_L250"])
def test_every_layout_is_brought_into_the_policy_s(raptor, name):
    """Rotors where they should be, turning the way they should: a torque it wants has the sign that it gets."""
    vehicle = vehicle_of(name)
    order, turn = raptor.layout(vehicle)
    position = Rotation.from_rotvec([0, 0, -turn]).apply(np.array(vehicle.rotor_position, float))[order]
    spin = np.array(vehicle.rotor_spin)[order]
    assert (np.sign(position[:, :2]) == [[1, -1], [-1, -1], [-1, 1], [1, 1]]).all()
    assert (spin == [-1, 1, -1, 1]).all()


def test_rotors_that_turn_the_other_way_are_a_vehicle_turned_by_a_right_angle(raptor):
    """The same flight, seen from a body frame that is turned by 90 degrees."""
    vehicle = vehicle_of("torrente")
    other = vehicle_of("torrente", rotor_spin=(1.0, -1.0, 1.0, -1.0))
    assert raptor.layout(other)[1] == pytest.approx(np.pi / 2)
    turn, flown = Rotation.from_rotvec([0, 0, np.pi / 2]), []
    attitude, velocity, rate = Rotation.from_rotvec([0.3, -0.2, 0.4]), np.array([0.4, 0.3, -0.2]), [0.5, -0.7, 0.6]
    for body, view in ((vehicle, Rotation.identity()), (other, turn)):
        # `other` sees the world turned too, so that its own heading of 0 is the policy's
        start = at_rest(view.apply([0.2, -0.3, 0.1]), view * attitude * view.inv())
        start[VELOCITY], start[RATE] = view.apply(velocity), view.apply(rate)
        controller = raptor.Raptor(backend="interpreted").controller(body)
        states, _ = fly(Body(body), controller, start, 1.0, lambda t, body=body: hovering(body))
        flown.append(view.inv().apply(states[:, POSITION]))
    assert flown[1] == pytest.approx(flown[0], abs=1e-9)


def test_the_heading_is_that_of_the_reference(raptor):
    """Turned by the same angle, the flight is the same one turned."""
    vehicle, flown = vehicle_of("crazyflie"), []
    for yaw in (0.0, 2.0):
        turn = Rotation.from_rotvec([0, 0, yaw])
        controller = raptor.Raptor(backend="interpreted").controller(vehicle)
        start = at_rest(turn.apply([0.2, 0.1, -0.2]), turn * Rotation.from_rotvec([0.2, 0.1, 0.3]))
        states, _ = fly(Body(vehicle), controller, start, 1.0, lambda t, yaw=yaw: hovering(vehicle, yaw=yaw))
        flown.append(turn.inv().apply(states[:, POSITION]))
    assert flown[0] == pytest.approx(flown[1], abs=1e-9)


def test_it_flies_a_crazyflie_whose_motors_nobody_told_it_of(raptor):
    """136 ms of lag, at which an MPC that does not know it is refused."""
    flight = fly_one(compose(["vehicle=cf2x_L250", "plant=drone_models", "controller=raptor", "trajectory.speed=2"]))
    assert flight.outcome == "ok" and flight.metadata["row"]["mean_error"] < 0.2


def test_other_rotors_than_four_in_an_x_are_refused(raptor):
    six = tuple((float(np.cos(a)), float(np.sin(a)), 0.0) for a in np.radians(60.0 * np.arange(6)))
    with pytest.raises(UsageError, match="four rotors in an X or a plus that turn alternately"):
        raptor.layout(vehicle_of("torrente", rotor_position=six, rotor_spin=(1.0, -1.0) * 3))
    narrow = ((0.3, -0.06, 0.0), (-0.3, -0.06, 0.0), (-0.3, 0.06, 0.0), (0.3, 0.06, 0.0))
    with pytest.raises(UsageError, match="four rotors"):
        raptor.layout(vehicle_of("torrente", rotor_position=narrow))


@pytest.mark.parametrize(
    ("controller", "module"),
    [("raptor", "foundation_policy"), ("rotorpy_se3", "rotorpy.controllers.quadrotor_control")],
)
def test_a_missing_package_is_said_in_one_line(monkeypatch, controller, module):
    from quadexp.plugins.foreign import raptor as laws

    monkeypatch.setitem(sys.modules, module, None)
    laws.policy.cache_clear()
    monkeypatch.setattr("quadexp.control.cached_function._functions", {})
    with pytest.raises(UsageError, match=rf'controller={controller}: needs the package .*pip install "quadexp'):
        fly_one(compose([f"controller={controller}", "vehicle=blackbird", "seed=7", "controller.rate=77"]))


def test_rotorpy_s_controller_is_what_its_paper_says(monkeypatch):
    """Its commands against the printed law in numpy, on a vehicle with products of inertia."""
    pytest.importorskip("rotorpy")
    from quadexp.plugins.foreign.rotorpy_se3 import RotorPySE3Controller

    vehicle, rng, keys = vehicle_of("lei_li", thrust_max=900.0), np.random.default_rng(6), RotorPySE3()
    object.__setattr__(vehicle, "thrust_min", -900.0)
    controller = RotorPySE3Controller(vehicle, keys)
    for _ in range(20):
        x, yaw = random_state(rng), rng.uniform(-3, 3)
        window = hovering(vehicle, (1.0, 2.0, 3.0), yaw)
        window.position[1:3] = rng.normal(size=(2, 3))
        u, record = controller.step(Measurement(0.0, x, None, None), window)
        R, J = rotation(x).as_matrix(), vehicle.inertia_matrix
        error, slow = x[POSITION] - window.position[0], x[VELOCITY] - window.position[1]
        F = -np.array([6.5, 6.5, 15]) * error - np.array([4.0, 4, 9]) * slow + window.position[2] + [0, 0, 9.81]
        z = F / np.linalg.norm(F)
        y = np.cross(z, [np.cos(yaw), np.sin(yaw), 0])
        y /= np.linalg.norm(y)
        D = np.stack([np.cross(y, z), y, z], axis=1)
        S = (D.T @ R - R.T @ D) / 2
        e_R, w = np.array([S[2, 1], S[0, 2], S[1, 0]]), x[RATE]
        torque = J @ (-310 * e_R - 57 * w) + np.cross(w, J @ w)
        expected = np.linalg.inv(vehicle.allocation) @ [vehicle.mass * F @ R[:, 2], *torque]
        assert u == pytest.approx(expected, rel=1e-9, abs=1e-9) and record.active == 0


@pytest.mark.parametrize("world", [["vehicle=hummingbird", "plant=rotorpy", "trajectory.speed=4"], ["plant=ideal"]])
def test_rotorpy_s_controller_flies(world):
    pytest.importorskip("rotorpy")
    flight = fly_one(compose(["controller=rotorpy_se3", *world]))
    assert flight.outcome == "ok" and flight.metadata["row"]["mean_error"] < 0.3
