"""The linear-quadratic subproblem that a control step leaves behind, over the whole horizon.

    min  sum_k 1/2 dx'Q dx + q'dx + 1/2 du'R du + r'du      dx_{k+1} = A_k dx_k + B_k du_k + b_k,   dx_0 = 0

`solution` and `input_gradient` chain the passes of control.riccati. `sweep_function` solves it with chosen inputs held
at a bound, and says which inputs should be held instead; `condensed_function` eliminates the states, for solvers that
want a dense problem.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from quadexp.control.attitude_error import attitude_error_in
from quadexp.control.riccati import Passes, passes_of
from quadexp.expression import Expression
from quadexp.state import N_STATE

TOLERANCE = 1e-9  # N, and gradient units: how far beyond a bound is still on it


def solution(
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


def input_gradient(
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


class _Symbols:
    """The subproblem's data as symbols, named and shaped as `step` returns them."""

    def __init__(self, step: ca.Function, nodes: int) -> None:
        A, B = (ca.MX.sym(name, step.sparsity_out(step.index_out(name))) for name in ("A", "B"))
        self.n = n = B.size2() // nodes
        b, q, r = ca.MX.sym("b", N_STATE, nodes), ca.MX.sym("q", N_STATE, nodes + 1), ca.MX.sym("r", n, nodes)
        self.Q, self.Q_end, self.R = ca.MX.sym("Q", N_STATE), ca.MX.sym("Q_end", N_STATE), ca.MX.sym("R", n)
        self.arguments = {"A": A, "B": B, "b": b, "q": q, "r": r, "Q": self.Q, "Q_end": self.Q_end, "R": self.R}
        self.A, self.B = ca.horzsplit(A, N_STATE), ca.horzsplit(B, n)
        self.b, self.q, self.r = ca.horzsplit(b), ca.horzsplit(q), ca.horzsplit(r)


def sweep_function(step: ca.Function, nodes: int) -> ca.Function:
    """The subproblem of `step` with some inputs held at a bound, and what should be held next.

    Inputs: A (13, 13 N), B (13, n N), b (13, N), q (13, N + 1), r (n, N), Q, Q_end (13,), R (n,); low, high (n, N), the
    bounds of the inputs' change (N); side (n, N): -1 held at low, 1 held at high, 0 free; frames where the step has
    them. Outputs: dX (13, N), the states' change; dU (n, N); gradient (n, N), the Lagrangian's derivative with respect
    to every input: the multiplier where held, else zero; after (n, N), the side on which each input should be: free
    ones that left their bounds are to be held, held ones whose multiplier has the wrong sign are to be free; checks
    (2,): how many differ from `side`, and the sum of |dU|, which is not finite where there is no solution.
    """
    data = _Symbols(step, nodes)
    A, B, n, Q, R = data.A, data.B, data.n, data.Q, data.R
    low, high, side = (ca.MX.sym(name, n, nodes) for name in ("low", "high", "side"))
    arguments = data.arguments | {"low": low, "high": high, "side": side}
    if "frames" in step.name_out():
        arguments["frames"] = ca.MX.sym("frames", 4, 4 * (nodes + 1))
    error = attitude_error_in(arguments.get("frames"))

    free = ca.horzsplit(side == 0)
    held = ca.horzsplit((side > 0) * high + (side < 0) * low)
    B_free = [ca.mtimes(B_k, ca.diag(f)) for B_k, f in zip(B, free, strict=True)]
    b_held = [b_k + ca.mtimes(B_k, v) for b_k, B_k, v in zip(data.b, B, held, strict=True)]
    r_free = [f * r_k for f, r_k in zip(free, data.r, strict=True)]
    passes = passes_of(step)
    dX, dU = solution(passes, A, B_free, b_held, data.q, r_free, Q, data.Q_end, R)
    dU = [du + v for du, v in zip(dU, held, strict=True)]

    weights = [*[Q] * (nodes - 1), data.Q_end]
    q_at = [q_k + W * dx for q_k, W, dx in zip(data.q[1:], weights, dX, strict=True)]
    r_at = [r_k + R * du for r_k, du in zip(data.r, dU, strict=True)]
    gradient = ca.horzcat(*input_gradient(passes, A, B, [data.q[0], *q_at], r_at))
    change = ca.horzcat(*dU)
    leaving = (change > high + TOLERANCE) - (change < low - TOLERANCE)
    after = (side == 0) * leaving + side * (side * gradient < TOLERANCE)
    checks = ca.vertcat(ca.sum1(ca.vec(after != side)), ca.sum1(ca.vec(ca.fabs(change))))
    states = ca.horzcat(*(error.change(k + 1, dx) for k, dx in enumerate(dX)))
    return ca.Function(
        "mpc_sweep",
        [*arguments.values()],
        [states, change, gradient, after, checks],
        [*arguments],
        ["dX", "dU", "gradient", "after", "checks"],
    )


def condensed_function(step: ca.Function, nodes: int) -> ca.Function:
    """The subproblem of `step` in its inputs alone: min 1/2 d'H d + g'd over d = (du_0 .. du_{N-1}).

    Inputs as `sweep_function`'s first: A, B, b, q, r, Q, Q_end, R. Outputs: H (Nn, Nn), g (Nn,).
    """
    data = _Symbols(step, nodes)
    n, size = data.n, data.n * nodes
    ahead, add = _condensing_passes(data.A[0].sparsity(), size)
    maps, offset = ca.MX.zeros(N_STATE, size), ca.MX.zeros(N_STATE)  # dx_k = maps d + offset
    H, g = ca.densify(ca.diag(ca.repmat(data.R, nodes, 1))), ca.vertcat(*data.r)
    for k in range(nodes):
        maps, offset = ahead(maps, offset, data.A[k], data.b[k])
        maps[:, k * n : (k + 1) * n] = ca.densify(data.B[k])
        weight = data.Q if k < nodes - 1 else data.Q_end
        H, g = add(H, g, maps, weight, weight * offset + data.q[k + 1])
    return ca.Function("mpc_condensed", [*data.arguments.values()], [H, g], [*data.arguments], ["H", "g"])


def _condensing_passes(a: ca.Sparsity, size: int) -> tuple[ca.Function, ca.Function]:
    """ahead: (maps, offset, A, b) -> those of the next node, before its own inputs; A with the pattern a.

    add: (H, g, maps, weight, slope) -> H, g with a node's cost. Functions of their own, so that they are compiled once.
    """
    maps, A = ca.MX.sym("maps", N_STATE, size), ca.MX.sym("A", a)
    offset, b = ca.MX.sym("offset", N_STATE), ca.MX.sym("b", N_STATE)
    H, g = ca.MX.sym("H", size, size), ca.MX.sym("g", size)
    weight, slope = ca.MX.sym("weight", N_STATE), ca.MX.sym("slope", N_STATE)
    alone = {"never_inline": True}
    ahead = [ca.mtimes(A, maps), ca.mtimes(A, offset) + b]
    add = [H + ca.mtimes(maps.T, ca.repmat(weight, 1, size) * maps), g + ca.mtimes(maps.T, slope)]
    return (
        ca.Function("condense_ahead", [maps, offset, A, b], ahead, alone),
        ca.Function("condense_add", [H, g, maps, weight, slope], add, alone),
    )
