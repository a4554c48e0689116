"""References by flatness: flown open loop by an independent rigid body they must follow the flat output."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from quadexp.errors import UsageError
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.models.residual import no_residual, symbolic_residual
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.reference.base import FlatOutput
from quadexp.reference.circle import Circle
from quadexp.reference.flatness import continuous, flat_reference
from quadexp.reference.hover import Hover
from quadexp.reference.lemniscate import Lemniscate
from quadexp.reference.random_polynomial import RandomPolynomial
from tests.reference.conftest import Wave
from tests.reference.rotor_drag import rotor_drag_reference

DRAG = (0.3, 0.45, 0.1)  # 1/s


def constant_residual(n_rotors, acceleration, torque):
    """The same body acceleration and torque everywhere."""
    z = ca.SX.sym("z", 6 + n_rotors)
    return symbolic_residual("constant", ca.vertcat(*acceleration, *torque) + 0 * z[0], z, ca.SX.sym("theta", 0), [])


def rich_residual(n_rotors):
    """Linear and quadratic drag, thrust loss of each rotor, coupling of thrust and rates into all six outputs."""
    z = ca.SX.sym("z", 6 + n_rotors)
    v, w, u = z[:3], z[3:6], z[6:]
    k = ca.SX.sym("k", 1)
    smooth = v * ca.sqrt(v * v + 0.5)
    lateral = -ca.DM([0.3, 0.35, 0.05]) * v - 0.05 * smooth - 0.004 * ca.sum1(u) * v + 0.01 * w
    a = lateral + ca.vertcat(0, 0, -k * ca.sumsqr(u))
    torque = ca.vertcat(0.004 * v[1] - 0.003 * w[0], -0.004 * v[0] - 0.003 * w[1], -0.002 * w[2] + 1e-4 * v[0] * v[1])
    return symbolic_residual("rich", ca.vertcat(a, torque), z, k, [0.003])


def fly_open_loop(reference, vehicle, residual):
    """States at reference.t of the rigid body under the reference's inputs from its first state (DOP853)."""
    thrusts = make_interp_spline(reference.t, reference.input, k=5)
    inertia = np.array(vehicle.inertia)
    spin, place = np.array(vehicle.rotor_spin), np.array(vehicle.rotor_position)

    def rates_of_change(t, x):
        q, v, w, u = x[3:7], x[7:10], x[10:13], thrusts(t)
        rotation = Rotation.from_quat(q, scalar_first=True)
        air = np.zeros(6) if residual is None else residual(np.concatenate([rotation.inv().apply(v), w, u]))[0]
        force = np.array([0, 0, u.sum() / vehicle.mass]) + air[:3]
        torque = np.cross(place, u[:, None] * [0, 0, 1]).sum(axis=0) + air[3:]
        torque[2] += vehicle.torque_coefficient * spin @ u
        w1, w2, w3 = w
        spinning = np.array([[0, -w1, -w2, -w3], [w1, 0, w3, -w2], [w2, -w3, 0, w1], [w3, w2, -w1, 0]])
        return np.concatenate(
            [
                v,
                spinning @ q / 2,
                rotation.apply(force) - [0, 0, vehicle.gravity],
                np.linalg.solve(inertia, torque - np.cross(w, inertia @ w)),
            ]
        )

    t = reference.t
    solution = solve_ivp(
        rates_of_change, t[[0, -1]], reference.state[0], method="DOP853", rtol=1e-10, atol=1e-11, t_eval=t[::50]
    )
    return solution.y.T


RESIDUALS = {
    "nominal": lambda v: None,
    "linear drag": lambda v: linear_drag_residual(v, DRAG, (0.1, -0.05, 0.2), -0.05),
    "rich": lambda v: rich_residual(v.n_rotors),
}
FLOWN = {  # a smooth stretch of each: vehicle, start, end (s); any path in simpler air: tests/properties
    "circle": (Circle(speed=5.0, yaw=0.7), "vehicle", 5.5, 8.5),
    "lemniscate": (Lemniscate(speed=4.0), "vehicle", 4.2, 7.0),
    "random": (RandomPolynomial(speed=1.5, seed=1), "vehicle", 0.0, 2.5),
    "turning yaw": (Wave(), "odd_vehicle", 2.0, 5.0),
    "free heading": (Wave(yaw=False), "odd_vehicle", 2.0, 5.0),
}


@pytest.mark.parametrize("path", FLOWN)
def test_flown_open_loop_it_gives_the_flat_output_back(path, request):
    trajectory, name, start, end = FLOWN[path]
    vehicle = request.getfixturevalue(name)
    residual = rich_residual(vehicle.n_rotors)
    t = np.linspace(start, end, 1 + round((end - start) / 0.004))
    reference = flat_reference(trajectory, t, vehicle, residual)
    flown, expected = fly_open_loop(reference, vehicle, residual), reference.state[::50]
    np.testing.assert_allclose(expected[:, POSITION], trajectory.flat_output(t[::50]).position[:, 0], atol=1e-12)
    np.testing.assert_allclose(flown, expected, atol=2e-6)


@pytest.mark.parametrize("path", ["wave", "circle", "lemniscate"])
def test_fixed_point_equals_the_closed_form_of_faessler(vehicle, wave, path):
    trajectory = {"wave": wave, "circle": Circle(speed=6.0, yaw=0.4), "lemniscate": Lemniscate(speed=4.0, yaw=-1.0)}[
        path
    ]
    t = np.arange(0.5, min(trajectory.duration, 9.5), 0.02)
    closed = rotor_drag_reference(trajectory, t, vehicle, DRAG)
    iterated = flat_reference(trajectory, t, vehicle, linear_drag_residual(vehicle, DRAG))
    np.testing.assert_allclose(iterated.state[:, :10], closed.state[:, :10], atol=1e-9)
    # the finite differences of the fixed point blur the jumps of the snap between sections (every 2 s or more)
    away = np.min(np.abs(t[:, None] - np.array([2.0, 4.0, 6.0, 8.0])), axis=1) > 0.04
    np.testing.assert_allclose(iterated.state[away, 10:], closed.state[away, 10:], atol=1e-7)
    np.testing.assert_allclose(iterated.input[away], closed.input[away], atol=1e-6)
    np.testing.assert_allclose(iterated.input, closed.input, atol=5e-3)


def test_no_residual_is_nominal(vehicle):
    t = np.linspace(0, 16, 200)
    a = flat_reference(Circle(speed=6.0), t, vehicle)
    b = flat_reference(Circle(speed=6.0), t, vehicle, no_residual(vehicle))
    np.testing.assert_array_equal(a.state, b.state)


def test_hover_thrust_is_a_quarter_of_the_weight(vehicle):
    reference = flat_reference(Hover(yaw=0.3), np.array([0.0, 5.0, 99.0]), vehicle)
    np.testing.assert_allclose(reference.input, vehicle.mass * 9.81 / 4)
    np.testing.assert_allclose(reference.state[:, ATTITUDE], [[np.cos(0.15), 0, 0, np.sin(0.15)]] * 3, atol=1e-15)
    assert np.all(reference.state[:, RATE] == 0)


def test_hover_under_constant_air_leans_against_it_and_gives_its_torque_back(vehicle):
    """Pitch p gives R^T (0, 0, g) = g (-sin p, 0, cos p): it holds air pushing by a along x_body where sin p = -a/g."""
    torque = np.array([0.02, -0.01, 0.003])
    reference = flat_reference(Hover(), np.array([1.0, 20.0]), vehicle, constant_residual(4, (1.0, 0, 0.5), torque))
    pitch = -np.arcsin(1.0 / 9.81)
    np.testing.assert_allclose(
        reference.state[:, ATTITUDE], [[np.cos(pitch / 2), 0, np.sin(pitch / 2), 0]] * 2, atol=1e-9
    )
    wrench = reference.input @ vehicle.allocation.T
    np.testing.assert_allclose(wrench[:, 0], 9.81 * np.cos(pitch) - 0.5, rtol=1e-9)
    np.testing.assert_allclose(wrench[:, 1:], [-torque] * 2, atol=1e-9)


class Straight:
    """Constant acceleration (m/s^2) with a little jerk and snap: what the signs of attitude and rates are read from."""

    duration, peak_speed = 10.0, 1.0

    def __init__(self, acceleration, jerk=(0, 0, 0), yaw=None):
        self.derivatives, self.yaw = (np.zeros(3), np.zeros(3), acceleration, jerk, np.zeros(3)), yaw

    def flat_output(self, t):
        position = np.tile(np.array(self.derivatives, float), (np.size(t), 1, 1))
        return FlatOutput(position, None if self.yaw is None else np.tile(np.array(self.yaw, float), (np.size(t), 1)))


@pytest.mark.parametrize("yaw", [None, (0.0, 0.0, 0.0)])
def test_signs_of_attitude_and_rates(vehicle, yaw):
    """FLU: z_body must lean towards the acceleration.

    About y (left), a positive angle turns z_body towards +x: forward acceleration is positive pitch. About x, a
    positive angle turns z_body towards -y: leftward acceleration is negative roll. tan(angle) = a / g.
    """
    angle = np.arctan(2.0 / 9.81)
    forward = flat_reference(Straight((2.0, 0, 0), yaw=yaw), [1.0], vehicle).state[0]
    np.testing.assert_allclose(forward[ATTITUDE], [np.cos(angle / 2), 0, np.sin(angle / 2), 0], atol=1e-12)
    left = flat_reference(Straight((0, 2.0, 0), yaw=yaw), [1.0], vehicle).state[0]
    np.testing.assert_allclose(left[ATTITUDE], [np.cos(angle / 2), -np.sin(angle / 2), 0, 0], atol=1e-12)
    # growing forward acceleration from level flight: pitch grows at j / g
    pitching = flat_reference(Straight((0, 0, 0), (3.0, 0, 0), yaw), [1.0], vehicle).state[0]
    np.testing.assert_allclose(pitching[RATE], [0, 3.0 / 9.81, 0], atol=1e-12)
    rolling = flat_reference(Straight((0, 0, 0), (0, 3.0, 0), yaw), [1.0], vehicle).state[0]
    np.testing.assert_allclose(rolling[RATE], [-3.0 / 9.81, 0, 0], atol=1e-12)


def test_turning_on_the_spot(vehicle):
    """Level, yaw rate 0.5 and acceleration 0.2: w = (0, 0, 0.5), yaw torque J_zz 0.2, quaternion about z."""
    reference = flat_reference(Straight((0, 0, 0), yaw=(1.0, 0.5, 0.2)), [1.0], vehicle)
    np.testing.assert_allclose(reference.state[0, ATTITUDE], [np.cos(0.5), 0, 0, np.sin(0.5)], atol=1e-12)
    np.testing.assert_allclose(reference.state[0, RATE], [0, 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(vehicle.allocation @ reference.input[0], [9.81, 0, 0, 0.06 * 0.2], atol=1e-12)


@pytest.mark.parametrize("air", RESIDUALS)
def test_yaw_convention(vehicle, wave, air):
    """y_body is level against x_C = (cos yaw, sin yaw, 0), x_body on its side, whatever the air does."""
    t = np.linspace(0.0, 10.0, 101)
    state = flat_reference(wave, t, vehicle, RESIDUALS[air](vehicle)).state
    rotation = Rotation.from_quat(state[:, ATTITUDE], scalar_first=True).as_matrix()
    yaw = wave.flat_output(t).yaw[:, 0]
    x_c = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1)
    np.testing.assert_allclose(np.einsum("ki,ki->k", rotation[:, :, 1], x_c), 0, atol=1e-12)
    assert np.all(np.einsum("ki,ki->k", rotation[:, :, 0], x_c) > 0)


@pytest.mark.parametrize("air", RESIDUALS)
def test_free_heading_does_not_turn_about_the_thrust_axis(vehicle, air):
    """w_z = 0 throughout, from heading 0; and the quaternion's own derivative agrees: q' = q o (0, w) / 2."""
    trajectory = Lemniscate(speed=4.0)
    h = 1e-3
    t = np.arange(0.0, trajectory.duration, 0.05)
    near = np.clip(t[:, None] + h * np.array([-2, -1, 0, 1, 2]), 0, trajectory.duration).ravel()
    reference = flat_reference(trajectory, near, vehicle, RESIDUALS[air](vehicle))
    assert np.all(reference.state[:, 12] == 0)
    q = reference.state[:, ATTITUDE].reshape(-1, 5, 4)[1:-1]
    slope = (q[:, 0] - 8 * q[:, 1] + 8 * q[:, 3] - q[:, 4]) / (12 * h)
    a, b, c, d = q[:, 2].T
    turning = 2 * (a * slope[:, 3] - b * slope[:, 2] + c * slope[:, 1] - d * slope[:, 0])
    np.testing.assert_allclose(turning, 0, atol=2e-5)


def test_only_a_free_heading_can_fly_the_fast_circle(vehicle):
    """At 12 m/s the circle leans by 72 deg; holding the yaw there would take negative thrusts."""
    t = np.arange(0, 28, 0.02)
    free = flat_reference(Circle(speed=12.0), t, vehicle).input
    fixed = flat_reference(Circle(speed=12.0, yaw=0.0), t, vehicle).input
    assert free.min() > 5 * vehicle.thrust_min and free.max() < vehicle.thrust_max
    assert fixed.min() < 0


def test_the_reference_at_a_time_does_not_depend_on_the_other_times(vehicle):
    """The free heading is an integral from the start, whatever is sampled; regular and irregular times agree."""
    circle, residual = Circle(speed=8.0), rich_residual(4)
    whole = flat_reference(circle, np.arange(0, 20, 0.02), vehicle, residual)
    for times in ([15.0], [3.0, 7.77, 15.0], [14.99, 15.0]):
        part = flat_reference(circle, times, vehicle, residual)
        np.testing.assert_allclose(np.abs(part.state[-1, ATTITUDE]), np.abs(whole.state[750, ATTITUDE]), atol=1e-7)
        np.testing.assert_allclose(part.state[-1, RATE], whole.state[750, RATE], atol=1e-6)
        np.testing.assert_allclose(part.input[-1], whole.input[750], atol=1e-5)


def test_any_quaternions_become_one_continuous_turn(rng):
    """Two and a half turns about a tilted axis, q and -q in any order: the first gets w >= 0, the others follow it."""
    half = 2.0 + np.linspace(0, 2.5 * np.pi, 60)[:, None]  # cos(2) < 0
    turn = np.hstack([np.cos(half), np.sin(half) * [0.0, 0.6, 0.8]])
    for first in (1.0, -1.0):
        signs = np.r_[first, rng.choice([-1.0, 1.0], 59)]
        np.testing.assert_allclose(continuous(signs[:, None] * turn), -turn, atol=1e-15)


def test_beyond_the_end_the_vehicle_hovers_in_the_air_it_knows(vehicle):
    """At rest the rich residual leaves the thrust loss k sum u^2: sum u = m (g + k sum u^2), u equal."""
    circle = Circle(speed=4.0)
    reference = flat_reference(circle, np.array([3.0, circle.duration + 1.0, -1.0]), vehicle, rich_residual(4))
    u = reference.input[1:]
    np.testing.assert_allclose(u.sum(axis=1), 9.81 + 0.003 * (u**2).sum(axis=1), rtol=1e-8)
    assert np.ptp(u) < 1e-8
    np.testing.assert_allclose(reference.state[1:, VELOCITY], 0)
    np.testing.assert_allclose(reference.state[2, POSITION], [5, 0, 1])


def test_any_number_of_times_beyond_the_ends(vehicle):
    """All of them as one alone: at rest, leaning as the air asks for, with the heading that the flight has there."""
    circle, residual = Circle(speed=4.0), rich_residual(4)
    early, late = np.array([-3.0, -2.0, -1.0]), circle.duration + np.array([0.5, 2.0, 7.0, 60.0])
    reference = flat_reference(circle, np.r_[early, 3.0, late], vehicle, residual)
    for held, one in ((slice(0, 3), -2.0), (slice(4, 8), circle.duration + 1.0)):
        alone = flat_reference(circle, np.array([one]), vehicle, residual)
        np.testing.assert_allclose(reference.state[held] - alone.state, 0, atol=1e-9)
        np.testing.assert_allclose(reference.input[held] - alone.input, 0, atol=1e-9)


def test_many_rotors_share_with_least_norm(odd_vehicle, wave):
    reference = flat_reference(wave, np.linspace(0, 9, 50), odd_vehicle)
    wrench = reference.input @ odd_vehicle.allocation.T
    np.testing.assert_allclose(reference.input, np.linalg.lstsq(odd_vehicle.allocation, wrench.T)[0].T, atol=1e-12)


def test_free_fall_is_refused_with_the_time(vehicle):
    with pytest.raises(UsageError, match=r"free fall or inverted flight at t = 1.00 s .* lower trajectory.speed"):
        flat_reference(Straight((0, 0, -9.81), yaw=(0, 0, 0)), [1.0], vehicle)


def test_a_residual_without_a_fixed_point_is_left_out(vehicle):
    """Air that changes sign within millimetres per second has no slope to follow: the reference is that without it."""
    z = ca.SX.sym("z", 10)
    rough = ca.vertcat(8 * ca.sin(5e4 * z[0]), 0, 0, 0, 0, 0)
    residual = symbolic_residual("rough", rough, z, ca.SX.sym("t", 0), [])
    t = np.arange(0, 6, 0.02)
    reference, without = (flat_reference(Circle(speed=4.0), t, vehicle, air) for air in (residual, None))
    assert reference.residual == 0.0 and np.isnan(without.residual)
    np.testing.assert_array_equal(reference.state, without.state)
    np.testing.assert_array_equal(reference.input, without.input)
