"""A flight stack's cascade, as PX4's multicopter modules have it, with physical units and this program's frames.

Position to velocity, P, the way to the reference before its velocity where the limit does not allow both; z clipped:

    v_c = K_p (p_r - p) + v_r                                                                                       (1)

Velocity to acceleration, PID, and from there to tilt and collective thrust f (per mass), tilt limited:

    a_c = a_r + K_v (v_c - v) + I - K_d v'_f,    z_d = (a_x, a_y, g)/|.|,    f = z_d (a_z + g)/(z_d . e_z)          (2)

f is cut to the largest thrust, the vertical first but for a margin of the horizontal. The integral I: vertical not
while saturated; horizontal by back-calculation, I' = K_i (v_c - v - 2/K_v (a_c - a_s)), a_s what the limits leave of
a_c. (PX4 compares a_c with f g/hover thrust, and relies on its estimate of the hover thrust: without one, a constant
vertical force would look like a saturation and leave a horizontal offset.)

Attitude to rate, P on a quaternion: first the shortest rotation of z to z_d, then a share of the remaining yaw:

    q_m = q_red^-1 o q_d,   q_d' = q_red o (cos(w_y acos q_m,w), 0, 0, sin(w_y asin q_m,z)),
    w_c = 2 K_a vec(q^-1 o q_d') + yaw' R^T e_z                                                                     (3)

Rate to torque, PID with a filtered derivative: tau = J (K_r (w_c - w) + I_w - D w'_f), I_w' = i K_i (w_c - w), with
i = max(0, 1 - ((w_c - w)/400 deg/s)^2), and 0 where an axis is saturated that way. Mixer: allocation.py.

Not in it: estimators, filters of the gyro, hover thrust estimate, thrust curve, ground handling. Rates of loops: one.

Source: PX4-Autopilot, mc_pos_control (PositionControl), mc_att_control (AttitudeControl), rate_control,
control_allocator (sequential desaturation); equations taken, code our own. World ENU, body FLU, SI.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.inputs import Inputs
from quadexp.control.law import Law
from quadexp.control.laws.explicit import Rate
from quadexp.parts.settings import Triple, key, keyed
from quadexp.physics.expression import Expression, limited
from quadexp.physics.low_pass import low_pass
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.laws.allocation import prioritised
from quadexp.plugins.laws.attitude import attitude_of

RATE_ERROR = math.radians(400.0)  # rad/s, at which the rate loop no longer integrates
# Share of the largest torque that the mixer leaves out, from which on an axis counts as saturated: above the rounding
# of single precision.
SATURATED = 1e-5


@keyed
class Cascade(Law):
    """The cascade of P and PID loops of a flight stack, fed with position, velocity, acceleration and yaw; PX4's
    defaults where they have a physical unit."""

    former_kind = "cascade"
    memory = dict.fromkeys(
        ("velocity_integral", "velocity", "velocity_filter", "rate_integral", "rate", "rate_filter"), 3
    )
    logged = ("velocity_integral", "rate_integral")

    rate: Rate = 200.0
    position_proportional: Triple = key(
        (0.95, 0.95, 1.0), "wanted velocity per position error", "[0, 100]", "1/s", tuned="0.3..6:log"
    )
    velocity_proportional: Triple = key(
        (1.8, 1.8, 4.0), "acceleration per velocity error", "[0, 100]", "1/s", tuned=".xy=0.5..15:log .z=1..20:log"
    )
    velocity_integral: Triple = key(
        (0.4, 0.4, 2.0), "rate of the integral per velocity error", "[0, 100]", "1/s^2", tuned="0.05..10:log"
    )
    velocity_derivative: Triple = key((0.2, 0.2, 0.0), "acceleration per filtered acceleration", "[0, 10]")
    attitude_proportional: Triple = key(
        (6.5, 6.5, 2.8), "wanted rate per attitude error: roll, pitch, yaw", "[0, 100]", "1/s", tuned="2..30:log"
    )
    yaw_weight: float = key(0.4, "weight of yaw against tilt in the attitude error", "[0, 1]")
    rate_proportional: Triple = key(
        (20.0, 20.0, 8.0), "angular acceleration per rate error", "[0, 1000]", "1/s", tuned="5..100:log"
    )
    rate_integral: Triple = key(
        (27.0, 27.0, 4.0), "rate of the integral per rate error: roll, pitch, yaw", "[0, 10000]", "1/s^2"
    )
    rate_derivative: Triple = key((0.4, 0.4, 0.0), "angular acceleration per filtered angular acceleration", "[0, 10]")
    velocity_cutoff: float = key(5.0, "cutoff of the filter on the acceleration", "(0, 1000]", "Hz")
    rate_cutoff: float = key(30.0, "cutoff of the filter on the angular acceleration", "(0, 1000]", "Hz")
    velocity_limit: Triple = key((20.0, 10.0, 10.0), "largest wanted velocity: horizontal, up, down", "(0, 100]", "m/s")
    tilt_limit: float = key(1.4, "largest wanted tilt", "(0, 1.57]", "rad")
    rate_limit: Triple = key((10.0, 10.0, 5.0), "largest wanted body rates", "(0, 100]", "rad/s")
    thrust_least: float = key(0.2, "least wanted collective thrust", "(0, 1]", "of the weight")
    horizontal_margin: float = key(
        0.3, "thrust kept for the horizontal where the vertical needs all", "[0, 1]", "of the largest thrust"
    )
    decoupled: bool = key(
        True, "the tilt assumes a vertical specific force of g, so that the vertical does not change it"
    )
    rate_integral_limit: Triple = key(
        (40.0, 40.0, 40.0), "largest integral of the rate loop, angular acceleration", "[0, 1e4]", "rad/s^2"
    )
    airmode: bool = key(False, "thrust may be raised where roll and pitch need it")
    yaw_margin: float = key(0.15, "thrust that yaw may take away at the upper limit", "[0, 1]", "of the range")
    rate_feedforward: bool = key(
        False, "add the reference's body rates to the wanted ones; flight stacks take none but the yaw rate"
    )

    def start(self, vehicle: Vehicle, x: np.ndarray) -> dict[str, np.ndarray]:
        """See Law: integrals and derivatives are zero."""
        return {"velocity": x[VELOCITY], "rate": x[RATE]}

    def equations(self, vehicle: Vehicle, inputs: Inputs, memory: Any) -> dict[str, Any]:
        """See Law; (1) to (3)."""
        period = inputs.period
        g = vehicle.gravity
        x = inputs.state
        state = inputs.reference
        path = inputs.path
        yaw = inputs.heading
        R = rotation_matrix(x[ATTITUDE])
        v = x[VELOCITY]
        w = x[RATE]
        change = (v - memory.velocity) / period
        turn = (w - memory.rate) / period
        acceleration, of_velocity = filtered(memory.velocity_filter, change, self.velocity_cutoff, period)
        turning, of_rate = filtered(memory.rate_filter, turn, self.rate_cutoff, period)

        towards = ca.DM(self.position_proportional) * (path[:, 0] - x[POSITION])
        v_c = wanted_velocity(towards, path[:, 1], self.velocity_limit)
        error = v_c - v
        a_c = path[:, 2] + ca.DM(self.velocity_proportional) * error + memory.velocity_integral
        a_c -= ca.DM(self.velocity_derivative) * acceleration
        f, uncut, produced = wanted_thrust(a_c, vehicle, self)
        top = vehicle.n_rotors * vehicle.thrust_max / vehicle.mass
        at_least = ca.logic_and(uncut[2] <= self.thrust_least * g, error[2] <= 0)
        at_most = ca.logic_and(uncut[2] >= top, error[2] >= 0)
        stuck = ca.logic_or(at_least, at_most)
        short = 2 / max(self.velocity_proportional[0], 1e-6) * (a_c[:2] - produced)
        back = ca.vertcat(error[:2] - short, ca.if_else(stuck, 0, error[2]))
        integral = memory.velocity_integral + period * ca.DM(self.velocity_integral) * back
        integral = ca.vertcat(integral[:2], limited(integral[2], -g, g))

        R_d = attitude_of(f, rotation_matrix(state[ATTITUDE]) @ ca.DM([1, 0, 0]))
        w_c = wanted_rate(R, R_d, self)
        if self.rate_feedforward:
            w_c += state[RATE]
        else:
            w_c += R[2, :].T * yaw[1]
        limit = ca.DM(self.rate_limit)
        w_c = limited(w_c, -limit, limit)
        slow = w_c - w
        angular = ca.DM(self.rate_proportional) * slow + memory.rate_integral
        angular -= ca.DM(self.rate_derivative) * turning
        torque = vehicle.inertia_matrix @ angular
        thrust = vehicle.mass * ca.norm_2(f)
        u = prioritised(vehicle, ca.vertcat(thrust, torque), airmode=self.airmode, yaw_margin=self.yaw_margin)
        lacking = torque - vehicle.allocation[1:] @ u
        scale = SATURATED * vehicle.thrust_max * float(np.abs(vehicle.allocation[1:]).max())
        backwards = ca.if_else(lacking < -scale, ca.fmax(slow, 0), slow)
        slow = ca.if_else(lacking > scale, ca.fmin(slow, 0), backwards)
        share = ca.fmax(0, 1 - (slow / RATE_ERROR) ** 2)
        bound = ca.DM(self.rate_integral_limit)
        rate_integral = memory.rate_integral + period * share * ca.DM(self.rate_integral) * slow
        rate_integral = limited(rate_integral, -bound, bound)

        return {
            "command": u,
            "velocity_integral": integral,
            "velocity": v,
            "velocity_filter": of_velocity,
            "rate_integral": rate_integral,
            "rate": w,
            "rate_filter": of_rate,
        }


def filtered(memory: Expression, value: Expression, cutoff: float, period: float) -> tuple[Expression, Expression]:
    """What a low pass (physics/low_pass.py) makes of a value, and its memory for the next; cutoff: Hz."""
    decay, before, now = low_pass(cutoff, period)
    passed = now * value + memory
    return passed, before * value + decay * passed


def wanted_velocity(towards: Expression, reference: Expression, limit: tuple[float, float, float]) -> Expression:
    """v_c, (3,), world: `towards` the reference's position before the reference's own velocity, (3,) each (m/s).

    limit: horizontal, up, down. Horizontally as much of `reference` is added as keeps the sum within the limit.
    """
    first = towards[:2]
    second = reference[:2]
    a = ca.sumsqr(second)
    b = ca.dot(first, second)
    c = ca.sumsqr(first) - limit[0] ** 2
    inside = c < 0  # of the way to the reference alone
    root = ca.sqrt(ca.fmax(b**2 - a * c, 0))
    share = (-b + root) / ca.fmax(a, 1e-12)
    within = first + limited(share, 0, 1) * second
    shortened = first * limit[0] / ca.fmax(ca.norm_2(first), 1e-12)
    horizontal = ca.if_else(inside, within, shortened)
    climb = towards[2] + reference[2]
    vertical = limited(climb, -limit[2], limit[1])
    return ca.vertcat(horizontal, vertical)


def wanted_thrust(a: Expression, vehicle: Vehicle, keys: Cascade) -> tuple[Expression, Expression, Expression]:
    """f of (2) within the thrust that there is, and before that, (3,) each, world, per mass (m/s^2); and what the
    limits of tilt and thrust leave of the wanted horizontal acceleration, (2,) (m/s^2)."""
    g = vehicle.gravity
    top = vehicle.n_rotors * vehicle.thrust_max / vehicle.mass
    vertical = g
    if not keys.decoupled:
        vertical = ca.fmax(a[2] + g, 1e-3)
    size = ca.norm_2(a[:2])
    widest = math.tan(keys.tilt_limit) * vertical
    level = a[:2] * ca.fmin(1, widest / ca.fmax(size, 1e-12))
    z = ca.vertcat(level, vertical)
    z = z / ca.norm_2(z)
    f = z * ca.fmax((a[2] + g) / z[2], keys.thrust_least * g)
    sideways = ca.norm_2(f[:2])
    most = ca.sqrt(top**2 - ca.fmin(sideways, keys.horizontal_margin * top) ** 2)
    up = ca.fmin(f[2], most)
    room = ca.sqrt(ca.fmax(top**2 - up**2, 0))
    share = ca.fmin(1, room / ca.fmax(sideways, 1e-12))
    return ca.vertcat(share * f[:2], up), f, share * level


def wanted_rate(R: Expression, R_d: Expression, keys: Cascade) -> Expression:
    """w_c of (3), (3,), body (rad/s), without feed-forward."""
    weight = keys.yaw_weight
    z_d = R.T @ R_d[:, 2]  # in the body; the shortest rotation takes e_z there
    turn = ca.sqrt(ca.fmax((1 + z_d[2]) / 2, 1e-12))
    reduced = ca.vertcat(turn, -z_d[1] / (2 * turn), z_d[0] / (2 * turn), 0)  # q^-1 o q_red
    mixed = rotation_matrix(reduced).T @ (R.T @ R_d)  # about z by the rest of the yaw
    angle = weight * ca.atan2(mixed[1, 0] - mixed[0, 1], mixed[0, 0] + mixed[1, 1])
    c = ca.cos(angle / 2)
    s = ca.sin(angle / 2)
    roll = reduced[1] * c + reduced[2] * s
    pitch = reduced[2] * c - reduced[1] * s
    error = ca.vertcat(roll, pitch, reduced[0] * s)
    sign = ca.if_else(reduced[0] * c < 0, -1, 1)
    proportional = np.array(keys.attitude_proportional, float)
    if weight > 1e-4:
        proportional[2] /= weight
    return 2 * sign * ca.DM(proportional) * error
