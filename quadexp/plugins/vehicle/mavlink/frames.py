"""Between world east north up, body forward left up, rotor thrusts, and what MAVLink says of them.

north east down -> east north up      P = (y, x, -z)
forward right down -> forward left up  F = (x, -y, -z)
attitude                               q_P q q_F, half a turn about (1, 1, 0) and about x
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError, UsageError
from quadexp.physics.rotation import air_velocity
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

LOCAL_NED, BODY_FRD = 1, 12  # MAV_FRAME
FLIPPED = np.array([1.0, -1.0, -1.0])  # forward right down to forward left up, and back
CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])  # of a quaternion
HALF = math.sqrt(0.5)


def swapped(vector: Any) -> np.ndarray:
    """North east down to east north up, and back; (3,)."""
    x, y, z = vector
    return np.array([y, x, -z])


def turned(attitude: Any) -> np.ndarray:
    """A quaternion, w first, between the two pairs of frames, either way; with w >= 0."""
    w, x, y, z = attitude
    turn = np.array([HALF * (w + z), HALF * (x + y), HALF * (x - y), HALF * (w - z)])
    return turn if turn[0] >= 0 else -turn


def odometry_state(message: Any) -> np.ndarray:
    """The state, (13,), of an ODOMETRY message. Raises QuadexpError for frames without a north."""
    if message.frame_id != LOCAL_NED:
        raise QuadexpError(f"ODOMETRY.frame_id is {message.frame_id}: LOCAL_NED (1) is needed")
    x = np.empty(N_STATE)
    x[POSITION], x[ATTITUDE] = swapped((message.x, message.y, message.z)), turned(message.q)
    velocity = np.array([message.vx, message.vy, message.vz])
    if message.child_frame_id == BODY_FRD:
        x[VELOCITY] = air_velocity(CONJUGATE * x[ATTITUDE], FLIPPED * velocity)  # from body to world
    elif message.child_frame_id == LOCAL_NED:
        x[VELOCITY] = swapped(velocity)
    else:
        raise QuadexpError(f"ODOMETRY.child_frame_id is {message.child_frame_id}: BODY_FRD (12) or LOCAL_NED (1)")
    x[RATE] = FLIPPED * np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
    return x


def parts_state(position: Any, attitude: Any) -> np.ndarray:
    """The state of LOCAL_POSITION_NED and ATTITUDE_QUATERNION, (13,)."""
    x = np.empty(N_STATE)
    x[POSITION] = swapped((position.x, position.y, position.z))
    x[VELOCITY] = swapped((position.vx, position.vy, position.vz))
    x[ATTITUDE] = turned((attitude.q1, attitude.q2, attitude.q3, attitude.q4))
    x[RATE] = FLIPPED * np.array([attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed])
    return x


@dataclass(frozen=True)
class ThrustMap:
    """Collective thrust (N) to the share of 0 .. 1 that an autopilot takes. full: thrust at 1 (N). curve: f of motors
    whose curve it does not invert: thrust / full = f s^2 + (1 - f) s."""

    full: float
    curve: float = 0.0

    def share(self, thrust: float) -> float:
        """Of a thrust (N)."""
        wanted = min(max(thrust / self.full, 0.0), 1.0)
        if not self.curve:
            return wanted
        rest = 1 - self.curve
        return (math.sqrt(rest * rest + 4 * self.curve * wanted) - rest) / (2 * self.curve)


def thrust_map(text: str, vehicle: Vehicle) -> ThrustMap:
    """hover=SHARE, of the thrust stick in hover; full: all rotors' limits at 1; curve=F: that, by a motor curve."""
    name, _, value = text.partition("=")
    try:
        number = float(value or 0)
    except ValueError:
        number = math.nan
    full = vehicle.n_rotors * vehicle.thrust_max
    if name == "full" and not value:
        return ThrustMap(full)
    if name == "hover" and 0 < number < 1:
        return ThrustMap(vehicle.mass * vehicle.gravity / number)
    if name == "curve" and 0 <= number <= 1:
        return ThrustMap(full, number)
    raise UsageError(f"--thrust {text}: must be hover=SHARE (0 to 1), full, or curve=FACTOR (0 to 1)")
