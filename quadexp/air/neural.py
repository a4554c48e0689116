"""Neural-network residual: a small multilayer perceptron with its analytic Jacobian.

    x_0 = B z,   x_l = s(W_l x_{l-1} + b_l),  l = 1 .. L,      y = W_o x_L + b_o,      s(t) = t / sqrt(1 + t^2)
    dy/dz = W_o D_L W_L .. D_1 W_1 B,          D_l = diag(s'),  s'(t) = (1 + t^2)^(-3/2)

B selects the features among body velocity, rates, rotor thrusts and their sum (B_z of Torrente et al. 2021). s is
smooth, bounded by 1 and has slopes of at most 1, so the outputs are bounded outside the data too, and the product of
the layers' spectral norms bounds the slope of y. It needs a square root and a division and no exponential, so that
compilers vectorise it.

All weights are parameters: networks of the same sizes share one compiled function. The Jacobian is computed backwards,
with one row per output.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from quadexp.air.base import OUTPUTS, Residual, feature_names
from quadexp.air.gaussian_process import COLLECTIVE_THRUST
from quadexp.air.network import Network
from quadexp.compile.backend import handwritten
from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle

LAYER, BACKWARD = (Path(__file__).with_name(name) for name in ("neural_layer.c", "neural_backward.c"))

Layer = Callable[[Expression, Expression, Expression], tuple[Expression, Expression]]  # W, b, x -> s, s'
Backward = Callable[[Expression, Expression, Expression], Expression]  # G, s', W -> G diag(s') W


def neural_residual(vehicle: Vehicle, network: Network, source: str = "") -> Residual:
    """Residual of a network; theta holds W_1 (column by column), b_1, .., W_o, b_o.

    Raises UsageError for an unknown feature or output, and for weights that do not fit together.
    """
    names = feature_names(vehicle.n_rotors)
    for feature in network.features:
        if feature not in (*names, COLLECTIVE_THRUST):
            raise UsageError(f"network feature {feature!r}: allowed are {', '.join((*names, COLLECTIVE_THRUST))}")
    for output in network.outputs:
        if output not in OUTPUTS:
            raise UsageError(f"network output {output!r}: allowed are {', '.join(OUTPUTS)}")
    shapes = [np.shape(w) for w in network.weights]
    if shapes != [(rows, columns) for columns, rows in pairwise(network.sizes)]:
        raise UsageError(f"network: weights of the shapes {shapes} do not fit {network.sizes} units")
    function, to_compile = (
        _network_function(names, network.features, network.outputs, network.sizes, *form)
        for form in ((_layer, _backward), (_compiled_layer, _compiled_backward))
    )
    theta = np.concatenate(
        [part for w, b in zip(network.weights, network.biases, strict=True) for part in (w.T.ravel(), b)]
    )
    return Residual("neural", function, theta, source, to_compile)


def _network_function(
    names: tuple[str, ...],
    features: tuple[str, ...],
    outputs: tuple[str, ...],
    sizes: tuple[int, ...],
    layer: Layer,
    backward: Backward,
) -> ca.Function:
    """(z, theta) -> y, dy/dz for a network of these sizes."""
    lengths = [length for columns, rows in pairwise(sizes) for length in (rows * columns, rows)]
    z, theta = ca.MX.sym("z", len(names)), ca.MX.sym("theta", sum(lengths))
    parts = ca.vertsplit(theta, np.cumsum([0, *lengths]).tolist())
    weights = [ca.reshape(w, rows, columns) for w, (columns, rows) in zip(parts[::2], pairwise(sizes), strict=True)]
    select = _selection(names, features)
    place = ca.sparsify(ca.DM(np.array([[name == output for output in outputs] for name in OUTPUTS], float)))
    x, slopes = ca.mtimes(select, z), []
    for w, b in zip(weights[:-1], parts[1:-1:2], strict=True):
        x, slope = layer(w, b, x)
        slopes.append(slope)
    y, gradient = ca.mtimes(weights[-1], x) + parts[-1], weights[-1]
    for w, slope in zip(reversed(weights[:-1]), reversed(slopes), strict=True):
        gradient = backward(gradient, slope, w)
    results = [ca.mtimes(place, y), ca.mtimes(place, ca.mtimes(gradient, select))]
    return ca.Function("residual_neural", [z, theta], results, ["z", "theta"], ["y", "dy_dz"])


def _selection(names: Sequence[str], features: Sequence[str]) -> ca.DM:
    """B, (d, 6 + n)."""
    thrusts = [name.startswith("u_") for name in names]
    rows = [thrusts if feature == COLLECTIVE_THRUST else [name == feature for name in names] for feature in features]
    return ca.sparsify(ca.DM(np.array(rows, float)))


def activation(t: Expression) -> tuple[Expression, Expression]:
    """s(t) and s'(t), elementwise; for numpy arrays and CasADi expressions."""
    q = 1 / (1 + t * t) ** 0.5
    return t * q, q * q * q


def _layer(w: Expression, b: Expression, x: Expression) -> tuple[Expression, Expression]:
    return activation(ca.mtimes(w, x) + b)


def _backward(gradient: Expression, slope: Expression, w: Expression) -> Expression:
    return ca.mtimes(gradient * ca.repmat(slope.T, gradient.size1(), 1), w)


def _compiled_layer(w: Expression, b: Expression, x: Expression) -> tuple[Expression, Expression]:
    """As _layer, by neural_layer.c."""
    rows, columns = w.shape
    dense = ca.Sparsity.dense
    kernel = handwritten(
        f"neural_layer_{rows}_{columns}",
        LAYER,
        {"ROWS": rows, "COLUMNS": columns},
        {"weight": dense(rows, columns), "bias": dense(rows), "x": dense(columns)},
        {"value": dense(rows), "slope": dense(rows)},
    )
    value, slope = kernel(w, b, x)
    return value, slope


def _compiled_backward(gradient: Expression, slope: Expression, w: Expression) -> Expression:
    """As _backward, by neural_backward.c; the gradient is stored with its outputs along the columns."""
    (rows, columns), outputs = w.shape, gradient.size1()
    dense = ca.Sparsity.dense
    kernel = handwritten(
        f"neural_backward_{outputs}_{rows}_{columns}",
        BACKWARD,
        {"OUTPUTS": outputs, "ROWS": rows, "COLUMNS": columns},
        {"gradient": dense(outputs, rows), "slope": dense(rows), "weight": dense(rows, columns)},
        {"product": dense(outputs, columns)},
    )
    return kernel(gradient, slope, w)
