"""RotorPy's SE3Control (Folk, Paulos, Kumar 2023; version 3.0) as a Controller: the package's own code.

    F = m (a_r + g e_z - K_p e_p - K_d e_v),   T = F . R e_z,   tau = J (-k_p e_R - k_d (w - yaw' e_z)) + w x J w

It knows no rate and no angular acceleration of the reference, and commands thrusts beyond the limits, which are clipped
here.
"""

from __future__ import annotations

import importlib
import time
from typing import Any

import numpy as np

from quadexp.control.base import Measurement, Window
from quadexp.control.laws.explicit import Rate
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import StepRecord
from quadexp.control.part import ControllerPart
from quadexp.errors import UsageError
from quadexp.models.build_context import BuildContext
from quadexp.names import named
from quadexp.parts.settings import Triple, key, keyed
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

AIR = ("c_Dx", "c_Dy", "c_Dz", "k_d", "k_z", "k_flap", "tau_m", "rotor_speed_min", "rotor_speed_max")  # not used


@keyed
class RotorPySE3(ControllerPart):
    """RotorPy's SE3Control (Folk, Paulos, Kumar 2023), the code of the package rotorpy itself, with its own gains."""

    former_kind = "rotorpy_se3"

    rate: Rate = 100.0
    position_proportional: Triple = key((6.5, 6.5, 15.0), "kp_pos", "[0, 1000]", "1/s^2", tuned="2..60:log")
    position_derivative: Triple = key((4.0, 4.0, 9.0), "kd_pos", "[0, 1000]", "1/s", tuned="1..30:log")
    attitude_proportional: float = key(310.0, "kp_att", "[0, 1e5]", "1/s^2", tuned="30..1000:log")
    attitude_derivative: float = key(57.0, "kd_att", "[0, 1e4]", "1/s", tuned="8..120:log")

    def build(self, context: BuildContext) -> Any:
        """See ControllerPart."""
        return RotorPySE3Controller(context.vehicle, self)


class RotorPySE3Controller:
    """A Controller (see control.base); raises UsageError without the package, and for other than four rotors."""

    reference_period = 0.0
    residual = None
    backend = "interpreted"
    residual_name = "none"
    source = ""

    def __init__(self, vehicle: Vehicle, keys: RotorPySE3) -> None:
        if vehicle.n_rotors != 4:
            raise UsageError(
                f"vehicle={vehicle.name}: controller=rotorpy_se3 flies 4 rotors, this vehicle has {vehicle.n_rotors}"
            )
        self.vehicle = vehicle
        self.control_period = 1.0 / keys.rate
        self.node_times = np.zeros(1)
        self._law = _controller(parameters(vehicle, keys))
        self._law.kp_pos = np.array(keys.position_proportional)
        self._law.kd_pos = np.array(keys.position_derivative)
        self._law.g = vehicle.gravity

    def forget(self) -> None:
        """See Controller.forget; nothing is learned."""

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset; it has no memory."""

    def step(self, measurement: Measurement, window: Window) -> tuple[np.ndarray, StepRecord]:
        """See Controller.step; a command that is not finite has status FAILED."""
        began = time.perf_counter()
        x = measurement.state
        state = {"x": x[POSITION], "v": x[VELOCITY], "q": np.roll(x[ATTITUDE], -1), "w": x[RATE]}
        path = named(("x", "x_dot", "x_ddot", "x_dddot", "x_ddddot"), window.position)
        heading = {"yaw": window.yaw[0], "yaw_dot": window.yaw[1]}
        wanted = self._law.update(measurement.t, state, path | heading)["cmd_motor_thrusts"]
        u = np.clip(wanted, self.vehicle.thrust_min, self.vehicle.thrust_max)
        status = Status.OK if np.isfinite(u).all() else Status.FAILED
        return u, StepRecord(time.perf_counter() - began, status, 0, int((u != wanted).sum()), 0.0)

    def log(self) -> dict[str, float]:
        """See Controller.log; nothing further."""
        return {}


def parameters(vehicle: Vehicle, keys: RotorPySE3) -> dict[str, Any]:
    """The vehicle as RotorPy's parameter files describe one; what its controller does not use is 0."""
    J = vehicle.inertia_matrix
    return {
        "mass": vehicle.mass,
        **{f"I{a}{b}": J["xyz".index(a), "xyz".index(b)] for a, b in ("xx", "yy", "zz", "xy", "xz", "yz")},
        "num_rotors": vehicle.n_rotors,
        "rotor_pos": {f"r{i}": np.array(place, float) for i, place in enumerate(vehicle.rotor_position)},
        "rotor_directions": np.array(vehicle.rotor_spin, float),
        "k_eta": 1.0,  # only the ratio of the two is used for thrusts
        "k_m": vehicle.torque_coefficient,
        "kp_att": keys.attitude_proportional,
        "kd_att": keys.attitude_derivative,
        **dict.fromkeys(AIR, 0.0),
    }


def _controller(parameters: dict[str, Any]) -> Any:
    try:
        module = importlib.import_module("rotorpy.controllers.quadrotor_control")
    except ImportError:
        raise UsageError(
            'controller=rotorpy_se3: needs the package rotorpy: pip install "quadexp[controllers]"'
        ) from None
    return module.SE3Control(parameters)
