"""A controller of your own: tracking on SE(3) (Lee, Leok & McClamroch 2010), reference rates fed forward.

f = m (a_ref + g e_z - k_p e_p - k_v e_v),   T = f . R e_z
tau = J (-k_R e_R - k_w (w - w_ref)) + w x J w,   e_R = 1/2 vee(R_d' R - R' R_d)
"""

import time
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import StepRecord
from quadexp.control.part import ControllerPart
from quadexp.parts.settings import key
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY


@dataclass(frozen=True, kw_only=True)
class Geometric(ControllerPart):
    """Tracking on SE(3) without an MPC."""

    # The keys of controller=geometric; swept as controller.position=4,6,8.
    rate: float = key(200.0, "control rate", "[1, 1000]", "Hz")
    position: float = key(6.0, "k_p", "[0, 1000]", "1/s^2")
    velocity: float = key(4.0, "k_v", "[0, 1000]", "1/s")
    attitude: float = key(120.0, "k_R", "[0, 1e5]", "1/s^2")
    angular: float = key(16.0, "k_w", "[0, 1e4]", "1/s")

    def build(self, given):
        return GeometricController(given.vehicle, self)


class GeometricController:
    """See quadexp/control/base.py for the interface of a controller."""

    residual, reference_period, backend = None, 0.0, "interpreted"
    name, source = "none", ""  # what it knows of the air, and from where

    def __init__(self, vehicle, keys):
        self.vehicle, self.control_period, self.node_times = vehicle, 1.0 / keys.rate, np.zeros(1)
        self.gains = keys.position, keys.velocity, keys.attitude, keys.angular
        self.mixer = np.linalg.pinv(vehicle.allocation)

    def forget(self):
        """Unlearn what earlier flights taught: nothing here, and nothing to reset."""

    def reset(self, x, window):
        pass

    def step(self, measurement, window):
        """Rotor thrusts (n,) N from what is measured and the reference, and how the step went."""
        began = time.perf_counter()
        x, reference, vehicle = measurement.state, window.state[0], self.vehicle
        k_p, k_v, k_R, k_w = self.gains
        R, R_ref = Rotation.from_quat(np.stack([x[ATTITUDE], reference[ATTITUDE]]), scalar_first=True).as_matrix()
        error_p, error_v = x[POSITION] - reference[POSITION], x[VELOCITY] - reference[VELOCITY]
        force = window.position[2] + [0, 0, vehicle.gravity] - k_p * error_p - k_v * error_v  # per mass
        z = force / np.linalg.norm(force)
        y = np.cross(z, R_ref[:, 0])  # heading as in the reference
        y /= np.linalg.norm(y)
        R_d = np.stack([np.cross(y, z), y, z], axis=1)
        skew = 0.5 * (R_d.T @ R - R.T @ R_d)
        error_R = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        w, J = x[RATE], vehicle.inertia_matrix
        torque = J @ (-k_R * error_R - k_w * (w - reference[RATE])) + np.cross(w, J @ w)
        wanted = self.mixer @ np.array([vehicle.mass * force @ R[:, 2], *torque])
        u = np.clip(wanted, vehicle.thrust_min, vehicle.thrust_max)
        status = Status.RICCATI if np.isfinite(u).all() else Status.FAILED
        return u, StepRecord(time.perf_counter() - began, status, 0, int((u != wanted).sum()), 0.0)

    def log(self):
        return {}
