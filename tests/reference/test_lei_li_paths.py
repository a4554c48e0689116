"""The two reference paths of Lei & Li 2017 as the paper prints them (NED), and their initial states."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.control.feedback.frames import NED_ENU
from quadexp.errors import UsageError
from quadexp.reference.base import Trajectory
from quadexp.reference.lei_li_circle import LeiLiCircle
from quadexp.reference.rectangle import Rectangle
from tests.states import ned_from_state

T = 60.0


def printed_rectangle(t, v0):
    """Example 1, NED."""
    leg = v0 * T / 4
    if t < T / 4:
        return np.array([v0 * t, 0, -5])
    if t < T / 2:
        return np.array([leg, v0 * t - leg, -5])
    if t < 3 * T / 4:
        return np.array([3 * leg - v0 * t, leg, -5])
    return np.array([0, v0 * T - v0 * t, -5])


def printed_circle(t):
    """Example 2, NED."""
    t = t if t <= 30 else t - 30 * np.ceil(t / 30 - 1)
    if t <= 20:
        return np.array([-28 * np.cos(np.pi * t / 20), 28 * np.sin(np.pi * t / 20), -5])
    return np.array([28 * np.cos(np.pi * (t - 20) / 10), -28 * np.sin(np.pi * (t - 20) / 10), -5])


@pytest.mark.parametrize("v0", [2.0, 5.0])
def test_the_rectangle_is_the_printed_one(v0):
    t = np.arange(0.0, T + 1e-9, 0.25)
    flat = Rectangle(speed=v0).flat_output(t)
    expected = np.stack([NED_ENU @ printed_rectangle(at, v0) for at in t])
    assert flat.position[:, 0] == pytest.approx(expected, abs=1e-9)
    assert np.linalg.norm(flat.position[:, 1], axis=1) == pytest.approx(np.full(len(t), v0))
    assert not flat.position[:, 2:].any(), "the acceleration is zero, corners included"
    assert flat.yaw[:, 0] == pytest.approx(np.full(len(t), np.pi / 2)), "heading north"


def test_the_circle_is_the_printed_one():
    t = np.arange(0.0, T + 1e-9, 0.25)
    flat = LeiLiCircle().flat_output(t)
    expected = np.stack([NED_ENU @ printed_circle(at) for at in t])
    assert flat.position[:, 0] == pytest.approx(expected, abs=1e-9)


def test_the_circle_s_derivatives_are_those_of_its_path():
    circle, h = LeiLiCircle(), 1e-3
    t = np.array([3.0, 12.0, 24.0, 33.0, 47.0, 55.0])
    before, here, after = (circle.flat_output(t + d).position for d in (-h, 0.0, h))
    for order in range(4):
        slope = (after[:, order] - before[:, order]) / (2 * h)
        assert here[:, order + 1] == pytest.approx(slope, abs=1e-5)
    speeds = np.linalg.norm(here[:, 1], axis=1)
    assert speeds == pytest.approx([4.39823, 4.39823, 8.79646, 4.39823, 4.39823, 8.79646], rel=1e-5)


@pytest.mark.parametrize("trajectory", [Rectangle(), LeiLiCircle()])
def test_it_is_a_trajectory_that_is_held_outside(trajectory):
    assert isinstance(trajectory, Trajectory)
    held = trajectory.flat_output(np.array([-1.0, T + 5.0])).position
    ends = trajectory.flat_output(np.array([0.0, T])).position
    assert np.array_equal(held[:, 0], ends[:, 0]) and not held[:, 1:].any()


def test_the_printed_initial_states():
    xi, eta, velocity, rate = ned_from_state(Rectangle().start_state)
    assert xi == pytest.approx([0.2, -0.2, -0.1]) and np.degrees(eta) == pytest.approx([1.0, -1.0, 5.0])
    assert not velocity.any() and not rate.any()
    xi, eta, _, _ = ned_from_state(LeiLiCircle().start_state)
    assert not xi.any() and eta == pytest.approx(np.zeros(3), abs=1e-12)
    start = LeiLiCircle().flat_output(np.zeros(1)).position[0, 0]
    assert np.linalg.norm(start - LeiLiCircle().start_state[:3]) == pytest.approx(28.443, abs=1e-3)


def test_another_start():
    assert Rectangle(start="reference").start_state is None
    with pytest.raises(UsageError, match="trajectory.start=elsewhere: must be one of printed, reference"):
        LeiLiCircle(start="elsewhere")
