"""Rotors with angular momentum: body and rotors together, against momentum integrated without Euler's equation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from quadexp.errors import UsageError
from quadexp.physics.state import ATTITUDE, RATE
from quadexp.world.actuator import Actuator
from quadexp.world.world import World
from tests.world.airframes import ideal, start

PERIOD, INERTIA, TAU = 0.02, 2e-4, 0.03  # kg m^2: large, so that the rotors' share is plain to see
UP = np.array([0.0, 0.0, 1.0])


def flown(vehicle, u, step, lag_of="rotor_speed", inertia=INERTIA):
    """States (k + 1, 13) and the rotors' sum of s W (k + 1,) under commands (k, n)."""
    lag = {"time_constant_up": TAU, "time_constant_down": TAU, "lag_of": lag_of}
    world = World(ideal(vehicle, step), [Actuator(rotor_inertia=inertia, **lag)])
    x = start(4)
    x[RATE] = [2.0, -1.5, 1.0]
    streams = world.begin(x, PERIOD, 1.0, np.random.default_rng(0))
    states, spin = [x], [world.rotor_speed @ np.array(vehicle.rotor_spin)]
    for command in u:
        x, _ = world.advance(x, command, PERIOD, streams)
        states.append(x)
        spin.append(world.rotor_speed @ np.array(vehicle.rotor_spin))
    return np.array(states), np.array(spin)


def thrusts(vehicle, periods):
    """Commands (k, n) that turn the vehicle about every axis and change the sum of the speeds."""
    share = 1 + 0.5 * np.random.default_rng(5).uniform(-1, 1, (periods, vehicle.n_rotors))
    return vehicle.hover_thrust * share


def momentum(vehicle, states, spin):
    """Of body and rotors about the centre of mass, world (k + 1, 3) (N m s)."""
    body = states[:, RATE] @ vehicle.inertia_matrix - INERTIA * spin[:, None] * UP
    return Rotation.from_quat(states[:, ATTITUDE], scalar_first=True).apply(body)


@pytest.mark.parametrize("lag_of", ["rotor_speed", "thrust"])
def test_without_a_torque_from_outside_angular_momentum_is_kept(lei_li, lag_of):
    """Rotors on very short arms, without drag, move the body by their inertia alone; the step's error falls with it."""
    arms = 1e-7 * np.array(lei_li.rotor_position)
    vehicle = replace(lei_li, rotor_position=tuple(map(tuple, arms)), torque_coefficient=1e-7)
    drift = []
    for step in (2e-3, 1e-3):
        states, spin = flown(vehicle, thrusts(vehicle, 25), step, lag_of)
        found = momentum(vehicle, states, spin)
        drift.append(np.abs(found - found[0]).max())
    exchanged = INERTIA * np.ptp(spin)
    assert exchanged > 0.01 and np.abs(states[:, RATE] - states[0, RATE]).max() > 1.0
    assert drift[0] < 0.02 * exchanged and drift[1] < 0.6 * drift[0]


def test_flights_are_those_of_momentum_integrated_by_itself(lei_li):
    """L' = R tau of the air, w = J^-1 (R' L + I_p S e_z): no gyroscopic term and no acceleration of rotors in it."""
    u, k = thrusts(lei_li, 15), lei_li.thrust_coefficient
    J, sign = lei_li.inertia_matrix, np.array(lei_li.rotor_spin)
    speed = np.full(4, np.sqrt(lei_li.hover_thrust / k))
    states = {step: flown(lei_li, u, step)[0] for step in (2e-3, 1e-3, 5e-4)}
    first = states[2e-3][0]
    R = Rotation.from_quat(first[ATTITUDE], scalar_first=True)
    y = np.r_[first[ATTITUDE], R.apply(J @ first[RATE] - INERTIA * (sign @ speed) * UP), speed]
    for command in u:

        def slope(t, y, command=command):
            q, L, W = y[:4], y[4:7], y[7:]
            R = Rotation.from_quat(q, scalar_first=True)
            w = np.linalg.solve(J, R.inv().apply(L) + INERTIA * (sign @ W) * UP)
            turn = 0.5 * np.r_[-q[1:] @ w, q[0] * w + np.cross(q[1:], w)]
            return np.r_[turn, R.apply(lei_li.allocation[1:] @ (k * W**2)), (np.sqrt(command / k) - W) / TAU]

        y = solve_ivp(slope, (0, PERIOD), y, rtol=1e-9, atol=1e-11).y[:, -1]
    R = Rotation.from_quat(y[:4], scalar_first=True)
    expected = np.linalg.solve(J, R.inv().apply(y[4:7]) + INERTIA * (sign @ y[7:]) * UP)
    error = [np.abs(found[-1, RATE] - expected).max() for found in states.values()]
    without = flown(lei_li, u, 5e-4, inertia=0.0)[0][-1, RATE]
    assert np.abs(without - expected).max() > 0.1
    assert error[0] < 0.02 and error[1] < 0.6 * error[0] and error[2] < 0.6 * error[1]


def test_without_inertia_nothing_is_added(lei_li):
    assert not World(ideal(lei_li), [Actuator(time_constant_up=TAU)]).effects[0].has("wrench")
    unknown = ideal(replace(lei_li, thrust_coefficient=None))
    with pytest.raises(UsageError, match=r"actuator\.rotor_inertia=5e-06: needs vehicle\.thrust_coefficient"):
        World(unknown, [Actuator(rotor_inertia=5e-6)]).columns(PERIOD)
