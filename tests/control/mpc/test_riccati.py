"""The hand-written backward pass against the recursion as the textbook writes it, in numpy."""

import casadi as ca
import numpy as np
import pytest

from quadexp.compile.backend import BufferedFunction, compiler, realise
from quadexp.control.mpc.riccati import CompiledPasses, MatrixPasses
from quadexp.physics.state import N_STATE

NODES = 12


def textbook(A, B, b, q, r, Q, Q_end, R):
    """K, k and H of min sum 1/2 dx'Q dx + q'dx + 1/2 du'R du + r'du, dx_next = A dx + B du + b.

    K (N, n, 13), k (N, n); H (N, n, n): second derivative of a node's cost and the cost to go in its inputs.
    """
    P, p, gains = np.diag(Q_end), q[-1], []
    for k in range(len(A) - 1, -1, -1):
        H, G = np.diag(R) + B[k].T @ P @ B[k], B[k].T @ P @ A[k]
        h = r[k] + B[k].T @ (P @ b[k] + p)
        K, feedforward = np.linalg.solve(H, G), np.linalg.solve(H, h)
        p = q[k] + A[k].T @ (P @ b[k] + p) - G.T @ feedforward
        P = np.diag(Q) + A[k].T @ P @ A[k] - G.T @ K
        gains.append((K, feedforward, H))
    return (np.array(part[::-1]) for part in zip(*gains, strict=True))


def gains_function(kind, n: int, m: int = N_STATE) -> ca.Function:
    """All gains by the passes of a kind: A, B, b, q, r side by side, then Q, Q_end, R -> K, k, factor side by side."""
    A_all, B_all = ca.MX.sym("A", m, m * NODES), ca.MX.sym("B", m, n * NODES)
    b_all, q_all, r_all = (ca.MX.sym(*shape) for shape in (("b", m, NODES), ("q", m, NODES + 1), ("r", n, NODES)))
    Q, Q_end, R = ca.MX.sym("Q", m), ca.MX.sym("Q_end", m), ca.MX.sym("R", n)
    A, B = ca.horzsplit(A_all, m), ca.horzsplit(B_all, n)
    b, q, r = ca.horzsplit(b_all), ca.horzsplit(q_all), ca.horzsplit(r_all)
    passes = kind.build(A[0].sparsity(), B[0].sparsity())
    cost, K, k, factors = passes.terminal(Q_end, q[NODES]), *([None] * NODES for _ in range(3))
    for i in range(NODES - 1, -1, -1):
        first, first_factor = passes.first_node(cost, A[i], B[i], b[i], q[i], r[i], Q, R)
        cost, K[i], k[i], factors[i] = passes.backward(cost, A[i], B[i], b[i], q[i], r[i], Q, R)
        k[i], factors[i] = ca.horzcat(k[i], first), ca.horzcat(factors[i], first_factor)
    arguments = [A_all, B_all, b_all, q_all, r_all, Q, Q_end, R]
    names = ["A", "B", "b", "q", "r", "Q", "Q_end", "R"]
    results = [ca.horzcat(*part) for part in (K, k, factors)]
    return ca.Function("gains", arguments, results, names, ["K", "k", "factor"])


@pytest.mark.parametrize(("n", "m"), [(4, 13), (3, 13), (6, 13), (8, 13), (4, 17), (6, 19)])
@pytest.mark.parametrize("kind", [MatrixPasses, CompiledPasses])
def test_gains_are_the_textbook_ones(kind, n, m, rng):
    """Random stable and unstable nodes, for as many rotors as fill a row of registers and more; with thrusts as states,
    there are 13 + n of these."""
    if kind is CompiledPasses and compiler() is None:
        pytest.skip("no C compiler")
    A = np.eye(m) + 0.3 * rng.normal(size=(NODES, m, m))
    A[:, :, :3] = np.eye(m)[:, :3]  # nothing depends on the position
    B, b = rng.normal(size=(NODES, m, n)), rng.normal(size=(NODES, m))
    q, r = rng.normal(size=(NODES + 1, m)), rng.normal(size=(NODES, n))
    Q, Q_end, R = rng.uniform(0, 2, m), rng.uniform(0, 2, m), rng.uniform(0.1, 1, n)
    function = BufferedFunction(
        realise(gains_function(kind, n, m), "compiled" if kind is CompiledPasses else "interpreted")
    )
    a = function.arguments
    a["A"][...], a["B"][...] = (np.concatenate(m.transpose(0, 2, 1)) for m in (A, B))
    a["b"][...], a["q"][...], a["r"][...], a["Q"][...], a["Q_end"][...], a["R"][...] = b, q, r, Q, Q_end, R
    function()
    K, k, H = textbook(A, B, b, q, r, Q, Q_end, R)
    assert np.allclose(function.results["K"].reshape(NODES, m, n).transpose(0, 2, 1), K, rtol=1e-9, atol=1e-10)
    both = function.results["k"].reshape(NODES, 2, n)
    assert np.allclose(both[:, 0], k, rtol=1e-9, atol=1e-9) and np.allclose(both[:, 1], k, rtol=1e-9, atol=1e-9)
    for stored in np.split(function.results["factor"].reshape(2 * NODES, n, n), NODES):
        for factor in stored.transpose(0, 2, 1):
            L, D = np.tril(factor, -1) + np.eye(n), np.diag(1 / np.diag(factor))
            assert np.allclose(L @ D @ L.T, H[0], rtol=1e-9, atol=1e-9)
            assert np.all(np.triu(factor, 1) == 0)
        H = H[1:]


@pytest.mark.parametrize("kind", [MatrixPasses, CompiledPasses])
def test_shapes_of_what_a_node_leaves(kind):
    """And a cost to go of one node takes the place of the next one's."""
    sizes = {"A": (13, 13), "B": (13, 6), "b": (13, 1), "q": (13, 1), "r": (6, 1), "Q": (13, 1), "R": (6, 1)}
    node = [ca.MX.sym(name, *size) for name, size in sizes.items()]
    passes = kind.build(node[0].sparsity(), node[1].sparsity())
    last = passes.terminal(*(ca.MX.sym(name, N_STATE) for name in "Qq"))
    before, K, k, factor = passes.backward(last, *node)
    assert [part.shape for part in before] == [part.shape for part in last]
    assert K.shape == (6, N_STATE) and k.shape == (6, 1) and factor.shape == (6, 6)
    assert [part.shape for part in passes.first_node(last, *node)] == [(6, 1), (6, 6)]


def test_a_kernel_cannot_be_run_uncompiled(rng):
    """It is C and nothing else: calling it in the virtual machine must fail, not return a number."""
    function = gains_function(CompiledPasses, 4)
    with pytest.raises(RuntimeError):
        function(*(ca.DM.ones(*function.size_in(i)) for i in range(function.n_in())))
