"""Targets under an assumed disturbance hold the path: their thrust is what it asks for less the disturbance."""

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.plugins.remedies.targets import LEAST, held_targets


def targets(vehicle, rotation, specific, push):
    """Axis of the thrust at the first of three equal nodes, and the sum of its thrusts over the mass."""
    q = np.roll(rotation.as_quat(), 1)
    x = np.concatenate([np.zeros(3), q, np.zeros(6)])
    u = np.full(vehicle.n_rotors, specific * vehicle.mass / vehicle.n_rotors)
    three, times = [ca.MX(ca.DM(x))] * 3, [ca.MX(0.1 * k) for k in range(3)]
    disturbance = ca.MX(ca.DM([*push, 0, 0, 0]))
    still, as_modelled = ca.MX.zeros(3), ca.MX(1)
    moved, changes, _ = held_targets(
        three, [ca.MX(ca.DM(u))] * 3, [ca.MX.zeros(6)] * 3, times, None, ca.MX(), disturbance, still, as_modelled,
        vehicle,
    )  # fmt: skip
    found, change = (np.array(v).ravel() for v in ca.Function("f", [], [moved[0][:4], changes[0]])().values())
    return Rotation.from_quat(np.roll(found, -1)).as_matrix()[:, 2], (u + change).sum() / vehicle.mass


def test_they_hold_the_path(vehicle, rng):
    for _ in range(5):
        rotation, specific = Rotation.random(random_state=rng.integers(1000)), rng.uniform(10, 30)
        push = rng.normal(size=3)
        push *= 0.5 * specific / np.linalg.norm(push)
        wanted = rotation.as_matrix()[:, 2] * specific - push
        axis, thrust = targets(vehicle, rotation, specific, push)
        assert axis * thrust == pytest.approx(wanted, abs=1e-6)


def test_they_stay_finite_in_an_air_that_is_far_too_strong(vehicle):
    """The air's force is asked for where the last step turned the vehicle to: from step to step it would grow."""
    fast = np.concatenate([np.zeros(3), [1, 0, 0, 0], [8.0, 0, 0], np.zeros(3)])
    thrusts = np.full(vehicle.n_rotors, vehicle.hover_thrust)
    z = ca.MX.sym("z", 6 + vehicle.n_rotors)
    force = ca.vertcat(-50 * z[0] * (1 + z[0] ** 2), 0, z[0] ** 3, 0, 0, 0)
    model = ca.Function("air", [z, ca.MX.sym("theta", 0)], [force, ca.jacobian(force, z)])
    last = ca.MX.sym("last", 6, 3)
    _, _, air = held_targets(
        [ca.MX(ca.DM(fast))] * 3, [ca.MX(ca.DM(thrusts))] * 3, ca.horzsplit(last), [ca.MX(0.1 * k) for k in range(3)],
        model, ca.MX(0, 1), ca.MX.zeros(6), ca.MX(ca.DM([9.0, 0, 0])), ca.MX(4), vehicle,
    )  # fmt: skip
    step, now = ca.Function("step", [last], [ca.horzcat(*air)]), np.zeros((6, 3))
    for _ in range(20):
        now = np.array(step(now))
        assert np.abs(now[:3]).max() <= vehicle.n_rotors * vehicle.thrust_max / vehicle.mass + 1e-9


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_next_to_no_specific_force_is_followed_by_its_share(vehicle, share):
    """A force across the rotors' axis, of a share of LEAST: the axis is turned to share * across + (1 - share) * up."""
    across, specific = share * LEAST * vehicle.gravity, 12.0
    axis, thrust = targets(vehicle, Rotation.identity(), specific, np.array([-across, 0, specific]))
    assert axis == pytest.approx(np.array([share, 0, 1 - share]) / np.hypot(share, 1 - share), abs=1e-9)
    assert thrust == pytest.approx(across, abs=1e-9)


def test_their_rates_are_those_of_their_attitudes(vehicle):
    """A reference that turns, under a push: the attitudes' own derivative, by differences, in body axes."""
    h, start, w = 1e-3, Rotation.from_euler("zyx", [1.0, 0.5, -0.4]), np.array([1.5, -2.0, 1.0])
    turns = [start * Rotation.from_rotvec(w * h * k) for k in (-1, 0, 1)]
    states = [ca.MX(ca.DM(np.r_[np.zeros(3), np.roll(one.as_quat(), 1), np.zeros(3), w])) for one in turns]
    inputs = [ca.MX(ca.DM(np.full(vehicle.n_rotors, 15.0 * vehicle.mass / vehicle.n_rotors)))] * 3
    push, times = ca.MX(ca.DM([1.0, -1.5, 0.5, 0, 0, 0])), [ca.MX(h * k) for k in range(3)]
    still, as_modelled = ca.MX.zeros(3), ca.MX(1)
    moved, *_ = held_targets(
        states, inputs, [ca.MX.zeros(6)] * 3, times, None, ca.MX(), push, still, as_modelled, vehicle
    )
    before, now, after = (np.array(ca.DM(ca.evalf(one))).ravel() for one in moved)
    first, last = (Rotation.from_quat(np.roll(one[:4], -1)) for one in (before, after))
    rate = (first.inv() * last).as_rotvec() / (2 * h)
    assert now[4:] == pytest.approx(rate, abs=0.01) and np.abs(rate - w).max() > 0.1
