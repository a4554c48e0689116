"""What a trajectory demands, and the motion that follows for given residual outputs: attitude, body rate, thrusts.

A trajectory prescribes a yaw, or leaves the heading free: the body then does not rotate about its thrust axis, w_z = 0,
from heading 0 at the start (the "yaw rate zero" of Torrente et al. 2021). A fixed yaw requires much larger body rates
and torques at high tilt: the 12 m/s circle of the paper can only be flown with a free heading.

The flatness map (flat_map.py) gives the tilt frame and its rates; with G the vehicle's allocation, rotor thrusts are

    u = G^+ [T, tau],    T = m (c - a_air,z),    tau = J w' + w x J w - tau_air

World ENU, body FLU, SI. Arrays are component first, (d, k) at k times.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Protocol

import numpy as np

from quadexp.errors import UsageError
from quadexp.models.residual import N_OUTPUTS
from quadexp.physics.vehicle import Vehicle
from quadexp.reference.base import Trajectory
from quadexp.reference.flat_map import Tilt, cross, free_body_rates, heading_body_rates, tilt

NO_ATTITUDE = 1e-3  # least share of the specific force along z_body, and least q_w of the tilt, for an attitude


@dataclass(frozen=True)
class Demand:
    """A flat output at the times t, (k,), s.

    path: position .. snap, (5, 3, k), world. specific_force: a - g, (3, k), world (m/s^2).
    yaw: yaw, yaw', yaw'', (3, k) (rad, s), or None for a free heading.
    """

    t: np.ndarray
    path: np.ndarray
    specific_force: np.ndarray
    yaw: np.ndarray | None

    @classmethod
    def of(cls, trajectory: Trajectory, t: np.ndarray, gravity: float) -> Demand:
        """The demand of a trajectory at the times t, (k,) (s); gravity in m/s^2."""
        flat = trajectory.flat_output(t)
        path = np.ascontiguousarray(flat.position.transpose(1, 2, 0))
        yaw = None if flat.yaw is None else np.ascontiguousarray(flat.yaw.T)
        return cls(t, path, path[2] + [[0.0], [0.0], [gravity]], yaw)

    @cached_property
    def size(self) -> np.ndarray:
        """Of the specific force, (k,) (m/s^2), or NO_ATTITUDE where that is more."""
        return np.maximum(np.linalg.norm(self.specific_force, axis=0), NO_ATTITUDE)

    def tilt(self, lateral: np.ndarray) -> Tilt:
        """Tilt frames for the lateral accelerations l, (2, k) (m/s^2); raises UsageError where there are none."""
        frame = tilt(self.specific_force, lateral)
        above = (frame.quaternion[0] > NO_ATTITUDE) | self._in_a_vertical_plane(lateral)
        undefined = ~((frame.force[2] > NO_ATTITUDE * self.size) & above)
        if undefined.any():
            i = int(np.argmax(undefined))
            raise UsageError(
                f"the trajectory requires free fall or inverted flight at t = {self.t[i]:.2f} s (specific force"
                f" {self.specific_force[:, i].round(2).tolist()} m/s^2), where the attitude is not determined: lower"
                " trajectory.speed"
            )
        return frame

    def _in_a_vertical_plane(self, lateral: np.ndarray) -> bool:
        """Whether all specific forces lie in the plane of x, z, with y_body across it: then the body only pitches, and
        its attitude is determined upside down too."""
        return self.yaw is None and not self.specific_force[1].any() and not lateral[1].any()


class Calculus(Protocol):
    """Derivatives and integrals in time of values (d, k) or (k,) at k times; see TimeGrid."""

    def differentiate(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...

    def integrate(self, values: np.ndarray, derivative: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class Constant:
    """Zero derivatives, and chi, (k,) rad, as the integral: for constant values, or where the twist is known."""

    chi: np.ndarray

    def differentiate(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros_like(values), np.zeros_like(values)

    def integrate(self, values: np.ndarray, derivative: np.ndarray) -> np.ndarray:
        return self.chi


@dataclass(frozen=True)
class Air:
    """Residual outputs along a motion.

    outputs: l (tilt frame), a_air,z (m/s^2), tau_air (body, N m), (6, k). lateral_1, lateral_2: l', l'', (2, k).
    """

    outputs: np.ndarray
    lateral_1: np.ndarray
    lateral_2: np.ndarray

    @classmethod
    def still(cls, k: int) -> Air:
        """Zero outputs at k times."""
        return cls.of_outputs(np.zeros((N_OUTPUTS, k)))

    @classmethod
    def of_outputs(cls, outputs: np.ndarray) -> Air:
        """The outputs (6, k), with the time derivatives of the lateral part set to zero."""
        return cls(outputs, *np.zeros((2, 2, outputs.shape[1])))


@dataclass(frozen=True)
class Motion:
    """frame: tilt frames. chi: twist, (k,), rad. rate: w, (3, k), body (rad/s). thrusts: (n, k), N."""

    frame: Tilt
    chi: np.ndarray
    rate: np.ndarray
    thrusts: np.ndarray


def flat_motion(demand: Demand, vehicle: Vehicle, air: Air, calculus: Calculus) -> Motion:
    """The flatness map for given residual outputs; `calculus` integrates the twist of a free heading.

    Raises UsageError where the attitude is not determined (Demand.tilt).
    """
    frame = demand.tilt(air.outputs[:2])
    o, o_dot = frame.rates(demand.path[3], demand.path[4], air.lateral_1, air.lateral_2)
    if demand.yaw is None:
        chi = calculus.integrate(-o[2], -o_dot[2])
        w, w_dot = free_body_rates(o, o_dot, chi)
    else:
        chi = frame.heading_twist(demand.yaw[0])
        w, w_dot = heading_body_rates(frame, o, o_dot, chi, demand.yaw)
    thrust = vehicle.mass * (frame.force[2] - air.outputs[2])
    return Motion(frame, chi, w, rotor_thrusts(vehicle, thrust, w, w_dot, air.outputs[3:]))


def rotor_thrusts(
    vehicle: Vehicle, thrust: np.ndarray, rate: np.ndarray, rate_derivative: np.ndarray, air_torque: np.ndarray
) -> np.ndarray:
    """u = G^+ [T, J w' + w x J w - tau_air], (n, k) (N); the least-norm thrusts for more than four rotors.

    thrust: T, (k,), N. rate: w, (3, k), body (rad/s). rate_derivative: w', (3, k) (rad/s^2).
    air_torque: (3, k), body (N m).
    """
    inertia = vehicle.inertia_matrix
    torque = inertia @ rate_derivative + cross(rate, inertia @ rate) - air_torque
    return allocation_inverse(vehicle) @ np.concatenate([thrust[None], torque])


@lru_cache(maxsize=64)
def allocation_inverse(vehicle: Vehicle) -> np.ndarray:
    """G^+, (n, 4)."""
    return np.linalg.pinv(vehicle.allocation)


def within_limits(thrusts: np.ndarray, vehicle: Vehicle) -> tuple[np.ndarray, np.ndarray]:
    """Rotor thrusts, (n, k) (N), with the torque reduced until they are within the limits, at the same collective.

    For references that exceed the limits, where a residual model has no data.
    Returns the thrusts, and at which times they are unchanged, (k,) bool.
    """
    collective = allocation_inverse(vehicle)[:, :1] * thrusts.sum(axis=0)
    torque = thrusts - collective
    room = np.where(torque > 0, vehicle.thrust_max, vehicle.thrust_min) - collective
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(torque == 0, 1.0, room / torque).min(axis=0)
    free = share >= 1.0
    return np.where(free, thrusts, collective + np.clip(share, 0.0, 1.0) * torque), free
