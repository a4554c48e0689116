"""The benchmark's optimal control problem written for acados: numbers, dynamics, and the RK4 step in two forms.

    p' = v,   q' = 1/2 q o [0, w],   v' = R(q) (T e_z / m + a(v_body)) + g,   w' = J^-1 (tau - w x J w)

with a(v_body) none, a linear drag, or the means of three one-dimensional Gaussian processes. Written independently of
quadexp (which the interpreter need not have), so that equal inputs verify both.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path

import casadi as ca
import numpy as np

NX, NU = 13, 4
GRAVITY = 9.81  # m/s^2


@dataclass(frozen=True)
class Residual:
    """Acceleration in the body frame (m/s^2) as a function of the body velocity v (m/s).

    linear_drag: -drag v. gp, on each axis i: sum_j alpha[i, j] exp(-1/2 ((v_i - Z[i, j]) / lengthscale[i])^2).
    """

    kind: str
    drag: np.ndarray | None = None
    Z: np.ndarray | None = None
    alpha: np.ndarray | None = None
    lengthscale: np.ndarray | None = None


@dataclass(frozen=True)
class Problem:
    """Vehicle, weights, horizon, and K control steps: states (K, 13), xref (K, N + 1, 13), uref (K, N, 4)."""

    residual: Residual
    nodes: int
    mass: float
    inertia: np.ndarray
    rotor_x: np.ndarray
    rotor_y: np.ndarray
    torque_sign: np.ndarray
    c_tau: float
    u_min: float
    u_max: float
    Q: np.ndarray
    R: np.ndarray
    terminal_weight: float
    horizon: float
    states: np.ndarray
    xref: np.ndarray
    uref: np.ndarray

    @property
    def step(self) -> float:
        """Time between shooting nodes (s)."""
        return self.horizon / self.nodes


def load_problem(path: Path) -> Problem:
    """Read the problem that `benchmarks.step` writes."""
    data = json.loads(path.read_text())
    arrays = {name: np.array(value, float) for name, value in data["residual"].items() if name != "kind"}
    numbers = {f.name: data[f.name] for f in fields(Problem) if f.name != "residual"}
    numbers = {name: np.array(value, float) if isinstance(value, list) else value for name, value in numbers.items()}
    return Problem(residual=Residual(data["residual"]["kind"], **arrays), **numbers)


def rotation_matrix(q):
    """R(q / |q|), (3, 3): turns body vectors into world vectors."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    double = 2 / ca.dot(q, q)
    rows = (
        (1 - double * (y * y + z * z), double * (x * y - w * z), double * (x * z + w * y)),
        (double * (x * y + w * z), 1 - double * (x * x + z * z), double * (y * z - w * x)),
        (double * (x * z - w * y), double * (y * z + w * x), 1 - double * (x * x + y * y)),
    )
    return ca.vertcat(*(ca.horzcat(*row) for row in rows))


def body_velocity(x):
    """Velocity in the body frame, (3,) (m/s)."""
    return rotation_matrix(x[3:7]).T @ x[7:10]


def residual_acceleration(residual: Residual, v):
    """Residual acceleration in the body frame, (3,) (m/s^2)."""
    if residual.kind == "none":
        return ca.DM(3, 1)
    if residual.kind == "linear_drag":
        return -ca.DM(residual.drag) * v
    axes = zip(residual.Z, residual.alpha, residual.lengthscale, strict=True)
    means = (ca.dot(alpha, ca.exp(-0.5 * ((v[i] - Z) / ell) ** 2)) for i, (Z, alpha, ell) in enumerate(axes))
    return ca.vertcat(*means)


def dynamics(problem: Problem, x, u, acceleration=None):
    """State derivative, (13,); acceleration replaces the model's residual."""
    q, v, w = x[3:7], x[7:10], x[10:13]
    if acceleration is None:
        acceleration = residual_acceleration(problem.residual, body_velocity(x))
    torque = ca.vertcat(
        ca.dot(problem.rotor_y, u), -ca.dot(problem.rotor_x, u), problem.c_tau * ca.dot(problem.torque_sign, u)
    )
    inertia = ca.DM(problem.inertia)
    return ca.vertcat(
        v,
        0.5 * ca.vertcat(-ca.dot(q[1:4], w), q[0] * w + ca.cross(q[1:4], w)),
        rotation_matrix(q) @ (ca.vertcat(0, 0, ca.sum1(u) / problem.mass) + acceleration) - ca.DM([0, 0, GRAVITY]),
        (torque - ca.cross(w, inertia * w)) / inertia,
    )


def rk4(problem: Problem, x, u):
    """State after one classical Runge-Kutta step over a node period."""
    h = problem.step
    k1 = dynamics(problem, x, u)
    k2 = dynamics(problem, x + h / 2 * k1, u)
    k3 = dynamics(problem, x + h / 2 * k2, u)
    k4 = dynamics(problem, x + h * k3, u)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def gp_mean_and_slope(residual: Residual) -> ca.Function:
    """Body velocity -> GP means (3,) and their derivatives (3,), in matrix operations, whose exponentials vectorise."""
    v = ca.MX.sym("v", 3)
    count = residual.Z.shape[1]
    scale = 1.0 / residual.lengthscale**2
    difference = ca.repmat(v.T, count, 1) - residual.Z.T
    terms = residual.alpha.T * ca.exp(np.tile(-0.5 * scale, (count, 1)) * difference * difference)

    def column_sums(matrix):
        return ca.vertcat(*(ca.dot(ca.DM.ones(count), column) for column in ca.horzsplit(matrix)))

    return ca.Function("gp", [v], [column_sums(terms), -scale * column_sums(terms * difference)], {"cse": True})


def chained_rk4(problem: Problem):
    """Symbols x and u, the RK4 step and its Jacobian in [u, x], chained stage by stage on sparse matrices.

    A Gaussian process enters through its mean and slope, evaluated once a stage; without one all is one scalar
    expression.
    """
    h, with_gp = problem.step, problem.residual.kind == "gp"
    mean_and_slope = gp_mean_and_slope(problem.residual) if with_gp else None
    sx = ca.SX.sym("x", NX)
    velocity = ca.Function("velocity", [sx], [body_velocity(sx)])
    seed_u = ca.horzcat(ca.SX.eye(NU), ca.SX(NU, NX))
    seed_x = ca.horzcat(ca.SX(NX, NU), ca.SX.eye(NX))

    x, u = ca.MX.sym("x", NX), ca.MX.sym("u", NU)
    slopes, sensitivities = [], []
    for stage, fraction in enumerate((0.0, h / 2, h / 2, h)):
        point = x + fraction * slopes[-1] if stage else x
        previous = sensitivities[-1] if stage else ca.MX(NX, NU + NX)
        xs, us, before = ca.SX.sym("x", NX), ca.SX.sym("u", NU), ca.SX.sym("s", previous.sparsity())
        inputs, values = [xs, us, before], [point, u, previous]
        if with_gp:
            mean, slope = ca.SX.sym("mean", 3), ca.SX.sym("slope", 3)
            inputs += [mean, slope]
            values += mean_and_slope(velocity(point))
            rate = dynamics(problem, xs, us, mean)
            inner = ca.diag(slope) @ ca.jacobian(body_velocity(xs), xs)
            rate_x = ca.jacobian(rate, xs) + ca.jacobian(rate, mean) @ inner
        else:
            rate = dynamics(problem, xs, us)
            rate_x = ca.jacobian(rate, xs)
        chained = rate_x @ (seed_x + fraction * before) + ca.jacobian(rate, us) @ seed_u
        slope_value, sensitivity = ca.Function(f"stage{stage}", inputs, [rate, chained], {"cse": True})(*values)
        slopes.append(slope_value)
        sensitivities.append(sensitivity)

    weights = [h / 6, h / 3, h / 3, h / 6]
    parts = [ca.SX.sym("s", s.sparsity()) for s in sensitivities]
    total = seed_x + sum(w * part for w, part in zip(weights, parts, strict=True))
    jacobian = ca.Function("combine", parts, [total])(*sensitivities)
    following = x + sum(w * k for w, k in zip(weights, slopes, strict=True))
    if not with_gp:
        scalar = ca.Function("step", [x, u], [following, jacobian]).expand()
        x, u = ca.SX.sym("x", NX), ca.SX.sym("u", NU)
        following, jacobian = scalar(x, u)
    return x, u, following, jacobian
