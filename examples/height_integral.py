"""A compensation of your own, around any controller: an integral of the height's error, added to its thrusts.

i' = p_z - p_z,ref,  |i| <= limit,    u = u_b - G^+ [m k i, 0, 0, 0]        G: thrusts -> collective thrust and torques
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from quadexp.control.layer import LayerPart
from quadexp.parts.settings import key
from quadexp.physics.expression import limited


@dataclass(frozen=True, kw_only=True)
class HeightIntegral(LayerPart):
    """Takes away the height that a wrong mass or a weak battery costs."""

    prefix = "adaptive."

    # The keys of adaptive=height_integral; swept as adaptive.gain=1,2,4.
    gain: float = key(10.0, "k", "[0, 100]", "1/s^3")
    limit: float = key(1.0, "largest integral", "[0, 100]", "m s")

    logged = {"integral": ("height_integral",)}  # columns of every flight

    def remembers(self, inputs):
        """Names, and how many numbers there are of each; zero when a flight begins."""
        return {"integral": 1}

    def after(self, vehicle, inputs, memory, found):
        """Called once: CasADi expressions of what is measured and of the command of the controller inside."""
        error = inputs.state[2] - inputs.path[2, 0]
        integral = limited(memory.integral + inputs.period * error, -self.limit, self.limit)
        up = ca.DM(np.linalg.pinv(vehicle.allocation)[:, 0])
        thrusts = inputs.command - up * vehicle.mass * self.gain * integral
        return {"command": limited(thrusts, vehicle.thrust_min, vehicle.thrust_max), "integral": integral}
