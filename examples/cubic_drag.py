"""A model of the air of your own: drag that grows with the cube of the speed, with a coefficient that is fitted.

    a_body = -c v |v|^2                                                             m/s^2

    quadexp fit cubic_drag data/residuals.parquet --conf FOLDER

From the equation follow its predictions, its residual in the MPC and in the reference's feed-forward, its checkpoint
and its verdict against linear drag.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from quadexp.models.coefficients import Equation
from quadexp.parts.settings import key


@dataclass(frozen=True, kw_only=True)
class CubicDrag(Equation):
    """How it is fitted. Fields are keys, such as model.least_speed, besides model.holdout and model.seed."""

    units = {"c": "s/m^2"}  # of the coefficients, in the order of theta
    least_speed: float = key(0.0, "slower rows are left out of the fit", "[0, 60]", "m/s")

    def acceleration(self, z, theta):
        """Of CasADi expressions: z = [body velocity (3), body rate (3), rotor thrusts]."""
        velocity = z[:3]
        return -theta[0] * velocity * ca.sumsqr(velocity)

    def estimate(self, rows):
        """Least squares over all rows and axes."""
        velocity = rows.matrix(["v_x", "v_y", "v_z"])
        measured = rows.matrix(["a_x", "a_y", "a_z"])
        speed = np.linalg.norm(velocity, axis=1, keepdims=True)
        regressor = -velocity * speed**2 * (speed >= self.least_speed)
        return [np.sum(regressor * measured) / np.sum(regressor**2)]
