"""The thrust that the rotors deliver, as far as a controller can know it.

Where rotor speeds W are measured and the vehicle's thrust coefficient is stated, it is c_t W^2. Otherwise it follows
from the commands: one that was sent at t_j acts over [t_j + d, t_j + d + T], d the dead time and T the control period,
and the thrust follows it with a first-order lag (physics.motor).
"""

from __future__ import annotations

import math

import numpy as np

from quadexp.control.base import Measurement
from quadexp.physics.motor import decayed
from quadexp.physics.vehicle import Vehicle


class DeliveredThrust:
    """Call `reset`, then at every control instant `now` and `record`, in this order.

    dead_time, lag: what is known of the commands' delay and of the rotors' time constant (s).
    thrust: by the commands, at the control instant, (n,) (N). mean: the same over the last control period; where rotor
    speeds are measured, and lag is not 0, of the measured thrusts at its two ends.
    """

    def __init__(self, vehicle: Vehicle, control_period: float, dead_time: float = 0.0, lag: float = 0.0) -> None:
        self._coefficient, self._lag = vehicle.thrust_coefficient, lag
        pending = max(math.ceil(dead_time / control_period - 1e-9), 0)
        first = dead_time - (pending - 1) * control_period  # s, for which the oldest command still acts
        self._durations = [first, control_period - first] if pending else [control_period]
        self._commands = np.zeros((pending, vehicle.n_rotors))
        self.thrust, self.mean = np.zeros((2, vehicle.n_rotors))

    def reset(self, thrust: np.ndarray) -> None:
        """Start a flight: this command, (n,) (N), has been sent for a long time."""
        self._commands[...] = self.thrust[...] = self.mean[...] = thrust
        self._measured: np.ndarray | None = None

    def now(self, measurement: Measurement) -> np.ndarray:
        """Thrusts at the control instant, just before the new command, (n,) (N)."""
        if measurement.rotor_speed is None or self._coefficient is None:
            return self.thrust
        before, measured = self._measured, self._coefficient * measurement.rotor_speed**2
        self._measured = measured
        self.mean[...] = (before + measured) / 2 if self._lag and before is not None else measured
        return measured

    def record(self, command: np.ndarray) -> None:
        """Add the command, (n,) (N), that was sent at this control instant, and go on by one control period."""
        acting = np.vstack([self._commands, command])
        self._commands[...] = acting[1:]
        total = 0.0
        for u, duration in zip(acting, self._durations, strict=False):
            after = advanced(self.thrust, u, duration, self._lag)
            total = total + duration * u + self._lag * (self.thrust - after)
            self.thrust = after
        self.mean[...] = total / sum(self._durations)


def advanced(thrust: np.ndarray, command: np.ndarray, duration: float, lag: float) -> np.ndarray:
    """Thrust (n,) (N) after a held command (n,) (N) has acted for a duration (s) with a lag (s); 0: at once."""
    if not duration:
        return thrust
    return decayed(thrust, command, math.exp(-duration / lag) if lag else 0.0)
