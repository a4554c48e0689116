"""Rotation vectors: exponential, logarithm and right Jacobian against scipy's rotations and against a limit."""

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.physics.rotation import air_velocity, exponential, product
from quadexp.plugins.worlds.rotation_vector import conjugate, cross_matrix, logarithm, right_jacobian


def number(expression) -> np.ndarray:
    return np.array(ca.DM(expression).full()).squeeze()


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-5, 9.9e-3, 1.01e-2, 0.7, 3.1])
def test_exponential_and_logarithm_are_scipys(angle):
    axis = np.array([0.6, -0.48, 0.64])
    q = number(exponential(ca.DM(angle * axis)))
    assert np.allclose(q, Rotation.from_rotvec(angle * axis).as_quat(scalar_first=True), atol=1e-15)
    assert np.allclose(number(logarithm(ca.DM(q))), angle * axis, rtol=1e-12, atol=1e-15)
    assert np.allclose(number(logarithm(ca.DM(-q))), angle * axis, rtol=1e-12, atol=1e-15)  # the same rotation


@pytest.mark.parametrize("angle", [0.0, 1e-6, 9.9e-3, 1.01e-2, 0.3, 2.5])
def test_right_jacobian_is_the_derivative_of_the_exponential(angle):
    phi, small = angle * np.array([0.6, -0.48, 0.64]), 1e-6

    def apart(d: np.ndarray) -> np.ndarray:
        return (Rotation.from_rotvec(phi).inv() * Rotation.from_rotvec(phi + d)).as_rotvec()

    derivative = np.column_stack([(apart(small * e) - apart(-small * e)) / (2 * small) for e in np.eye(3)])
    assert np.allclose(number(right_jacobian(ca.DM(phi))), derivative, atol=1e-9)


def test_products_and_cross_products():
    rng = np.random.default_rng(0)
    p, q = Rotation.from_quat(rng.normal(size=(2, 4)))
    a, b = (r.as_quat(scalar_first=True) for r in (p, q))
    assert np.allclose(
        Rotation.from_quat(number(product(ca.DM(a), ca.DM(b))), scalar_first=True).as_matrix(), (p * q).as_matrix()
    )
    assert np.allclose(number(product(ca.DM(a), conjugate(ca.DM(a)))), [1, 0, 0, 0])
    u, v = rng.normal(size=(2, 3))
    assert np.allclose(number(cross_matrix(ca.DM(u))) @ v, np.cross(u, v))


def test_velocity_relative_to_the_air_of_one_and_of_many(rng):
    """Expressions, one sample and many, against scipy: R' (v - wind)."""
    q = Rotation.from_quat(rng.normal(size=(6, 4)))
    velocity, wind = rng.normal(size=(2, 6, 3))
    rows = q.as_quat(scalar_first=True)
    for blowing in (wind, None):
        expected = q.inv().apply(velocity if blowing is None else velocity - blowing)
        assert np.allclose(air_velocity(rows, velocity, blowing), expected, atol=1e-14)
        for k in range(6):
            one = rows[k], velocity[k], None if blowing is None else blowing[k]
            assert np.allclose(air_velocity(*one), expected[k], atol=1e-14)
            terms = [None if part is None else ca.DM(part) for part in one]
            assert np.allclose(number(air_velocity(*terms)), expected[k], atol=1e-14)
