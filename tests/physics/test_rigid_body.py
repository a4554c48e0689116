"""The rigid body against what mechanics says of it."""

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.physics.rigid_body import body_features, rigid_body_function, state_derivative
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from tests.states import random_state


def rotation(x: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(x[ATTITUDE], scalar_first=True).as_matrix()


def call(function: ca.Function, *arguments) -> np.ndarray:
    return np.array(function(*arguments)).reshape(-1)


def test_hover_is_an_equilibrium(vehicle):
    x = np.zeros(13)
    x[3] = 1
    assert np.allclose(call(rigid_body_function(vehicle), x, np.full(4, vehicle.hover_thrust)), 0, atol=1e-14)


def test_torque_signs_of_the_x_layout(vehicle):
    """Torrente: tau = [d(-T0-T1+T2+T3), d(-T0+T1+T2-T3), c(-T0+T1-T2+T3)]."""
    d, c = 0.235 / np.sqrt(2), 0.013
    expected = [[1, 1, 1, 1], [-d, -d, d, d], [-d, d, d, -d], [-c, c, -c, c]]
    assert np.allclose(vehicle.allocation, expected, atol=1e-15)


def test_newton_euler_in_matrix_form(odd_vehicle, rng):
    """Independent numpy Newton-Euler: m v' = R T e_z + m g, J w' + w x J w = tau = sum r x F + reaction."""
    function, J = rigid_body_function(odd_vehicle), odd_vehicle.inertia_matrix
    for _ in range(20):
        x, u = random_state(rng), rng.uniform(0.5, 8, 6)
        R, w = rotation(x), x[RATE]
        torque = sum(np.cross(r, [0, 0, t]) for r, t in zip(odd_vehicle.rotor_position, u, strict=True))
        torque[2] += odd_vehicle.torque_coefficient * np.dot(odd_vehicle.rotor_spin, u)
        derivative = call(function, x, u)
        assert np.allclose(derivative[POSITION], x[VELOCITY])
        assert np.allclose(derivative[VELOCITY], R @ [0, 0, u.sum()] / odd_vehicle.mass - [0, 0, 9.81])
        assert np.allclose(J @ derivative[RATE] + np.cross(w, J @ w), torque)
        q_dot, q = derivative[ATTITUDE], x[ATTITUDE]
        turn = 1e-6  # finite rotation by w dt about the body axes is R exp([w] dt)
        ahead = Rotation.from_matrix(R) * Rotation.from_rotvec(w * turn)
        assert np.allclose(rotation(np.r_[0, 0, 0, q + turn * q_dot]), ahead.as_matrix(), atol=1e-10)


def test_correction_enters_in_the_body_frame(vehicle, rng):
    x, u, y = random_state(rng), rng.uniform(1, 5, 4), rng.normal(size=6)
    plain = call(rigid_body_function(vehicle), x, u)
    corrected = np.array(ca.evalf(state_derivative(ca.DM(x), ca.DM(u), vehicle, ca.DM(y)))).reshape(-1)
    assert np.allclose(corrected[VELOCITY] - plain[VELOCITY], rotation(x) @ y[:3])
    assert np.allclose(vehicle.inertia_matrix @ (corrected[RATE] - plain[RATE]), y[3:])


def test_features_are_body_velocity_rate_and_thrust(vehicle, rng):
    x, u = random_state(rng), rng.uniform(1, 5, 4)
    z = np.array(ca.evalf(body_features(ca.DM(x), ca.DM(u)))).reshape(-1)
    assert np.allclose(z, np.r_[rotation(x).T @ x[VELOCITY], x[RATE], u])
