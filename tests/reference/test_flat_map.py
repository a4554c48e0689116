"""The tilt frame: it maps f to the specific force by a turn about a horizontal axis, and its rates are its rates."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.reference.flat_map import tilt, twisted, untwisted


def some(rng, k=40):
    force = rng.normal(size=(3, k)) * 6 + [[0], [0], [9.81]]
    force[2] = np.abs(force[2]) + 0.5
    return force, rng.normal(size=(2, k)) * 0.3 * np.linalg.norm(force, axis=0) / 2


def test_tilt_takes_f_to_the_specific_force(rng):
    force, lateral = some(rng)
    frame = tilt(force, lateral)
    w, x, y = frame.quaternion
    rotation = Rotation.from_quat(np.stack([x, y, 0 * x, w], axis=1))
    np.testing.assert_allclose(rotation.apply(frame.force.T).T, force, atol=1e-12)
    np.testing.assert_allclose(frame.force[:2], lateral)
    vector = rng.normal(size=force.shape)
    np.testing.assert_allclose(frame.into_frame(vector), rotation.inv().apply(vector.T).T, atol=1e-13)


def test_upside_down_the_tilt_is_half_a_turn_about_y():
    """Straight down no horizontal axis is distinguished: x and z change their signs, and nothing its length."""
    frame = tilt(np.array([[0.0], [0.0], [-5.0]]), np.zeros((2, 1)))
    np.testing.assert_allclose(frame.force[:, 0], [0, 0, 5])
    np.testing.assert_allclose(frame.into_frame(np.array([[1.0], [2.0], [3.0]]))[:, 0], [-1, 2, -3])
    np.testing.assert_allclose(np.linalg.norm(frame.body_quaternion(np.array([0.7])), axis=0), 1)


def test_body_quaternion_is_tilt_then_twist(rng):
    frame = tilt(*some(rng))
    w, x, y = frame.quaternion
    chi = rng.uniform(-3, 3, len(w))
    expected = Rotation.from_quat(np.stack([x, y, 0 * x, w], axis=1)) * Rotation.from_rotvec(chi[:, None] * [0, 0, 1])
    body = Rotation.from_quat(frame.body_quaternion(chi).T, scalar_first=True)
    assert (expected.inv() * body).magnitude().max() < 1e-12
    vector = rng.normal(size=(3, len(chi)))
    np.testing.assert_allclose(untwisted(twisted(vector, chi), chi), vector, atol=1e-14)


def test_rates_against_differences_of_the_attitude(rng):
    """F and l cubic in time: o from q' and o' from its difference, at t = 0."""
    coefficients, lateral = rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    coefficients[0] += [0, 0, 12]
    powers = lambda t, c: (c[0] + c[1] * t + c[2] * t**2)[:, None]  # noqa: E731

    def attitude(t):
        w, x, y = tilt(powers(t, coefficients), powers(t, lateral)).quaternion[:, 0]
        return Rotation.from_quat([x, y, 0, w])

    def rate(t, h=1e-3):
        return (attitude(t - h).inv() * attitude(t + h)).as_rotvec() / (2 * h)

    frame = tilt(powers(0, coefficients), powers(0, lateral))
    o, o_dot = frame.rates(
        coefficients[1][:, None], 2 * coefficients[2][:, None], lateral[1][:, None], 2 * lateral[2][:, None]
    )
    np.testing.assert_allclose(o[:, 0], rate(0.0), atol=1e-6)
    np.testing.assert_allclose(o_dot[:, 0], (rate(1e-3) - rate(-1e-3)) / 2e-3, atol=1e-5)
