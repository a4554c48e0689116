"""The discrete prediction model: the state after one node, one Runge-Kutta step.

A command that is held for a node of length h cannot follow a reference whose thrust changes within the node. With the
control period T < h the command that is best for the whole node is applied during its first part only, about
(h - T) / 2 too early, and an exact model still leaves a tracking error. With controller.input_hold=deviation a node
holds u_k - u*_k, and the prediction contains the reference's thrust T*(t), known at the start, middle and end of the
node:

    thrust(t) = T*(t) + (u_k - u*_k)                                                    no motor lag
    thrust(t) = T*(t) + (u_k - u*_k) + exp(-t / tau) (T_k - T*(0) - (u_k - u*_k))       lag tau, thrust state T_k

u*_k is the command whose held value gives T* on average: the mean of T* + tau dT*/dt over the time for which the
command is held, which is the node, but for the first one only a control period. On the reference all deviations are
zero for any node length. The feedback gains are those of the held command, and so are the delay margins.
"""

from __future__ import annotations

from typing import NamedTuple

from quadexp.compile.symbolic import ca
from quadexp.control.mpc.settings import SAMPLES
from quadexp.models.residual import Residual
from quadexp.physics.expression import Expression, limited, symbols
from quadexp.physics.integrator import rk4_step, rk4_step_with_input
from quadexp.physics.motor import lagging_rk4_step
from quadexp.physics.rigid_body import N_DISTURBANCE, corrected_function, disturbed_derivative
from quadexp.physics.scalars import as_scalars
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
    n = vehicle.n_rotors
    dynamics = corrected_function(vehicle, residual)
    x, u, dt, theta, tau, plus, disturbance = symbols(
        ca.MX,
        x=N_STATE + n * lag,
        u=n,
        dt=1,
        theta=residual.function.size1_in(1),
        tau=1,
        added=(n, 3),
        disturbance=N_DISTURBANCE,
    )
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


class HeldDeviation(NamedTuple):
    """U_ref: u*_k within the thrust limits, (n, N) (N). added: of each node, (n, 3): thrust that is added to what the
    command u_k gives, at the node's start, middle and end (N)."""

    U_ref: Expression
    added: list[Expression]


def held_deviation(
    thrusts: Expression,
    u_min: Expression,
    u_max: Expression,
    dt: Expression,
    first_share: Expression,
    tau: Expression | None = None,
) -> HeldDeviation:
    """From the reference's thrusts, (n, 2 N) (N), at the start and the middle of each node.

    They are limited to u_min .. u_max, (n,) (N): what no rotor can give is no part of a prediction. dt: (N,) (s).
    first_share: part of the first node for which its command is held. tau: motor time constant (s). The thrust at the
    end of the last node is extrapolated; without a terminal weight nothing depends on it.
    """
    samples = [limited(thrust, u_min, u_max) for thrust in ca.horzsplit(thrusts)]
    samples.append(2 * samples[-1] - samples[-2])
    commands = []
    added = []
    for k, dt_k in enumerate(ca.vertsplit(dt)):
        node = [*samples[SAMPLES * k : SAMPLES * k + 3], dt_k, first_share if k == 0 else type(dt)(1), u_min, u_max]
        command, beyond = as_scalars(held_thrust)(*node, *([] if tau is None else [tau]))
        commands.append(command)
        added.append(beyond)
    return HeldDeviation(ca.horzcat(*commands), added)


def held_thrust(
    start: Expression,
    middle: Expression,
    end: Expression,
    dt: Expression,
    share: Expression,
    u_min: Expression,
    u_max: Expression,
    tau: Expression | None = None,
) -> list[Expression]:
    """u* within its limits and the added thrusts for T*(s dt) = start + slope s + bend s^2, 0 <= s <= 1; u* is held
    until s = share."""
    slope = 4 * middle - 3 * start - end
    bend = 2 * (start + end - 2 * middle)
    command = start + share * (slope / 2 + share * bend / 3)
    if tau is None:
        return [limited(command, u_min, u_max), ca.horzcat(start, middle, end) - command]
    command += tau / dt * (slope + share * bend)
    decay = [ca.exp(-t / tau) for t in (dt / 2, dt)]
    added = [T - a * start - (1 - a) * command for T, a in zip((middle, end), decay, strict=True)]
    return [limited(command, u_min, u_max), ca.horzcat(ca.SX.zeros(start.shape), *added)]
