"""Delivered and commanded thrust of a rotor.

    loss = k u^2 / u_max        with u the commanded and u_max the largest thrust        N
    y'   = (c - y) / tau        first-order lag, tau_up where c > y and tau_down where c < y

The lag is that of the thrust, y = T and c = u, or that of the rotor speed, y = sqrt(T) and c = sqrt(u): speeds enter by
the root of the thrust, so that no coefficient is needed.

On normalised commands a = u / u_max the loss is k a^2; the simplified simulation of Torrente et al. 2021 has
k = 0.1 / 1.3^2. The lag under a held command has a closed form, y(t) = c + (y(0) - c) exp(-t / tau), which does not
cross the command, and nothing acts back on it, so a Runge-Kutta step of the body takes the thrust at its stages from
there.
"""

from __future__ import annotations

from collections.abc import Callable

from quadexp.compile.symbolic import ca
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
    return decayed(thrust, command, ca.exp(-elapsed / time_constant))


def decayed(value: Expression, command: Expression, decay: Expression) -> Expression:
    """As lagging_thrust, with the decay exp(-elapsed / tau) instead of the two times."""
    return command + (value - command) * decay


def time_constant_towards(value: Expression, command: Expression, up: Expression, down: Expression) -> Expression:
    """Time constant (s) of every rotor, (n,): up where it has to rise to its command, down where it has to fall."""
    return ca.if_else(command > value, up, down)


def lagging_rk4_step(
    derivative: Callable[[Expression, Expression], Expression], x: Expression, command: Expression, dt: Expression,
    time_constant: Expression, added: Expression | None = None,
) -> Expression:  # fmt: skip
    """The state (13 + n,), a rigid body's followed by its rotors' thrusts (N), after dt (s) of a held command.

    derivative: (state (13,), thrusts (n,)) -> state' of the body. added: thrust (N) beyond what the command gives, at
    the start, the middle and the end of the step, (n, 3). One classical Runge-Kutta step; the lag is exact.
    """
    body = x[:N_STATE]
    thrust = x[N_STATE:]
    middle = lagging_thrust(thrust, command, dt / 2, time_constant)
    end = lagging_thrust(thrust, command, dt, time_constant)
    if added is not None:
        thrust = thrust + added[:, 0]
        middle = middle + added[:, 1]
        end = end + added[:, 2]
    return ca.vertcat(rk4_step_with_input(derivative, body, (thrust, middle, end), dt), end)
