"""The control step written out in numpy, with dense matrices and no pass of the package: what others must equal."""

import casadi as ca
import numpy as np

from quadexp.control.mpc.prediction import held_deviation
from quadexp.models.residual import Residual
from quadexp.physics.sensitivity import rk4_sensitivity_function
from quadexp.physics.state import ATTITUDE
from quadexp.physics.vehicle import Vehicle

Arrays = dict[str, np.ndarray]


def unrolled(
    vehicle: Vehicle, residual: Residual, a: Arrays, *, attitude_error="plain", lag=False, deviation=False,
    disturbed=False,
) -> Arrays:  # fmt: skip
    """X_new, U_new, checks, X_lin, U_lin of a step with the arguments a, named as there."""
    nodes, samples = len(a["U"]), 2 if deviation else 1
    node = rk4_sensitivity_function(vehicle, residual, scalar=False, lag=lag, added=deviation, disturbed=disturbed)
    X, U, X_ref, share = a["X"].copy(), a["U"].copy(), a["X_ref"][::samples], a["shift"][:, None]
    X[:-1] += share * (a["X"][1:] - a["X"][:-1])
    U[:-1] += share[:-1] * (a["U"][1:] - a["U"][:-1])
    length = np.linalg.norm(X[1:, ATTITUDE], axis=1)
    X[1:, ATTITUDE] *= (np.clip(length, 0.5, 2.0) / length)[:, None]
    X[0] = a["x0"]
    U_ref, added = a["U_ref"], [[]] * nodes
    if deviation:
        constants = [ca.MX(a[name]) for name in ("u_min", "u_max", "dt", "first_share", *(["tau"] if lag else []))]
        held = held_deviation(ca.MX(U_ref.T), *constants)
        U_ref, *added = (np.array(part) for part in ca.Function("held", [], [held.U_ref, *held.added])().values())
        U_ref, added = U_ref.T, [[part] for part in added]

    tau, pushed = ([a[name]] if asked else [] for name, asked in (("tau", lag), ("disturbance", disturbed)))
    linear = [
        [np.array(part) for part in node(X[k], U[k], a["theta"], a["dt"][k], *tau, *added[k], *pushed)]
        for k in range(nodes)
    ]
    turns = [turn(x, attitude_error) for x in X_ref]
    A = [turns[k + 1].T @ linear[k][1] @ turns[k] for k in range(nodes)]
    B = [turns[k + 1].T @ linear[k][2] for k in range(nodes)]
    b = [turns[k + 1].T @ (linear[k][0].ravel() - X[k + 1]) for k in range(nodes)]
    weights = [*a["Q"], a["Q_end"]]
    q = [weights[k] * (turns[k].T @ (X[k] - X_ref[k])) for k in range(nodes + 1)]
    r = a["R"] * (U - U_ref)

    P, p, multiplier, gains, steps = np.diag(weights[-1]), q[-1], q[-1], [], []
    for k in range(nodes - 1, -1, -1):
        H = np.diag(a["R"][k]) + B[k].T @ P @ B[k]
        K, feedforward = (np.linalg.solve(H, part) for part in (B[k].T @ P @ A[k], r[k] + B[k].T @ (P @ b[k] + p)))
        steps.append(np.abs(U[k] - np.clip(U[k] - r[k] - B[k].T @ multiplier, a["u_min"], a["u_max"])).max())
        multiplier = q[k] + A[k].T @ multiplier
        p = q[k] + A[k].T @ (P @ b[k] + p) - A[k].T @ P.T @ B[k] @ feedforward
        P = np.diag(weights[k]) + A[k].T @ P @ (A[k] - B[k] @ K)
        gains.insert(0, (K, feedforward))
    dx, X_new, U_new, turned = np.zeros(X.shape[1]), X.copy(), U.copy(), []
    for k, (K, feedforward) in enumerate(gains):
        du = -feedforward - K @ dx
        dx = A[k] @ dx + B[k] @ du + b[k]
        U_new[k] += du
        X_new[k + 1] += turns[k + 1] @ dx
        turned.append(np.linalg.norm(dx[ATTITUDE]))
    excess = np.maximum(U_new - a["u_max"], a["u_min"] - U_new).max()
    checks = np.array([excess, max(turned), max(*steps, np.abs(b).max())])
    return {"X_new": X_new, "U_new": U_new, "checks": checks, "X_lin": X, "U_lin": U}


def turn(reference: np.ndarray, attitude_error: str) -> np.ndarray:
    """(m, m): from the coordinates of the attitude's error to the state's, q* o e in body, e o q* in world axes."""
    matrix = np.eye(len(reference))
    if attitude_error != "plain":
        w, x, y, z = reference[ATTITUDE] / np.linalg.norm(reference[ATTITUDE])
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) * (1 if attitude_error == "body" else -1)
        v = np.array([x, y, z])
        matrix[ATTITUDE, ATTITUDE] = np.block([[np.array([[w]]), -v[None]], [v[:, None], w * np.eye(3) + cross]])
    return matrix
