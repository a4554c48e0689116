"""A flight stack's cascade: its pieces as printed, steps within limits, integrals that do not wind up, no offset."""

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.physics.state import POSITION, RATE, VELOCITY
from quadexp.plugins.laws.cascade import Cascade, wanted_rate, wanted_thrust, wanted_velocity
from tests.control.laws.flown import Body, at_rest, fly, hovering, rotation, vehicle_of

FORCE, TORQUE = np.array([1.5, -1.0, 0.8]), np.array([0.05, -0.03, 0.01])


def cascade(vehicle, **changes):
    return Cascade(**changes, backend="interpreted").controller(vehicle)


def test_the_rate_is_that_of_the_printed_quaternion_law():
    """PX4's AttitudeControl with quaternions of SciPy."""
    rng, keys = np.random.default_rng(1), Cascade()
    R, R_d = ca.SX.sym("R", 3, 3), ca.SX.sym("R_d", 3, 3)
    function = ca.Function("f", [R, R_d], [wanted_rate(R, R_d, keys)])
    for _ in range(50):
        q, q_d = Rotation.random(rng=rng), Rotation.random(rng=rng)
        e_z, e_zd = q.as_matrix()[:, 2], q_d.as_matrix()[:, 2]
        axis = np.cross(e_z, e_zd)
        angle = np.arctan2(np.linalg.norm(axis), e_z @ e_zd)
        reduced = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)) * q
        mixed = (reduced.inv() * q_d).as_quat(canonical=True, scalar_first=True)
        assert np.abs(mixed[1:3]).max() < 1e-9
        yaw = keys.yaw_weight
        parts = [
            np.cos(yaw * np.arccos(np.clip(mixed[0], -1, 1))),
            0,
            0,
            np.sin(yaw * np.arcsin(np.clip(mixed[3], -1, 1))),
        ]
        wanted = q.inv() * reduced * Rotation.from_quat(parts, scalar_first=True)
        error = 2 * wanted.as_quat(canonical=True, scalar_first=True)[1:]
        gain = np.array(keys.attitude_proportional) / [1, 1, yaw]
        assert function(q.as_matrix(), q_d.as_matrix()).full().ravel() == pytest.approx(gain * error, abs=1e-6)


def test_the_velocity_keeps_its_limit_and_goes_to_the_reference_first():
    towards, reference = ca.SX.sym("a", 3), ca.SX.sym("b", 3)
    function = ca.Function("f", [towards, reference], [wanted_velocity(towards, reference, (5.0, 2.0, 1.0))])
    rng = np.random.default_rng(2)
    for _ in range(200):
        a, b = rng.normal(size=3) * rng.choice([0.5, 3, 8]), rng.normal(size=3) * rng.choice([0, 1, 8])
        found = function(a, b).full().ravel()
        assert np.linalg.norm(found[:2]) < 5 + 1e-9 and -1 <= found[2] <= 2
        assert found[2] == pytest.approx(np.clip(a[2] + b[2], -1, 2))
        if np.linalg.norm((a + b)[:2]) <= 5 and np.linalg.norm(a[:2]) < 5:
            assert found[:2] == pytest.approx((a + b)[:2])
        elif np.linalg.norm(a[:2]) >= 5:
            assert found[:2] == pytest.approx(5 * a[:2] / np.linalg.norm(a[:2]))
        else:  # on the circle, along the reference's velocity from `towards`
            along = found[:2] - a[:2]
            assert np.linalg.norm(found[:2]) == pytest.approx(5) and along @ b[:2] >= 0
            assert abs(along[0] * b[1] - along[1] * b[0]) < 1e-6


def tilt_of(a, decoupled):
    return np.arctan2(np.linalg.norm(a[:2]), 9.81 if decoupled else max(a[2] + 9.81, 1e-3))


@pytest.mark.parametrize("decoupled", [True, False])
def test_the_thrust_is_tilted_within_its_limit_and_no_larger_than_there_is(decoupled):
    vehicle, keys = vehicle_of("torrente"), Cascade(tilt_limit=0.8, decoupled=decoupled)
    a = ca.SX.sym("a", 3)
    function = ca.Function("f", [a], list(wanted_thrust(a, vehicle, keys)))
    rng, top = np.random.default_rng(3), 80.0
    assert function([0, 0, 0])[0].full().ravel() == pytest.approx([0, 0, 9.81])
    assert function([1.0, -2.0, 0.0])[0].full().ravel() == pytest.approx([1, -2, 9.81])
    for _ in range(100):
        a_c = rng.normal(size=3) * rng.choice([2, 20, 100])
        f, plain, left = (value.full().ravel() for value in function(a_c))
        limited = tilt_of(a_c, decoupled) > 0.8 or np.linalg.norm(plain) > top
        assert (np.linalg.norm(left) < np.linalg.norm(a_c[:2]) - 1e-9) == limited
        tilt = np.arccos(plain[2] / np.linalg.norm(plain))
        assert tilt < 0.8 + 1e-9 and np.linalg.norm(f) < top + 1e-9 and f[2] > 0
        if np.linalg.norm(plain) > top:  # the vertical first, with a margin of the horizontal
            sideways = min(np.linalg.norm(plain[:2]), 0.3 * top)
            assert f[2] == pytest.approx(min(plain[2], np.sqrt(top**2 - sideways**2)))


@pytest.mark.parametrize("name", ["torrente", "lei_li", "cf2x_L250"])
def test_a_constant_force_and_torque_leave_no_error(name):
    vehicle = vehicle_of(name)
    weight, J = vehicle.mass * vehicle.gravity, np.diag(vehicle.inertia_matrix)
    torque = np.array([2.0, -1.5, 0.2 if name != "lei_li" else 0.1]) * J
    force = weight * np.array([0.12, -0.08, 0.06])
    body, window = Body(vehicle, lambda t: force, lambda t: torque), hovering(vehicle, yaw=0.3)
    states, _ = fly(body, cascade(vehicle), at_rest(), 40.0, lambda t: window)
    assert np.abs(states[-1, POSITION]).max() < 1e-3 and np.abs(states[-1, RATE]).max() < 1e-3
    ahead = rotation(states[-1]).as_matrix()
    assert np.arctan2(-ahead[0, 1], ahead[1, 1]) == pytest.approx(0.3, abs=2e-3)


@pytest.mark.parametrize("name", ["torrente", "crazyflie", "lei_li"])
def test_a_step_keeps_the_velocity_limit_and_does_not_overshoot_much(name):
    vehicle = vehicle_of(name)
    controller = cascade(vehicle, velocity_limit=(3.0, 2.0, 1.0))
    window = hovering(vehicle, (12.0, 0.0, 4.0))
    states, _ = fly(Body(vehicle), controller, at_rest(), 25.0, lambda t: window)
    assert np.linalg.norm(states[:, VELOCITY][:, :2], axis=1).max() < 3.6 and states[:, 9].max() < 2.4
    assert states[:, 0].max() < 12.5 and states[:, 2].max() < 4.4
    assert states[-1, POSITION] == pytest.approx([12, 0, 4], abs=0.02)


def test_the_integral_of_a_velocity_that_cannot_be_reached_does_not_wind_up():
    """A wind that no tilt can stand: back-calculation holds I where K_v/2 (v_c - v) is what the tilt lacks."""
    vehicle = vehicle_of("torrente")
    controller, window, integral = cascade(vehicle, tilt_limit=0.5), hovering(vehicle), []

    def note(t):
        integral.append(controller.memory.now[0])

    body = Body(vehicle, lambda t: np.array([1.0, 0.0, 0.0]) * vehicle.mass * vehicle.gravity)
    states, _ = fly(body, controller, at_rest(), 12.0, lambda t: window, note)
    error = np.clip(-0.95 * states[:, 0], -20, 20) - states[:, 7]
    plain = 0.4 * np.abs(np.cumsum(error)[-1]) * controller.control_period
    bound = 9.81 * np.tan(0.5) + 1.8 / 2 * np.abs(error).max()
    assert np.abs(integral).max() < bound < 0.6 * plain


def test_the_vertical_integral_stands_still_at_full_thrust():
    vehicle = vehicle_of("torrente", thrust_max=3.0)  # 12 N for 9.81
    controller = cascade(vehicle)
    window, x = hovering(vehicle, (0.0, 0.0, 200.0)), at_rest()
    states, commands = fly(Body(vehicle), controller, x, 3.0, lambda t: window)
    assert commands[10:].min() == pytest.approx(3.0) and controller.log()["velocity_integral_z"] == 0.0
    window = hovering(vehicle, (0.0, 0.0, 0.2))
    fly(Body(vehicle), controller, x, 0.5, lambda t: window)
    assert controller.log()["velocity_integral_z"] > 0.01


def test_the_rate_integral_stands_still_where_the_mixer_is_saturated():
    """A yaw that takes all there is: only the integral against it may grow."""
    vehicle, window = vehicle_of("torrente"), hovering(vehicle_of("torrente"), yaw=3.0)
    controller = cascade(vehicle, rate_integral=(27.0, 27.0, 40.0))
    saturated = []

    def note(t):
        saturated.append((controller.running.control_step.saturated[0] > 0, controller.memory.now[11]))

    fly(Body(vehicle), controller, at_rest(), 0.6, lambda t: window, note)
    held = [after - before for (_, before), (now, after) in zip(saturated, saturated[1:], strict=False) if now]
    assert len(held) > 20 and max(held) <= 1e-12


def test_the_reference_s_velocity_and_acceleration_are_fed_forward():
    """As a flight stack takes them offboard: a slow circle with little error, a larger one without a rate's
    feed-forward than with."""
    errors = [
        fly_one(compose(["controller=pid", "plant=ideal", "trajectory.speed=4", *extra])).metadata["row"]["mean_error"]
        for extra in ([], ["controller.rate_feedforward=true"])
    ]
    assert errors[1] < errors[0] < 0.3


def transfer(s, keys, feedforward=(1.0, 1.0)):
    """p(s)/p_r(s) of the cascade in the horizontal at small angles, on a rigid body, in continuous time.

    feedforward: shares of the reference's velocity and acceleration that are fed forward.
    """

    def low_pass(cutoff):
        return 1 / (1 + s / (2 * np.pi * cutoff))

    pi = keys.rate_proportional[0] + keys.rate_integral[0] / s
    slowed = s**2 * (1 + keys.rate_derivative[0] * low_pass(keys.rate_cutoff))
    attitude = pi * keys.attitude_proportional[0] / (slowed + pi * (s + keys.attitude_proportional[0]))
    velocity = keys.velocity_proportional[0] + keys.velocity_integral[0] / s
    towards = velocity * (keys.position_proportional[0] + s)
    damping = keys.velocity_derivative[0] * low_pass(keys.velocity_cutoff) * s**2
    forward = velocity * (keys.position_proportional[0] + feedforward[0] * s) + feedforward[1] * s**2
    return attitude * forward / (s**2 + attitude * (towards + damping))


def circling(vehicle, radius, frequency):
    """The windows of a circle that is flown for ever, about the origin."""
    held = hovering(vehicle)

    def window(t):
        turn = radius * np.exp(1j * frequency * t) * (1j * frequency) ** np.arange(5)
        return held._replace(position=np.column_stack([turn.real, turn.imag, np.zeros(5)]))

    return window


@pytest.mark.parametrize(
    ("name", "frequency", "changes"),
    [
        ("torrente", 1.6, {}),  # of the circle at 8 m/s
        ("lei_li", 1.0, {}),
        ("crazyflie", 2.5, {"velocity_integral": (1.0, 1.0, 2.0), "attitude_proportional": (9.0, 9.0, 2.8)}),
    ],
)
def test_a_small_circle_is_followed_as_its_transfer_function_says(name, frequency, changes):
    """Gains, units, filters, integrals and both feed-forwards; 3 % for a continuous in place of a sampled law."""
    vehicle, keys, radius = vehicle_of(name), Cascade(**changes, backend="interpreted"), 0.02
    controller = keys.controller(vehicle)
    states, _ = fly(Body(vehicle), controller, at_rest((radius, 0, 0)), 30.0, circling(vehicle, radius, frequency))
    t = np.arange(len(states)) / keys.rate
    found = ((states[:, 0] + 1j * states[:, 1]) * np.exp(-1j * frequency * t) / radius)[-1000:]
    wanted = transfer(1j * frequency, keys)
    assert np.abs(found - wanted).max() < 0.03 * abs(1 - wanted)
    for wrong in (transfer(1j * frequency, keys, (0, 1)), transfer(1j * frequency, keys, (1, 0))):
        assert abs(wrong - wanted) > 0.2 * abs(1 - wanted)  # a feed-forward that were not there would show
