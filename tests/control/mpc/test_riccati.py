"""The passes over the nodes, on both back ends, against the recursion as the textbook writes it, in numpy."""

import numpy as np
import pytest

from quadexp.compile.backend import compiler
from quadexp.control.mpc.mpc import stages_of
from quadexp.control.mpc.step import Step
from quadexp.models.residual import no_residual
from tests.states import with_rotor_count

NODES = 12


def textbook(A, B, b, q, r, Q, Q_end, R):
    """K, k and H of min sum 1/2 dx'Q dx + q'dx + 1/2 du'R du + r'du, dx_next = A dx + B du + b.

    K (N, n, m), k (N, n); H (N, n, n): second derivative of a node's cost and the cost to go in its inputs.
    """
    P, p, gains = np.diag(Q_end), q[-1], []
    for k in range(len(A) - 1, -1, -1):
        H, G = np.diag(R[k]) + B[k].T @ P @ B[k], B[k].T @ P @ A[k]
        h = r[k] + B[k].T @ (P @ b[k] + p)
        K, feedforward = np.linalg.solve(H, G), np.linalg.solve(H, h)
        p = q[k] + A[k].T @ (P @ b[k] + p) - G.T @ feedforward
        P = np.diag(Q[k]) + A[k].T @ P @ A[k] - G.T @ K
        gains.append((K, feedforward, H))
    return (np.array(part[::-1]) for part in zip(*gains, strict=True))


def pose(step: Step, rng: np.random.Generator) -> None:
    """Random weights, and a guess and a reference with attitudes of every kind."""
    a, m = step.arguments, step.form.states
    for array in a.values():
        array[...] = rng.normal(size=array.shape)
    for name in ("Q", "Q_end", "R", "dt"):
        a[name][...] = rng.uniform(0.05, 0.5, a[name].shape)
    a["U"][...], a["x0"][:], a["shift"][...] = rng.uniform(1, 5, a["U"].shape), rng.normal(size=m), 0.2


@pytest.mark.parametrize(("rotors", "lag"), [(4, False), (5, False), (6, False), (8, False), (4, True), (6, True)])
@pytest.mark.parametrize("backend", ["interpreted", "compiled"])
def test_gains_are_the_textbook_ones(vehicle, backend, rotors, lag, rng):
    """For as many rotors as fill a row of registers and more; with thrusts as states, there are 13 + n of these."""
    if backend == "compiled" and compiler() is None:
        pytest.skip("no C compiler")
    vehicle = with_rotor_count(vehicle, rotors)
    step = Step(stages_of(vehicle, no_residual(vehicle), backend, lag=lag), NODES)
    pose(step, rng)
    if lag:
        step.arguments["tau"][...] = 0.03
    step()
    (A, B, b), r, a = step.dynamics, step.results, step.arguments
    weights = a["Q"], a["Q_end"], a["R"]
    K, k, H = textbook(A, B, b, r["q"], r["r"], *weights)
    assert np.allclose(r["K"][1:].transpose(0, 2, 1), K[1:], rtol=1e-8, atol=1e-9)
    dx = np.zeros(step.form.states)
    for node in range(NODES):
        du = -k[node] - K[node] @ dx
        assert np.allclose(r["U_new"][node] - r["U_lin"][node], du, rtol=1e-8, atol=1e-8)
        dx = A[node] @ dx + B[node] @ du + b[node]
        assert np.allclose(r["X_new"][node + 1] - r["X_lin"][node + 1], dx, rtol=1e-8, atol=1e-8)
    for factor, expected in zip(r["factor"].transpose(0, 2, 1), H, strict=True):
        L, D = np.tril(factor, -1) + np.eye(rotors), np.diag(1 / np.diag(factor))
        assert np.allclose(L @ D @ L.T, expected, rtol=1e-9, atol=1e-9)
        assert np.all(np.triu(factor, 1) == 0)
