"""Flatness-based control (Sun et al. 2022, (13)-(31)).

p_r .. s_r: position to snap of the reference, psi_r its heading; f_a, tau_a: force and torque of the air by the model
at the present velocity; d_F, d_tau: assumed disturbance; T: collective thrust that the rotors deliver now; z = R e_z.

    a_d = K_p (p_r - p) + K_v (v_r - v) + a_r,         T_d z_d = m (a_d - g) - f_a - d_F                     (13), (14)
    y_d = z_d x x_C / |.|,  x_d = y_d x z_d,           x_C = [cos psi_r, sin psi_r, 0]                       (15)-(17)
    T' = m j_r . z,   T'' = m s_r . z + m (w x z) . j_r                                                      (23), (24)
    h = (m j_r - T' z) / T,   w_r = [-h . y, h . x, psi_r' e_z . z]                                          (19), (20)
    h_a = m s_r / T - (w x (w x z) + 2 T'/T w x z + T''/T z)                                                 (21)
    alpha_r = [-h_a . y, h_a . x, psi_r'' e_z . z]                                                           (22)
    alpha_d = k_t e_tilt + k_y e_yaw + K_w (w_r - w) + alpha_r                                               (28)
    u = argmin_{l <= u <= h} |[T_d; J alpha_d + w x J w - tau_a - d_tau] - G u|_W                            (31)

The error of attitude is that of q^-1 o q_d, in body axes, split into tilt and yaw ((25)-(27)) and counted double, since
the vector part of a quaternion is half an angle; printed are q_d o q^-1 and the single vector part, with which their
gains do not fly. With r = R' z_d and the angle phi of R' R_d about z_body

    e_tilt = 2 [-r_y, r_x, 0] / sqrt(2 (1 + r_z)),    e_yaw = 2 sin(phi / 2) e_z

Rates and accelerations are fed forward at the present attitude and thrust, which stays right off the reference. y_d
turns by 180 degrees where z_d passes the horizon; upside down the side that is nearer to the present y is taken.

World ENU, body FLU, SI.
"""

from __future__ import annotations

from typing import Any, Literal

from quadexp.compile.symbolic import ca
from quadexp.control.base import N_BELIEF
from quadexp.control.inputs import Inputs
from quadexp.control.law import Law
from quadexp.control.part import RESIDUAL
from quadexp.models.residual import N_OUTPUTS
from quadexp.parts.settings import Setting, Triple, key, keyed
from quadexp.physics.expression import Expression, limited, symbols
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.laws.allocation import allocation

WRENCH_WEIGHT = Setting(
    "weight of the squared error of collective thrust (N^-2) and of roll, pitch, yaw torque ((N m)^-2) where the rotors"
    " cannot give all of them",
    "(0, 1e6]",
    when="allocation=exact",
)
Wrench = tuple[float, float, float, float]
TILT_FIRST: Wrench = (0.001, 10.0, 10.0, 0.1)  # of Sun et al. 2022

AT_LIMIT = 1e-9  # of the thrust range
OPPOSITE = 1e-6  # least 1 + r_z: a tilt error of 180 degrees has no axis
SMALL = 1e-9  # of a length, below which a direction is not determined


@keyed
class FlatnessBased(Law):
    """Flatness-based control (Sun et al. 2022), its gains of Table I; it needs position and heading of the reference.
    residual: its model of the air."""

    former_kind = "dfbc"
    logged = ("error_tilt", "error_yaw")
    nodes = (0.0, 1.0)  # of which the thrust now is read when a flight begins
    symbols = ca.MX
    air_thrusts = "delivered"

    residual: str = key("none", RESIDUAL)
    rate: float = key(300.0, "control rate", "[1, 2000]", "Hz")
    position_gain: Triple = key(
        (10.0, 10.0, 10.0), "acceleration per position error, world axes", "[0, 1e4]", "1/s^2", tuned="1..50:log"
    )
    velocity_gain: Triple = key(
        (6.0, 6.0, 6.0), "acceleration per velocity error, world axes", "[0, 1e4]", "1/s", tuned="1..30:log"
    )
    tilt_gain: float = key(150.0, "angular acceleration per tilt error", "[0, 1e5]", "1/s^2", tuned="30..1000:log")
    yaw_gain: float = key(3.0, "angular acceleration per yaw error", "[0, 1e5]", "1/s^2")
    rate_gain: Triple = key(
        (20.0, 20.0, 8.0), "angular acceleration per body rate error", "[0, 1e4]", "1/s", tuned="5..100:log"
    )
    wrench_weight: Wrench = key(TILT_FIRST, WRENCH_WEIGHT)
    allocation: Literal["exact", "clip"] = key(
        "exact", "exact: thrusts of the least weighted error within the limits; clip: each clipped by itself"
    )
    inverted: Literal["continuous", "printed"] = key(
        "continuous",
        "upside down, continuous: y_body stays on its side; printed: turned by 180 degrees past the horizon",
    )
    least_thrust: float = key(
        0.07, "thrust, as a share of the weight, below which body rates are fed forward as at this one", "(0, 1]"
    )

    def equations(self, vehicle: Vehicle, inputs: Inputs, memory: Any) -> dict[str, Any]:
        """See Law; (13) to (31); errors of tilt and yaw (rad)."""
        arguments = symbols(
            ca.SX, x=N_STATE, path=(3, 5), yaw=3, delivered=vehicle.n_rotors, belief=N_BELIEF, air=N_OUTPUTS
        )
        results = ca.cse(_wrench(vehicle, self, *arguments))
        wanted = ca.Function("dfbc_wrench", arguments, results)
        of_belief = inputs.symbol("belief")
        wrench, angle = wanted(inputs.state, inputs.path, inputs.heading, inputs.delivered, of_belief, inputs.air)
        thrust = allocation(vehicle, self.allocation, self.wrench_weight)(wrench / inputs.belief.thrust_scale)
        margin = AT_LIMIT * (vehicle.thrust_max - vehicle.thrust_min)
        low = vehicle.thrust_min + margin
        high = vehicle.thrust_max - margin
        held = ca.sum1(ca.logic_or(thrust < low, thrust > high))
        return {"command": thrust, "held": held, "error_tilt": angle[0], "error_yaw": angle[1]}


def _wrench(
    vehicle: Vehicle,
    keys: FlatnessBased,
    x: Expression,
    path: Expression,
    yaw: Expression,
    delivered: Expression,
    belief: Expression,
    air: Expression,
) -> list[Expression]:
    """Wanted thrust and torques (4,), and the errors of tilt and yaw (2,). air: by the model, (6,)."""
    m = vehicle.mass
    J = ca.DM(vehicle.inertia_matrix)
    up = ca.DM([0, 0, 1])
    R = rotation_matrix(x[ATTITUDE])
    w = x[RATE]
    x_b, y_b, z_b = ca.horzsplit(R)
    p_r, v_r, a_r, j_r, s_r = ca.horzsplit(path)

    a_d = ca.DM(keys.position_gain) * (p_r - x[POSITION])
    a_d += ca.DM(keys.velocity_gain) * (v_r - x[VELOCITY])
    a_d += a_r
    force = m * (a_d + vehicle.gravity * up) - m * (R @ air[:3]) - belief[:3]
    T_d = ca.norm_2(force)
    z_d = force / ca.fmax(T_d, SMALL)
    x_c = ca.vertcat(ca.cos(yaw[0]), ca.sin(yaw[0]), 0)
    y_d = ca.cross(z_d, x_c)
    y_d = y_d / ca.fmax(ca.norm_2(y_d), SMALL)
    if keys.inverted == "continuous":
        upside_down = ca.fmin(z_d[2], z_b[2]) < 0
        changes = ca.logic_and(upside_down, ca.dot(y_d, y_b) < 0)
        y_d = ca.if_else(changes, -1, 1) * y_d

    T = ca.fmax(ca.sum1(delivered), keys.least_thrust * m * vehicle.gravity)
    turning = ca.cross(R @ w, z_b)  # z', world
    T_1 = m * ca.dot(j_r, z_b)
    T_2 = m * ca.dot(s_r, z_b) + m * ca.dot(turning, j_r)
    h = (m * j_r - T_1 * z_b) / T
    w_r = ca.vertcat(-ca.dot(h, y_b), ca.dot(h, x_b), yaw[1] * z_b[2])
    of_thrust = ca.cross(R @ w, turning) + 2 * T_1 / T * turning + T_2 / T * z_b
    h_a = m * s_r / T - of_thrust
    alpha_r = ca.vertcat(-ca.dot(h_a, y_b), ca.dot(h_a, x_b), yaw[2] * z_b[2])

    error = R.T @ ca.horzcat(ca.cross(y_d, z_d), y_d, z_d)
    r = error[:, 2]
    tilt = 2 * ca.vertcat(-r[1], r[0]) / ca.sqrt(2 * ca.fmax(1 + r[2], OPPOSITE))
    turn = ca.atan2(error[1, 0] - error[0, 1], error[0, 0] + error[1, 1])
    alpha = ca.vertcat(keys.tilt_gain * tilt, keys.yaw_gain * 2 * ca.sin(turn / 2))
    alpha += ca.DM(keys.rate_gain) * (w_r - w) + alpha_r
    torque = J @ alpha + ca.cross(w, J @ w) - air[3:] - belief[3:6]
    angle = ca.acos(limited(r[2], -1, 1))
    return [ca.vertcat(T_d, torque), ca.vertcat(angle, turn)]
