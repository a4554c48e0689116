"""Ellipses at speed: their printed form, references through inverted flight, and limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.errors import UsageError
from quadexp.physics.state import ATTITUDE, RATE
from quadexp.reference.ellipse import Ellipse
from quadexp.reference.feasibility import clipped
from quadexp.reference.flatness import flat_reference

CASES = [("horizontal", 10.0, 20.0, 1.0), ("horizontal", 7.0, 15.0, 5.0), ("vertical", 12.0, 25.0, 2.0)]


@pytest.mark.parametrize(("plane", "speed", "acceleration", "ratio"), CASES)
def test_as_printed(plane, speed, acceleration, ratio):
    """r = V^2 / a, k = a / V; V at the start, a a quarter of a lap later; derivatives and heading by differences."""
    path = Ellipse(plane=plane, speed=speed, acceleration=acceleration, ratio=ratio)
    k, r, across = acceleration / speed, speed**2 / acceleration, 1 if plane == "horizontal" else 2
    t = np.linspace(0.3, 5.0, 50)
    flat, h = path.flat_output(t), 1e-5
    position = flat.position[:, 0] - [0, 0, path.height]
    assert position[:, 0] == pytest.approx(r * np.sin(k * t), abs=1e-9)
    assert position[:, across] == pytest.approx(r / ratio * np.cos(k * t), abs=1e-9)
    assert np.linalg.norm(path.flat_output(np.zeros(1)).position[0, 1]) == pytest.approx(speed)
    quarter = np.array([np.pi / 2 / k])
    assert np.linalg.norm(path.flat_output(quarter).position[0, 2]) == pytest.approx(acceleration)
    before, after = path.flat_output(t - h), path.flat_output(t + h)
    found = (after.position[:, :-1] - before.position[:, :-1]) / (2 * h)
    assert found == pytest.approx(flat.position[:, 1:], rel=1e-6, abs=1e-4)
    if plane == "vertical":
        assert flat.yaw is None
        return
    centre = np.arctan2(-position[:, 1], -position[:, 0])
    assert flat.yaw[:, 0] == pytest.approx(centre, abs=1e-9)
    turned = np.remainder(after.yaw[:, 0] - before.yaw[:, 0] + np.pi, 2 * np.pi) - np.pi
    assert flat.yaw[:, 1] == pytest.approx(turned / (2 * h), abs=1e-4)
    assert flat.yaw[:, 2] == pytest.approx((after.yaw[:, 1] - before.yaw[:, 1]) / (2 * h), abs=1e-3)


def test_it_goes_on_behind_the_flight():
    """The horizon of a controller sees the ellipse, not a stop."""
    path = Ellipse(duration=5.0)
    assert path.flat_output(np.array([6.0])).position[0, 1] == pytest.approx(
        Ellipse(duration=20.0).flat_output(np.array([6.0])).position[0, 1]
    )


@pytest.mark.parametrize(("speed", "acceleration"), [(8.0, 20.0), (20.0, 10.0), (5.0, 30.0)])
def test_through_inverted_flight(vehicle, speed, acceleration):
    """Starting upside down: y_body stays across the plane, rates and thrusts are those of the motion."""
    vehicle = replace(vehicle, thrust_max=200.0, rate_max=100.0)
    path = Ellipse(plane="vertical", speed=speed, acceleration=acceleration)
    h = 1e-4
    t = 0.21 + np.arange(4000) * h
    reference = flat_reference(path, t, vehicle)
    turn = Rotation.from_quat(reference.state[:, ATTITUDE], scalar_first=True)
    assert turn.apply([0, 1, 0]) == pytest.approx(np.tile([0.0, 1, 0], (len(t), 1)), abs=1e-9)
    rate = (turn[:-1].inv() * turn[1:]).as_rotvec() / h
    assert rate == pytest.approx((reference.state[1:, RATE] + reference.state[:-1, RATE]) / 2, abs=1e-3)
    specific = path.flat_output(t).position[:, 2] + [0, 0, vehicle.gravity]
    collective = vehicle.mass * (specific * turn.apply([0, 0, 1])).sum(axis=1)
    assert reference.input.sum(axis=1) == pytest.approx(collective, abs=1e-9)
    assert (collective > 0).all()
    start = flat_reference(path, np.zeros(1), vehicle)  # exactly upside down
    assert np.abs(start.state[0, ATTITUDE]) == pytest.approx([0, 0, 1, 0], abs=1e-9)
    assert start.state[0, RATE] == pytest.approx(
        flat_reference(path, np.array([1e-4]), vehicle).state[0, RATE], rel=1e-2
    )


def test_a_loop_with_a_prescribed_yaw_is_still_refused(vehicle):
    """Out of the plane of a free heading nothing says which way is up."""
    with pytest.raises(UsageError, match="vertical ellipse has heading=constant"):
        Ellipse(plane="vertical", heading="centre")


def test_clipped_references_keep_the_limits(vehicle):
    vehicle = replace(vehicle, rate_max=6.0)
    path = Ellipse(plane="vertical", speed=20.0, acceleration=10.0)
    reference = flat_reference(path, np.linspace(0, 5, 500), vehicle)
    found = clipped(reference, vehicle)
    assert np.abs(reference.state[:, RATE]).max() > 6 and np.abs(found.state[:, RATE]).max() == 6
    assert found.input.min() >= vehicle.thrust_min and found.input.max() <= vehicle.thrust_max
    inside = np.abs(reference.state[:, RATE]).max(axis=1) < 6
    assert (found.state[inside] == reference.state[inside]).all()
