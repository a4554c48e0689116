"""One node of the controller's model: the state after a held input, as every part of the controller predicts it."""

from __future__ import annotations

import casadi as ca

from quadexp.air.base import Residual
from quadexp.physics.integrator import rk4_step
from quadexp.physics.motor import lagging_rk4_step
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle


def node_function(vehicle: Vehicle, residual: Residual, *, lag: bool = False) -> ca.Function:
    """(x (13,), u (n,), theta (p,), dt (s)) -> x_next; with `lag` x is (13 + n,), and tau (s) the last input."""
    n, dynamics = vehicle.n_rotors, corrected_function(vehicle, residual)
    x, u, dt = ca.MX.sym("x", N_STATE + n * lag), ca.MX.sym("u", n), ca.MX.sym("dt")
    theta, tau = ca.MX.sym("theta", residual.function.size1_in(1)), ca.MX.sym("tau")
    if not lag:
        return ca.Function("node", [x, u, theta, dt], [rk4_step(lambda s: dynamics(s, u, theta), x, dt)])
    x_next = lagging_rk4_step(lambda s, thrust: dynamics(s, thrust, theta), x, u, dt, tau)
    return ca.Function("node", [x, u, theta, dt, tau], [x_next])
