"""Backward and forward passes of the linear-quadratic subproblem, one node at a time, as CasADi functions.

The Gauss-Newton subproblem in deviations (dx, du) from the linearisation point is

    min sum_k 1/2 dx'Q dx + q'dx + 1/2 du'R du + r'du,     dx_{k+1} = A_k dx_k + B_k du_k + b_k,     dx_0 = 0

With the cost to go 1/2 dx'P dx + p'dx of the next node and H = R + B'PB, G = B'PA, h = r + B'(Pb + p):

    K = H^-1 G,   k = H^-1 h,   P <- Q + A'PA - G'K,   p <- q + A'(Pb + p) - G'k,   du = -k - K dx

Results of a node: the gains K, k and the factor of H = L D L', with L below the diagonal and D^-1 on it.

There are two forms. `MatrixPasses`, for CasADi's virtual machine, use dense matrix products. `CompiledPasses` are for
generated code: the backward pass, the largest part of a control step, is hand-written C with vector registers
(riccati_backward.c); the others are scalar operations without the structural zeros of A and B.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from quadexp.compile.backend import handwritten
from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression, symbols

N_PLACE = 3  # first states, the position: the dynamics do not depend on it, so A's first columns are [I; 0]
Node = tuple[list[Expression], Expression, Expression, Expression]  # cost to go, K, k, factor
KERNEL = Path(__file__).with_name("riccati_backward.c")


class MatrixPasses:
    """The passes in dense matrix operations; a cost to go is [P, p]."""

    def __init__(self, find: Callable[[str], ca.Function]) -> None:
        self._backward, self._first_node = find("backward"), find("first_node")
        self.forward, self.adjoint = find("forward"), find("adjoint")

    @classmethod
    def build(cls, a: ca.Sparsity, b: ca.Sparsity) -> MatrixPasses:
        """The passes where A and B have the patterns a and b."""
        n = b.size2()
        functions = (_backward_function(n, a.size1()), _first_node_function(n, a.size1()), *_vector_passes(ca.MX, a, b))
        return cls({function.name(): function for function in functions}.__getitem__)

    def terminal(self, Q_end: Expression, p: Expression) -> list[Expression]:
        """Cost to go at the last node."""
        return [ca.densify(ca.diag(Q_end)), p]

    def backward(self, cost: list[Expression], *node: Expression) -> Node:
        """Cost to go of a node from the next one's, and its K, k and factor. node: A, B, b, q, r, Q, R."""
        *before, K, k, factor = self._backward(*cost, *node)
        return before, K, k, factor

    def first_node(self, cost: list[Expression], *node: Expression) -> tuple[Expression, Expression]:
        """k and factor of node 0; its state is given, so neither the gain nor the cost to go is needed."""
        k, factor = self._first_node(*cost, *node)
        return k, factor


class CompiledPasses:
    """The passes for compiled code; a cost to go is riccati_backward.c's array."""

    def __init__(self, find: Callable[[str], ca.Function]) -> None:
        self._rows, self._terminal, self._kernel = (find(f"riccati_{name}") for name in ("rows", "terminal", "kernel"))
        self.forward, self.adjoint = find("forward"), find("adjoint")

    @classmethod
    def build(cls, a: ca.Sparsity, b: ca.Sparsity) -> CompiledPasses:
        """The passes where A and B have the patterns a and b."""
        n = b.size2()
        own = (_rows_function(a, b), _terminal_function(n, a.size1()), kernel_function(n, a.size1()))
        functions = (*own, *_vector_passes(ca.SX, a, b))
        return cls({function.name(): function for function in functions}.__getitem__)

    def terminal(self, Q_end: Expression, p: Expression) -> list[Expression]:
        """See MatrixPasses."""
        return [self._terminal(Q_end, p)]

    def backward(self, cost: list[Expression], *node: Expression) -> Node:
        """See MatrixPasses."""
        before, K, k, factor = self._kernel(*cost, self._rows(*node[:3]), *node[3:])
        return [before], K, k, factor

    def first_node(self, cost: list[Expression], *node: Expression) -> tuple[Expression, Expression]:
        """See MatrixPasses."""
        return self.backward(cost, *node)[2:]


Passes = MatrixPasses | CompiledPasses


def solve_function(n_inputs: int, states: int) -> ca.Function:
    """(H, G, h) -> K = H^-1 G, k = H^-1 h, factor by an unrolled LDL' factorisation; H's upper triangle is read."""
    H, G, h = symbols(ca.SX, H=(n_inputs, n_inputs), G=(n_inputs, states), h=n_inputs)
    D, LT, order = ca.ldl(ca.triu2symm(ca.triu(H)), False)
    gains = ca.ldl_solve(ca.horzcat(G, h), D, LT, order)
    factor = ca.densify(LT.T + ca.diag(1 / D))
    return ca.Function("solve", [H, G, h], ca.cse([gains[:, :states], gains[:, states], factor]))


def _node_symbols(n: int, m: int) -> list[ca.MX]:
    shapes = {"P": (m, m), "p": m, "A": (m, m), "B": (m, n)}
    shapes |= {"b": m, "q": m, "r": n, "Q": m, "R": n}
    return symbols(ca.MX, **shapes)


def _backward_function(n: int, m: int) -> ca.Function:
    """For n inputs and m states: (P, p, A, B, b, q, r, Q, R) of a node -> P, p, K, k, factor; Q and R as diagonals."""
    P, p, A, B, b, q, r, Q, R = given = _node_symbols(n, m)
    products = P @ ca.horzcat(A, B, b)
    PA, PB, Pb = ca.horzsplit(products, [0, m, m + n, m + n + 1])
    H, G, h = PB.T @ B + ca.diag(R), PB.T @ A, r + B.T @ (Pb + p)
    K, k, factor = solve_function(n, m)(H, G, h)
    P_next = A.T @ PA - G.T @ K + ca.diag(Q)
    p_next = q + A.T @ (Pb + p) - G.T @ k
    return _function("backward", given, [P_next, p_next, K, k, factor])


def _first_node_function(n: int, m: int) -> ca.Function:
    """(P, p, A, B, b, q, r, Q, R) of node 0 -> k, factor."""
    P, p, _, B, b, _, r, _, R = given = _node_symbols(n, m)
    H = B.T @ (P @ B) + ca.diag(R)
    h = r + B.T @ (P @ b + p)
    _, k, factor = solve_function(n, m)(H, ca.MX(n, m), h)
    return _function("first_node", given, [k, factor])


def _vector_passes(kind: type[Expression], a: ca.Sparsity, b: ca.Sparsity) -> tuple[ca.Function, ca.Function]:
    """forward: (dx, A, B, b, K, k) -> du, dx of the next node.

    adjoint: (lambda of the next node, A, B, q, r) -> lambda = q + A'lambda, gradient by u = r + B'lambda.
    """
    m, n = b.shape
    x, A, B, gap, K, k, q, r = symbols(kind, x=m, A=a, B=b, b=m, K=(n, m), k=n, q=m, r=n)
    du = -k - K @ x
    forward = _function("forward", [x, A, B, gap, K, k], [du, A @ x + B @ du + gap])
    return forward, _function("adjoint", [x, A, B, q, r], [q + A.T @ x, r + B.T @ x])


def _function(name: str, arguments: list[Expression], results: list[Expression]) -> ca.Function:
    return ca.Function(name, arguments, ca.cse([ca.densify(result) for result in results]))


def line_length(n: int, states: int) -> int:
    """Length of a row in riccati_backward.c: states without position, inputs, the affine column, padding."""
    return 8 * ((states - N_PLACE + n) // 8 + 1)


def _rows_function(a: ca.Sparsity, b: ca.Sparsity) -> ca.Function:
    """(A, B, b) -> the kernel's rows, one in each column."""
    m, n = b.shape
    A, B, gap = symbols(ca.SX, A=a, B=b, b=m)
    padding = ca.SX(line_length(n, m) - (m - N_PLACE + n + 1), m)
    return _function("riccati_rows", [A, B, gap], [ca.vertcat(A[:, N_PLACE:].T, B.T, gap.T, padding)])


def _terminal_function(n: int, m: int) -> ca.Function:
    """(Q_end, p) -> the kernel's cost at the last node."""
    Q_end, p = symbols(ca.SX, Q_end=m, p=m)
    rows, affine = ca.SX(line_length(n, m), m), m - N_PLACE + n
    rows[: m - N_PLACE, N_PLACE:] = ca.diag(Q_end[N_PLACE:])
    rows[affine, :] = p.T
    return _function("riccati_terminal", [Q_end, p], [ca.vertcat(ca.vec(rows), ca.vec(ca.diag(Q_end[:N_PLACE])))])


def kernel_function(n: int, m: int) -> ca.Function:
    """riccati_backward.c for n inputs and m states: (cost, rows, q, r, Q, R) -> cost of this node, K, k, factor.

    It can only be compiled.
    """
    dense = ca.Sparsity.dense
    cost, state, inputs = dense(line_length(n, m) * m + N_PLACE**2, 1), dense(m, 1), dense(n, 1)
    arguments = {"cost": cost, "rows": dense(line_length(n, m), m), "q": state, "r": inputs, "Q": state, "R": inputs}
    results = {"cost_next": cost, "K": dense(n, m), "k": inputs, "factor": dense(n, n)}
    return handwritten("riccati_kernel", KERNEL, {"N_INPUTS": n, "STATES": m}, arguments, results)
