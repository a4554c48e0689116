"""The linear-quadratic subproblem of a control step over the whole horizon.

    min  sum_k 1/2 dx'Q_k dx + q'dx + 1/2 du'R_k du + r'du    dx_{k+1} = A_k dx_k + B_k du_k + b_k,   dx_0 = 0

`backward_pass`, `forward_pass` and `input_gradient` chain the passes of control.mpc.riccati: the subproblem without
bounds. `bounded_function` solves it under low <= du <= high from their factorisation (control.mpc.active_set).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from quadexp.compile.backend import handwritten
from quadexp.compile.symbolic import ca
from quadexp.control.mpc.attitude_error import attitude_error_in
from quadexp.control.mpc.riccati import Passes, line_length
from quadexp.physics.expression import Expression, limited, named_function, named_symbols
from quadexp.physics.state import ATTITUDE

KERNEL = Path(__file__).with_name("active_set.c")
TOLERANCE = 1e-9  # N: bound violation that counts as none


def backward_pass(
    passes: Passes,
    A: Sequence[Expression],
    B: Sequence[Expression],
    b: Sequence[Expression],
    q: Sequence[Expression],
    r: Sequence[Expression],
    Q: Sequence[Expression],
    Q_end: Expression,
    R: Sequence[Expression],
) -> tuple[list[Expression], list[Expression], list[Expression], list[Expression]]:
    """Riccati recursion over some nodes, q also of the one behind the last.

    Returns the cost to go from the first, and the gains K, k and the factors of all (see control.mpc.riccati).
    """
    K, k, factor = ([None] * len(A) for _ in range(3))
    cost = passes.terminal(Q_end, q[-1])
    for i in range(len(A) - 1, -1, -1):
        cost, K[i], k[i], factor[i] = passes.backward(cost, A[i], B[i], b[i], q[i], r[i], Q[i], R[i])
    return cost, K, k, factor


def forward_pass(
    passes: Passes,
    B_0: Expression,
    b_0: Expression,
    k_0: Expression,
    A: Sequence[Expression],
    B: Sequence[Expression],
    b: Sequence[Expression],
    K: Sequence[Expression],
    k: Sequence[Expression],
) -> tuple[list[Expression], list[Expression]]:
    """Deviations dX_1 .. dX_N and dU_0 .. dU_{N-1} from the gains, dX_0 = 0; the sequences begin with node 1."""
    dU = [-k_0]
    dX = [B_0 @ dU[0] + b_0]
    for node in zip(A, B, b, K, k, strict=True):
        du, dx = passes.forward(dX[-1], *node)
        dU.append(du)
        dX.append(dx)
    return dX, dU


def input_gradient(
    passes: Passes, A: Sequence[Expression], B: Sequence[Expression], q: Sequence[Expression], r: Sequence[Expression]
) -> tuple[Expression, list[Expression]]:
    """Derivative of the Lagrangian with respect to each input of some nodes, q also of the one behind the last.

    First the multiplier of the dynamics into the first node: the adjoint runs backwards from the last.
    """
    multiplier, gradient = q[-1], [None] * len(A)
    for k in range(len(A) - 1, -1, -1):
        multiplier, gradient[k] = passes.adjoint(multiplier, A[k], B[k], q[k], r[k])
    return multiplier, gradient


def subproblem_sparsity(prepare: ca.Function, feedback: ca.Function) -> dict[str, ca.Sparsity]:
    """Of the subproblem's matrices, by name: what `feedback` leaves of node 0 before what `prepare` leaves."""
    m, n = prepare.size1_in("Q"), prepare.size1_in("R")
    whole = {name: prepare.sparsity_out(name) for name in ("U_lin", "r", "frames") if name in prepare.name_out()}
    first = {name: feedback.sparsity_out(name) for name in ("A", "B", "b", "q", "factor", "X_lin")}
    first["K"] = ca.Sparsity.dense(n, m)
    return whole | {name: ca.horzcat(part, prepare.sparsity_out(name)) for name, part in first.items()}


def bounded_function(prepare: ca.Function, feedback: ca.Function, nodes: int) -> ca.Function:
    """Solver of the subproblem of the compiled step with input bounds, by active_set.c; it has no interpreted form.

    Inputs, as the step has or returns them: A, B, b, q, r, K, factor, X_lin, U_lin, Q, Q_end, R, u_min, u_max, frames
    where the step has them; U_free (n, N), the solution without bounds (N); guess (n, N), the expected active set: -1
    at the lower, 1 at the upper bound, 0 free. Outputs: X_new (m, N + 1), U_new (n, N); side (n, N), the active set;
    checks (5,): whether it is solved, exchanges of the active set, inputs at a bound, the estimated error of the inputs
    (N), the largest change of a quaternion (length).
    """
    given = named_symbols(ca.MX, subproblem_sparsity(prepare, feedback))
    given |= {name: ca.MX.sym(name, *prepare.size_in(name)) for name in ("Q", "Q_end", "R", "u_min", "u_max")}
    n, m = prepare.size1_in("R"), prepare.size1_in("Q")
    given |= {name: ca.MX.sym(name, n, nodes) for name in ("U_free", "guess")}
    rows_of = prepare.get_function("riccati_rows")
    blocks = zip(ca.horzsplit(given["A"], m), ca.horzsplit(given["B"], n), ca.horzsplit(given["b"]), strict=True)
    rows = ca.horzcat(*(rows_of(*node) for node in blocks))
    weights = ca.horzcat(given["Q"][:, 1:], given["Q_end"])
    U, low, high = given["U_lin"], ca.repmat(given["u_min"], 1, nodes), ca.repmat(given["u_max"], 1, nodes)
    arguments = [rows, *(given[name] for name in ("K", "factor", "q", "r")), weights, given["R"]]
    arguments += [given["U_free"] - U, low - U, high - U, given["guess"]]
    dX, dU, side, checks = kernel_function(n, m, nodes)(*arguments)

    error = attitude_error_in(given.get("frames"))
    x = ca.horzsplit(given["X_lin"])
    X_new = ca.horzcat(x[0], *(x[k + 1] + error.change(k + 1, d) for k, d in enumerate(ca.horzsplit(dX))))
    U_new = limited(U + dU, low, high)  # rounding only
    turn = ca.sqrt(ca.mmax(ca.sum1(dX[ATTITUDE, :] ** 2)))
    results = {"X_new": X_new, "U_new": U_new, "side": side, "checks": ca.vertcat(checks, turn)}
    return named_function("mpc_bounded", given, results)


def kernel_function(n: int, m: int, nodes: int) -> ca.Function:
    """active_set.c for n inputs, m states and N nodes; arguments as named there. It has no interpreted form."""
    dense = ca.Sparsity.dense
    states, inputs = dense(m, nodes), dense(n, nodes)
    arguments = {"rows": dense(line_length(n, m), m * nodes), "K": dense(n, m * nodes)}
    arguments |= {"factor": dense(n, n * nodes), "q": dense(m, nodes + 1), "r": inputs}
    arguments |= {"Q": states, "R": inputs, "start": inputs, "low": inputs, "high": inputs, "guess": inputs}
    results = {"dX": states, "dU": inputs, "side": inputs, "checks": dense(4, 1)}
    return handwritten("active_set", KERNEL, {"N_INPUTS": n, "STATES": m, "NODES": nodes}, arguments, results)
