"""Differential flatness of a multirotor with given lateral accelerations by the air.

Newton's law with the residual acceleration a_air of the air, seen in the tilt frame R_t (z along the rotors' axis):

    f := R_t^T (a - g) = (l_x, l_y, c),    T = m (c - a_air,z)                                                  (1)

The attitude is such that the specific force a - g (world, from the trajectory) has the lateral components l that the
air provides; |f| = |a - g| determines c > 0. The body frame is R = R_t R_z(chi).

Tilt: R_t rotates about a horizontal axis only (Watterson & Kumar 2017). Of all rotations that take f to F = a - g,
q = p (1 + f.F, f x F) + r (0, f + F) for unit f and F, it is the one with q_z = 0:  p = (f + F)_z, r = -(f x F)_z.  (2)
Regular but upside down. Its rate o, from the derivative of (1) with jerk j and of q_z = 0, and o', with snap s:

    (o x f)_xy  = (R_t^T j)_xy - l',                                (-q_y, q_x, q_w) . o  = 0                     (3)
    (o' x f)_xy = (R_t^T s - o x (2 R_t^T j - o x f))_xy - l'',     (-q_y, q_x, q_w) . o' = 0                     (4)

Twist: body rates w = R_z(-chi) o + (0, 0, chi'). Either the heading is free, and the body does not rotate about the
rotors' axis: w_z = 0, chi' = -o_z. Or a yaw is prescribed, and y_body is level against x_C = (cos yaw, sin yaw, 0):
y_body . x_C = 0 (Mellinger & Kumar 2011), whence with h = R^T x_C, e = R^T y_C

    (w x h)_y = yaw' e_y,    (w' x h)_y = yaw'' e_y - 2 yaw' (w x e)_y + (w x (w x h))_y                          (5)

World ENU, body FLU, SI. Arrays are component first, (3, k) for k times, so that every component is contiguous.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

UPSIDE_DOWN = 1e-44  # square of the quaternion before it is normed, for a specific force 1e-7 rad from straight down
SINGULAR = 1e-9  # share of the thrust's direction below which that of the tilt frame is not determined
PITCHED = np.array([[0.0], [0.0], [1.0]])  # half a turn about y


def stacked(*components: np.ndarray) -> np.ndarray:
    """Components, (k,) each, as one array (d, k); several times quicker than np.stack."""
    if any(type(component) is not np.ndarray for component in components):
        return np.stack(components)
    result = np.empty((len(components), *components[0].shape))
    for row, component in zip(result, components, strict=True):
        row[...] = component
    return result


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b, (3, k); several times faster than np.cross."""
    return stacked(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def untwisted(vector: np.ndarray, chi: np.ndarray) -> np.ndarray:
    """R_z(chi) vector: a body vector in tilt-frame coordinates; (2, k) or (3, k), chi (k,) rad."""
    cosine = np.cos(chi)
    sine = np.sin(chi)
    return stacked(cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1], *vector[2:])


def twisted(vector: np.ndarray, chi: np.ndarray) -> np.ndarray:
    """R_z(-chi) vector: a tilt-frame vector in body coordinates; (2, k) or (3, k), chi (k,) rad."""
    return untwisted(vector, -chi)


@dataclass(frozen=True)
class Tilt:
    """Tilt frames at k times.

    quaternion: q_w, q_x, q_y (q_z is zero), (3, k). force: f of (1), (3, k), m/s^2.
    """

    quaternion: np.ndarray
    force: np.ndarray

    def into_frame(self, vector: np.ndarray) -> np.ndarray:
        """R_t^T vector, (3, k), of world vectors (3, k)."""
        w, x, y = self.quaternion
        a, b, c = vector
        upright = 1 - 2 * (x * x + y * y)
        around = 2 * (x * a + y * b)
        up = 2 * w * c
        return stacked(
            a * upright + x * around - y * up, b * upright + y * around + x * up, c * upright + 2 * w * (y * a - x * b)
        )

    def solve(self, p_x: np.ndarray | float, p_y: np.ndarray | float) -> np.ndarray:
        """The o, (3, k), with (o x f)_xy = p and (-q_y, q_x, q_w) . o = 0."""
        w, x, y = self.quaternion
        l_x, l_y, c = self.force
        along = w * c + x * l_y - y * l_x  # zero upside down, where a motion in a vertical plane has no numerator
        along = np.where(np.abs(along) < SINGULAR * c, SINGULAR * c, along)
        o_z = -(x * p_x + y * p_y) / along
        return stacked((l_x * o_z - p_y) / c, (l_y * o_z + p_x) / c, o_z)

    def rates(
        self, jerk: np.ndarray, snap: np.ndarray, lateral_1: np.ndarray, lateral_2: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rate o (rad/s) and its derivative o' (rad/s^2) of the tilt frame, (3, k) each: equations (3), (4).

        jerk, snap: (3, k), world. lateral_1, lateral_2: l' (m/s^3), l'' (m/s^4), (2, k).
        """
        jerk = self.into_frame(jerk)
        snap = self.into_frame(snap)
        o = self.solve(*(jerk[:2] - lateral_1))
        coupling = cross(o, 2 * jerk - cross(o, self.force))
        return o, self.solve(*((snap - coupling)[:2] - lateral_2))

    def heading_twist(self, yaw: np.ndarray) -> np.ndarray:
        """The chi, (k,) (rad), that makes y_body level against x_C for the yaw (k,) (rad)."""
        x_c = self.into_frame(np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)]))
        return np.arctan2(x_c[1], x_c[0])

    def body_quaternion(self, chi: np.ndarray) -> np.ndarray:
        """Body to world, Hamilton, w first, (4, k)."""
        w, x, y = self.quaternion
        c = np.cos(chi / 2)
        s = np.sin(chi / 2)
        return np.stack([w * c, x * c + y * s, y * c - x * s, w * s])


def tilt(specific_force: np.ndarray, lateral: np.ndarray) -> Tilt:
    """Tilt frames in which the specific force has the given lateral components: equation (2).

    specific_force: a - g, (3, k), world (m/s^2). lateral: l, (2, k), tilt frame (m/s^2).
    There is none in free fall, upside down and where l exceeds the specific force: c or q_w is then not above zero,
    which the caller must check. Upside down, where any horizontal axis would do, it is that of pitch.
    """
    size = np.sqrt((specific_force**2).sum(axis=0))
    force = np.stack([*lateral, np.sqrt(np.maximum(size**2 - (lateral**2).sum(axis=0), 0.0))])
    with np.errstate(divide="ignore", invalid="ignore"):
        before = force / size
        after = specific_force / size
        turn = cross(before, after)
        middle = before + after
        w = middle[2] * (1 + (before * after).sum(axis=0))
        quaternion = np.stack([w, *(middle[2] * turn - turn[2] * middle)[:2]])
        square = (quaternion**2).sum(axis=0)
        return Tilt(np.where(square < UPSIDE_DOWN, PITCHED, quaternion / np.sqrt(square)), force)


def free_body_rates(o: np.ndarray, o_dot: np.ndarray, chi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Body rate w and w', (3, k) each, for w_z = 0 and the twist chi, (k,) (rad)."""
    w = twisted(o, chi)
    w_dot = twisted(o_dot, chi)
    w[2] = w_dot[2] = 0.0
    _add_turn(w_dot, w, -o[2])
    return w, w_dot


def heading_body_rates(
    frame: Tilt, o: np.ndarray, o_dot: np.ndarray, chi: np.ndarray, yaw: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Body rate w and w', (3, k) each, for a prescribed yaw: equation (5).

    chi: of Tilt.heading_twist. yaw: (3, k): rad, rad/s, rad/s^2.
    """
    cosine = np.cos(yaw[0])
    sine = np.sin(yaw[0])
    zero = np.zeros_like(cosine)
    h = twisted(frame.into_frame(np.stack([cosine, sine, zero])), chi)
    e = twisted(frame.into_frame(np.stack([-sine, cosine, zero])), chi)
    w = twisted(o, chi)
    w_dot = twisted(o_dot, chi)
    w[2] = (yaw[1] * e[1] + w[0] * h[2]) / h[0]
    _add_turn(w_dot, w, w[2] - o[2])
    right = yaw[2] * e[1] - 2 * yaw[1] * cross(w, e)[1] + cross(w, cross(w, h))[1]
    w_dot[2] = (right + w_dot[0] * h[2]) / h[0]
    return w, w_dot


def _add_turn(w_dot: np.ndarray, w: np.ndarray, chi_dot: np.ndarray) -> None:
    """Add to w' the effect of the twist rate on the lateral rates: -chi' e_z x w."""
    w_dot[0] += chi_dot * w[1]
    w_dot[1] -= chi_dot * w[0]
