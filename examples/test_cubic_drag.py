"""What a learned model must be: the equation that is meant, with its derivatives; found again in data; flown."""

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from cubic_drag import CubicDrag

import quadexp as qx
from quadexp.models.dataset import ResidualDataset

HERE = Path(__file__).parent
COEFFICIENT = 0.01  # s/m^2


def rows(flights=5, count=200):
    """Rows of flights of a vehicle whose air is the equation, without noise."""
    drawn = np.random.default_rng(0).normal(0.0, 1.0, (flights * count, 7))
    velocity, thrust = 4.0 * drawn[:, :3], 2.5 + 0.5 * drawn[:, 3:]
    acceleration = -COEFFICIENT * velocity * np.sum(velocity**2, axis=1, keepdims=True)
    names = ["v_x", "v_y", "v_z", "a_x", "a_y", "a_z", "u_0", "u_1", "u_2", "u_3"]
    columns = dict(zip(names, [*velocity.T, *acceleration.T, *thrust.T], strict=True))
    return ResidualDataset(columns | {"flight": np.repeat(np.arange(flights), count)}, {})


def test_the_coefficient_is_found_again():
    for least_speed in (0.0, 5.0):
        assert CubicDrag(least_speed=least_speed).fit(rows()).theta == pytest.approx([COEFFICIENT], rel=1e-12)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """Fitted, as by the command, to half a minute of flights."""
    folder = tmp_path_factory.mktemp("models")
    data = qx.collect(duration=30, out=folder / "data.parquet")
    return qx.fit("cubic_drag", data, conf=HERE, out=folder / "cubic_drag")


@pytest.fixture(scope="module")
def residual(checkpoint):
    vehicle = qx.controller("controller=cubic_drag_mpc", model=checkpoint, conf=HERE).vehicle
    return checkpoint.model.residual(vehicle)


def at(velocity):
    """Features, (10,): body velocity (m/s), no body rate, 2.5 N a rotor."""
    return np.concatenate([velocity, np.zeros(3), np.full(4, 2.5)])


def test_its_value_at_a_point(residual):
    """|v| = 5 m/s: c x 25 x (3, 0, 4) m/s^2, against the velocity; no torque."""
    (c,) = residual.theta
    np.testing.assert_allclose(residual(at([3.0, 0.0, 4.0])), [[-75 * c, 0, -100 * c, 0, 0, 0]], rtol=1e-12)


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


def test_the_mpc_flies_with_it(checkpoint):
    flight = qx.simulate("controller=cubic_drag_mpc", "trajectory=circle", speed=4, model=checkpoint, conf=HERE)
    assert flight.outcome == "ok" and flight.record["residual"]["name"] == "cubic_drag"
    assert flight.metrics["reference_residual"] == 1  # all of it is in the reference too
    assert checkpoint.report["verdict"]["outputs"].keys() == {"a_x", "a_y", "a_z"}
