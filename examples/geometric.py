"""A controller of your own: tracking on SE(3) (Lee, Leok & McClamroch 2010), reference rates fed forward.

f = m (a_ref + g e_z - k_p e_p - k_v e_v),   T = f . R e_z
tau = J (-k_R e_R - k_w (w - w_ref)) + w x J w,   e_R = 1/2 vee(R_d' R - R' R_d)
"""

from dataclasses import dataclass

import casadi as ca

from quadexp.control.allocation import clipped
from quadexp.control.law import Law
from quadexp.parts.settings import key
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY


@dataclass(frozen=True, kw_only=True)
class Geometric(Law):
    """Tracking on SE(3) without an MPC."""

    # The keys of controller=geometric; swept as controller.position=4,6,8.
    rate: float = key(200.0, "control rate", "[1, 1000]", "Hz")
    position: float = key(6.0, "k_p", "[0, 1000]", "1/s^2")
    velocity: float = key(4.0, "k_v", "[0, 1000]", "1/s")
    attitude: float = key(120.0, "k_R", "[0, 1e5]", "1/s^2")
    angular: float = key(16.0, "k_w", "[0, 1e4]", "1/s")

    logged = ("error",)  # a column of every flight; what it should remember would be named in `memory`

    def equations(self, vehicle, inputs, memory):
        """Called once: CasADi expressions of what is measured and of the reference, for the command."""
        x, reference, path = inputs.state, inputs.reference, inputs.path
        R, w, R_ref = rotation_matrix(x[ATTITUDE]), x[RATE], rotation_matrix(reference[ATTITUDE])
        error_p, error_v = x[POSITION] - path[:, 0], x[VELOCITY] - path[:, 1]
        force = path[:, 2] + ca.DM([0, 0, vehicle.gravity]) - self.position * error_p - self.velocity * error_v
        z = force / ca.norm_2(force)
        y = ca.cross(z, R_ref[:, 0])  # heading as in the reference
        y /= ca.norm_2(y)
        R_d = ca.horzcat(ca.cross(y, z), y, z)
        skew = (R_d.T @ R - R.T @ R_d) / 2
        error_R = ca.vertcat(skew[2, 1], skew[0, 2], skew[1, 0])
        J = ca.DM(vehicle.inertia_matrix)
        torque = J @ (-self.attitude * error_R - self.angular * (w - reference[RATE])) + ca.cross(w, J @ w)
        wrench = ca.vertcat(vehicle.mass * ca.dot(force, R[:, 2]), torque)
        return {"command": clipped(vehicle, wrench), "error": ca.norm_2(error_p)}
