"""The interface of a correction to the rigid body: the layout of a residual's inputs and outputs, and its function.

    z = [v_body, w, u] -> y = [a_body, tau_body]

Implemented by quadexp.models, which imports this package.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import casadi as ca

FEATURES = ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")
OUTPUTS = ("a_x", "a_y", "a_z", "tau_x", "tau_y", "tau_z")
N_OUTPUTS = len(OUTPUTS)


class Correction(Protocol):
    """An object with such a function, such as quadexp.models.residual.Residual."""

    @property
    def function(self) -> ca.Function:
        """CasADi, (z (6 + n,), theta (p,)) -> (y (6,), dy/dz (6, 6 + n))."""
