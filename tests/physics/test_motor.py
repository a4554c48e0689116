"""Rotors that lag behind their commands: the closed form, and the body's step on them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from quadexp.physics.motor import lagging_rk4_step, lagging_thrust
from quadexp.physics.rigid_body import rigid_body_function
from tests.states import random_state


def test_a_lag_comes_63_percent_of_the_way_in_its_time_constant():
    assert float(lagging_thrust(2.0, 5.0, 0.03, 0.03)) == pytest.approx(5 - 3 * np.exp(-1))
    assert float(lagging_thrust(2.0, 5.0, 0.0, 0.03)) == 2.0


@pytest.mark.parametrize("dt", [0.01, 0.02])
def test_the_step_converges_with_the_fourth_order_to_body_and_lag_integrated(vehicle, rng, dt):
    model, tau = rigid_body_function(vehicle), 0.04
    x, u = np.concatenate([random_state(rng, speed=2.0, rate=1.0), rng.uniform(1, 5, 4)]), rng.uniform(1, 5, 4)

    def slope(_, z):
        return np.concatenate([model(z[:13], z[13:]).full().ravel(), (u - z[13:]) / tau])

    exact = solve_ivp(slope, (0, dt), x, rtol=1e-12, atol=1e-13).y[:, -1]
    whole = lagging_rk4_step(model, x, u, dt, tau).full().ravel()
    halves = lagging_rk4_step(model, lagging_rk4_step(model, x, u, dt / 2, tau), u, dt / 2, tau).full().ravel()
    assert whole[13:] == pytest.approx(exact[13:], rel=1e-10)
    error, half = (np.abs(found - exact)[:13].max() for found in (whole, halves))
    assert error < 2e-4 * (dt / 0.02) ** 4 and half < error / 10
