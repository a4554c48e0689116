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
    blocks = [mean]
    for o in outputs:
        scale = 1.0 / (np.sqrt(2.0) * np.asarray(o.lengthscale, float))
        points = np.asarray(o.inducing, float).reshape(len(o.alpha), len(o.features)) * scale
        blocks += [scale, points.T.reshape(-1), np.asarray(o.alpha, float)]
    function = _posterior_mean_function(names, structure, with_mean=bool(np.any(mean)))
    return Residual("gaussian_process", function, np.concatenate(blocks), source)


def _posterior_mean_function(
    names: tuple[str, ...], structure: tuple[tuple[str, tuple[str, ...], int], ...], *, with_mean: bool
) -> ca.Function:
    """(z, theta) -> y, dy/dz for outputs of the given (output, features, number of points)."""
    n_features = len(names)
    z = ca.MX.sym("z", n_features)
    theta = ca.MX.sym("theta", N_PARAMETERS + sum(len(f) * (m + 1) + m for _, f, m in structure))
    values, gradients, rows = [], [], []
    at = N_PARAMETERS
    for output, features, m in structure:
        d = len(features)
        scale, points, alpha = (
            theta[at : at + d],
            theta[at + d : at + d + d * m],
            theta[at + d + d * m : at + d + d * m + m],
        )
        at += d + d * m + m
        distance = []
        for i, feature in enumerate(features):
            phi = ca.sum1(z[6:]) if feature == COLLECTIVE_THRUST else z[names.index(feature)]
            distance.append(scale[i] * phi - points[i * m : (i + 1) * m])
        exponent = distance[0] * distance[0]
        for e in distance[1:]:
            exponent = exponent + e * e
        weighted = alpha * ca.exp(-exponent)
        values.append(ca.sum1(weighted))
        gradients += [-2 * scale[i] * ca.dot(weighted, distance[i]) for i in range(d)]
        rows.append(OUTPUTS.index(output))
    assemble = _assembly_function(names, structure, rows, with_mean=with_mean)
    y, dy_dz = assemble(z, theta[:N_PARAMETERS], ca.vertcat(*values), ca.vertcat(*gradients))
    return ca.Function("residual_gaussian_process", [z, theta], [y, dy_dz], ["z", "theta"], ["y", "dy_dz"])


def _assembly_function(names, structure, rows, *, with_mean: bool) -> ca.Function:
    """(z, mean parameters, values, gradients) -> y, dy/dz with structural zeros, mean function added."""
    z, drag = ca.SX.sym("z", len(names)), ca.SX.sym("drag", N_PARAMETERS)
    value = ca.SX.sym("value", len(structure))
    gradient = ca.SX.sym("gradient", sum(len(features) for _, features, _ in structure))
    y, dy_dz = ca.SX(N_OUTPUTS, 1), ca.SX(N_OUTPUTS, len(names))
    if with_mean:
        y[:3] = linear_drag_acceleration(z, drag)
        dy_dz[:3, :] = ca.jacobian(y[:3], z)
    at = 0
    for i, (row, (_, features, _)) in enumerate(zip(rows, structure, strict=True)):
        y[row] += value[i]
        for feature in features:
            columns = range(6, len(names)) if feature == COLLECTIVE_THRUST else [names.index(feature)]
            for column in columns:
                dy_dz[row, column] += gradient[at]
            at += 1
    return ca.Function("assemble", [z, drag, value, gradient], [ca.sparsify(y), ca.sparsify(dy_dz)])
