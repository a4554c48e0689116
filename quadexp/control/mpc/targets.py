"""Targets that hold the path in the world that is believed: attitudes, rates and thrusts of a reference made anew.

A reference holds its path in still air without disturbance. At a node with attitude R, thrusts u of sum T and the air
that the reference was made with, a_0 = a_air(R'v, w, u), the path asks for the specific force f = R (T e_z / m + a_0).
Under a force F, a torque tau and a wind W the same path needs R_1, u_1 with

    R_1 (T_1 e_z / m + a_1) + F / m = f,          a_1 = a_air(R_1'(v - W), w, u_1)
    G u_1 = [T_1, G_tau u + tau_0 - tau_1 - tau]      tau_0, tau_1: of the air, likewise

R_1 turns R by the shortest way that brings its z axis onto f - F / m - R_1 a_1. The force of the air on the right-hand
side is that of the last control step, which converges from step to step; where nothing moves the targets are exact. The
rates get the turn's derivative along the horizon, by differences. With weights on attitude and thrust an MPC only
reaches zero error with such targets (Muske and Badgwell 2002, Maeder, Borrelli and Morari 2009).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from quadexp.physics.expression import Expression
from quadexp.physics.rotation import product, rotation_matrix
from quadexp.physics.scalars import as_scalars
from quadexp.physics.state import ATTITUDE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

SMALL = 1e-9  # m/s^2: of a specific force that has no direction


def held_targets(
    states: list[Expression],
    inputs: list[Expression],
    air: list[Expression],
    times: list[Expression],
    model: ca.Function | None,
    theta: Expression,
    disturbance: Expression,
    wind: Expression,
    vehicle: Vehicle,
) -> tuple[list[Expression], list[Expression], list[Expression]]:
    """Attitudes (4,), rates (3,) and changes of the thrusts (n,) (N) at the nodes, and the force of the air there.

    states: (13,) of the reference at the nodes. inputs: (n,) (N). air: R_1 a_1 of the last step, (3,), world (m/s^2).
    times: of the nodes (s). model: of the air, with which the reference was made; None: made without, and there is
    none. disturbance: (6,), see physics.rigid_body. wind: (3,) (m/s).
    """
    allocate = np.linalg.pinv(vehicle.allocation)

    def demanded(x: Expression, u: Expression, y: Expression) -> Expression:
        lift = ca.vertcat(0, 0, ca.sum1(u) / vehicle.mass)
        return ca.mtimes(rotation_matrix(x[ATTITUDE]), lift + y[:3])

    def turned(x: Expression, force: Expression) -> list[Expression]:
        axis = rotation_matrix(x[ATTITUDE])[:, 2]
        size = ca.sqrt(ca.sumsqr(force) + SMALL**2)
        towards = force / size
        turn = ca.vertcat(1 + ca.dot(axis, towards), ca.cross(axis, towards))
        turn = turn / ca.norm_2(turn)
        return [product(turn, x[ATTITUDE]), size, 2 * turn[1:]]

    def features(x: Expression, q: Expression, u: Expression, wind: Expression) -> Expression:
        return ca.vertcat(ca.mtimes(rotation_matrix(q).T, x[VELOCITY] - wind), x[RATE], u)

    def still(x: Expression, u: Expression) -> Expression:
        return features(x, x[ATTITUDE], u, ca.DM.zeros(3))

    def change(u: Expression, size: Expression, torque: Expression) -> Expression:
        return ca.mtimes(ca.DM(allocate), ca.vertcat(vehicle.mass * size - ca.sum1(u), -torque))

    inertia = ca.DM(vehicle.inertia_matrix)
    unknown = ca.mtimes(inertia, disturbance[3:])
    attitudes, turns, changes, forces = [], [], [], []
    for x, u, last in zip(states, inputs, air, strict=True):
        zero = ca.MX.zeros(6)
        y0 = zero if model is None else ca.densify(model(as_scalars(still)(x, u), theta)[0])
        force = as_scalars(demanded)(x, u, y0) - disturbance[:3]
        q, size, turn = as_scalars(turned)(x, force - last)
        now, torque = last, unknown
        if model is not None:
            thrusts = u + as_scalars(change)(u, size, unknown)
            y1 = ca.densify(model(as_scalars(features)(x, q, thrusts, wind), theta)[0])
            now, torque = ca.mtimes(rotation_matrix(q), y1[:3]), unknown + y1[3:] - y0[3:]
            q, size, turn = as_scalars(turned)(x, force - now)
        attitudes.append(q)
        turns.append(turn)
        changes.append(as_scalars(change)(u, size, torque))
        forces.append(now)
    rates = []
    for x, q, slope in zip(states, attitudes, _slopes(turns, times), strict=True):
        rates.append(x[RATE] + ca.mtimes(rotation_matrix(q).T, slope))
    moved = [ca.vertcat(q, w) for q, w in zip(attitudes, rates, strict=True)]
    return moved, changes, forces


def _slopes(values: list[Expression], times: list[Expression]) -> list[Expression]:
    """Derivatives at uneven times: of the parabola through three neighbours, at the ends of the line through two."""
    d = [(b - a) for a, b in zip(times, times[1:], strict=False)]
    secants = [(b - a) / h for a, b, h in zip(values, values[1:], d, strict=False)]
    inside = [
        (before * after_h + after * before_h) / (before_h + after_h)
        for before, after, before_h, after_h in zip(secants, secants[1:], d, d[1:], strict=False)
    ]
    return [secants[0], *inside, secants[-1]]
