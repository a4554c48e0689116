"""Explicit one-step integrators for x' = f(x), with x any CasADi or numpy vector."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from quadexp.physics.expression import Expression


def rk4_step(f: Callable[[Expression], Expression], x: Expression, dt: Expression) -> Expression:
    """One classical Runge-Kutta step of x' = f(x) over dt (s); global error O(dt^4)."""
    return rk4_step_with_input(lambda x, _: f(x), x, (None, None, None), dt)


def rk4_step_with_input(
    f: Callable[[Expression, Expression], Expression], x: Expression, inputs: Sequence[Expression], dt: Expression
) -> Expression:
    """One classical Runge-Kutta step of x' = f(x, u(t)); inputs: u at the start, the middle and the end of the step."""
    start, middle, end = inputs
    k1 = f(x, start)
    k2 = f(x + dt / 2 * k1, middle)
    k3 = f(x + dt / 2 * k2, middle)
    k4 = f(x + dt * k3, end)
    slopes = k1 + 2 * k2 + 2 * k3 + k4
    return x + dt / 6 * slopes


def euler_step(f: Callable[[Expression], Expression], x: Expression, dt: Expression) -> Expression:
    """One explicit Euler step of x' = f(x) over dt (s); global error O(dt)."""
    return x + dt * f(x)
