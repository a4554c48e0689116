"""Gaussian-process residual: sparse posterior means, one per corrected output (Torrente et al. 2021, section III-C).

    y_o(z) = sum_j alpha_oj exp(-1/2 sum_i ((phi_oi - Z_oji) / l_oi)^2) + mean_o(z)

phi_o are the features of output o (B_z selects them among body velocity, rates, rotor thrusts and their sum), Z_o the
inducing points, alpha_o the weights including the signal variance. The mean function is linear drag, a sum of
identified terms (quadexp.air.terms), or zero.

Written in matrix operations with the analytic derivative; the cost is linear in the number of points. Points and
weights are parameters, so fits of the same size share one function. With s = 1 / (sqrt(2) l) the code evaluates d = s
phi - s Z, k = exp(-sum d^2), dy/dphi = -2 s (alpha k)^T d.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from quadexp.air.base import N_OUTPUTS, OUTPUTS, Residual, feature_names
from quadexp.air.linear_drag import N_PARAMETERS, linear_drag_acceleration
from quadexp.air.terms import TermStructure, term_acceleration
from quadexp.compile.backend import handwritten
from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle

COLLECTIVE_THRUST = "thrust"  # feature: sum of the rotor thrusts (N)
SUMS = Path(__file__).with_name("gp_sums.c")

Sums = tuple[list[Expression], list[Expression]]  # over the points: one value per output, one slope per feature
Structure = tuple[tuple[str, tuple[str, ...], int], ...]  # output, its features, its number of points


@dataclass(frozen=True)
class GPOutput:
    """Posterior mean of one output.

    output: a name in OUTPUTS. features: d names. inducing: (M, d), in the features' units.
    alpha: (M,), in the output's unit. lengthscale: (d,), in the features' units.
    """

    output: str
    features: tuple[str, ...]
    inducing: np.ndarray
    alpha: np.ndarray
    lengthscale: np.ndarray


class PosteriorMean(Protocol):
    """Posterior mean of one output: a GPOutput, or another object with its fields."""

    @property
    def output(self) -> str: ...
    @property
    def features(self) -> tuple[str, ...]: ...
    @property
    def inducing(self) -> np.ndarray: ...
    @property
    def alpha(self) -> np.ndarray: ...
    @property
    def lengthscale(self) -> np.ndarray: ...


def gaussian_process_residual(
    vehicle: Vehicle,
    outputs: Sequence[PosteriorMean],
    mean_parameters: npt.ArrayLike | None = None,
    source: str = "",
    *,
    mean_terms: TermStructure | None = None,
) -> Residual:
    """Residual of one or more GP outputs.

    mean_parameters: [D (3,), b (3,), kappa] of the linear-drag mean function (quadexp.air.linear_drag), or None.
    mean_terms: the mean function as terms, whose coefficients are then mean_parameters.
    Raises UsageError for an unknown feature or output.
    """
    names = feature_names(vehicle.n_rotors)
    structure = tuple((o.output, tuple(o.features), len(o.alpha)) for o in outputs)
    for output, features, _ in structure:
        if output not in OUTPUTS:
            raise UsageError(f"gp output {output!r}: allowed are {', '.join(OUTPUTS)}")
        for feature in features:
            if feature not in (*names, COLLECTIVE_THRUST):
                raise UsageError(f"gp feature {feature!r}: allowed are {', '.join((*names, COLLECTIVE_THRUST))}")
    n_mean = N_PARAMETERS if mean_terms is None else mean_terms.n_parameters
    mean = np.zeros(n_mean) if mean_parameters is None else np.asarray(mean_parameters, float)
    scales = [1.0 / (np.sqrt(2.0) * np.asarray(o.lengthscale, float)) for o in outputs]
    points = [
        (np.asarray(o.inducing, float).reshape(len(o.alpha), len(o.features)) * scale).T.ravel()
        for o, scale in zip(outputs, scales, strict=True)
    ]
    alphas = [np.asarray(o.alpha, float) for o in outputs]
    function, to_compile = (
        _posterior_mean_function(names, structure, sums, with_mean=bool(np.any(mean)), mean_terms=mean_terms)
        for sums in (_matrix_sums, _compiled_sums)
    )
    theta = np.concatenate([mean, *scales, *points, *alphas])
    return Residual("gaussian_process", function, theta, source, to_compile)


def _posterior_mean_function(
    names: tuple[str, ...],
    structure: Structure,
    sums: Callable[..., Sums],
    *,
    with_mean: bool,
    mean_terms: TermStructure | None,
) -> ca.Function:
    """(z, theta) -> y, dy/dz for outputs of the given (output, features, number of points).

    theta: parameters of the mean function, then s, s Z and alpha of all outputs. sums: _matrix_sums or _compiled_sums.
    """
    n_alpha, n_point = _sizes(structure)
    n_mean = N_PARAMETERS if mean_terms is None else mean_terms.n_parameters
    sizes = [n_mean, len(n_point), sum(n_point), sum(n_alpha)]
    z, theta = ca.MX.sym("z", len(names)), ca.MX.sym("theta", sum(sizes))
    mean, scale, points, alpha = _split(theta, sizes)
    select, assemble = _scalar_functions(names, structure, with_mean=with_mean, mean_terms=mean_terms)

    values, slopes = sums(structure, select(z, scale), points, alpha)
    y, dy_dz = assemble(z, mean, scale, ca.vertcat(*values), ca.vertcat(*slopes))
    return ca.Function("residual_gaussian_process", [z, theta], [y, dy_dz], ["z", "theta"], ["y", "dy_dz"])


def _matrix_sums(structure: Structure, scaled: Expression, points: Expression, alpha: Expression) -> Sums:
    """(alpha k) 1 of every output and (alpha k)^T d of every feature, in matrix operations."""
    n_alpha, n_point = _sizes(structure)
    distance = [feature - point for feature, point in zip(ca.vertsplit(scaled), _split(points, n_point), strict=True)]
    of_output = [i for i, (_, features, _) in enumerate(structure) for _ in features]
    exponent = [sum(d * d for d, i in zip(distance, of_output, strict=True) if i == o) for o in range(len(structure))]
    kernel = ca.exp(-ca.vertcat(*exponent))  # all outputs in one vectorised loop
    weighted = _split(alpha * kernel, n_alpha)
    values = [ca.dot(a, k) for a, k in zip(_split(alpha, n_alpha), _split(kernel, n_alpha), strict=True)]
    return values, [ca.dot(weighted[i], d) for d, i in zip(distance, of_output, strict=True)]


def _compiled_sums(structure: Structure, scaled: Expression, points: Expression, alpha: Expression) -> Sums:
    """As _matrix_sums, by gp_sums.c, one call per output."""
    n_alpha, _ = _sizes(structure)
    n_features = [len(features) for _, features, _ in structure]
    kernels = {shape: _sums_function(*shape) for shape in zip(n_alpha, n_features, strict=True)}
    parts = zip(
        n_alpha,
        n_features,
        _split(scaled, n_features),
        _split(points, [m * d for m, d in zip(n_alpha, n_features, strict=True)]),
        _split(alpha, n_alpha),
        strict=True,
    )
    values, slopes = zip(*(kernels[m, d](*arguments) for m, d, *arguments in parts), strict=True)
    return list(values), list(slopes)


def _sums_function(m: int, d: int) -> ca.Function:
    """(scaled features (d,), scaled points (m d,), alpha (m,)) -> (alpha k) 1, (alpha k)^T d of one output."""
    one, feature, alpha, points = (ca.Sparsity.dense(size, 1) for size in (1, d, m, m * d))
    return handwritten(
        f"gp_sums_{m}_{d}",
        SUMS,
        {"POINTS": m, "FEATURES": d},
        {"feature": feature, "points": points, "alpha": alpha},
        {"value": one, "slope": feature},
    )


def _sizes(structure: Structure) -> tuple[list[int], list[int]]:
    """Number of points of every output, and of every feature."""
    return [m for _, _, m in structure], [m for _, features, m in structure for _ in features]


def _split(vector: Expression, sizes: Sequence[int]) -> list[Expression]:
    return ca.vertsplit(vector, np.cumsum([0, *sizes]).tolist())


def _scalar_functions(
    names: Sequence[str], structure: Structure, *, with_mean: bool, mean_terms: TermStructure | None
) -> tuple[ca.Function, ca.Function]:
    """The functions before and after the sums over points.

    (z, s) -> s phi of all features; (z, mean, s, (alpha k) 1, (alpha k)^T d) -> y, dy/dz with structural zeros. mean:
    parameters of the mean function.
    """
    n_mean = N_PARAMETERS if mean_terms is None else mean_terms.n_parameters
    z, mean = ca.SX.sym("z", len(names)), ca.SX.sym("mean", n_mean)
    n_features = sum(len(features) for _, features, _ in structure)
    scale, slope = ca.SX.sym("scale", n_features), ca.SX.sym("slope", n_features)
    value = ca.SX.sym("value", len(structure))
    y, dy_dz = ca.SX(N_OUTPUTS, 1), ca.SX(N_OUTPUTS, len(names))
    if with_mean:
        y[:3] = linear_drag_acceleration(z, mean) if mean_terms is None else term_acceleration(z, mean, mean_terms)
        dy_dz[:3, :] = ca.jacobian(y[:3], z)
    phi: list[Expression] = []
    for i, (output, features, _) in enumerate(structure):
        row = OUTPUTS.index(output)
        y[row] += value[i]
        for feature in features:
            columns = list(range(6, len(names))) if feature == COLLECTIVE_THRUST else [names.index(feature)]
            dy_dz[row, columns] -= 2 * scale[len(phi)] * slope[len(phi)]
            phi.append(ca.sum1(z[columns]))
    select = ca.Function("select", [z, scale], [scale * ca.vertcat(*phi)])
    return select, ca.Function("assemble", [z, mean, scale, value, slope], [ca.sparsify(y), ca.sparsify(dy_dz)])
