"""Values and derivatives of every model against an independent one differentiated by complex step."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given

from quadexp.models.linear_drag import linear_drag_residual
from quadexp.models.residual import no_residual
from quadexp.physics.sensitivity import rk4_sensitivity_function
from quadexp.plugins.gaussian_process.posterior import gaussian_process_residual
from quadexp.plugins.papers.lei_li.blade_element import blade_element_residual
from quadexp.world import SimplifiedPlant
from tests.properties import complex_model
from tests.properties.strategies import (
    few,
    generators,
    make_blade,
    make_effects,
    make_features,
    make_gp_outputs,
    make_thrusts,
    make_upright_state,
    vehicles,
)

KINDS = ("none", "linear_drag", "gaussian_process", "blade_element")


def pair(kind: str, vehicle, rng):
    """A residual, and the air of the independent model with the same numbers."""
    if kind == "none":
        return no_residual(vehicle), complex_model.no_air
    theta = np.r_[rng.uniform(0, 0.6, 3), 0.1 * rng.normal(size=3), 0.02 * rng.normal()]
    if kind == "linear_drag":
        return linear_drag_residual(vehicle, theta[:3], theta[3:6], theta[6]), complex_model.linear_drag(theta)
    if kind == "gaussian_process":
        outputs = make_gp_outputs(rng)
        return gaussian_process_residual(vehicle, outputs, theta), complex_model.gaussian_process(outputs, theta)
    blade = make_blade(rng)
    return blade_element_residual(vehicle, blade, iterations=8), complex_model.blade_element(vehicle, blade)


def climbing(z: np.ndarray) -> np.ndarray:
    """Without descent, where the induced velocity may have more than one value."""
    z[2] = abs(z[2])
    return z


@pytest.mark.parametrize("kind", KINDS)
@given(vehicles(), generators)
def test_residuals(kind, vehicle, rng):
    (residual, air), z = pair(kind, vehicle, rng), climbing(make_features(rng, vehicle))
    y, dy_dz = (np.array(ca.DM(part).full()) for part in residual.function(z, residual.theta))
    expected, slope = air(z).real, complex_model.derivative(lambda z: air(z) + 0j, z)
    assert np.allclose(y.ravel(), expected, rtol=1e-9, atol=1e-9)
    scale = np.abs(slope).max(axis=0) + 1e-9
    assert np.all(np.abs(dy_dz - slope) < 1e-7 * scale)


@pytest.mark.parametrize("kind", KINDS)
@few
@given(vehicles(), generators)
def test_the_linearised_node(kind, vehicle, rng):
    """x_next, A and B of one RK4 step, in both forms, against the complex-step derivative of the independent step."""
    (residual, air), h = pair(kind, vehicle, rng), 0.02
    x, u = make_upright_state(rng, speed=3.0), make_thrusts(rng, vehicle)
    size = len(u)

    def step(both):
        def f(state):
            return complex_model.rigid_body(vehicle, state, both[13:], air(complex_model.features(state, both[13:])))

        return complex_model.rk4(f, both[:13] + 0j, h)

    both = np.r_[x, u]
    expected, slope = step(both).real, complex_model.derivative(step, both)
    scale = np.abs(slope).max(axis=0) + 1e-9
    for scalar in (True, False):
        node = rk4_sensitivity_function(vehicle, residual, scalar=scalar)
        x_next, A, B = (np.array(ca.DM(part).full()) for part in node(x, u, residual.theta, h))
        assert np.allclose(x_next.ravel(), expected, rtol=1e-8, atol=1e-8)
        assert np.all(np.abs(np.hstack([A, B]) - slope) < 1e-5 * scale)
        assert B.shape == (13, size)


@given(vehicles(), generators)
def test_the_plant_s_residual_by_hand(vehicle, rng):
    """Drag linear and quadratic per axis, motor loss and lift of the simplified plant, value and derivative."""
    effects, z = make_effects(rng), make_features(rng, vehicle)
    residual = SimplifiedPlant(vehicle, effects, backend="interpreted").residual()
    linear, quadratic = np.array(effects.linear_drag), np.array(effects.quadratic_drag)
    sign = np.sign(z[:3])
    x, y, _ = np.array(vehicle.rotor_position).T
    lever = np.array([y, -x, vehicle.torque_coefficient * np.array(vehicle.rotor_spin)])

    def air(z):
        v, u = z[:3], z[6:]
        lost = effects.motor_loss * u**2 / vehicle.thrust_max
        force = -linear * v - sign * quadratic * v**2 + np.array([0, 0, 1]) * (u - lost).sum()
        force = force + np.array([0, 0, 1]) * effects.lift * (v[0] ** 2 + v[1] ** 2)
        acceleration = force / vehicle.mass - np.array([0, 0, 1]) * u.sum() / vehicle.mass
        return np.concatenate([acceleration, -lever @ lost])

    value, dy_dz = (np.array(ca.DM(part).full()) for part in residual.function(z, residual.theta))
    assert np.allclose(value.ravel(), air(z), rtol=1e-12, atol=1e-12)
    assert np.allclose(dy_dz, complex_model.derivative(lambda z: air(z) + 0j, z), rtol=1e-10, atol=1e-10)
