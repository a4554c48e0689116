"""Rotor thrusts asked for beyond the limits: the torque gives way, the collective does not."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.reference.motion import within_limits


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
