"""Every path: the numbers of its specification, derivatives that are derivatives, and an end that is held."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from quadexp.errors import UsageError
from quadexp.physics.state import ATTITUDE, RATE
from quadexp.plugins.logs.from_file import FileTrajectory
from quadexp.plugins.papers.ellipse import Ellipse
from quadexp.plugins.papers.lei_li.feedback.frames import NED_ENU
from quadexp.plugins.papers.lei_li.paths import LeiLiCircle, Rectangle
from quadexp.reference.base import Trajectory
from quadexp.reference.circle import Circle
from quadexp.reference.flatness import clipped, flat_reference
from quadexp.reference.hover import Hover
from quadexp.reference.lemniscate import Lemniscate
from quadexp.reference.phasor import phasor
from quadexp.reference.random_polynomial import RandomPolynomial
from quadexp.reference.step import Step
from tests.states import ned_from_state

SPEED, ACCELERATION, RADIUS = 8.0, 1.0, 5.0
PATHS = [
    Circle(speed=4.0), Circle(speed=4.0, yaw=1.0), Lemniscate(speed=4.0), RandomPolynomial(speed=2.0), Hover(), Step(),
    Rectangle(), LeiLiCircle(),
]  # fmt: skip
SECTIONS = ((0.2, 1.8), (2.2, 7.8), (8.2, 11.8), (12.2, 17.8), (18.2, 19.8))  # of Torrente's profile at 8 m/s
SMOOTH = [(kind(speed=SPEED), *part) for kind in (Circle, Lemniscate) for part in SECTIONS]
SMOOTH += [(LeiLiCircle(), *part) for part in ((0.5, 19.5), (20.5, 29.5), (50.5, 59.5))]
SMOOTH += [(RandomPolynomial(speed=4.0, seed=3), 0.1, 3.0)]
ELLIPSES = [
    Ellipse(plane=plane, speed=speed, acceleration=acceleration, ratio=ratio)
    for plane, speed, acceleration, ratio in (
        ("horizontal", 10.0, 20.0, 1.0), ("horizontal", 7.0, 15.0, 5.0), ("vertical", 12.0, 25.0, 2.0),
    )
]  # fmt: skip
SMOOTH += [(path, 0.3, 5.0) for path in ELLIPSES]


@pytest.mark.parametrize(("path", "start", "end"), SMOOTH)
def test_each_derivative_is_the_derivative_of_the_one_before(path, start, end):
    """By differences of fourth order; also those of a heading."""
    t, h = np.linspace(start, end, 37), 1e-3

    def differences(values):
        return (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)

    near, here = [path.flat_output(t + k * h) for k in (-2, -1, 1, 2)], path.flat_output(t)
    found = differences([flat.position for flat in near])
    for order in range(4):
        size = max(1.0, np.abs(here.position[:, order + 1]).max())
        np.testing.assert_allclose(found[:, order], here.position[:, order + 1], atol=1e-6 * size)
    if here.yaw is not None:
        away = [np.remainder(flat.yaw[:, :2] - here.yaw[:, :2] + np.pi, 2 * np.pi) - np.pi for flat in near]
        size = max(1.0, np.abs(here.yaw).max())
        np.testing.assert_allclose(differences(away), here.yaw[:, 1:], atol=1e-5 * size)


@pytest.mark.parametrize("path", PATHS, ids=lambda path: type(path).__name__)
def test_the_end_is_held_at_rest(path):
    assert isinstance(path, Trajectory) and path.peak_speed >= 0 and path.duration > 0
    end = path.duration
    outside, ends = path.flat_output(np.array([-3.0, end + 1e-9, end + 5])), path.flat_output(np.array([0.0, end]))
    np.testing.assert_allclose(outside.position[:, 0], ends.position[[0, 1, 1], 0], atol=1e-12)
    assert np.all(outside.position[:, 1:] == 0)
    assert outside.yaw is None or np.all(outside.yaw[:, 1:] == 0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Circle(speed=-1.0), r"trajectory.speed=-1.0: must be in \(0, 60\] m/s"),
        (lambda: Circle(speed=1.5), r"trajectory.speed: 1.5 .* raise speed to 2 or lower acceleration to 0.75"),
        (lambda: Lemniscate(speed=8.0, height=float("nan")), "trajectory.height=nan: must be in"),
        (lambda: Hover(position=(1, 2)), r"trajectory.position=\[1.0,2.0\]: must be a list of 3 numbers"),
        (lambda: Step(step_time=9.0), "trajectory.step_time: 9.0"),
        (lambda: RandomPolynomial(speed=4.0, keypoints=3), "trajectory.keypoints=3: must be in"),
        (lambda: Ellipse(plane="vertical", heading="centre"), "vertical ellipse has heading=constant"),
        (lambda: LeiLiCircle(start="elsewhere"), "trajectory.start=elsewhere: must be one of printed, reference"),
        (lambda: FileTrajectory(path="nowhere.csv").duration, "no file 'nowhere.csv'"),
    ],
)
def test_numbers_out_of_range_are_one_line(make, message):
    with pytest.raises(UsageError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


# ------------------------------------------------------------------------------------------------ Torrente et al. 2021
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
    path = Circle(speed=SPEED, acceleration=ACCELERATION, radius=RADIUS)
    assert path.duration == pytest.approx(2 * SPEED / ACCELERATION + 4)
    knots = [0, 2, 8, 12, 18, 20]
    for t in (1.3, 2.0, 5.0, 9.7, 13.0, 19.1, 20.0):
        angle = path.angle(np.array([t]))[0]
        within = [k for k in knots if 0 < k < t]
        rate = quad(specified_angular_acceleration, 0, t, points=within or None, limit=200)[0]
        moved = quad(lambda s, end=t: (end - s) * specified_angular_acceleration(s), 0, t, points=within or None)[0]
        assert angle[:3] == pytest.approx([moved, rate, specified_angular_acceleration(t - 1e-12)], abs=1e-9)


def test_profile_starts_and_ends_at_rest_and_peaks_above_the_nominal_speed():
    path = Circle(speed=SPEED, acceleration=ACCELERATION, radius=RADIUS)
    angle = path.angle(np.linspace(0, path.duration, 200001))
    assert np.abs(angle[[0, -1], 1:4]).max() < 1e-14
    assert RADIUS * angle[:, 1].max() == pytest.approx(SPEED + (4 / np.pi - 1) * ACCELERATION, abs=1e-9)
    assert np.abs(np.diff(angle[:, 3])).max() < 1e-4  # th''' has no jumps
    assert Circle(speed=0.6, acceleration=0.3).duration == pytest.approx(8.0), "no cruise"


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
    assert lemniscate.peak_speed == pytest.approx(np.sqrt(2) * 8.27, rel=0.01)


def test_hover_and_step():
    hover = Hover(position=[1, 2, 3], yaw=0.5, duration=4.0).flat_output(np.array([0.0, 9.0]))
    np.testing.assert_allclose(hover.position[:, 0], [[1, 2, 3]] * 2)
    np.testing.assert_allclose(hover.yaw, [[0.5, 0, 0]] * 2)
    step = Step(start=(0, 0, 1), target=(2, 0, 1), step_time=1.0, duration=3.0).flat_output(np.array([0.99, 1.0, 7.0]))
    np.testing.assert_allclose(step.position[:, 0, 0], [0, 2, 2])


# ----------------------------------------------------------------------------------------------------- Lei & Li 2017
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


def test_the_examples_of_lei_and_li_are_the_printed_ones():
    t = np.arange(0.0, T + 1e-9, 0.25)
    flat = LeiLiCircle().flat_output(t)
    assert flat.position[:, 0] == pytest.approx(np.stack([NED_ENU @ printed_circle(at) for at in t]), abs=1e-9)
    speeds = np.linalg.norm(flat.position[[12, 48, 96, 220], 1], axis=1)
    assert speeds == pytest.approx([4.39823, 4.39823, 8.79646, 8.79646], rel=1e-5)
    for v0 in (2.0, 5.0):
        flat = Rectangle(speed=v0).flat_output(t)
        expected = np.stack([NED_ENU @ printed_rectangle(at, v0) for at in t])
        assert flat.position[:, 0] == pytest.approx(expected, abs=1e-9)
        assert np.linalg.norm(flat.position[:, 1], axis=1) == pytest.approx(np.full(len(t), v0))
        assert not flat.position[:, 2:].any(), "the acceleration is zero, corners included"
        assert flat.yaw[:, 0] == pytest.approx(np.full(len(t), np.pi / 2)), "heading north"


def test_the_printed_initial_states():
    xi, eta, velocity, rate = ned_from_state(Rectangle().start_state)
    assert xi == pytest.approx([0.2, -0.2, -0.1]) and np.degrees(eta) == pytest.approx([1.0, -1.0, 5.0])
    assert not velocity.any() and not rate.any()
    xi, eta, _, _ = ned_from_state(LeiLiCircle().start_state)
    assert not xi.any() and eta == pytest.approx(np.zeros(3), abs=1e-12)
    assert Rectangle(start="reference").start_state is None


# ------------------------------------------------------------------------------------------------ Sun et al. 2022
@pytest.mark.parametrize("path", ELLIPSES)
def test_the_ellipse_is_the_printed_one(path):
    """r = V^2 / a, k = a / V; V at the start, a a quarter of a lap later; behind the flight it goes on."""
    k, r = path.acceleration / path.speed, path.speed**2 / path.acceleration
    t = np.linspace(0.3, path.duration + 5.0, 50)
    flat, across = path.flat_output(t), 1 if path.plane == "horizontal" else 2
    position = flat.position[:, 0] - [0, 0, path.height]
    assert position[:, 0] == pytest.approx(r * np.sin(k * t), abs=1e-9)
    assert position[:, across] == pytest.approx(r / path.ratio * np.cos(k * t), abs=1e-9)
    ends = path.flat_output(np.array([0.0, np.pi / 2 / k])).position
    assert np.linalg.norm(ends[0, 1]) == pytest.approx(path.speed)
    assert np.linalg.norm(ends[1, 2]) == pytest.approx(path.acceleration)
    if path.plane == "vertical":
        assert flat.yaw is None
    else:
        assert flat.yaw[:, 0] == pytest.approx(np.arctan2(-position[:, 1], -position[:, 0]), abs=1e-9)


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
    start, next_ = (flat_reference(path, np.array([at]), vehicle).state[0] for at in (0.0, 1e-4))
    assert np.abs(start[ATTITUDE]) == pytest.approx([0, 0, 1, 0], abs=1e-9), "exactly upside down"
    assert start[RATE] == pytest.approx(next_[RATE], rel=1e-2)


def test_clipped_references_keep_the_limits(vehicle):
    vehicle = replace(vehicle, rate_max=6.0)
    path = Ellipse(plane="vertical", speed=20.0, acceleration=10.0)
    reference = flat_reference(path, np.linspace(0, 5, 500), vehicle)
    found = clipped(reference, vehicle)
    assert np.abs(reference.state[:, RATE]).max() > 6 and np.abs(found.state[:, RATE]).max() == 6
    assert found.input.min() >= vehicle.thrust_min and found.input.max() <= vehicle.thrust_max
    inside = np.abs(reference.state[:, RATE]).max(axis=1) < 6
    assert (found.state[inside] == reference.state[inside]).all()
