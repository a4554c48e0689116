"""The interface of residual models: a CasADi function with its parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from quadexp.compile.symbolic import ca
from quadexp.physics.correction import FEATURES, N_OUTPUTS, OUTPUTS
from quadexp.physics.expression import Expression

__all__ = ["FEATURES", "N_OUTPUTS", "OUTPUTS", "Residual", "feature_names", "symbolic_residual"]


def feature_names(n_rotors: int) -> tuple[str, ...]:
    """Names of the entries of z: body velocity (m/s), body rate (rad/s), rotor thrusts (N)."""
    return FEATURES + tuple(f"u_{i}" for i in range(n_rotors))


@dataclass(frozen=True)
class Residual:
    """A residual model: function, parameters, and their source.

    name: for output ("none", "linear_drag", "gaussian_process", ...).
    function: CasADi, (z (6 + n,), theta (p,)) -> (y (6,), dy/dz (6, 6 + n)); entries that are always zero are
        structural zeros, so that code using it can omit them.
    theta: parameter values, (p,).
    source: checkpoint path or a word, for the record.
    to_compile: the same function in a form suited for compilation; None: `function` itself.
    ranges: feature -> [least, largest] of the data that it was fitted to (models.support); None where unknown or
        not fitted.
    unscaled: of a residual whose last parameter is a scale of the outputs, the residual without it (air.scaled).
    """

    name: str
    function: ca.Function
    theta: np.ndarray
    source: str = ""
    to_compile: ca.Function | None = None
    ranges: Mapping[str, Sequence[float]] | None = field(default=None, compare=False)
    unscaled: Residual | None = None

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Residual at many points: features (k, 6 + n) -> outputs (k, 6) in the units of `OUTPUTS`."""
        features = np.atleast_2d(features)
        outputs, _ = self.function(features.T, np.tile(self.theta[:, None], (1, len(features))))
        return np.array(ca.DM(outputs).full()).T

    @property
    def is_zero(self) -> bool:
        """Whether the outputs are structurally zero."""
        return self.function.nnz_out(0) == 0


def symbolic_residual(
    name: str, outputs: Expression, features: Expression, theta: Expression, values: npt.ArrayLike, *, source: str = ""
) -> Residual:
    """A residual from SX expressions; the Jacobian by automatic differentiation.

    outputs: SX (6,). features: SX (6 + n,). theta: SX (p,), p may be 0. values: (p,).
    """
    jacobian = ca.jacobian(outputs, features)
    function = ca.Function(
        f"residual_{name}",
        [features, theta],
        [ca.sparsify(outputs), jacobian],
        ["z", "theta"],
        ["y", "dy_dz"],
    )
    return Residual(name, function, np.asarray(values, float).ravel(), source)
