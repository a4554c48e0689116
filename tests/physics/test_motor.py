"""Rotors that lag behind their commands: the closed form, and the body's step on them."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from quadexp.physics.motor import lagging_rk4_step, lagging_thrust, time_constant_towards
from quadexp.physics.rigid_body import rigid_body_function
from tests.states import random_state


def test_a_lag_comes_63_percent_of_the_way_in_its_time_constant():
    assert float(lagging_thrust(2.0, 5.0, 0.03, 0.03)) == pytest.approx(5 - 3 * np.exp(-1))
    assert float(lagging_thrust(2.0, 5.0, 0.0, 0.03)) == 2.0


def test_up_and_down_have_their_own_time_constants():
    """63 % of the way up after tau_up, of the way down after tau_down; steps of any length make the same way."""
    up, down, first, command = 0.0125, 0.025, np.array([2.0, 5.0]), np.array([5.0, 2.0])
    tau = np.array(time_constant_towards(ca.DM(first), ca.DM(command), up, down)).ravel()
    assert tau == pytest.approx([up, down])
    for i, (rise, constant) in enumerate([(3.0, up), (-3.0, down)]):
        value = first[i]
        for _ in range(7):
            now = float(time_constant_towards(value, command[i], up, down))
            value = float(lagging_thrust(value, command[i], constant / 7, now))
        assert value == pytest.approx(first[i] + rise * (1 - np.exp(-1)), rel=1e-12)


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
