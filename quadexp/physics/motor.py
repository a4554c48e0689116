"""Delivered and commanded thrust of a rotor.

    loss = k u^2 / u_max        with u the commanded and u_max the largest thrust        N
    T'   = (u - T) / tau        first-order lag

On normalised commands a = u / u_max the loss is k a^2; the simplified simulation of Torrente et al. 2021 has
k = 0.1 / 1.3^2. The lag under a held command has a closed form, T(t) = u + (T(0) - u) exp(-t / tau), and nothing acts
back on it, so a Runge-Kutta step of the body takes the thrust at its stages from there.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

from quadexp.physics.expression import Expression
from quadexp.physics.integrator import rk4_step_with_input
from quadexp.physics.state import N_STATE


def thrust_loss(command: Expression, coefficient: Expression, thrust_max: float) -> Expression:
    """Mean thrust lost by each rotor, (n,) (N); command (n,) (N), coefficient k (-)."""
    return coefficient * command * command / thrust_max


def lagging_thrust(
    thrust: Expression, command: Expression, elapsed: Expression, time_constant: Expression
) -> Expression:
    """Thrust (n,) (N) a time `elapsed` (s) after `thrust`, under a held command (n,) (N); time_constant tau (s)."""
    return command + (thrust - command) * ca.exp(-elapsed / time_constant)


def lagging_rk4_step(
    derivative: Callable[[Expression, Expression], Expression],
    x: Expression,
    command: Expression,
    dt: Expression,
    time_constant: Expression,
    added: Expression | None = None,
) -> Expression:
    """The state (13 + n,), a rigid body's followed by its rotors' thrusts (N), after dt (s) of a held command.

    derivative: (state (13,), thrusts (n,)) -> state' of the body. added: thrust (N) beyond what the command gives, at
    the start, the middle and the end of the step, (n, 3). One classical Runge-Kutta step; the lag is exact.
    """
    body, thrust = x[:N_STATE], x[N_STATE:]
    middle, end = (lagging_thrust(thrust, command, t, time_constant) for t in (dt / 2, dt))
    if added is not None:
        thrust, middle, end = thrust + added[:, 0], middle + added[:, 1], end + added[:, 2]
    return ca.vertcat(rk4_step_with_input(derivative, body, (thrust, middle, end), dt), end)
