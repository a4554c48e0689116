"""What the rigid body may be corrected with: the layout of a residual's inputs and outputs, and the function it brings.

    z = [v_body, w, u] -> y = [a_body, tau_body]

This is all that the equations need to know of quadexp.air, which is built on them.
"""

from __future__ import annotations

from typing import Protocol

import casadi as ca

FEATURES = ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")
OUTPUTS = ("a_x", "a_y", "a_z", "tau_x", "tau_y", "tau_z")
N_OUTPUTS = len(OUTPUTS)


class Correction(Protocol):
    """Anything with such a function; quadexp.air.base.Residual is one."""

    @property
    def function(self) -> ca.Function:
        """CasADi, (z (6 + n,), theta (p,)) -> (y (6,), dy/dz (6, 6 + n))."""
