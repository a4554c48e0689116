"""What a reference is computed from: the tilt frame, steps of Newton's method towards the air, the time grid."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.reference.air_step import MAX_TURN, MIN_SHARE, AirResponse, _lateral_step, newton_step, turned
from quadexp.reference.flat_map import tilt, twisted, untwisted
from quadexp.reference.hover import Hover
from quadexp.reference.motion import Air, Constant, Demand, flat_motion
from quadexp.reference.time_grid import SPACING, TimeGrid


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


EDGE = np.sqrt(1 - MIN_SHARE**2)


def test_two_equations_at_every_time(rng):
    """The solution where the system is like the unit matrix; the plain step where it is nearly or truly singular."""
    system = np.eye(2)[..., None] + 0.5 * rng.uniform(-1, 1, (2, 2, 50))
    system[:, :, 10] = [[1.0, 2.0], [0.5, 1.0]]  # singular
    system[:, :, 11] = [[1.0, 0.9], [1.0, 1.0]]  # determinant 0.1
    system[:, :, 12] = [[-1.0, 0.2], [0.1, -1.0]]  # regular, but it leads the other way
    system[:, :, 13] = [[0.4, 0.9], [-0.9, 0.4]]  # regular
    right, plain = rng.normal(size=(2, 50)), rng.normal(size=(2, 50))
    step = _lateral_step(system, right, plain)
    np.testing.assert_array_equal(step[:, 10:13], plain[:, 10:13])
    determinant = np.linalg.det(system.transpose(2, 0, 1))
    solved = [k for k in range(50) if k not in (10, 11, 12) and determinant[k] > 0.5]
    assert len(solved) > 25 and 13 in solved
    for k in solved:
        np.testing.assert_allclose(system[:, :, k] @ step[:, k], right[:, k], atol=1e-12)


def test_where_the_system_is_singular_the_air_is_taken_as_it_answers(vehicle):
    """Hovering while rising at w, air with da/dv = g / w answers every turn of the attitude in full, A_ll = 1: then
    l is turned by what was asked for and not given, by both of its components."""
    rising = np.array([[0.0], [0.0], [4.0]])
    motion = flat_motion(
        Demand.of(Hover(yaw=0.0), [1.0], vehicle.gravity), vehicle, Air.still(1), Constant(np.zeros(1))
    )
    by_velocity = np.zeros((6, 3, 1))
    by_velocity[0, 0], by_velocity[1, 1] = 2 * [vehicle.gravity / rising[2]]
    response = AirResponse(np.zeros((6, 1)), by_velocity, np.zeros((6, 4, 1)))
    asked = np.array([0.7, -0.4, 0.3, 0, 0, 0])[:, None]
    found = newton_step(np.zeros((6, 1)), asked, motion, rising, response, vehicle)[:, 0]
    size = np.hypot(0.7, 0.4)
    assert found[:2] == pytest.approx(9.81 * np.sin(size / 9.81) / size * asked[:2, 0], rel=1e-12)
    assert found[2:] == pytest.approx([0.3, 0, 0, 0])


@pytest.mark.parametrize("length", [0.1, 1.0, 2.5, 40.0])
def test_a_step_is_a_turn(length, rng):
    """About the axis f x t, with t tangent to the sphere above the step, by |t| / |f|, at most MAX_TURN."""
    force = 9.81 * np.array([0, 0, 1.0]) + 3 * rng.normal(size=(20, 3))
    step = rng.normal(size=(20, 2))
    step *= length / np.linalg.norm(step, axis=1)[:, None]
    found = turned(force.T, step.T).T
    for f, s, lateral in zip(force, step, found, strict=True):
        tangent = np.r_[s, -f[:2] @ s / f[2]]
        axis = np.cross(f, tangent)
        angle = min(np.linalg.norm(tangent) / np.linalg.norm(f), MAX_TURN)
        after = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).apply(f)
        assert after[2] > 0.5
        assert lateral == pytest.approx(after[:2], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(("turn", "share"), [(0.05, np.sin(1.5)), (0.11, EDGE), (0.2, EDGE), (9.0, EDGE)])
def test_a_turn_ends_before_the_equator(turn, share):
    """Outwards from 1.45 rad by any angle: MIN_SHARE of the force stays on the rotors' axis, the direction is kept.
    Inwards it comes back."""
    direction = np.array([0.6, 0.8])
    force = 9.81 * np.r_[np.sin(1.45) * direction, np.cos(1.45)]
    outwards, inwards = (
        turned(force[:, None], 9.81 * np.cos(1.45) * angle * direction[:, None])[:, 0] for angle in (turn, -0.1)
    )
    assert outwards == pytest.approx(9.81 * share * direction, rel=1e-12)
    assert inwards == pytest.approx(9.81 * np.sin(1.35) * direction, rel=1e-12)


def test_grid_covers_the_times_within_the_range():
    grid = TimeGrid.around(1.0, 2.0, 0.0, 10.0)
    assert grid.times[0] < 1.0 and grid.times[-1] > 2.0
    assert np.diff(grid.times).max() <= SPACING * (1 + 1e-9)
    tight = TimeGrid.around(0.0, 10.0, 0.0, 10.0)
    assert (tight.times[0], tight.times[-1]) == (0.0, 10.0)
    assert len(TimeGrid.around(4.0, 4.0, 0.0, 10.0).times) >= 9


def test_differences_are_exact_for_quartics_at_every_node():
    grid = TimeGrid.around(0.0, 0.1, 0.0, 0.1)
    t = grid.times
    first, second = grid.differentiate(np.stack([t**4 - 2 * t**3, t**2]))
    np.testing.assert_allclose(first, [4 * t**3 - 6 * t**2, 2 * t], atol=1e-12)
    np.testing.assert_allclose(second, [12 * t**2 - 12 * t, 0 * t + 2], atol=1e-9)


def test_interpolation_is_exact_for_quintics():
    grid = TimeGrid.around(0.0, 0.2, 0.0, 0.2)
    t = np.random.default_rng(0).uniform(0, 0.2, 50)
    value, first, second = grid.interpolate(grid.times[None] ** 5, t)
    np.testing.assert_allclose(value[0], t**5, atol=1e-15)
    np.testing.assert_allclose(first[0], 5 * t**4, atol=1e-12)
    np.testing.assert_allclose(second[0], 20 * t**3, atol=1e-9)


@pytest.mark.parametrize("what", ["first", "second", "integral"])
def test_order_four(what):
    def error(steps):
        t = np.linspace(0, 2, steps + 1)
        grid = TimeGrid(t, 2 / steps)
        first, second = grid.differentiate(np.sin(3 * t)[None])
        found = {"first": first[0], "second": second[0], "integral": grid.integrate(np.sin(3 * t), 3 * np.cos(3 * t))}
        exact = {"first": 3 * np.cos(3 * t), "second": -9 * np.sin(3 * t), "integral": (1 - np.cos(3 * t)) / 3}
        return np.abs(found[what] - exact[what])[2:-2].max()  # the ends are one-sided

    assert np.log2(error(40) / error(80)) == pytest.approx(4, abs=0.3)
