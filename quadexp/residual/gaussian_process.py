"""Gaussian-process residual: sparse posterior means, one per corrected output (Torrente et al. 2021, section III-C).

    y_o(z) = sum_j alpha_oj exp(-1/2 sum_i ((phi_oi - Z_oji) / l_oi)^2) + mean_o(z)

phi_o are the features of output o (B_z selects them among body velocity, rates, rotor thrusts and their sum), Z_o the
inducing points, alpha_o the weights with the signal variance folded in. The mean function is linear drag, or zero.

Written in matrix operations with the analytic derivative: linear in the number of points, and one function for every
fit of the same shape, since points and weights are parameters. With s = 1 / (sqrt(2) l) the code evaluates
d = s phi - s Z, k = exp(-sum d^2), dy/dphi = -2 s (alpha k)^T d.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from quadexp.errors import UsageError
from quadexp.residual.base import N_OUTPUTS, OUTPUTS, Residual, feature_names
from quadexp.residual.linear_drag import N_PARAMETERS, linear_drag_acceleration
from quadexp.vehicle import Vehicle

COLLECTIVE_THRUST = "thrust"  # feature: sum of the rotor thrusts (N)


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


def gaussian_process_residual(
    vehicle: Vehicle, outputs: Sequence[GPOutput], mean_parameters: Sequence[float] | None = None, source: str = ""
) -> Residual:
    """Residual of one or more GP outputs.

    mean_parameters: [D (3,), b (3,), kappa] of the linear-drag mean function (see residual.linear_drag), or None.
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
    mean = np.zeros(N_PARAMETERS) if mean_parameters is None else np.asarray(mean_parameters, float)
    scales = [1.0 / (np.sqrt(2.0) * np.asarray(o.lengthscale, float)) for o in outputs]
    points = [
        (np.asarray(o.inducing, float).reshape(len(o.alpha), len(o.features)) * scale).T.reshape(-1)
        for o, scale in zip(outputs, scales, strict=True)
    ]
    alphas = [np.asarray(o.alpha, float) for o in outputs]
    function = _posterior_mean_function(names, structure, with_mean=bool(np.any(mean)))
    return Residual("gaussian_process", function, np.concatenate([mean, *scales, *points, *alphas]), source)


def _posterior_mean_function(
    names: tuple[str, ...], structure: tuple[tuple[str, tuple[str, ...], int], ...], *, with_mean: bool
) -> ca.Function:
    """(z, theta) -> y, dy/dz for outputs of the given (output, features, number of points).

    theta: parameters of the mean function, then s, s Z and alpha of all outputs, one after the other.
    """
    n_alpha = [m for _, _, m in structure]
    n_point = [m for _, features, m in structure for _ in features]
    sizes = [N_PARAMETERS, len(n_point), sum(n_point), sum(n_alpha)]
    z, theta = ca.MX.sym("z", len(names)), ca.MX.sym("theta", sum(sizes))
    drag, scale, points, alpha = _split(theta, sizes)
    select, assemble = _scalar_functions(names, structure, with_mean=with_mean)

    scaled = ca.vertsplit(select(z, scale))
    distance = [feature - point for feature, point in zip(scaled, _split(points, n_point), strict=True)]
    of_output = [i for i, (_, features, _) in enumerate(structure) for _ in features]
    exponent = [sum(d * d for d, i in zip(distance, of_output, strict=True) if i == o) for o in range(len(structure))]
    kernel = ca.exp(-ca.vertcat(*exponent))  # all outputs at once: a long loop
    weighted = _split(alpha * kernel, n_alpha)
    values = [ca.dot(a, k) for a, k in zip(_split(alpha, n_alpha), _split(kernel, n_alpha), strict=True)]
    slopes = [ca.dot(weighted[i], d) for d, i in zip(distance, of_output, strict=True)]
    y, dy_dz = assemble(z, drag, scale, ca.vertcat(*values), ca.vertcat(*slopes))
    return ca.Function("residual_gaussian_process", [z, theta], [y, dy_dz], ["z", "theta"], ["y", "dy_dz"])


def _split(vector, sizes: Sequence[int]):
    return ca.vertsplit(vector, np.cumsum([0, *sizes]).tolist())


def _scalar_functions(names, structure, *, with_mean: bool) -> tuple[ca.Function, ca.Function]:
    """What comes before and after the sums over points:

    (z, s) -> s phi of all features; (z, drag, s, (alpha k) 1, (alpha k)^T d) -> y, dy/dz with structural zeros, where
    drag are the parameters of the mean function.
    """
    z, drag = ca.SX.sym("z", len(names)), ca.SX.sym("drag", N_PARAMETERS)
    n_features = sum(len(features) for _, features, _ in structure)
    scale, slope = ca.SX.sym("scale", n_features), ca.SX.sym("slope", n_features)
    value = ca.SX.sym("value", len(structure))
    y, dy_dz = ca.SX(N_OUTPUTS, 1), ca.SX(N_OUTPUTS, len(names))
    if with_mean:
        y[:3] = linear_drag_acceleration(z, drag)
        dy_dz[:3, :] = ca.jacobian(y[:3], z)
    phi = []
    for i, (output, features, _) in enumerate(structure):
        row = OUTPUTS.index(output)
        y[row] += value[i]
        for feature in features:
            columns = list(range(6, len(names))) if feature == COLLECTIVE_THRUST else [names.index(feature)]
            dy_dz[row, columns] -= 2 * scale[len(phi)] * slope[len(phi)]
            phi.append(ca.sum1(z[columns]))
    select = ca.Function("select", [z, scale], [scale * ca.vertcat(*phi)])
    return select, ca.Function("assemble", [z, drag, scale, value, slope], [ca.sparsify(y), ca.sparsify(dy_dz)])
