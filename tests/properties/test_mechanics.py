"""Balances of energy and momentum for any rigid body with rotors, under any wrench of the air."""

from dataclasses import replace

import casadi as ca
import numpy as np
from hypothesis import given
from scipy.spatial.transform import Rotation

from quadexp.physics.integrator import rk4_step
from quadexp.physics.rigid_body import corrected_function, rigid_body_function, state_derivative
from quadexp.physics.rotation import quaternion_rate, rotation_matrix
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.plugins.papers.lei_li.plant import BladeElementPlant
from quadexp.world import SimplifiedPlant
from tests.properties.strategies import (
    generators,
    make_blade,
    make_blade_effects,
    make_effects,
    make_state,
    make_thrusts,
    make_upright_state,
    vehicles,
)

GRAVITY = np.array([0, 0, -9.81])


def attitude(x) -> np.ndarray:
    return Rotation.from_quat(x[ATTITUDE], scalar_first=True).as_matrix()


def rotor_wrench(vehicle, u) -> tuple[np.ndarray, np.ndarray]:
    """Force and torque of the rotors, body frame: sum of r_i x F_i and of the reaction torques."""
    forces = np.outer(u, [0, 0, 1.0])
    torque = np.cross(np.array(vehicle.rotor_position), forces).sum(axis=0)
    torque[2] += vehicle.torque_coefficient * np.dot(vehicle.rotor_spin, u)
    return forces.sum(axis=0), torque


@given(vehicles(), generators)
def test_power_and_momentum_balance(vehicle, rng):
    """dE/dt = F . v + tau . w,  dp/dt = R F + m g,  dL/dt = R tau  with E, p = m v, L = R J w in the world."""
    x, u, air = make_state(rng), make_thrusts(rng, vehicle), rng.normal(size=6)
    rate_of_change = np.array(ca.evalf(state_derivative(ca.DM(x), ca.DM(u), vehicle, ca.DM(air)))).reshape(-1)
    m, J, R, v, w = vehicle.mass, vehicle.inertia_matrix, attitude(x), x[VELOCITY], x[RATE]
    force, torque = rotor_wrench(vehicle, u)
    force, torque = force + m * air[:3], torque + air[3:]

    momentum_rate = m * rate_of_change[VELOCITY]
    assert np.allclose(momentum_rate, R @ force + m * GRAVITY, rtol=1e-12, atol=1e-12 * m)
    spin_rate = J @ rate_of_change[RATE]
    assert np.allclose(R @ (spin_rate + np.cross(w, J @ w)), R @ torque, rtol=1e-9, atol=1e-12)
    energy_rate = momentum_rate @ v + w @ spin_rate - m * GRAVITY @ rate_of_change[POSITION]
    assert np.isclose(energy_rate, force @ R.T @ v + torque @ w, rtol=1e-10, atol=1e-10)
    assert np.array_equal(rate_of_change[POSITION], v)


@given(generators)
def test_attitude_turns_with_the_body_rate(rng):
    """R' = R [w]x exactly, by differentiating R(q) along q'; the quaternion keeps its length."""
    x = make_state(rng)
    q, w = ca.SX.sym("q", 4), ca.SX.sym("w", 3)
    q_dot = quaternion_rate(q, w)
    turned = ca.Function("R_dot", [q, w], [ca.jtimes(ca.vec(rotation_matrix(q)), q, q_dot), ca.dot(q, q_dot)])
    R_dot, growth = turned(x[ATTITUDE], x[RATE])
    w1, w2, w3 = x[RATE]
    expected = attitude(x) @ np.array([[0, -w3, w2], [w3, 0, -w1], [-w2, w1, 0]])
    assert np.allclose(np.array(R_dot).reshape(3, 3, order="F"), expected, atol=1e-12)
    assert abs(float(growth)) < 1e-14


@given(vehicles(), generators)
def test_torque_free_flight_conserves(vehicle, rng):
    """No wrench: rotational energy and angular momentum in the world stay while it tumbles, and it falls freely."""
    x0, step = make_state(rng), 2e-3
    x = ca.SX.sym("x", 13)
    f = rigid_body_function(vehicle)
    one = ca.Function("one", [x], [rk4_step(lambda s: f(s, np.zeros(vehicle.n_rotors)), x, step)])
    path = np.array(one.mapaccum(400)(x0)).T
    J = vehicle.inertia_matrix
    size = np.linalg.norm(J @ x0[RATE])
    for state in path[::80]:
        w = state[RATE]
        assert np.isclose(w @ J @ w, x0[RATE] @ J @ x0[RATE], rtol=1e-6)
        assert np.allclose(attitude(state) @ J @ w, attitude(x0) @ J @ x0[RATE], atol=1e-6 * size)
    t = 400 * step
    assert np.allclose(path[-1, VELOCITY], x0[VELOCITY] + t * GRAVITY, atol=1e-10)
    assert np.allclose(path[-1, POSITION], x0[POSITION] + t * x0[VELOCITY] + t * t / 2 * GRAVITY, atol=1e-10)


@given(vehicles(), generators)
def test_drag_only_takes_energy(vehicle, rng):
    """Rotors off in the simplified plant: the mechanical energy never rises."""
    plant = SimplifiedPlant(vehicle, replace(make_effects(rng), lift=0.0), step=2e-3, backend="interpreted")
    mass, J, x = vehicle.mass, vehicle.inertia_matrix, make_state(rng)

    def energy(x):
        return mass * (x[VELOCITY] @ x[VELOCITY] / 2 - GRAVITY @ x[POSITION]) + x[RATE] @ J @ x[RATE] / 2

    before = energy(x)
    for _ in range(5):
        x, _ = plant.advance(x, np.zeros(vehicle.n_rotors), 0.02, rng)
        assert energy(x) < before + 1e-7 * abs(before)
        before = energy(x)


@given(vehicles(flat=True), generators)
def test_plants_integrate_the_equations_they_state(vehicle, rng):
    """One RK4 step of a plant is one RK4 step of the rigid body with the plant's own residual, in any state.

    The accelerometer reads what that residual and the rotors accelerate besides gravity.
    """
    x, u, h = make_upright_state(rng), make_thrusts(rng, vehicle), 4e-3
    plants = (
        SimplifiedPlant(vehicle, make_effects(rng), step=h, backend="interpreted"),
        BladeElementPlant(
            vehicle, make_blade(rng), make_blade_effects(rng), step=h, method="rk4", backend="interpreted"
        ),
    )
    for plant in plants:
        residual = plant.residual()
        f = corrected_function(vehicle, residual)
        after, reading = plant.advance(x, u, h, rng)
        expected = np.array(rk4_step(lambda s, f=f, r=residual: f(s, u, r.theta), ca.DM(x), h)).reshape(-1)
        expected[ATTITUDE] /= np.linalg.norm(expected[ATTITUDE])
        change = np.abs(expected - x) + 1e-3
        assert np.all(np.abs(after - expected) < 1e-6 * change)
        acceleration = np.array(f(after, u, residual.theta)).reshape(-1)[VELOCITY]
        assert np.allclose(reading, attitude(after).T @ (acceleration - GRAVITY), rtol=1e-6, atol=1e-6)
