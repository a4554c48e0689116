"""Profile, circle, lemniscate, hover, step: the numbers of the specification, and derivatives that are derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from quadexp.errors import UsageError
from quadexp.reference.base import Trajectory
from quadexp.reference.circle import Circle
from quadexp.reference.from_file import FileTrajectory
from quadexp.reference.hover import Hover
from quadexp.reference.lemniscate import Lemniscate
from quadexp.reference.phasor import phasor
from quadexp.reference.profile import SpeedProfile
from quadexp.reference.random_polynomial import RandomPolynomial
from quadexp.reference.step import Step

SPEED, ACCELERATION, RADIUS = 8.0, 1.0, 5.0


def specified_angular_acceleration(t: float) -> float:
    """th'' as the specification words it, section after section."""
    alpha, cruise = ACCELERATION / RADIUS, SPEED / ACCELERATION - 2
    if t < 2:
        return alpha * np.sin(np.pi * t / 4) ** 2
    t -= 2
    if t < cruise:
        return alpha
    t -= cruise
    if t < 4:
        return alpha * np.cos(np.pi * t / 4)
    t -= 4
    if t < cruise:
        return -alpha
    t -= cruise
    return alpha * (np.sin(np.pi * t / 4) ** 2 - 1)


def test_profile_is_the_specified_one_integrated():
    profile = SpeedProfile(SPEED, ACCELERATION, RADIUS)
    assert profile.duration == pytest.approx(2 * SPEED / ACCELERATION + 4)
    knots = [0, 2, 8, 12, 18, 20]
    for t in (1.3, 2.0, 5.0, 9.7, 13.0, 19.1, 20.0):
        angle = profile.angle(np.array([t]))[0]
        within = [k for k in knots if 0 < k < t]
        rate = quad(specified_angular_acceleration, 0, t, points=within or None, limit=200)[0]
        moved = quad(lambda s, end=t: (end - s) * specified_angular_acceleration(s), 0, t, points=within or None)[0]
        assert angle[2] == pytest.approx(specified_angular_acceleration(t - 1e-12), abs=1e-9)
        assert angle[1] == pytest.approx(rate, abs=1e-9)
        assert angle[0] == pytest.approx(moved, abs=1e-9)


def test_profile_starts_and_ends_at_rest_and_peaks_above_the_nominal_speed():
    profile = SpeedProfile(SPEED, ACCELERATION, RADIUS)
    t = np.linspace(0, profile.duration, 200001)
    angle = profile.angle(t)
    assert np.abs(angle[[0, -1], 1:4]).max() < 1e-14
    assert RADIUS * angle[:, 1].max() == pytest.approx(SPEED + (4 / np.pi - 1) * ACCELERATION, abs=1e-9)
    assert np.abs(np.diff(angle[:, 3])).max() < 1e-4  # th''' has no jumps


def test_shortest_profile_has_no_cruise():
    assert SpeedProfile(0.6, 0.3, 1.0).duration == pytest.approx(8.0)


def test_too_slow_a_profile_names_both_mends():
    with pytest.raises(UsageError, match=r"trajectory.speed: 1.5 .* raise speed to 2 or lower acceleration to 0.75"):
        Circle(speed=1.5, acceleration=1.0)


def test_phasor_against_complex_exponential_series():
    """th(t) a quartic: exp(i th) as a Taylor polynomial from its truncated power series."""
    theta = np.array([0.3, -1.2, 0.7, 2.1, -0.4])  # derivatives at 0
    coefficients = theta / np.array([1, 1, 2, 6, 24])
    series, power = np.zeros(5, complex), np.array([1, 0, 0, 0, 0], complex)
    shifted = coefficients.astype(complex)
    shifted[0] = 0
    factorial = 1.0
    for n in range(5):
        series += power / factorial
        power = np.convolve(power, 1j * shifted)[:5]
        factorial *= n + 1
    expected = np.exp(1j * theta[0]) * series * np.array([1, 1, 2, 6, 24])
    np.testing.assert_allclose(phasor(theta[None])[0], expected, rtol=1e-13)


SMOOTH_PARTS = ((0.2, 1.8), (2.2, 7.8), (8.2, 11.8), (12.2, 17.8), (18.2, 19.8))  # inside the sections at 8 m/s


@pytest.mark.parametrize("kind", [Circle, Lemniscate])
@pytest.mark.parametrize("part", SMOOTH_PARTS)
def test_each_derivative_is_the_derivative_of_the_one_before(kind, part):
    trajectory = kind(speed=SPEED)
    t, h = np.linspace(*part, 37), 1e-3
    stencil = [trajectory.flat_output(t + k * h).position for k in (-2, -1, 1, 2)]
    difference = (stencil[0] - 8 * stencil[1] + 8 * stencil[2] - stencil[3]) / (12 * h)
    values = trajectory.flat_output(t).position
    for order in range(4):
        np.testing.assert_allclose(difference[:, order], values[:, order + 1], atol=2e-7 * 8**order)


def test_circle_is_a_circle_started_at_radius():
    circle = Circle(speed=6.0, radius=3.0, height=2.0)
    p = circle.flat_output(np.linspace(0, circle.duration, 500)).position
    np.testing.assert_allclose(p[0, 0], [3.0, 0.0, 2.0])
    np.testing.assert_allclose(np.hypot(p[:, 0, 0], p[:, 0, 1]), 3.0)
    assert p[100, 0, 1] > 0  # counter-clockwise
    assert np.linalg.norm(p[:, 1], axis=1).max() == pytest.approx(circle.peak_speed, abs=1e-3)


def test_lemniscate_satisfies_its_implicit_equation_and_peaks_in_the_crossing():
    """x = r cos, y = r sin cos: r^2 y^2 = x^2 (r^2 - x^2); the speed there is at most sqrt(2) r th'."""
    lemniscate = Lemniscate(speed=8.0)
    p = lemniscate.flat_output(np.linspace(0, lemniscate.duration, 3001)).position
    x, y = p[:, 0, 0], p[:, 0, 1]
    np.testing.assert_allclose(25 * y**2, x**2 * (25 - x**2), atol=1e-10)
    assert np.linalg.norm(p[:, 1], axis=1).max() == pytest.approx(lemniscate.peak_speed, abs=1e-3)
    assert lemniscate.peak_speed < np.sqrt(2) * lemniscate.profile.peak_speed
    assert lemniscate.peak_speed == pytest.approx(np.sqrt(2) * 8.27, rel=0.01)


def test_the_end_is_held_at_rest():
    for trajectory in (
        Circle(speed=4.0),
        Lemniscate(speed=4.0),
        RandomPolynomial(speed=2.0),
        Circle(speed=4.0, yaw=1.0),
    ):
        end = trajectory.duration
        outside = trajectory.flat_output(np.array([-3.0, end + 1e-9, end + 5]))
        np.testing.assert_allclose(outside.position[0, 0], trajectory.flat_output(0.0).position[0, 0])
        np.testing.assert_allclose(outside.position[1:, 0] - trajectory.flat_output(end).position[0, 0], 0, atol=1e-12)
        assert np.all(outside.position[:, 1:] == 0)
        assert outside.yaw is None or np.all(outside.yaw[:, 1:] == 0)


def test_hover_and_step():
    hover = Hover(position=[1, 2, 3], yaw=0.5, duration=4.0).flat_output(np.array([0.0, 9.0]))
    np.testing.assert_allclose(hover.position[:, 0], [[1, 2, 3]] * 2)
    np.testing.assert_allclose(hover.yaw, [[0.5, 0, 0]] * 2)
    step = Step(start=(0, 0, 1), target=(2, 0, 1), step_time=1.0, duration=3.0).flat_output(np.array([0.99, 1.0, 7.0]))
    np.testing.assert_allclose(step.position[:, 0, 0], [0, 2, 2])
    assert np.all(step.position[:, 1:] == 0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Circle(speed=-1.0), r"trajectory.speed=-1.0: must be in \(0, 60\] m/s"),
        (lambda: Circle(speed=8.0, radius=0.0), "trajectory.radius=0.0: must be in"),
        (lambda: Lemniscate(speed=8.0, height=float("nan")), "trajectory.height=nan: must be in"),
        (lambda: Lemniscate(speed=8.0, yaw=float("inf")), "trajectory.yaw: inf"),
        (lambda: Hover(position=(1, 2)), r"trajectory.position=\[1.0,2.0\]: must be a list of 3 numbers"),
        (lambda: Hover(duration=0), "trajectory.duration=0.0: must be in"),
        (lambda: Step(step_time=9.0), "trajectory.step_time: 9.0"),
        (lambda: Step(target="abc"), "trajectory.target=abc: must be a list of 3 numbers"),
        (lambda: RandomPolynomial(speed=4.0, keypoints=3), "trajectory.keypoints=3: must be in"),
        (lambda: RandomPolynomial(speed=4.0, seed=-1), "trajectory.seed=-1: must be in"),
        (lambda: FileTrajectory(path="nowhere.csv").duration, "no file 'nowhere.csv'"),
    ],
)
def test_numbers_out_of_range_are_one_line(make, message):
    with pytest.raises(UsageError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


def test_all_are_trajectories():
    for trajectory in (Circle(speed=4.0), Lemniscate(speed=4.0), Hover(), Step(), RandomPolynomial(speed=2.0)):
        assert isinstance(trajectory, Trajectory)
        assert trajectory.peak_speed >= 0 and trajectory.duration > 0
