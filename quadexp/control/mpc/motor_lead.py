"""The command with which lagging rotors deliver a planned thrust when the next command comes.

    u = T + (T* - T) / (1 - exp(-h / tau)),    h the control period, T the thrust now, T* the planned one

clipped to the vehicle's limits. It inverts T(t + h) of physics.motor. Two other laws are worse: a command for
the mean thrust over the period amplifies noise and errors of the timing, and T* + tau T*' with T*' from the plan takes
damping away (docs/delays.md has the figures).
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from quadexp.compile.backend import BufferedFunction, realise
from quadexp.compile.symbolic import ca
from quadexp.control.instant import Operation, call, copy
from quadexp.control.mpc.settings import MPCSettings
from quadexp.physics.vehicle import Vehicle


class MotorLead:
    """Inverts the lag settings.motor_lead (s) of a vehicle's rotors over a control period."""

    def __init__(self, vehicle: Vehicle, settings: MPCSettings, backend: str = "interpreted") -> None:
        self._invert = BufferedFunction(_function(vehicle.n_rotors, backend))
        arguments = self._invert.arguments
        gain = -1 / math.expm1(-settings.control_period / settings.motor_lead)
        arguments["numbers"][...] = gain, vehicle.thrust_min, vehicle.thrust_max
        self._planned, self._now = arguments["planned"], arguments["now"]

    def command(self, planned: np.ndarray, thrust: np.ndarray) -> np.ndarray:
        """planned, thrust: (n,) (N), planned and now -> the command, (n,) (N)."""
        self._planned[...], self._now[...] = planned, thrust
        self._invert()
        return self._invert.results["command"].copy()

    def operations(self, planned: np.ndarray, thrust: np.ndarray) -> tuple[list[Operation], np.ndarray]:
        """`command` for C, and the array where it is then."""
        given = [copy(self._planned, planned), copy(self._now, thrust)]
        return [*given, call(self._invert)], self._invert.results["command"]


@cache
def _function(rotors: int, backend: str) -> ca.Function:
    """planned, now (n,) (N); numbers: gain, least and largest thrust (N) -> command (n,) (N)."""
    planned, now, numbers = ca.SX.sym("planned", rotors), ca.SX.sym("now", rotors), ca.SX.sym("numbers", 3)
    command = ca.fmin(ca.fmax(now + numbers[0] * (planned - now), numbers[1]), numbers[2])
    names = ["planned", "now", "numbers"], ["command"]
    return realise(ca.Function("motor_lead", [planned, now, numbers], [command], *names), backend)
