"""Backward and forward passes of the linear-quadratic subproblem, one node at a time, as scalar CasADi functions.

The Gauss-Newton subproblem in deviations (dx, du) from the linearisation point is

    min sum_k 1/2 dx'Q dx + q'dx + 1/2 du'R du + r'du,     dx_{k+1} = A_k dx_k + B_k du_k + b_k,     dx_0 = 0

and the cost to go 1/2 dx'P dx + p'dx follows, with H = R + B'PB, G = B'PA, h = r + B'(Pb + p):

    K = H^-1 G,   k = H^-1 h,   P <- Q + A'PA - G'K,   p <- q + A'(Pb + p) - G'k,   du = -k - K dx

Inputs held at a bound drop out: their column of B is zero, b gains B v, and H keeps R on the diagonal.
Scalar (SX) functions skip structural zeros and the lower triangle of P; matrix (MX) ones are dense products.
"""

from __future__ import annotations

import casadi as ca

from quadexp.state import N_STATE


def solve_function(n_inputs: int) -> ca.Function:
    """(H, G, h) -> K = H^-1 G, k = H^-1 h by an unrolled LDL' factorisation; H symmetric, its upper triangle read."""
    H, G, h = ca.SX.sym("H", n_inputs, n_inputs), ca.SX.sym("G", n_inputs, N_STATE), ca.SX.sym("h", n_inputs)
    D, LT, order = ca.ldl(ca.triu2symm(ca.triu(H)), False)
    gains = ca.ldl_solve(ca.horzcat(G, h), D, LT, order)
    return ca.Function("solve", [H, G, h], ca.cse([gains[:, :N_STATE], gains[:, N_STATE]]))


def _node_symbols(kind, a: ca.Sparsity, b: ca.Sparsity):
    n_inputs = b.size2()
    upper = ca.Sparsity.upper(N_STATE) if kind is ca.SX else ca.Sparsity.dense(N_STATE, N_STATE)
    shapes = {"P": upper, "p": (N_STATE, 1), "A": a, "B": b, "b": (N_STATE, 1), "q": (N_STATE, 1), "r": (n_inputs, 1)}
    shapes |= {"Q": (N_STATE, 1), "R": (n_inputs, 1)}
    return [kind.sym(name, s) if isinstance(s, ca.Sparsity) else kind.sym(name, *s) for name, s in shapes.items()]


def _quadratic(P, p, A, B, b, r, R):
    """P A, P b + p, H, G, h of one node."""
    if P.sparsity().is_triu():
        P = ca.triu2symm(P)
    products = ca.mtimes(P, ca.horzcat(A, B, b))
    PA, PB, Pb = ca.horzsplit(products, [0, N_STATE, N_STATE + B.size2(), N_STATE + B.size2() + 1])
    Pb = Pb + p
    return PA, Pb, ca.mtimes(PB.T, B) + ca.diag(R), ca.mtimes(PB.T, A), r + ca.mtimes(B.T, Pb)


def backward_function(kind, a: ca.Sparsity, b: ca.Sparsity) -> ca.Function:
    """(P, p, A, B, b, q, r, Q, R) of a node -> P, p, K, k; Q and R as diagonals, P as upper triangle for SX."""
    P, p, A, B, gap, q, r, Q, R = symbols = _node_symbols(kind, a, b)
    PA, Pb, H, G, h = _quadratic(P, p, A, B, gap, r, R)
    K, k = solve_function(b.size2())(H, G, h)
    P_next = ca.mtimes(A.T, PA) - ca.mtimes(G.T, K) + ca.diag(Q)
    P_next = ca.project(ca.triu(P_next), P.sparsity()) if kind is ca.SX else ca.densify(P_next)
    p_next = q + ca.mtimes(A.T, Pb) - ca.mtimes(G.T, k)
    return _function("backward", symbols, [P_next, p_next, K, k])


def first_node_function(kind, a: ca.Sparsity, b: ca.Sparsity) -> ca.Function:
    """(P, p, A, B, b, q, r, Q, R) of node 0 -> k: its state is measured, so no gain and no cost to go are needed."""
    P, p, A, B, gap, q, r, Q, R = symbols = _node_symbols(kind, a, b)
    if P.sparsity().is_triu():
        P = ca.triu2symm(P)
    H = ca.mtimes(B.T, ca.mtimes(P, B)) + ca.diag(R)
    h = r + ca.mtimes(B.T, ca.mtimes(P, gap) + p)
    _, k = solve_function(b.size2())(H, kind(b.size2(), N_STATE), h)
    return _function("first_node", symbols, [k])


def forward_function(kind, a: ca.Sparsity, b: ca.Sparsity) -> ca.Function:
    """(dx, A, B, b, K, k) -> du, dx of the next node."""
    dx, A, B = kind.sym("dx", N_STATE), kind.sym("A", a), kind.sym("B", b)
    gap, K, k = kind.sym("b", N_STATE), kind.sym("K", b.size2(), N_STATE), kind.sym("k", b.size2())
    du = -k - ca.mtimes(K, dx)
    return _function("forward", [dx, A, B, gap, K, k], [du, ca.mtimes(A, dx) + ca.mtimes(B, du) + gap])


def adjoint_function(kind, a: ca.Sparsity, b: ca.Sparsity) -> ca.Function:
    """(lambda of the next node, A, B, q, r) -> lambda = q + A'lambda, gradient with respect to u = r + B'lambda."""
    multiplier, A, B = kind.sym("lambda", N_STATE), kind.sym("A", a), kind.sym("B", b)
    q, r = kind.sym("q", N_STATE), kind.sym("r", b.size2())
    return _function(
        "adjoint", [multiplier, A, B, q, r], [q + ca.mtimes(A.T, multiplier), r + ca.mtimes(B.T, multiplier)]
    )


def riccati_functions(kind, a: ca.Sparsity, b: ca.Sparsity) -> dict[str, ca.Function]:
    """The functions of a node by name, for matrices of type kind (SX or MX) where A and B have the patterns a and b."""
    makers = (backward_function, first_node_function, forward_function, adjoint_function)
    return {function.name(): function for function in (make(kind, a, b) for make in makers)}


def _function(name: str, arguments: list, results: list) -> ca.Function:
    return ca.Function(
        name, arguments, ca.cse([ca.densify(result) if name != "backward" else result for result in results])
    )
