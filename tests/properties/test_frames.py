"""Round trips between frames and between ways of writing an attitude."""

import casadi as ca
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.plugins.papers.lei_li.feedback.frames import (
    FRD_FLU,
    NED_ENU,
    euler_angles,
    rotation_euler,
    state_from_ned,
    yaw_ned,
)
from tests.properties.strategies import generators, make_state
from tests.states import ned_from_state

angles = st.floats(-3.1, 3.1)
pitches = st.floats(-1.56, 1.56)


def number(expression) -> np.ndarray:
    return np.array(ca.DM(expression).full())


@given(generators)
def test_quaternion_to_matrix_is_scipys_and_composes(rng):
    a, b = (make_state(rng)[ATTITUDE] for _ in range(2))
    A, B = (Rotation.from_quat(q, scalar_first=True) for q in (a, b))
    assert np.allclose(number(rotation_matrix(ca.DM(a))), A.as_matrix(), atol=1e-14)
    assert np.allclose(number(rotation_matrix(ca.DM(-a))), A.as_matrix(), atol=1e-14)
    length = rng.uniform(0.5, 2.0)
    assert np.allclose(number(rotation_matrix(ca.DM(length * a))), A.as_matrix(), atol=1e-14)
    product = (A * B).as_quat(scalar_first=True)
    composed = number(rotation_matrix(ca.DM(a))) @ number(rotation_matrix(ca.DM(b)))
    assert np.allclose(number(rotation_matrix(ca.DM(product))), composed, atol=1e-14)


@given(angles, pitches, angles)
def test_euler_angles_round_trip_up_to_steep_pitch(roll, pitch, yaw):
    eta = np.array([roll, pitch, yaw])
    R = number(rotation_euler(ca.DM(eta)))
    assert np.allclose(R, Rotation.from_euler("ZYX", eta[::-1]).as_matrix(), atol=1e-14)
    assert np.allclose(number(euler_angles(ca.DM(R))).ravel(), eta, atol=1e-7 / np.cos(pitch))


@given(generators)
def test_states_round_trip_between_enu_flu_and_ned_frd(rng):
    x = make_state(rng)
    back = state_from_ned(*ned_from_state(x))
    back[ATTITUDE] *= np.sign(back[ATTITUDE] @ x[ATTITUDE])
    assert np.allclose(back, x, atol=1e-7)


@given(generators)
def test_vectors_agree_in_both_worlds(rng):
    """A body vector, turned into the world and there from ENU to NED, is the FRD vector turned by the Euler angles."""
    x, body = make_state(rng), rng.normal(size=3)
    position, eta, velocity, rate = ned_from_state(x)
    east_north_up = Rotation.from_quat(x[ATTITUDE], scalar_first=True).apply(body)
    assert np.allclose(NED_ENU @ east_north_up, number(rotation_euler(ca.DM(eta))) @ FRD_FLU @ body, atol=1e-8)
    for ned, enu in ((position, x[POSITION]), (velocity, x[VELOCITY])):
        assert np.array_equal(ned, [enu[1], enu[0], -enu[2]])
    assert np.array_equal(rate, x[RATE] * [1, -1, -1])


@given(angles, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_heading_in_both_worlds(yaw, roll, pitch):
    """psi of the NED/FRD attitude is pi/2 less the ENU heading, and back, tilted or not."""
    q = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat(scalar_first=True)
    _, eta, _, _ = ned_from_state(np.r_[np.zeros(3), q, np.zeros(6)])
    assert np.isclose(np.angle(np.exp(1j * (eta[2] - yaw_ned(yaw)))), 0, atol=1e-9)
    assert np.isclose(eta[0], roll, atol=1e-9) and np.isclose(eta[1], -pitch, atol=1e-9)
    assert np.isclose(yaw_ned(yaw_ned(yaw)), yaw)
