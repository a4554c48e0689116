"""A residual times a number that may change in flight: y = s r(z, theta), with s as the last parameter.

Another density of the air, or more area in it, scales drag as a whole; an observer that finds s tells the controller
what the air will do where the vehicle is going to be, which a force that is found where it is now does not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quadexp.air.base import Residual
from quadexp.compile.symbolic import ca


def scaled_residual(residual: Residual) -> Residual:
    """The residual with a scale behind its parameters, 1 at first; `unscaled` is the residual itself."""
    parts = {"function": _scaled(residual.function)}
    if residual.to_compile is not None:
        parts["to_compile"] = _scaled(residual.to_compile)
    return replace(residual, theta=np.append(residual.theta, 1.0), unscaled=residual, **parts)


def _scaled(function: ca.Function) -> ca.Function:
    z, theta = ca.MX.sym("z", function.size1_in(0)), ca.MX.sym("theta", function.size1_in(1) + 1)
    y, slope = function(z, theta[:-1])
    return ca.Function(
        "residual_scaled", [z, theta], [theta[-1] * y, theta[-1] * slope], ["z", "theta"], ["y", "dy_dz"]
    )
