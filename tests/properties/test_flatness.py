"""References of random paths for random vehicles in random air obey the equations of motion, and turn with the path."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadexp.errors import UsageError
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.reference.flat_map import tilt
from quadexp.reference.flatness import flat_reference
from tests.properties.paths import Transformed, Wander
from tests.properties.strategies import generators, make_residual, vehicles
from tests.properties.test_symmetry import MIRROR, mirrored, mirrored_residual, mirrored_vehicle, turned_world, z_turn

turns = st.floats(-np.pi, np.pi)
STEP = 0.01  # s


def integrated(reference, vehicle, residual) -> np.ndarray:
    """States at every second time of the reference, from its first, by RK4 with the inputs at the stages' times."""
    f = corrected_function(vehicle, residual)
    x, u = ca.MX.sym("x", 13), ca.MX.sym("u", vehicle.n_rotors, 3)
    k1 = f(x, u[:, 0], residual.theta)
    k2 = f(x + STEP / 2 * k1, u[:, 1], residual.theta)
    k3 = f(x + STEP / 2 * k2, u[:, 1], residual.theta)
    k4 = f(x + STEP * k3, u[:, 2], residual.theta)
    one = ca.Function("one", [x, u], [x + STEP / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    inputs = reference.input
    stages = np.concatenate([inputs[k : k + 3].T for k in range(0, len(inputs) - 2, 2)], axis=1)
    return np.array(one.mapaccum(len(inputs) // 2)(reference.state[0], stages)).T


@pytest.mark.parametrize("air", ["none", "linear_drag"])
@given(vehicles(), st.booleans(), generators)
def test_references_integrate_into_themselves(air, vehicle, heading, rng):
    path, residual = Wander(rng, yaw=heading), make_residual(air, vehicle, rng)
    t = 0.2 + np.arange(0, 0.6 + 1e-9, STEP / 2)
    reference = flat_reference(path, t, vehicle, residual)
    flown, expected = integrated(reference, vehicle, residual), reference.state[2::2]
    assert np.allclose(expected[:, POSITION], path.flat_output(t[2::2]).position[:, 0], atol=1e-12)
    for part, bound in ((POSITION, 1e-6), (VELOCITY, 1e-5), (ATTITUDE, 1e-5), (RATE, 1e-4)):
        assert np.abs(flown[:, part] - expected[:, part]).max() < bound


@given(vehicles(flat=True), st.booleans(), generators)
def test_references_in_blade_element_air_integrate_into_themselves(vehicle, heading, rng):
    path, residual = Wander(rng, yaw=heading, size=0.6), make_residual("blade_element", vehicle, rng)
    t = 0.2 + np.arange(0, 0.3 + 1e-9, STEP / 2)
    try:
        reference = flat_reference(path, t, vehicle, residual)
    except UsageError:  # no fixed point: the model's coefficients lift less than the vehicle weighs, say
        return
    if reference.input.max() > vehicle.thrust_max or reference.input.min() < vehicle.thrust_min:
        return  # cannot be flown: the air is asked for at thrusts within the limits, as documented
    flown, expected = integrated(reference, vehicle, residual), reference.state[2::2]
    assert np.abs(flown - expected)[:, :10].max() < 1e-4


@pytest.mark.parametrize("mirror", [False, True], ids=["turned", "mirrored"])
@given(vehicles(), turns, st.booleans(), generators)
def test_references_turn_with_the_path_and_in_a_mirror(mirror, vehicle, angle, heading, rng):
    """Turned about the vertical or mirrored, states are so too and thrusts stay, in air that goes with the body."""
    path, t = Wander(rng, yaw=heading or not mirror), np.linspace(0.2, 0.8, 5)
    residual, image = mirrored_residual("linear_drag", vehicle, rng)
    one = flat_reference(path, t, vehicle, residual)
    if mirror:
        other = flat_reference(Transformed(path, MIRROR, sign=-1.0), t, mirrored_vehicle(vehicle), image)
    else:
        other = flat_reference(Transformed(path, z_turn(angle).as_matrix(), angle=angle), t, vehicle, residual)
    assert np.allclose(other.input, one.input, rtol=1e-7, atol=1e-7)
    for a, b in zip(one.state, other.state, strict=True):
        a = mirrored(a) if mirror else turned_world(a, angle)
        sign = np.r_[np.ones(3), np.ones(4) * np.sign(a[ATTITUDE] @ b[ATTITUDE]), np.ones(6)]
        assert np.allclose(a * sign, b, atol=1e-7)


@given(vehicles(), generators)
def test_hover_in_constant_air(vehicle, rng):
    """A constant push is leant against: R (c e_z + a) = -g, with the thrust that is left to the rotors."""
    push = 2 * rng.normal(size=3)
    residual = linear_drag_residual(vehicle, (0, 0, 0), push, 0.0)
    path = Transformed(Wander(rng), np.zeros((3, 3)))
    path.path.amplitude[3] = 0.0
    reference = flat_reference(path, np.array([0.5]), vehicle, residual)
    lift = np.sqrt(9.81**2 - push[0] ** 2 - push[1] ** 2) - push[2]
    assert np.isclose(reference.input[0].sum(), vehicle.mass * lift, rtol=1e-6)
    assert np.allclose(vehicle.allocation[1:] @ reference.input[0], 0, atol=1e-6)
    assert np.allclose(reference.state[0, RATE], 0, atol=1e-6)


@given(generators)
def test_air_that_pushes_harder_than_the_path_asks_leaves_no_thrust(rng):
    """|l| > |a - g|: no attitude balances it, and the thrust direction's share c is not above zero, as documented."""
    force = rng.normal(size=(3, 1))
    sideways = rng.normal(size=(2, 1))
    sideways *= np.linalg.norm(force) / np.linalg.norm(sideways)
    assert not tilt(force, 1.01 * sideways).force[2, 0] > 0
    assert np.isclose(tilt(force, 0.6 * sideways).force[2, 0], 0.8 * np.linalg.norm(force))
