"""The control step as CasADi functions: shift, linearise, solve, update (real-time iteration, Gauss-Newton SQP).

    min  sum_{k<N} |x_k - x*_k|_Q^2 + |u_k - u*_k|_R^2  +  c |x_N - x*_N|_Q^2
    s.t. x_{k+1} = F(x_k, u_k, theta, dt),   x_0 measured,   u_min <= u <= u_max

`step_function` does one iteration as if no bound were there. Where none is violated its answer is the subproblem's
solution; otherwise `bounded_function` solves the same subproblem with chosen inputs held at a bound, which is what the
active-set method in `control.active_set` asks for, again and again, until the optimality conditions hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca

from quadexp.control.riccati import CompiledPasses, MatrixPasses, Passes, passes_of
from quadexp.dynamics.sensitivity import rk4_sensitivity_function
from quadexp.expression import Expression
from quadexp.residual.base import Residual
from quadexp.state import ATTITUDE, N_STATE
from quadexp.vehicle import Vehicle

LENGTH_MIN, LENGTH_MAX = 0.95, 1.05  # of a quaternion at a shooting node


def step_function(vehicle: Vehicle, residual: Residual, nodes: int, *, scalar: bool = True) -> ca.Function:
    """One iteration for N = nodes; scalar: the form to compile, otherwise the form that the virtual machine runs.

    Inputs: X (13, N + 1), U (n, N) last solution; x0 (13,) measured; X_ref, U_ref; theta (p,) residual parameters;
    Q, Q_end (13,), R (n,) weights; u_min, u_max (n,) N; dt node period (s); shift, share of a node to move the last
    solution forward.
    Outputs: X_new, U_new; checks (3,): the largest bound violation (N), the largest change of a quaternion component,
    and the optimality residual of the shifted guess (the largest of the gaps of the dynamics and of the projected
    gradient step in u); then the subproblem: A (13, 13 N), B (13, n N), b (13, N), q (13, N + 1), r (n, N) and the
    linearisation point X_lin, U_lin.
    """
    n = vehicle.n_rotors
    if scalar and residual.to_compile is not None:
        residual = replace(residual, function=residual.to_compile)
    node = rk4_sensitivity_function(vehicle, residual, scalar=scalar)
    X, U = ca.MX.sym("X", N_STATE, nodes + 1), ca.MX.sym("U", n, nodes)
    x0, theta = ca.MX.sym("x0", N_STATE), ca.MX.sym("theta", residual.function.size1_in(1))
    X_ref, U_ref = ca.MX.sym("X_ref", N_STATE, nodes + 1), ca.MX.sym("U_ref", n, nodes)
    Q, Q_end, R = ca.MX.sym("Q", N_STATE), ca.MX.sym("Q_end", N_STATE), ca.MX.sym("R", n)
    u_min, u_max = ca.MX.sym("u_min", n), ca.MX.sym("u_max", n)
    dt, shift = ca.MX.sym("dt"), ca.MX.sym("shift")

    moved = X[:, :nodes] + shift * (X[:, 1:] - X[:, :nodes])
    guard = _attitude_guard()
    X_lin = ca.horzcat(x0, *(guard(x_k) for x_k in ca.horzsplit(ca.horzcat(moved[:, 1:], X[:, nodes]))))
    U_lin = ca.horzcat(U[:, :-1] + shift * (U[:, 1:] - U[:, :-1]), U[:, -1])
    x, u = ca.horzsplit(X_lin), ca.horzsplit(U_lin)

    A, B, b = [], [], []
    for k in range(nodes):
        x_next, A_k, B_k = node(x[k], u[k], theta, dt)
        A.append(A_k)
        B.append(B_k)
        b.append(x_next - x[k + 1])
    deviation, effort = ca.horzsplit(X_lin - X_ref), ca.horzsplit(U_lin - U_ref)
    q = [Q * d for d in deviation[:nodes]] + [Q_end * deviation[nodes]]
    r = [R * e for e in effort]

    passes = (CompiledPasses if scalar else MatrixPasses).build(A[0].sparsity(), B[0].sparsity())
    dX, dU = _solve(passes, A, B, b, q, r, Q, Q_end, R)
    X_new = ca.horzcat(x0, *(x[k + 1] + dX[k] for k in range(nodes)))
    U_new = ca.horzcat(*(u[k] + dU[k] for k in range(nodes)))
    high, low = ca.repmat(u_max, 1, nodes), ca.repmat(u_min, 1, nodes)
    turn = ca.norm_inf(ca.vec(ca.horzcat(*dX)[ATTITUDE, :]))
    excess = ca.mmax(ca.fmax(U_new - high, low - U_new))

    gradient = _input_gradient(passes, A, B, q, r)
    projected = [u[k] - ca.fmin(ca.fmax(u[k] - gradient[k], u_min), u_max) for k in range(nodes)]
    kkt = ca.fmax(ca.norm_inf(ca.vertcat(*b)), ca.norm_inf(ca.vertcat(*projected)))
    return ca.Function(
        "mpc_step",
        [X, U, x0, X_ref, U_ref, theta, Q, Q_end, R, u_min, u_max, dt, shift],
        [X_new, U_new, ca.vertcat(excess, turn, kkt), *(ca.horzcat(*m) for m in (A, B, b, q, r)), X_lin, U_lin],
        ["X", "U", "x0", "X_ref", "U_ref", "theta", "Q", "Q_end", "R", "u_min", "u_max", "dt", "shift"],
        ["X_new", "U_new", "checks", "A", "B", "b", "q", "r", "X_lin", "U_lin"],
    )


def bounded_function(step: ca.Function, nodes: int) -> ca.Function:
    """The subproblem of `step` with some inputs held: (A, B, b, q, r, Q, Q_end, R, held (n, N), value (n, N)).

    held is 1 where an input's change is fixed to value (N), else 0. Returns dX (13, N), dU (n, N) and gradient (n, N),
    the Lagrangian's derivative with respect to every input: the multiplier where held, zero elsewhere.
    """
    A_all, B_all = (ca.MX.sym(name, step.sparsity_out(step.index_out(name))) for name in ("A", "B"))
    n = B_all.size2() // nodes
    b_all, q_all, r_all = ca.MX.sym("b", N_STATE, nodes), ca.MX.sym("q", N_STATE, nodes + 1), ca.MX.sym("r", n, nodes)
    Q, Q_end, R = ca.MX.sym("Q", N_STATE), ca.MX.sym("Q_end", N_STATE), ca.MX.sym("R", n)
    held_all, value_all = ca.MX.sym("held", n, nodes), ca.MX.sym("value", n, nodes)
    A, B = ca.horzsplit(A_all, N_STATE), ca.horzsplit(B_all, n)
    b, q, r = ca.horzsplit(b_all), ca.horzsplit(q_all), ca.horzsplit(r_all)
    held, value = ca.horzsplit(held_all), ca.horzsplit(value_all)

    fixed = [h * v for h, v in zip(held, value, strict=True)]
    free = [1 - h for h in held]
    B_free = [ca.mtimes(B_k, ca.diag(f)) for B_k, f in zip(B, free, strict=True)]
    b_fixed = [b_k + ca.mtimes(B_k, v) for b_k, B_k, v in zip(b, B, fixed, strict=True)]
    r_free = [f * r_k for f, r_k in zip(free, r, strict=True)]
    passes = passes_of(step)
    dX, dU = _solve(passes, A, B_free, b_fixed, q, r_free, Q, Q_end, R)
    dU = [du + v for du, v in zip(dU, fixed, strict=True)]

    q_at = [q_k + Q * dx for q_k, dx in zip(q[1:nodes], dX[:-1], strict=True)] + [q[nodes] + Q_end * dX[-1]]
    r_at = [r_k + R * du for r_k, du in zip(r, dU, strict=True)]
    gradient = _input_gradient(passes, A, B, [q[0], *q_at], r_at)
    return ca.Function(
        "mpc_bounded",
        [A_all, B_all, b_all, q_all, r_all, Q, Q_end, R, held_all, value_all],
        [ca.horzcat(*dX), ca.horzcat(*dU), ca.horzcat(*gradient)],
        ["A", "B", "b", "q", "r", "Q", "Q_end", "R", "held", "value"],
        ["dX", "dU", "gradient"],
    )


def _attitude_guard() -> ca.Function:
    """State with its quaternion's length brought back between LENGTH_MIN and LENGTH_MAX.

    Integration alone leaves the length within half a percent of one; a full Newton step far from the solution does not,
    and R(q) grows with the square of the length.
    """
    x = ca.SX.sym("x", N_STATE)
    length = ca.norm_2(x[ATTITUDE])
    scale = ca.fmin(ca.fmax(length, LENGTH_MIN), LENGTH_MAX) / length
    return ca.Function("attitude_guard", [x], [ca.vertcat(x[:3], x[ATTITUDE] * scale, x[7:])])


def _solve(
    passes: Passes,
    A: Sequence[Expression],
    B: Sequence[Expression],
    b: Sequence[Expression],
    q: Sequence[Expression],
    r: Sequence[Expression],
    Q: Expression,
    Q_end: Expression,
    R: Expression,
) -> tuple[list[Expression], list[Expression]]:
    """Deviations dX_1..dX_N and dU_0..dU_{N-1} of the unbounded subproblem (Riccati recursion)."""
    nodes = len(A)
    K: list[Any] = [None] * nodes
    k: list[Any] = [None] * nodes
    cost = passes.terminal(Q_end, q[nodes])
    for i in range(nodes - 1, 0, -1):
        cost, K[i], k[i] = passes.backward(cost, A[i], B[i], b[i], q[i], r[i], Q, R)
    k[0] = passes.first_node(cost, A[0], B[0], b[0], q[0], r[0], Q, R)
    dU = [-k[0]]
    dX = [ca.mtimes(B[0], dU[0]) + b[0]]
    for i in range(1, nodes):
        du, dx = passes.forward(dX[-1], A[i], B[i], b[i], K[i], k[i])
        dU.append(du)
        dX.append(dx)
    return dX, dU


def _input_gradient(
    passes: Passes,
    A: Sequence[Expression],
    B: Sequence[Expression],
    q: Sequence[Expression],
    r: Sequence[Expression],
) -> list[Expression]:
    """Derivative of the Lagrangian with respect to each input, the adjoint run backwards from the last node."""
    multiplier = q[len(A)]
    gradient: list[Any] = [None] * len(A)
    for k in range(len(A) - 1, -1, -1):
        multiplier, gradient[k] = passes.adjoint(multiplier, A[k], B[k], q[k], r[k])
    return gradient
