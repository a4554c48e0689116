"""What a controller or a plant takes of a model: the acceleration and torque of the air beyond the rigid body.

One CasADi function of body-frame quantities and runtime parameters,

    y, dy/dz = r(z, theta)
    z = [v_body (3, m/s), w (3, rad/s), u (n, N)]            (6 + n,)
    y = [a_body (3, m/s^2), tau_body (3, N m)]               (6,)

so that v' = R (T e_z / m + a_body) + g and J w' = tau + tau_body - w x J w. The function also returns the Jacobian,
because a learned model has a cheaper one than automatic differentiation. theta is an input of every compiled function:
new coefficients do not require recompilation.

Residuals are summed, y = y_1 + y_2 + .., or multiplied by a scale that may change in flight, y = s y_1. Derivatives
likewise; the parameters stand one after the other, the scale s last. Another density of the air, or more area in it,
scales drag as a whole; an observer that finds s tells the controller what the air will do where the vehicle is going to
be, which a force that is found where it is now does not.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.physics.expression import Expression, split, symbols
from quadexp.physics.rigid_body import FEATURES, N_OUTPUTS, OUTPUTS
from quadexp.physics.vehicle import Vehicle

__all__ = ["FEATURES", "N_OUTPUTS", "OUTPUTS", "Residual", "feature_names", "no_residual", "symbolic_residual"]

AXES = "xyz"
VELOCITY = ("v_x", "v_y", "v_z")
THRUST = "thrust"  # feature: sum of the rotor thrusts (N)
_FEATURE = re.compile(r"[vw]_[xyz]|u_\d+|thrust")


@dataclass(frozen=True)
class Residual:
    """A residual model: function, parameters, and their source.

    name: for output ("none", "linear_drag", ...).
    function: CasADi, (z (6 + n,), theta (p,)) -> (y (6,), dy/dz (6, 6 + n)); entries that are always zero are
        structural zeros, so that code using it can omit them.
    theta: parameter values, (p,). source: checkpoint path or a word, for the record.
    to_compile: the same function in a form suited for compilation; None: `function` itself.
    ranges: feature -> [least, largest] of the data of the fit (models.base); None where unknown or not fitted.
    unscaled: of a residual whose last parameter is a scale of the outputs, the residual without it (`scaled_residual`).
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

    def form(self, compiled: bool) -> ca.Function:
        """The function, or its form for compilation."""
        return (self.to_compile if compiled else None) or self.function

    @property
    def is_zero(self) -> bool:
        """Whether the outputs are structurally zero."""
        return self.function.nnz_out(0) == 0


def feature_names(n_rotors: int) -> tuple[str, ...]:
    """Names of the entries of z: body velocity (m/s), body rate (rad/s), rotor thrusts (N)."""
    return FEATURES + tuple(f"u_{i}" for i in range(n_rotors))


def check_features(key: str, features: Iterable[str]) -> None:
    """Raise UsageError where one is no feature of any vehicle. key: of the configuration, for the message."""
    for feature in features:
        if not _FEATURE.fullmatch(feature):
            raise UsageError(
                f"{key}: unknown feature {feature!r}; allowed are v_x v_y v_z w_x w_y w_z thrust u_0 u_1 ..."
            )


def feature_places(names: Sequence[str], features: Iterable[str], what: str) -> list[list[int]]:
    """Places of each feature in z; of the collective thrust those of all rotors. what: the model, for messages.

    Raises UsageError for an unknown feature.
    """
    places = {name: [i] for i, name in enumerate(names)} | {THRUST: list(range(len(FEATURES), len(names)))}
    for feature in features:
        if feature not in places:
            raise UsageError(f"{what} feature {feature!r}: allowed are {', '.join(places)}")
    return [places[feature] for feature in features]


def symbolic_residual(
    name: str, outputs: Expression, features: Expression, theta: Expression, values: npt.ArrayLike, *,
    source: str = "", slope: Expression | None = None,
) -> Residual:  # fmt: skip
    """A residual from SX expressions: outputs (6,), of features (6 + n,) and theta (p,), p may be 0.

    values: (p,). slope: the Jacobian, (6, 6 + n); None: by automatic differentiation.
    """
    if slope is None:
        slope = ca.jacobian(outputs, features)
        outputs = ca.sparsify(outputs)
    else:
        outputs, slope = ca.cse([outputs, slope])
    function = residual_function(name, features, theta, [outputs, slope])
    return Residual(name, function, np.asarray(values, float).ravel(), source)


def residual_function(name: str, z: Expression, theta: Expression, results: Sequence[Expression]) -> ca.Function:
    """The function of a residual. results: y and dy/dz."""
    return ca.Function(f"residual_{name}", [z, theta], list(results), ["z", "theta"], ["y", "dy_dz"])


def no_residual(vehicle: Vehicle) -> Residual:
    """y = 0, structurally: the nominal rigid body."""
    features = ca.SX.sym("z", len(feature_names(vehicle.n_rotors)))
    return symbolic_residual("none", ca.SX(N_OUTPUTS, 1), features, ca.SX.sym("theta", 0), [])


def sum_residual(parts: Sequence[Residual]) -> Residual:
    """The sum of residuals of one vehicle; a single one is returned as it is.

    name: the names with "+" between; source likewise. ranges: inside only what all parts were fitted to.
    Raises UsageError where there is none, or where they are of vehicles with different numbers of rotors.
    """
    if not parts:
        raise UsageError("a sum of residuals needs at least one")
    if len(parts) == 1:
        return parts[0]
    if len({part.function.size1_in(0) for part in parts}) > 1:
        raise UsageError("a sum of residuals: the parts are of vehicles with different numbers of rotors")

    sources = dict.fromkeys(part.source for part in parts if part.source)
    ranges: dict[str, list[float]] = {}
    for part in parts:
        for name, (low, high) in (part.ranges or {}).items():
            least, largest = ranges.get(name, (low, high))
            ranges[name] = [max(least, low), min(largest, high)]
    theta = np.concatenate([part.theta for part in parts])
    function = _sum([part.function for part in parts], parts)
    to_compile = None
    if any(part.to_compile is not None for part in parts):
        to_compile = _sum([part.form(True) for part in parts], parts)
    return Residual(
        "+".join(part.name for part in parts), function, theta, "+".join(sources), to_compile, ranges or None
    )


def _sum(functions: Sequence[ca.Function], parts: Sequence[Residual]) -> ca.Function:
    sizes = [len(part.theta) for part in parts]
    z, theta = symbols(ca.MX, z=functions[0].size1_in(0), theta=sum(sizes))
    values = [function(z, part) for function, part in zip(functions, split(theta, sizes), strict=True)]
    results = [sum(terms[1:], terms[0]) for terms in zip(*values, strict=True)]
    return residual_function("sum", z, theta, results)


def scaled_residual(residual: Residual) -> Residual:
    """The residual with a scale behind its parameters, 1 at first; `unscaled` is the residual itself."""

    def scaled(function: ca.Function) -> ca.Function:
        z, theta = symbols(ca.MX, z=function.size1_in(0), theta=function.size1_in(1) + 1)
        return residual_function("scaled", z, theta, [theta[-1] * value for value in function(z, theta[:-1])])

    to_compile = residual.to_compile
    if to_compile is not None:
        to_compile = scaled(to_compile)
    theta = np.append(residual.theta, 1.0)
    return replace(residual, theta=theta, function=scaled(residual.function), to_compile=to_compile, unscaled=residual)
