"""Thrusts and rates beyond the limits: the torque gives way, the collective does not; the worst violation is named."""

from dataclasses import replace

import numpy as np
import pytest

from quadexp.physics.state import RATE
from quadexp.reference.circle import Circle
from quadexp.reference.flatness import check_feasible, flat_reference
from quadexp.reference.hover import Hover
from quadexp.reference.lemniscate import Lemniscate
from quadexp.reference.motion import within_limits

T = np.arange(0, 20.02, 0.02)


@pytest.mark.parametrize("name", ["vehicle", "odd_vehicle"])
def test_torque_gives_way_to_the_limits(name, request, rng):
    """[T, tau] becomes [T, s tau] with the largest s up to one that keeps every rotor within its limits."""
    vehicle = request.getfixturevalue(name)
    G, middle = vehicle.allocation, (vehicle.thrust_max + vehicle.thrust_min) / 2
    wrench = G @ (middle * (1 + 0.6 * rng.normal(size=(vehicle.n_rotors, 400))))
    wrench[0] = vehicle.n_rotors * middle * rng.uniform(0.6, 1.4, 400)  # within the limits without a torque
    asked = np.linalg.pinv(G) @ wrench
    inside = np.all((asked >= vehicle.thrust_min) & (asked <= vehicle.thrust_max), axis=0)
    assert 20 < inside.sum() < 380

    given, free = within_limits(asked, vehicle)
    np.testing.assert_array_equal(free, inside)
    np.testing.assert_array_equal(given[:, inside], asked[:, inside])
    np.testing.assert_allclose((G @ given)[0], wrench[0], rtol=1e-12)
    torque, wanted = (G @ given)[1:], (G @ asked)[1:]
    share = (torque * wanted).sum(axis=0) / (wanted**2).sum(axis=0)
    np.testing.assert_allclose(torque, share * wanted, atol=1e-10)
    assert np.all(share[~inside] >= 0) and np.all(share[~inside] < 1)
    slack = np.minimum(given - vehicle.thrust_min, vehicle.thrust_max - given).min(axis=0)
    np.testing.assert_allclose(slack[~inside], 0, atol=1e-10)  # one rotor at its limit, none beyond
    assert np.all(slack > -1e-10)


def test_free_fall_is_within_the_limits(vehicle):
    """No thrust and no torque asked for, where rotors may stand still."""
    given, free = within_limits(np.zeros((4, 3)), vehicle)
    assert np.all(given == 0) and free.all()


def test_a_flyable_reference_has_nothing_to_report(vehicle):
    assert check_feasible(flat_reference(Hover(), T, vehicle), vehicle) is None
    assert check_feasible(flat_reference(Circle(speed=8.0), T, vehicle), vehicle) is None


def test_worst_thrust_of_a_circle(vehicle):
    """Hardly any inertia: each rotor gives m sqrt(g^2 + (V^2/r)^2) / 4, most at the peak V = v + 0.273 a at t = 10
    s."""
    tiny = tuple(tuple(1e-7 * v for v in row) for row in vehicle.inertia)
    light = replace(vehicle, inertia=tiny, thrust_max=4.0)
    circle = Circle(speed=8.0, radius=5.0)
    found = check_feasible(flat_reference(circle, T, light), light)
    worst = np.hypot(9.81, (8.0 + (4 / np.pi - 1)) ** 2 / 5.0) / 4
    assert found.value == pytest.approx(worst, rel=1e-4)
    assert found.margin == pytest.approx(worst - 4.0, rel=1e-3)
    assert found.t == pytest.approx(10.0, abs=0.05)
    assert (found.limit, found.unit) == (4.0, "N") and found.what.startswith("rotor")
    assert "N above the limit of 4 N" in str(found) and "\n" not in str(found)


def test_thrust_below_the_least(vehicle):
    """The crossing of the lemniscate at 11.7 m/s flips the vehicle over faster than its rotors can without pulling."""
    reference = flat_reference(Lemniscate(speed=8.0), T, vehicle)
    found = check_feasible(reference, vehicle)
    assert found.value == reference.input.min() == -found.margin
    assert found.t == T[np.argmin(reference.input.min(axis=1))]
    assert "N below the limit of 0 N" in str(found)


def test_body_rate(vehicle):
    slow = replace(vehicle, rate_max=1.0)
    reference = flat_reference(Circle(speed=8.0), T, slow)
    found = check_feasible(reference, slow)
    rate = np.linalg.norm(reference.state[:, RATE], axis=1)
    assert (found.what, found.unit, found.value) == ("body rate", "rad/s", pytest.approx(rate.max()))
    assert found.t == T[np.argmax(rate)]
    assert found.share == pytest.approx((rate > 1.0).mean())
