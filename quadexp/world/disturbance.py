"""A force and a torque from outside, constant or for a while.

    F(t) = F, tau(t) = tau     for t_0 <= t < t_0 + D, else zero                  force world (N), torque body (N m)

In a step that begins or ends the while, they act with the share of the step that lies inside, so that the impulse F D
does not depend on the step.
"""

from __future__ import annotations

import casadi as ca

from quadexp.physics.expression import Expression


def active_share(t: Expression, step: Expression, start: float, end: float) -> Expression:
    """Share of the step (s) from t (s) on that lies between start and end (s), 0 .. 1."""
    return ca.fmax(ca.fmin(t + step, end) - ca.fmax(t, start), 0) / step
