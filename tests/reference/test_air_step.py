"""The parts of a Newton step towards the air: a system of two equations each, and a turn of the specific force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.reference.air_step import MAX_TURN, MIN_SHARE, AirResponse, _lateral_step, newton_step, turned
from quadexp.reference.hover import Hover
from quadexp.reference.motion import Air, Constant, Demand, flat_motion

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
