"""What a residual must be: the equation that is meant, with its derivatives, nothing at rest, and in the MPC."""

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from cubic_drag import cubic_drag

import quadexp as qx

HERE = Path(__file__).parent
COEFFICIENT = 0.01  # s/m^2


@pytest.fixture
def residual():
    return cubic_drag(qx.controller("controller=cubic_drag_mpc", conf=HERE).vehicle, coefficient=COEFFICIENT)


def at(velocity, rotors=4):
    """Features, (10,): body velocity (m/s), no body rate, 2.5 N a rotor."""
    return np.concatenate([velocity, np.zeros(3), np.full(rotors, 2.5)])


def test_its_value_at_a_point(residual):
    """|v| = 5 m/s: 0.01 x 25 x (3, 0, 4) m/s^2, against the velocity; no torque."""
    np.testing.assert_allclose(residual(at([3.0, 0.0, 4.0])), [[-0.75, 0, -1.0, 0, 0, 0]], rtol=1e-12)


def test_it_takes_energy_and_is_nothing_at_rest(residual):
    velocities = np.random.default_rng(0).normal(0.0, 5.0, (100, 3))
    found = residual(np.stack([at(v) for v in velocities]))
    assert (np.sum(found[:, :3] * velocities, axis=1) < 0).all()
    np.testing.assert_array_equal(residual(at([0.0, 0.0, 0.0])), np.zeros((1, 6)))


def test_its_derivatives_are_those_of_its_values(residual):
    """The MPC steps along them: compared with central differences."""
    z, h = at([3.0, -2.0, 1.0]), 1e-5
    jacobian = ca.DM(residual.function(z, residual.theta)[1]).full()
    steps = h * np.eye(len(z))
    differences = np.stack([(residual(z + step) - residual(z - step))[0] / (2 * h) for step in steps], axis=1)
    np.testing.assert_allclose(jacobian, differences, rtol=1e-6, atol=1e-8)


def test_the_mpc_flies_with_it():
    flight = qx.simulate("controller=cubic_drag_mpc", "trajectory=circle", speed=4, conf=HERE)
    assert flight.outcome == "ok" and flight.record["residual"]["name"] == "cubic_drag"
    assert flight.metrics["reference_residual"] == 1  # all of it is in the reference too
