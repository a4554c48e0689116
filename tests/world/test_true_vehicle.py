"""The true vehicle against sums over its point masses, and Newton and Euler for a payload at a point."""

from dataclasses import replace

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.experiment.build import build_vehicle, build_world
from quadexp.parts.compose import compose
from quadexp.world.true_vehicle import coefficient_allocation, with_factors, with_payload


def moments(masses, points):
    """Mass, centre and inertia about the centre of point masses."""
    mass = masses.sum()
    centre = masses @ points / mass
    d = points - centre
    inertia = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, d, strict=True))
    return mass, centre, inertia


def cloud(vehicle, rng):
    """Point masses with the mass and inertia of a vehicle, their centre at the origin: its principal axes' six ends."""
    moment, axes = np.linalg.eigh(vehicle.inertia_matrix)
    share = moment.sum() / 2 - moment  # sum of m r^2 along each principal axis
    masses = np.full(6, vehicle.mass / 6)
    reach = np.sqrt(share / (vehicle.mass / 3))
    points = np.concatenate([axes.T * reach[:, None], -axes.T * reach[:, None]])
    return masses, points


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_payload_is_one_more_point_mass(odd_vehicle, seed):
    rng = np.random.default_rng(seed)
    payload, point = rng.uniform(0.05, 0.6), rng.normal(size=3) * 0.1
    masses, points = cloud(odd_vehicle, rng)
    mass, centre, inertia = moments(np.append(masses, payload), np.vstack([points, point]))
    loaded = with_payload(odd_vehicle, payload, point)
    assert loaded.mass == pytest.approx(mass)
    assert loaded.inertia_matrix == pytest.approx(inertia, rel=1e-12)
    assert np.array(loaded.rotor_position) == pytest.approx(np.array(odd_vehicle.rotor_position) - centre)


def test_factors_scale_and_the_centre_moves(vehicle, odd_vehicle):
    true = with_factors(odd_vehicle, 0.7, np.array([1.2, 0.9, 1.1]), np.array([0.01, -0.02, 0.03]))
    assert true.mass == pytest.approx(0.7 * odd_vehicle.mass)
    ratio = true.inertia_matrix / odd_vehicle.inertia_matrix
    assert np.diag(ratio) == pytest.approx([1.2, 0.9, 1.1]) and ratio[0, 1] == pytest.approx(np.sqrt(1.2 * 0.9))
    moved = np.array(odd_vehicle.rotor_position) - [0.01, -0.02, 0.03]
    assert np.array(true.rotor_position) == pytest.approx(moved)
    assert with_factors(vehicle, 1.0, np.ones(3), np.zeros(3)) == vehicle


def test_the_torque_of_equal_thrusts_is_that_of_gravity_about_the_old_centre(vehicle):
    """Equal thrusts act in the middle of the rotors; with the centre of mass off it by c they turn the vehicle."""
    c = np.array([0.02, -0.01, 0.05])
    true = with_factors(vehicle, 1.3, np.ones(3), c)
    wrench = true.allocation @ np.full(4, 2.5)
    assert wrench[1:] == pytest.approx(np.cross(-c, [0, 0, 10.0]), abs=1e-12)


def test_a_vehicle_that_cannot_hover_is_refused(vehicle):
    with pytest.raises(UsageError, match="payload: gives no vehicle that can fly: .*hovering takes"):
        with_payload(vehicle, 20.0, np.zeros(3))
    with pytest.raises(UsageError, match="truth: gives no vehicle that can fly: .*principal moments"):
        with_factors(vehicle, 1.0, np.array([1, 1, 4.0]), np.zeros(3))


@pytest.mark.parametrize(("thrust_factor", "torque_factor"), [(1.1, 1.0), (0.9, 1.3), (1.0, 0.5)])
def test_coefficients_change_the_wrench_as_another_vehicle_would_give_it(
    odd_vehicle, thrust_factor, torque_factor, rng
):
    """Thrusts times f_T on a vehicle whose torque per thrust is f_Q times as large."""
    u = rng.uniform(1, 4, 6)
    other = replace(odd_vehicle, torque_coefficient=torque_factor * odd_vehicle.torque_coefficient)
    wanted = other.allocation @ (thrust_factor * u) - odd_vehicle.allocation @ u
    found = coefficient_allocation(odd_vehicle, thrust_factor, torque_factor) @ u
    assert found == pytest.approx(wanted, abs=1e-12)


LAGGING = {
    "drone_models": ["vehicle=cf2x_L250", "plant=drone_models"],
    "rotorpy": ["vehicle=hummingbird", "plant=rotorpy", "plant.motor_lag=0.03"],
    "blade_element": ["vehicle=lei_li", "plant=blade_element", "plant.motor_lag=0.05", "plant.step=1e-3"],
    "actuator": ["plant=ideal", "actuator=first_order"],
}


def forces(overrides, scale):
    """Specific force along z and rates after each of 10 periods, in which the thrusts rise by a fifth of hover."""
    config = compose([*overrides, "plant.backend=interpreted"])
    vehicle = build_vehicle(config.vehicle)
    world = build_world(config, vehicle)
    hover = scale * vehicle.hover_thrust
    x, rows = np.r_[np.zeros(3), 1, np.zeros(9)], []
    noise = world.begin(x, 0.02, 1.0, np.random.default_rng(0), np.full(4, hover))
    for _ in range(10):
        x, force = world.advance(x, np.full(4, 1.2 * hover), 0.02, noise)
        rows.append(force[2])
    return np.array(rows)


@pytest.mark.parametrize("factor", [0.8, 1.2])
@pytest.mark.parametrize("plant", LAGGING)
def test_thrust_that_is_off_lags_as_the_rotors_do(plant, factor):
    """As if the commands were so many times larger, whether the rotors are the plant's own or an actuator's."""
    off = forces([*LAGGING[plant], f"truth.thrust_coefficient={factor}"], 1.0)
    assert off == pytest.approx(forces(LAGGING[plant], factor), abs=0.1)
    assert off[0] < off[1] < off[2]


@pytest.mark.parametrize("plant", ["drone_models", "blade_element"])
def test_thrust_near_the_ground_lags_as_the_rotors_do(plant):
    """The ground gives a constant factor of what the rotors give, here from the first period on."""
    near = ["ground=cheeseman_bennett", "ground.rotor_radius=2.0"]  # less than half of it above the ground
    share = forces([*LAGGING[plant], *near], 1.0)[:3] / forces(LAGGING[plant], 1.0)[:3]
    assert share == pytest.approx(np.full(3, share[0]), rel=0.02) and share[0] > 1.25
