"""Geometric tracking control on SE(3) (Lee, Leok, McClamroch 2010), with a model of the air and an adaptive variant.

e_p = p - p_r, e_v = v - v_r; R_r, w_r, u_r: attitude, body rate and thrusts of the reference, exact by flatness, with
the air where the controller knows it; F_m, tau_m: force and torque of the air by the model, d_F, d_tau: assumed
disturbance.

    F   = m (a_r - g - K_x e_p - K_v e_v) - F_m - d_F - m theta_F,     T = F . R e_z                                (1)
    R_d : z along F, heading as R_r (attitude.py);      w_d, w_d' its exact rate along the closed loop
    e_R = 1/2 vee(R_d' R - R' R_d),    e_w = w - R' R_d w_d
    tau = J (-K_R e_R - K_w e_w - (w x R' R_d w_d - R' R_d w_d') - theta_tau) + w x J w - tau_m - d_tau            (2)

K_x = W^2, K_v = 2 zeta W are diagonal, in world axes (K_R, K_w in body axes), and multiply mass and inertia: with W_R
the attitude error obeys e_w' = -W_R^2 e_R - 2 zeta W_R e_w on every vehicle. Lee et al. have scalar k_R, k_w instead.

The exact rate needs F', F''. With f = T_r R_r e_z the reference's own force, which contains the air, of

    F' = f' - m (K_x e_v + K_v e_a),   F'' = f'' - m (K_x e_a + K_v e_j),   e_a = (T R e_z + F_m + d_F)/m + g - a_r,
    e_j = (T' R e_z + T R (w x e_z) - f')/m,    T' = F' . R e_z + F . R (w x e_z)

f' and f'' across z_r follow from w_r, w_r'; along z_r from jerk and snap, which on the reference does not turn F. So
w_d is exact without air, and on the reference with it; off the reference the derivative of F_m is neglected.

A command is held for a control period; the reference's wrench in the middle of it is used: [T; tau] += G (u_m - u_r).

Adaptation (Goodarzi, Lee, Lee 2015), with W_F = W_tau = 1, held within balls:

    theta_F' = gamma_F (e_v + c_1 e_p),    theta_tau' = gamma_tau (e_w + c_2 e_R)                                   (3)

World ENU, body FLU, SI.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.allocation import clipped
from quadexp.control.inputs import Inputs
from quadexp.control.law import Law
from quadexp.control.part import RESIDUAL
from quadexp.parts.settings import Triple, key, keyed
from quadexp.physics.expression import Expression
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.laws.allocation import prioritised
from quadexp.plugins.laws.attitude import attitude_distance, attitude_error, moving_attitude

E_X = ca.DM([1, 0, 0])
E_Z = ca.DM([0, 0, 1])


@keyed
class Geometric(Law):
    """Geometric tracking on SE(3) (Lee, Leok, McClamroch 2010). residual: its model of the air."""

    former_kind = "geometric"
    memory = {"theta_force": 3, "theta_torque": 3}  # m/s^2, rad/s^2
    logged = ("psi",)

    residual: str = key("none", RESIDUAL)
    position_bandwidth: Triple = key(
        (4.0, 4.0, 4.0), "w: k_x = m w^2, k_v = 2 m damping w", "[0, 100]", "rad/s", tuned="1..20:log"
    )
    position_damping: float = key(0.9, "damping ratio of the position loop", "[0, 10]", tuned="0.3..3:log")
    attitude_bandwidth: Triple = key(
        (14.0, 14.0, 6.0), "w: k_R = J w^2, k_w = 2 J damping w", "[0, 1000]", "rad/s", tuned="5..60:log"
    )
    attitude_damping: float = key(0.9, "damping ratio of the attitude loop", "[0, 10]", tuned="0.3..3:log")
    rates: Literal["exact", "reference", "none"] = key(
        "reference",
        "desired body rate: exact: of the desired attitude (Lee et al.); reference: without feedback; none: zero",
    )
    priority: Literal["tilt", "equal"] = key(
        "tilt", "where rotors reach their limits: tilt before thrust before yaw, or each rotor clipped by itself"
    )
    force_adaptation: float = key(
        0.0, "gain of the estimate of a constant acceleration (Goodarzi et al. 2015); 0: none", "[0, 1000]", "1/s^2"
    )
    torque_adaptation: float = key(
        0.0, "gain of the estimate of a constant angular acceleration; 0: none", "[0, 1e5]", "1/s^2"
    )
    position_share: float = key(
        2.0, "c_1: share of the position error in the adaptation", "[0, 100]", "1/s", when="force_adaptation"
    )
    attitude_share: float = key(
        7.0, "c_2: share of the attitude error in the adaptation", "[0, 1000]", "1/s", when="torque_adaptation"
    )
    force_limit: float = key(5.0, "largest acceleration that is adapted", "[0, 100]", "m/s^2", when="force_adaptation")
    torque_limit: float = key(
        50.0, "largest angular acceleration that is adapted", "[0, 1e4]", "rad/s^2", when="torque_adaptation"
    )

    def equations(self, vehicle: Vehicle, inputs: Inputs, memory: Any) -> dict[str, Any]:
        """See Law; (1) to (3)."""
        m = vehicle.mass
        J = ca.DM(vehicle.inertia_matrix)
        x = inputs.state
        state = inputs.reference
        thrust = inputs.thrusts
        path = inputs.path
        belief = inputs.belief
        air = inputs.air
        air_r = inputs.air_reference
        gravity = ca.DM([0, 0, -vehicle.gravity])
        G = ca.DM(vehicle.allocation)
        K_x, K_v, K_R, K_w = gains(self)

        R = rotation_matrix(x[ATTITUDE])
        w = x[RATE]
        R_r = rotation_matrix(state[ATTITUDE])
        w_r = state[RATE]
        wrench_r = G @ thrust
        torque_r = wrench_r[1:] + air_r[3:] - ca.cross(w_r, J @ w_r)
        w_r_dot = ca.inv(J) @ torque_r
        e_p = x[POSITION] - path[:, 0]
        e_v = x[VELOCITY] - path[:, 1]

        # Force per mass, and its derivatives along the closed loop.
        known = R @ air[:3] + belief.force / m
        force = path[:, 2] - gravity - K_x * e_p - K_v * e_v - known - memory.theta_force
        heading = _turning(R_r, w_r, w_r_dot, E_X)
        if self.rates == "none":
            still = ca.SX(3, 1)
            forces = (force, still, still)
            heading = (heading[0], still, still)
        elif self.rates == "reference":
            forces = (force, ca.SX(3, 1), ca.SX(3, 1))
        else:
            first, second = _reference_derivatives(wrench_r[0] / m, R_r, w_r, w_r_dot, path)
            z = R[:, 2]
            z_dot = R @ ca.cross(w, E_Z)
            e_a = ca.dot(force, z) * z + known + gravity - path[:, 2]
            after = first - K_x * e_v - K_v * e_a
            along = ca.dot(after, z) + ca.dot(force, z_dot)
            e_j = along * z + ca.dot(force, z) * z_dot - first
            forces = (force, after, second - K_x * e_a - K_v * e_j)
        R_d, w_d, w_d_dot = moving_attitude(forces, heading)
        if self.rates == "reference":
            w_d = w_r
            w_d_dot = w_r_dot
        turn = R.T @ R_d
        e_R = attitude_error(R, R_d)
        e_w = w - turn @ w_d
        spin = -ca.cross(w, turn @ w_d) + turn @ w_d_dot
        turning = spin - K_R * e_R - K_w * e_w - memory.theta_torque
        gyroscopic = ca.cross(w, J @ w)
        torque = J @ turning + gyroscopic
        torque -= air[3:] + belief.torque
        wrench = ca.vertcat(m * ca.dot(force, R[:, 2]), torque) + G @ (inputs.thrusts_middle - thrust)
        wrench /= belief.thrust_scale
        u = prioritised(vehicle, wrench) if self.priority == "tilt" else clipped(vehicle, wrench)

        force_rate = self.force_adaptation * (e_v + self.position_share * e_p)
        torque_rate = self.torque_adaptation * (e_w + self.attitude_share * e_R)
        theta_force = _in_ball(memory.theta_force + inputs.period * force_rate, self.force_limit)
        theta_torque = _in_ball(memory.theta_torque + inputs.period * torque_rate, self.torque_limit)
        psi = attitude_distance(R, R_d)
        return {"command": u, "theta_force": theta_force, "theta_torque": theta_torque, "psi": psi}


def gains(keys: Geometric) -> tuple[ca.DM, ca.DM, ca.DM, ca.DM]:
    """K_x (1/s^2), K_v (1/s), K_R (1/s^2), K_w (1/s), diagonals (3,)."""
    position = np.array(keys.position_bandwidth)
    attitude = np.array(keys.attitude_bandwidth)
    by_velocity = 2 * keys.position_damping * position
    by_rate = 2 * keys.attitude_damping * attitude
    return ca.DM(position**2), ca.DM(by_velocity), ca.DM(attitude**2), ca.DM(by_rate)


def _turning(
    R: Expression, w: Expression, w_dot: Expression, axis: Expression
) -> tuple[Expression, Expression, Expression]:
    """A body axis (3,) in the world with its two derivatives, of an attitude with rate w and w', (3,) each."""
    across = ca.cross(w, axis)
    second = ca.cross(w, across) + ca.cross(w_dot, axis)
    return R @ axis, R @ across, R @ second


def _reference_derivatives(
    thrust: Expression, R: Expression, w: Expression, w_dot: Expression, path: Expression
) -> tuple[Expression, Expression]:
    """f'/m and f''/m, (3,) each, of the reference's force f = m thrust R e_z (see the module)."""
    z, z_1, z_2 = _turning(R, w, w_dot, E_Z)
    jerk = path[:, 3]
    snap = path[:, 4]
    along = ca.dot(z, jerk)
    turned = thrust * z_2 + 2 * along * z_1
    lengthened = z * (ca.dot(z, snap) - ca.dot(z, turned))
    return thrust * z_1 + along * z, turned + lengthened


def _in_ball(vector: Expression, radius: float) -> Expression:
    """The vector (3,), shortened to the radius where it is longer."""
    return vector * radius / ca.fmax(ca.norm_2(vector), max(radius, 1e-12))
