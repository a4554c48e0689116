"""The discrete prediction model: the state after one node, one Runge-Kutta step."""

from __future__ import annotations

from quadexp.compile.symbolic import ca
from quadexp.models.residual import Residual
from quadexp.physics.integrator import rk4_step, rk4_step_with_input
from quadexp.physics.motor import lagging_rk4_step
from quadexp.physics.rigid_body import N_DISTURBANCE, corrected_function, disturbed_derivative
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle


def node_function(
    vehicle: Vehicle, residual: Residual, *, lag: bool = False, added: bool = False, disturbed: bool = False
) -> ca.Function:
    """(x (13,), u (n,), theta (p,), dt (s)) -> x_next (13,).

    With `lag` x is (13 + n,) and tau (s) a further input; with `added` the next one is the thrust added to what u gives
    (N), (n, 3): at the start, the middle and the end of the node; with `disturbed` the last one is a disturbance (6,),
    see physics.rigid_body.
    """
    n, dynamics = vehicle.n_rotors, corrected_function(vehicle, residual)
    x, u, dt = ca.MX.sym("x", N_STATE + n * lag), ca.MX.sym("u", n), ca.MX.sym("dt")
    theta, tau = ca.MX.sym("theta", residual.function.size1_in(1)), ca.MX.sym("tau")
    plus, disturbance = ca.MX.sym("added", n, 3), ca.MX.sym("disturbance", N_DISTURBANCE)
    arguments = [x, u, theta, dt] + [tau] * lag + [plus] * added + [disturbance] * disturbed

    def derivative(s: ca.MX, thrust: ca.MX) -> ca.MX:
        slope = dynamics(s, thrust, theta)
        return disturbed_derivative(slope, disturbance) if disturbed else slope

    if lag:
        x_next = lagging_rk4_step(derivative, x, u, dt, tau, plus if added else None)
    elif added:
        x_next = rk4_step_with_input(derivative, x, [u + column for column in ca.horzsplit(plus)], dt)
    else:
        x_next = rk4_step(lambda s: derivative(s, u), x, dt)
    return ca.Function("node", arguments, [x_next])
