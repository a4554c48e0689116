"""Targets that hold the path in the world that is assumed: attitudes, rates and thrusts of a reference made anew.

A reference holds its path in still air without disturbance. At a node with attitude R, thrusts u of sum T and the air
that the reference was made with, a_0 = a_air(R'v, w, u), the path asks for the specific force R (T e_z / m + a_0).
Under a force F, a torque tau and a wind W the same path needs R_1, u_1 with

    R_1 T_1 e_z / m = R T e_z / m - F / m - d,        d = R_1 a_1 - R a_0,    a_1 = a_air(R_1'(v - W), w, u_1)
    G u_1 = [T_1, G_tau u + tau_0 - tau_1 - tau]                              tau_0, tau_1: of the air, likewise

R_1 turns R by the shortest way that brings its z axis onto the right-hand side. The d in it is that of the last control
step, which converges from step to step; where nothing moves the targets are exact. No axis of d or tau_1 - tau_0 is
larger than what the rotors can hold, so that targets stay finite where the air is assumed far too strong. d is found
at every second node, and linear in time between. The rates get the turn's derivative along the horizon, by differences.
Where next to no specific force is asked for, its direction is none to follow, and the attitude remains that of the
reference. With weights on attitude and thrust an MPC only reaches zero error with such targets (Muske and Badgwell
2002, Maeder, Borrelli and Morari 2009).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression, limited, unit
from quadexp.physics.rotation import product, rotation_matrix
from quadexp.physics.scalars import as_scalars
from quadexp.physics.state import ATTITUDE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

SMALL = 1e-9  # m/s^2: of a specific force that has no direction
LEAST = 0.5  # of gravity: below, the specific force decides the attitude the less the smaller it is
TURNING = 0.25  # of the vehicle's largest rate: limit of what the turn adds to a rate


def held_targets(
    states: list[Expression],
    inputs: list[Expression],
    air: list[Expression],
    times: list[Expression],
    model: ca.Function | None,
    theta: Expression,
    disturbance: Expression,
    wind: Expression,
    air_scale: Expression,
    vehicle: Vehicle,
) -> tuple[list[Expression], list[Expression], list[Expression]]:
    """Attitudes with rates (7,) and changes of the thrusts (n,) (N) at the nodes, and `air` for the next step.

    states: (13,) of the reference at the nodes. inputs: (n,) (N). air: d, (3,), world (m/s^2), then tau_1 - tau_0,
    (3,), body (N m), of the last step. times: of the nodes (s). model: of the air, with which the reference was made;
    None: made without, and there is none. disturbance: (6,), see physics.rigid_body. wind: (3,) (m/s).
    """
    allocate = ca.DM(np.linalg.pinv(vehicle.allocation))
    inertia = ca.DM(vehicle.inertia_matrix)
    force, *torque = np.abs(vehicle.allocation).sum(1) * vehicle.thrust_max
    most = ca.DM([force / vehicle.mass] * 3 + torque)

    def turned(x: Expression, u: Expression, air: Expression, disturbance: Expression) -> list[Expression]:
        axis = rotation_matrix(x[ATTITUDE])[:, 2]
        thrust = ca.sum1(u)
        force = axis * (thrust / vehicle.mass) - disturbance[:3] - air[:3]
        size = ca.sqrt(ca.sumsqr(force) + SMALL**2)
        sure = ca.fmin(1, size / (LEAST * vehicle.gravity))
        towards = sure * force / size + (1 - sure) * axis
        towards = towards / ca.sqrt(ca.sumsqr(towards) + SMALL**2)
        turn = ca.vertcat(1 + ca.dot(axis, towards), ca.cross(axis, towards))
        turn = unit(turn)
        torque = inertia @ disturbance[3:] + air[3:]
        change = allocate @ ca.vertcat(vehicle.mass * size - thrust, -torque)
        return [product(turn, x[ATTITUDE]), 2 * turn[1:], change]

    def features(x: Expression, q: Expression, u: Expression, wind: Expression) -> list[Expression]:
        still = rotation_matrix(x[ATTITUDE]).T @ x[VELOCITY]
        blown = rotation_matrix(q).T @ (x[VELOCITY] - wind)
        return [ca.vertcat(still, x[RATE]), ca.vertcat(blown, x[RATE], u)]

    def difference(x: Expression, q: Expression, y0: Expression, y1: Expression, scale: Expression) -> Expression:
        y1 = scale * y1
        force = rotation_matrix(q) @ y1[:3] - rotation_matrix(x[ATTITUDE]) @ y0[:3]
        torque = y1[3:] - y0[3:]
        return limited(ca.vertcat(force, torque), -most, most)

    last = len(states) - 1
    if model is not None:
        exact = {}
        for k in sorted({*range(0, last, 2), last}):
            x = states[k]
            u = inputs[k]
            q, _, change = as_scalars(turned)(x, u, air[k], disturbance)
            still, blown = as_scalars(features)(x, q, u + change, wind)
            y0 = ca.densify(model(ca.vertcat(still, u), theta)[0])
            y1 = ca.densify(model(blown, theta)[0])
            exact[k] = as_scalars(difference)(x, q, y0, y1, air_scale)
        air = []
        for k in range(last + 1):
            before = max(i for i in exact if i <= k)
            after = min(i for i in exact if i >= k)
            span = times[after] - times[before]
            share = 0 if k in exact else (times[k] - times[before]) / span
            air.append(exact[before] + share * (exact[after] - exact[before]))
    attitudes = []
    turns = []
    changes = []
    for x, u, d in zip(states, inputs, air, strict=True):
        q, turn, change = as_scalars(turned)(x, u, d, disturbance)
        attitudes.append(q)
        turns.append(turn)
        changes.append(change)
    moved = []
    limit = TURNING * vehicle.rate_max
    for x, q, slope in zip(states, attitudes, _slopes(turns, times), strict=True):
        turning = rotation_matrix(q).T @ slope
        moved.append(ca.vertcat(q, x[RATE] + limited(turning, -limit, limit)))
    return moved, changes, air


def _slopes(values: list[Expression], times: list[Expression]) -> list[Expression]:
    """Derivatives at uneven times: of the parabola through three neighbours, at the ends of the line through two."""
    steps = [b - a for a, b in pairwise(times)]
    secants = [(b - a) / h for (a, b), h in zip(pairwise(values), steps, strict=True)]
    inside = []
    for (before, after), (h, next_h) in zip(pairwise(secants), pairwise(steps), strict=True):
        inside.append((before * next_h + after * h) / (h + next_h))
    return [secants[0], *inside, secants[-1]]
