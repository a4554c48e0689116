"""Ground effect: Cheeseman and Bennett's factor, its limits, forces and torques where rotors differ in height."""

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.plugins.worlds.ground import ground_wrench, thrust_factor

RADIUS = 0.12


def places(vehicle):
    return ca.DM(np.array(vehicle.rotor_position).T)


def test_the_factor_is_that_of_cheeseman_and_bennett():
    """1 / (1 - (R / 4 z)^2): 1.0667 at z = R, 1.0159 at 2 R (16/15 and 64/63); the limit of 4/3 below half a radius."""
    found = np.array(thrust_factor(ca.DM([1, 2, 0.5, 0.1, -3]) * RADIUS, RADIUS)).ravel()
    assert found == pytest.approx([16 / 15, 64 / 63, 4 / 3, 4 / 3, 4 / 3])


def test_level_over_the_ground_only_thrust_grows(vehicle, rng):
    x = np.r_[3.0, -2.0, 5.0 + 1.5 * RADIUS, 1, np.zeros(9)]
    u = np.full(4, 2.5)
    force, torque = ground_wrench(ca.DM(x), ca.DM(u), places(vehicle), RADIUS, 5.0, 10.0)
    assert np.array(force).ravel() == pytest.approx([0, 0, 10.0 * (36 / 35 - 1)])  # (1 / 6)^2 = 1 / 36
    assert np.array(torque).ravel() == pytest.approx(np.zeros(3), abs=1e-14)


def test_tilted_the_lower_rotors_gain_more_and_right_the_vehicle(odd_vehicle, rng):
    """Against a sum over the rotors; the torque opposes the tilt, and the force is along z_body."""
    turn = Rotation.from_rotvec([0.3, 0.0, 0.0])
    x = np.r_[0.0, 0.0, 0.25, turn.as_quat(scalar_first=True), np.zeros(6)]
    u = rng.uniform(2, 3, 6)
    force, torque = (
        np.array(v).ravel() for v in ground_wrench(ca.DM(x), ca.DM(u), places(odd_vehicle), RADIUS, 0.0, 10.0)
    )
    at = np.array(odd_vehicle.rotor_position)
    heights = 0.25 + turn.apply(at)[:, 2]
    added = u * (1 / (1 - (RADIUS / 4 / np.maximum(heights, RADIUS / 2)) ** 2) - 1)
    assert force == pytest.approx(turn.apply([0, 0, added.sum()]))
    assert torque == pytest.approx(np.cross(at, np.outer(added, [0, 0, 1])).sum(0))
    assert torque[0] < 0


def test_there_is_none_above_the_limit(vehicle):
    x = np.r_[0.0, 0.0, 0.5, 1, np.zeros(9)]
    for limit, there in ((0.4, False), (0.6, True)):
        force, _ = ground_wrench(ca.DM(x), ca.DM.ones(4), places(vehicle), RADIUS, 0.0, limit)
        assert (float(force[2]) > 0) is there
