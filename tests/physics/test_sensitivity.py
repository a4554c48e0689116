"""The chained linearisation against automatic differentiation of the whole step, for every residual."""

import casadi as ca
import numpy as np
import pytest

from quadexp.physics.integrator import rk4_step
from quadexp.physics.motor import lagging_rk4_step
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.sensitivity import rk4_sensitivity_function
from tests.models.residuals import RESIDUALS, make_residual
from tests.states import random_state

LAGGING = ("none", "gp_with_mean", "plant", "blade_element")


@pytest.mark.parametrize("scalar", [True, False])
@pytest.mark.parametrize(
    ("name", "lag"),
    [
        *((name, ()) for name in RESIDUALS),
        *((name, (0.03,)) for name in ("none", "gp_with_mean", "plant", "blade_element")),
    ],
)
def test_equals_automatic_differentiation(vehicle, rng, name, lag, scalar):
    """With a lag 17 states: the thrusts at the stages of the step follow the command."""
    residual, dt, size = make_residual(name, vehicle), 0.07 if lag else 0.1, 17 if lag else 13
    corrected = corrected_function(vehicle, residual)
    x, u = ca.MX.sym("x", size), ca.MX.sym("u", 4)
    if lag:
        x_next = lagging_rk4_step(lambda s, thrust: corrected(s, thrust, residual.theta), x, u, dt, *lag)
    else:
        x_next = rk4_step(lambda s: corrected(s, u, residual.theta), x, dt)
    whole = ca.Function("whole", [x, u], [x_next, ca.jacobian(x_next, x), ca.jacobian(x_next, u)])
    chained = rk4_sensitivity_function(vehicle, residual, scalar=scalar, lag=bool(lag))
    for _ in range(5):
        x0, u0 = np.r_[random_state(rng), rng.uniform(0.5, 10, size - 13)], rng.uniform(0.5, 10, 4)
        for expected, found in zip(whole(x0, u0), chained(x0, u0, residual.theta, dt, *lag), strict=True):
            assert np.allclose(expected, found, rtol=1e-11, atol=1e-11)


def test_any_layout(odd_vehicle, rng):
    residual = make_residual("none", odd_vehicle)
    corrected = corrected_function(odd_vehicle, residual)
    chained = rk4_sensitivity_function(odd_vehicle, residual)
    x0, u0, h = random_state(rng), rng.uniform(0.5, 8, 6), 1e-6
    x_next, A, B = (np.array(part) for part in chained(x0, u0, [], 0.05))

    def step(x, u):
        return np.array(rk4_step(lambda s: corrected(s, u, []), ca.DM(x), 0.05)).reshape(-1)

    numeric_A = np.stack([(step(x0 + h * e, u0) - step(x0 - h * e, u0)) / (2 * h) for e in np.eye(13)], axis=1)
    numeric_B = np.stack([(step(x0, u0 + h * e) - step(x0, u0 - h * e)) / (2 * h) for e in np.eye(6)], axis=1)
    assert np.allclose(x_next.reshape(-1), step(x0, u0), atol=1e-13)
    assert np.allclose(A, numeric_A, atol=1e-7)
    assert np.allclose(B, numeric_B, atol=1e-7)
