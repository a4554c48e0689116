"""The command with which lagging rotors deliver a planned thrust when the next command comes.

    u = T + (T* - T) / (1 - exp(-h / tau)),    h the control period, T the thrust now, T* the planned one

clipped to the vehicle's limits. It inverts T(t + h) of physics.motor. Two other laws are worse: a command for
the mean thrust over the period amplifies noise and errors of the timing, and T* + tau T*' with T*' from the plan takes
damping away (docs/delays.md has the figures).
"""

from __future__ import annotations

import math

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.mpc.settings import MPCSettings
from quadexp.physics.vehicle import Vehicle


class MotorLead:
    """Inverts the lag settings.motor_lead (s) of a vehicle's rotors over a control period."""

    def __init__(self, vehicle: Vehicle, settings: MPCSettings) -> None:
        planned, now = (ca.SX.sym(name, vehicle.n_rotors) for name in ("planned", "now"))
        gain = -1 / math.expm1(-settings.control_period / settings.motor_lead)
        command = ca.fmin(ca.fmax(now + gain * (planned - now), vehicle.thrust_min), vehicle.thrust_max)
        function = ca.Function("motor_lead", [planned, now], [command], ["planned", "now"], ["command"])
        self._invert = BufferedFunction(function)
        self._planned, self._now = self._invert.arguments["planned"], self._invert.arguments["now"]

    def command(self, planned: np.ndarray, thrust: np.ndarray) -> np.ndarray:
        """planned, thrust: (n,) (N), planned and now -> the command, (n,) (N)."""
        self._planned[...], self._now[...] = planned, thrust
        self._invert()
        return self._invert.results["command"].copy()
