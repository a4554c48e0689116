"""What a policy sees and what it says: one definition for training (env.py) and for flying (policy.py).

Observation, float32, 23 + a + 3 f numbers, with a actions and f future points of the reference:

    p_r - p (3)   v_r (3)   R, row by row (9)   v (3)   w (3)   last action (a)   least, largest thrust over hover (2)
    p_r(t + i spacing) - p, i = 1 .. f (3 f)

Action, in [-1, 1], 0 hovers:

    thrusts    a = n: rotor by rotor; -1 and 1 are the vehicle's least and largest thrust
    rates      a = 4: collective thrust in the same scale, then body rates over vehicle.rate_max, held by a rate loop

        tau = J K (w* - w) + w x J w,   K = (25, 25, 10) 1/s,   u = G^+ [T, tau]                                    (1)

World ENU, body FLU, SI units.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

Action = Literal["thrusts", "rates"]
GAIN = np.array([25.0, 25.0, 10.0])  # K, 1/s: a rate loop of a small autopilot
PLAIN = 23  # numbers of an observation beside actions and future points


class Task:
    """The observations and actions of a vehicle. action: "thrusts" or "rates". future: points of the reference."""

    def __init__(self, vehicle: Vehicle, action: Action, future: int) -> None:
        self.vehicle = vehicle
        self.action = action
        self.future = future
        self.actions = vehicle.n_rotors if action == "thrusts" else 4
        self.size = PLAIN + self.actions + 3 * future
        self._room = np.array([vehicle.thrust_min, vehicle.thrust_max]) / vehicle.hover_thrust
        self._inertia = vehicle.inertia_matrix
        self._of_torque = np.linalg.pinv(vehicle.allocation)

    def observation(self, x: np.ndarray, reference: np.ndarray, last: np.ndarray) -> np.ndarray:
        """What the policy sees, (size,), float32. x: state (13,) as it is measured. reference: states (1 + f, 13), now
        and ahead. last: the action before, (a,)."""
        error = reference[0, POSITION] - x[POSITION]
        ahead = reference[1:, POSITION] - x[POSITION]
        attitude = Rotation.from_quat(x[ATTITUDE], scalar_first=True).as_matrix()  # body to world
        parts = (error, reference[0, VELOCITY], attitude.ravel(), x[VELOCITY], x[RATE], last, self._room)
        return np.concatenate([*parts, ahead.ravel()], dtype=np.float32, casting="same_kind")

    def thrusts(self, action: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Rotor thrusts (n,) (N) of an action in [-1, 1]. rate: measured body rates (3,) (rad/s), for the rate loop."""
        if self.action == "thrusts":
            return self._scaled(action)
        wanted = action[1:] * self.vehicle.rate_max
        torque = self._inertia @ (GAIN * (wanted - rate)) + np.cross(rate, self._inertia @ rate)  # (1)
        collective = self.vehicle.n_rotors * self._scaled(action[0])
        u = self._of_torque @ np.concatenate([[collective], torque])
        return np.clip(u, self.vehicle.thrust_min, self.vehicle.thrust_max)

    def _scaled(self, action: np.ndarray) -> np.ndarray:
        """From [-1, 1] to the thrust of a rotor (N)."""
        vehicle = self.vehicle
        below = vehicle.hover_thrust - vehicle.thrust_min
        above = vehicle.thrust_max - vehicle.hover_thrust
        return vehicle.hover_thrust + np.where(action < 0, action * below, action * above)
