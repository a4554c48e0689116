"""What a vehicle must be: a rigid body in trim, with rotors that can hold it in every axis, and flyable."""

from pathlib import Path

import numpy as np
import pytest

import quadexp as qx

HERE = Path(__file__).parent


@pytest.fixture
def vehicle():
    return qx.controller("vehicle=quad_x", conf=HERE).vehicle


def test_equal_thrusts_hover_without_a_torque(vehicle):
    """The centre of mass lies amid the rotors, and their reaction torques cancel."""
    weight = vehicle.mass * vehicle.gravity
    np.testing.assert_allclose(vehicle.allocation @ np.full(vehicle.n_rotors, weight / vehicle.n_rotors),
                               [weight, 0, 0, 0], rtol=1e-9, atol=1e-3 * weight)  # fmt: skip


def test_it_has_thrust_to_spare(vehicle):
    """Twice its weight at least, or it can hardly fly a curve; and hovering lies above the least thrust."""
    assert vehicle.thrust_min < vehicle.hover_thrust < 0.5 * vehicle.thrust_max


def test_its_moments_of_inertia_are_a_rigid_bodys(vehicle):
    """Symmetric and positive, none larger than the sum of the others, and no more than that of its mass at the arms."""
    moments = np.linalg.eigvalsh(vehicle.inertia_matrix)
    arm = np.linalg.norm(vehicle.rotor_position, axis=1).max()
    np.testing.assert_allclose(vehicle.inertia_matrix, vehicle.inertia_matrix.T)
    assert moments[0] > 0 and moments[2] <= moments[:2].sum() and moments[2] < vehicle.mass * arm**2


def test_every_axis_can_be_turned_while_hovering(vehicle):
    """A torque of 5 % of weight times arm about x and y, and some about z, within the limits of every rotor."""
    weight, arm = vehicle.mass * vehicle.gravity, np.linalg.norm(vehicle.rotor_position, axis=1).max()
    for axis, share in ((1, 0.05), (2, 0.05), (3, 0.002)):
        for sign in (-1, 1):
            wanted = np.eye(4)[0] * weight + np.eye(4)[axis] * sign * share * weight * arm
            thrusts = np.linalg.pinv(vehicle.allocation) @ wanted
            assert (thrusts > vehicle.thrust_min).all() and (thrusts < vehicle.thrust_max).all()


def test_it_flies():
    settings = ("vehicle=quad_x", "trajectory=circle", "plant=ideal", "controller=nominal_mpc")
    flight = qx.simulate(*settings, speed=4, conf=HERE)
    assert flight.outcome == "ok" and flight.metrics["mean_error"] < 2e-3  # m
