"""The attitude error in the cost: the difference q - q*, or the error rotation e = q*^-1 o q or q o q*^-1.

    plain    weighted q - q*, as in Torrente et al. 2021. The components do not belong to axes of the vehicle: the same
             weights mean other weights of roll, pitch and yaw at every heading: (0, c, c, c) weighs a turn about z_body
             by c (1 - q_z*^2), half of it at a heading of 90 degrees, nothing at 180.
    body     weighted e - (1, 0, 0, 0), with e = (cos a/2, sin(a/2) axis) and the axis in the reference's body frame:
             weights of roll, pitch and yaw errors, the same at every heading.
    world    weighted q o q*^-1 - (1, 0, 0, 0): the axis in world axes, as Sun et al. 2022 print it; the third weight
             is that of a turn about the vertical, however the vehicle is tilted.

With L(q*), L(q) p = q o p, of a unit q*, e = L(q*)' q is linear in q, and L is orthogonal. So "body" is the same
subproblem in other coordinates of the quaternion at each node, dq = L de: the weights stay diagonal, A, B and b are
transformed from the left and from the right, and the solver is the same. So it is for "world", with M(q*),
M(q) p = p o q, in place of L(q*).
"""

from __future__ import annotations

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression, unit
from quadexp.physics.rotation import left_matrix, right_matrix
from quadexp.physics.scalars import as_scalars
from quadexp.physics.state import ATTITUDE


def yaw_share(reference: np.ndarray, weight: np.ndarray) -> float:
    """The least weight that "plain" gives a turn about z_body along a reference, over that at a heading of zero.

    reference: quaternions (k, 4). weight: on w, x, y, z, (4,). 1 where there is none at a heading of zero.
    """
    q_w, q_x, q_y, q_z = reference.T
    turned = np.stack([-q_z, q_y, -q_x, q_w])  # q o (0, e_z)
    return float((weight @ turned**2).min() / weight[3]) if weight[3] else 1.0


class AttitudeError:
    """Coordinates of the quaternion's deviation at the nodes 0..N of a horizon: its own, of q - q*."""

    def deviation(self, k: int, dx: Expression) -> Expression:
        """State deviation at node k in the cost's coordinates."""
        return dx

    def change(self, k: int, dx: Expression) -> Expression:
        """The way back: from the cost's coordinates to a change of the state."""
        return dx

    def linearisation(
        self, k: int, A: Expression, B: Expression, b: Expression
    ) -> tuple[Expression, Expression, Expression]:
        """dx_{k+1} = A dx_k + B du_k + b in the cost's coordinates."""
        return A, B, b


class Rotation(AttitudeError):
    """q*^-1 o q, or q o q*^-1.

    frames: L(q*_k), or M(q*_k), side by side, (4, 4 (N + 1)); see `reference_frames`.
    """

    def __init__(self, frames: Expression) -> None:
        self._frames = ca.horzsplit(frames, 4)

    def deviation(self, k: int, dx: Expression) -> Expression:
        """See AttitudeError."""
        return as_scalars(_into)(self._frames[k], dx)

    def change(self, k: int, dx: Expression) -> Expression:
        """See AttitudeError."""
        return as_scalars(_out_of)(self._frames[k], dx)

    def linearisation(
        self, k: int, A: Expression, B: Expression, b: Expression
    ) -> tuple[Expression, Expression, Expression]:
        """See AttitudeError."""
        A, B, b = as_scalars(_turned)(self._frames[k], self._frames[k + 1], A, B, b)
        return A, B, b


def attitude_error_in(frames: Expression | None) -> AttitudeError:
    """The error in a horizon's frames; None: the plain difference."""
    return AttitudeError() if frames is None else Rotation(frames)


def reference_frames(X_ref: Expression, kind: str) -> list[Expression]:
    """L or M of q* / |q*| of every reference state, (13, N + 1), side by side: (4, 4 (N + 1)); none for "plain"."""
    if kind == "plain":
        return []
    matrix = {"body": left_matrix, "world": right_matrix}[kind]

    def frame(q: Expression) -> Expression:
        return matrix(unit(q))

    return [ca.horzcat(*(as_scalars(frame)(x[ATTITUDE]) for x in ca.horzsplit(X_ref)))]


def _into(L: Expression, rows: Expression) -> Expression:
    """Rows of a state-sized matrix, from the quaternion's coordinates into the error's."""
    before, attitude, after = ca.vertsplit(rows, [0, ATTITUDE.start, ATTITUDE.stop, rows.size1()])
    return ca.vertcat(before, L.T @ attitude, after)


def _out_of(L: Expression, rows: Expression) -> Expression:
    return _into(L.T, rows)


def _turned(L: Expression, L_next: Expression, A: Expression, B: Expression, b: Expression) -> list[Expression]:
    """A, B, b of one node between the coordinates of its two ends."""
    return [_into(L_next, _into(L, A.T).T), _into(L_next, B), _into(L_next, b)]
