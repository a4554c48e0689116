"""The control step as a CasADi function: shift, linearise, solve, update (real-time iteration, Gauss-Newton SQP).

    min  sum_{k<N} |x_k - x*_k|_{Q_k}^2 + |u_k - u*_k|_{R_k}^2  +  |x_N - x*_N|_{Q_end}^2
    s.t. x_{k+1} = F(x_k, u_k, theta, dt_k),   x_0 measured,   u_min <= u <= u_max

This is one iteration as if no bound were there. Where none is violated its answer is the subproblem's solution;
otherwise control.active_set solves the subproblem that it leaves behind.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from quadexp.air.base import Residual
from quadexp.control.mpc.attitude_error import attitude_error_in, reference_frames
from quadexp.control.mpc.reference_thrust import SAMPLES, held_deviation
from quadexp.control.mpc.riccati import CompiledPasses, MatrixPasses
from quadexp.control.mpc.subproblem import input_gradient, solution
from quadexp.physics.sensitivity import rk4_sensitivity_function
from quadexp.physics.state import ATTITUDE, N_STATE
from quadexp.physics.vehicle import Vehicle

LENGTH_MIN, LENGTH_MAX = 0.5, 2.0  # of a quaternion at a shooting node


def step_function(
    vehicle: Vehicle,
    residual: Residual,
    nodes: int,
    *,
    attitude_error: str = "plain",
    scalar: bool = True,
    lag: bool = False,
    deviation: bool = False,
) -> ca.Function:
    """One iteration for N = nodes; scalar: the form to compile, otherwise the form that the virtual machine runs.

    attitude_error: what Q weighs of the attitude, see control.mpc.attitude_error.
    lag: rotors lag behind their commands, and their thrusts are states: m = 13 + n of them; otherwise m = 13.
    deviation: nodes hold the deviation from the reference's thrust, see control.mpc.reference_thrust.

    Inputs: X (m, N + 1), U (n, N) last solution; x0 (m,) measured; X_ref (m, s N + 1), U_ref (n, s N) the reference at
    s times in every node, s = 2 with `deviation`, otherwise 1; theta (p,) residual parameters;
    Q (m, N), Q_end (m,), R (n, N) weights; u_min, u_max (n,) N; dt (N,) node periods (s); shift (N,), the share of
    each node by which to move the last solution forward; with `lag` tau, the lag's time constant (s); with `deviation`
    first_share, the part of the first node for which its command is held.
    Outputs: X_new, U_new; checks (3,): the largest bound violation (N), the largest change of a quaternion (length),
    and the optimality residual of the shifted guess (the largest of the gaps of the dynamics and of the projected
    gradient step in u); then the subproblem: A (m, m N), B (m, n N), b (m, N), q (m, N + 1), r (n, N), its
    factorisation K (n, m N), factor (n, n N), the linearisation point X_lin, U_lin, and frames, (4, 4 (N + 1)), where
    the subproblem is in the coordinates of "body".
    """
    n = vehicle.n_rotors
    if scalar and residual.to_compile is not None:
        residual = replace(residual, function=residual.to_compile)
    m = N_STATE + n * lag
    node = rk4_sensitivity_function(vehicle, residual, scalar=scalar, lag=lag, added=deviation)
    X, U = ca.MX.sym("X", m, nodes + 1), ca.MX.sym("U", n, nodes)
    x0, theta = ca.MX.sym("x0", m), ca.MX.sym("theta", residual.function.size1_in(1))
    samples = SAMPLES if deviation else 1
    X_given, U_given = ca.MX.sym("X_ref", m, samples * nodes + 1), ca.MX.sym("U_ref", n, samples * nodes)
    Q, Q_end, R = ca.MX.sym("Q", m, nodes), ca.MX.sym("Q_end", m), ca.MX.sym("R", n, nodes)
    u_min, u_max = ca.MX.sym("u_min", n), ca.MX.sym("u_max", n)
    dt, shift = ca.MX.sym("dt", nodes), ca.MX.sym("shift", nodes)
    time_constant = [ca.MX.sym("tau")] if lag else []
    first_share = [ca.MX.sym("first_share")] if deviation else []
    X_ref, U_ref, added = X_given[:, ::samples], U_given, [[]] * nodes
    if deviation:
        U_ref, thrusts = held_deviation(U_given, u_min, u_max, dt, *first_share, *time_constant)
        added = [[thrust] for thrust in thrusts]
    Q_at, R_at, dt_at, along = ca.horzsplit(Q), ca.horzsplit(R), ca.vertsplit(dt), shift.T

    moved = X[:, :nodes] + ca.repmat(along, m, 1) * (X[:, 1:] - X[:, :nodes])
    guard = _attitude_guard(m)
    X_lin = ca.horzcat(x0, *(guard(x_k) for x_k in ca.horzsplit(ca.horzcat(moved[:, 1:], X[:, nodes]))))
    U_lin = ca.horzcat(U[:, :-1] + ca.repmat(along[:-1], n, 1) * (U[:, 1:] - U[:, :-1]), U[:, -1])
    x, u = ca.horzsplit(X_lin), ca.horzsplit(U_lin)

    frames = reference_frames(X_ref) if attitude_error == "body" else None
    error = attitude_error_in(frames)
    A, B, b = [], [], []
    for k in range(nodes):
        x_next, A_k, B_k = node(x[k], u[k], theta, dt_at[k], *time_constant, *added[k])
        A_k, B_k, b_k = error.linearisation(k, A_k, B_k, x_next - x[k + 1])
        A.append(A_k)
        B.append(B_k)
        b.append(b_k)
    errors = [error.deviation(k, d) for k, d in enumerate(ca.horzsplit(X_lin - X_ref))]
    effort = ca.horzsplit(U_lin - U_ref)
    q = [Q_k * d for Q_k, d in zip(Q_at, errors, strict=False)] + [Q_end * errors[nodes]]
    r = [R_k * e for R_k, e in zip(R_at, effort, strict=True)]

    passes = (CompiledPasses if scalar else MatrixPasses).build(A[0].sparsity(), B[0].sparsity())
    dX, dU, K, factor = solution(passes, A, B, b, q, r, Q_at, Q_end, R_at)
    X_new = ca.horzcat(x0, *(x[k + 1] + error.change(k + 1, dX[k]) for k in range(nodes)))
    U_new = ca.horzcat(*(u[k] + dU[k] for k in range(nodes)))
    high, low = ca.repmat(u_max, 1, nodes), ca.repmat(u_min, 1, nodes)
    turn = ca.sqrt(ca.mmax(ca.sum1(ca.horzcat(*dX)[ATTITUDE, :] ** 2)))
    excess = ca.mmax(ca.fmax(U_new - high, low - U_new))

    gradient = input_gradient(passes, A, B, q, r)
    projected = [u[k] - ca.fmin(ca.fmax(u[k] - gradient[k], u_min), u_max) for k in range(nodes)]
    kkt = ca.fmax(ca.norm_inf(ca.vertcat(*b)), ca.norm_inf(ca.vertcat(*projected)))
    results = {"X_new": X_new, "U_new": U_new, "checks": ca.vertcat(excess, turn, kkt)}
    results |= {name: ca.horzcat(*m) for name, m in {"A": A, "B": B, "b": b, "q": q, "r": r}.items()}
    results |= {"K": ca.horzcat(*K), "factor": ca.horzcat(*factor)}
    results |= {"X_lin": X_lin, "U_lin": U_lin} | ({} if frames is None else {"frames": frames})
    arguments = [X, U, x0, X_given, U_given, theta, Q, Q_end, R, u_min, u_max, dt, shift, *time_constant, *first_share]
    names = [
        "X",
        "U",
        "x0",
        "X_ref",
        "U_ref",
        "theta",
        "Q",
        "Q_end",
        "R",
        "u_min",
        "u_max",
        "dt",
        "shift",
        *(["tau"] if lag else []),
        *(["first_share"] if deviation else []),
    ]
    return ca.Function("mpc_step", arguments, [*results.values()], names, [*results])


def _attitude_guard(m: int) -> ca.Function:
    """State (m,) with its quaternion's length brought back between LENGTH_MIN and LENGTH_MAX.

    Integration alone leaves the length within half a percent of one; Newton steps far from the solution do not, and at
    a length of zero a quaternion is no attitude.
    """
    x = ca.SX.sym("x", m)
    length = ca.norm_2(x[ATTITUDE])
    scale = ca.fmin(ca.fmax(length, LENGTH_MIN), LENGTH_MAX) / length
    return ca.Function("attitude_guard", [x], [ca.vertcat(x[:3], x[ATTITUDE] * scale, x[7:])])
