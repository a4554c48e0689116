"""Linear rotor drag (Faessler et al. 2018; RDRv in Torrente et al. 2021), with an intercept and a thrust term.

    a_body = -D v_body + b + (0, 0, kappa T)                                m/s^2

D diagonal (1/s), intercept b (m/s^2), kappa (1/kg): acceleration lost or gained per collective thrust T (N). b = 0 and
kappa = 0 give the published model.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from quadexp.air.base import Residual, feature_names, symbolic_residual
from quadexp.compile.symbolic import ca
from quadexp.physics.drag import linear_drag_force
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle

N_PARAMETERS = 7


def linear_drag_acceleration(features: Expression, theta: Expression) -> Expression:
    """a_body, (3,) (m/s^2), of z = [v_body, w, u] and theta = [D (3,), b (3,), kappa]."""
    thrust = ca.sum1(features[6:])
    return linear_drag_force(features[:3], theta[:3]) + theta[3:6] + ca.vertcat(0, 0, theta[6] * thrust)


def linear_drag_residual(
    vehicle: Vehicle,
    drag: npt.ArrayLike,
    intercept: npt.ArrayLike = (0.0, 0.0, 0.0),
    thrust_gain: float = 0.0,
    source: str = "",
) -> Residual:
    """Linear-drag residual; drag (3,) 1/s, intercept (3,) m/s^2, thrust_gain 1/kg."""
    features = ca.SX.sym("z", len(feature_names(vehicle.n_rotors)))
    theta = ca.SX.sym("theta", N_PARAMETERS)
    outputs = ca.vertcat(linear_drag_acceleration(features, theta), ca.SX(3, 1))
    values = np.concatenate([np.asarray(drag), np.asarray(intercept), [thrust_gain]])
    return symbolic_residual("linear_drag", outputs, features, theta, values, source=source)
