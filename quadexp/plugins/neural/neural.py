"""A neural network of the residual: a small multilayer perceptron with its analytic Jacobian.

    x_0 = B z,   x_l = s(W_l x_{l-1} + b_l),  l = 1 .. L,      y = W_o x_L + b_o,      s(t) = t / sqrt(1 + t^2)
    dy/dz = W_o D_L W_L .. D_1 W_1 B,          D_l = diag(s'),  s'(t) = (1 + t^2)^(-3/2)

B selects the features among body velocity, rates, rotor thrusts and their sum (B_z of Torrente et al. 2021). s is
smooth, bounded by 1 and has slopes of at most 1, so the outputs are bounded outside the data too, and the product of
the layers' spectral norms bounds the slope of y. It needs a square root and a division and no exponential, so that
compilers vectorise it. All weights are parameters: networks of the same sizes share one compiled function. The Jacobian
is computed backwards, with one row per output.

In the fit features are scaled to mean 0 and standard deviation 1, every output by its root mean square. The mean
squared error, and a small penalty on the weights, is minimised over all rows at once by L-BFGS: residuals of simulated
flights have so little noise that stochastic steps with batches stop at ten times the error.

With model.spectral = G, every one of the L + 1 weight matrices W is W' min(1, g / |W'|_2), g = G^(1 / (L + 1)), and W'
is what is optimised (Miyato et al. 2018; Shi et al. 2019): the scaled network then has slopes of at most G, because
those of the activation are at most 1. The scaling of the data goes into the first and the last layer in the end.

The same seed gives the same weights on one machine: double precision, one thread, an own random generator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import count, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np

from quadexp.compile.backend import handwritten
from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.log.schema import describe
from quadexp.models.adapting import Adapting, Block
from quadexp.models.base import (
    AXIS,
    Callback,
    Model,
    ModelPart,
    Output,
    Prediction,
    Shape,
    one_thread,
    origin,
    quiet,
    require_variation,
)
from quadexp.models.common_scale import with_common_scale
from quadexp.models.dataset import ResidualDataset
from quadexp.models.linear_drag import LinearDrag, baseline
from quadexp.models.residual import OUTPUTS, Residual, check_features, feature_names, feature_places, residual_function
from quadexp.parts.settings import SEEDS, key, keyed
from quadexp.physics.expression import Expression, split, symbols
from quadexp.physics.vehicle import Vehicle

if TYPE_CHECKING:
    import torch

LAYER = Path(__file__).with_name("neural_layer.c")
BACKWARD = Path(__file__).with_name("neural_backward.c")

Layer = Callable[[Expression, Expression, Expression], tuple[Expression, Expression]]  # W, b, x -> s, s'
Backward = Callable[[Expression, Expression, Expression], Expression]  # G, s', W -> G diag(s') W


class Network(NamedTuple):
    """features, outputs: names. weights: W_1 .. W_L, W_o, (rows, columns) each. biases: b_1 .. b_L, b_o; SI units."""

    features: tuple[str, ...]
    outputs: tuple[str, ...]
    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of features, of the units of every hidden layer, and of outputs."""
        return (len(self.features), *(len(b) for b in self.biases))

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Outputs (k, o) at features (k, d)."""
        x = features
        for w, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            t = x @ w.T + b
            x = t / np.sqrt(1 + t * t)
        return x @ self.weights[-1].T + self.biases[-1]


def activation(t: Expression) -> tuple[Expression, Expression]:
    """s(t) and s'(t), elementwise; for numpy arrays and CasADi expressions."""
    q = 1 / (1 + t * t) ** 0.5
    return t * q, q * q * q


@keyed
class NNConfig(ModelPart):
    """How the neural network is made and trained; see quadexp/plugins/neural/neural.py."""

    features: tuple[str, ...] = key(("v_x", "v_y", "v_z", "thrust"), "features of all outputs")
    outputs: tuple[str, ...] = key(("a_x", "a_y", "a_z"), "outputs; the others are not corrected")
    hidden: tuple[int, ...] = key((16, 16), "units of every hidden layer", "[1, 1000]", "units")
    spectral: float | None = key(
        None, "largest slope of the scaled network, by spectral normalisation; null: no limit", "(0, 1000]"
    )
    max_iterations: int = key(400, "largest number of L-BFGS iterations", "[1, 100000]")
    penalty: float = key(
        1e-6, "penalty on every layer's mean square weight, relative to the outputs' mean square", "[0, 1]"
    )
    seed: int = key(0, "seed of held-out flights, first weights", SEEDS)
    refit: bool = key(True, "after the report, fit again to all flights", when="holdout")

    def check_together(self) -> None:
        check_features("model.features", self.features)
        if unknown := set(self.outputs) - set(OUTPUTS):
            raise UsageError(f"model.outputs: {min(unknown)!r} is no output; allowed are {', '.join(OUTPUTS)}")
        for name in ("features", "outputs"):
            names = getattr(self, name)
            if not names or len(set(names)) < len(names):
                raise UsageError(f"model.{name}=[{','.join(names)}]: at least one is needed, and each only once")
        if not self.hidden:
            raise UsageError("model.hidden=[]: at least one hidden layer is needed")

    def fit(self, rows: ResidualDataset, *, callback: Callback = quiet, **_: Any) -> NeuralModel:
        """See ModelPart; always from the start that the seed gives."""
        return fit_network(rows, self, callback)


class NeuralModel(Model, frozen=True, tag="neural"):
    """A network with weights in physical units.

    weights: W_1 .. W_L, W_o. biases: b_1 .. b_L, b_o. residual_std: root mean square error on the rows of the fit, per
    output. lipschitz: product of the layers' spectral norms, in units of the standard deviations of features and
    outputs: a bound on the slope of the scaled network. linear_drag: baseline fitted to the same rows.
    """

    features: tuple[str, ...]
    outputs: tuple[Output, ...]
    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    residual_std: Annotated[np.ndarray, Shape("outputs")]
    lipschitz: float
    linear_drag: LinearDrag
    predictor = "nn"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_each_once(self.outputs)
        sizes = self.network.sizes
        if not all(b.ndim == 1 for b in self.biases) or len(self.biases) < 2 or sizes[-1] != len(self.outputs):
            raise ValueError("biases must be one list for every layer, the last as long as the outputs")
        right = [(rows, columns) for columns, rows in pairwise(sizes)]
        if [w.shape for w in self.weights] != right:
            shapes = ", ".join(str(w.shape) for w in self.weights)
            raise ValueError(f"weights are of the shapes {shapes}; features, biases and outputs need {right}")

    @property
    def network(self) -> Network:
        """The network alone."""
        return Network(self.features, self.outputs, self.weights, self.biases)

    def predict(self, rows: ResidualDataset) -> dict[str, Prediction]:
        means = self.network(rows.matrix(self.features)).T
        parts = zip(self.outputs, means, self.residual_std**2, strict=True)
        return {output: Prediction(mean, None, float(variance)) for output, mean, variance in parts}

    def residual(self, vehicle: Vehicle, source: str = "", part: str = "best") -> Residual:
        self.require(part, source)
        return neural_residual(vehicle, self.network, source)

    def adapting(self, vehicle: Vehicle, residual: Residual, deviation: float) -> Adapting:
        return adapting_network(residual, self.network, deviation)

    @property
    def summary(self) -> str:
        layers = "-".join(map(str, self.network.sizes))
        return (
            f"neural network {layers}, {', '.join(self.outputs)} <- {', '.join(self.features)}, largest slope"
            f" of the scaled network at most {self.lipschitz:.3g},"
        )

    @property
    def numbers(self) -> dict[str, Any]:
        return {"lipschitz": self.lipschitz}

    def described(self, report: Callable[[], Mapping[str, Any]]) -> tuple[dict[str, Any], list[str]]:
        sizes = list(self.network.sizes)
        layers = "-".join(map(str, sizes))
        lines = [
            f"network     {layers} units: {', '.join(self.outputs)} from {', '.join(self.features)}",
            f"            largest slope of the scaled network at most {self.lipschitz:.3g}",
        ]
        for name, std in zip(self.outputs, self.residual_std, strict=True):
            lines.append(f"{name:<12}error on the rows of the fit {std:.3g} {describe(name, 'residuals').unit}")
        return {"sizes": sizes, "features": list(self.features), "lipschitz": self.lipschitz}, [
            *lines,
            *super().described(report)[1],
        ]


def fit_network(rows: ResidualDataset, settings: NNConfig, callback: Callback = quiet) -> NeuralModel:
    """The network that fits the rows, always from the start that the seed gives.

    Raises DataError where there are no rows, or a feature never changes."""
    require_variation(rows, settings.features, (), "model.features")
    drag = baseline(rows, intervals=False)
    rows = with_common_scale(rows).dataset
    x = rows.matrix(settings.features)
    y = rows.matrix(settings.outputs)
    centre = x.mean(axis=0)
    spread = x.std(axis=0)
    unit = np.sqrt(np.mean(y**2, axis=0))
    unit[unit == 0] = 1.0
    with one_thread():
        weights, biases = _train((x - centre) / spread, y / unit, settings, callback)
    lipschitz = math.prod(float(np.linalg.norm(w, 2)) for w in weights)
    weights[0] = weights[0] / spread
    biases[0] = biases[0] - weights[0] @ centre
    weights[-1] = unit[:, None] * weights[-1]
    biases[-1] = unit * biases[-1]
    network = Network(settings.features, settings.outputs, tuple(weights), tuple(biases))
    error = np.sqrt(np.mean((y - network(x)) ** 2, axis=0))
    about = origin(rows, settings.features, settings, ("numpy", "scipy", "torch"))
    return NeuralModel(*network, error, lipschitz, drag, **about)


def neural_residual(vehicle: Vehicle, network: Network, source: str = "") -> Residual:
    """Residual of a network; theta holds W_1 (column by column), b_1, .., W_o, b_o.

    Raises UsageError for an unknown feature.
    """
    function = _network_function(feature_names(vehicle.n_rotors), network, _layer, _backward)
    to_compile = _network_function(feature_names(vehicle.n_rotors), network, _compiled_layer, _compiled_backward)
    theta = []
    for w, b in zip(network.weights, network.biases, strict=True):
        theta += [w.T.ravel(), b]
    return Residual("neural", function, np.concatenate(theta), source, to_compile)


def adapting_network(residual: Residual, network: Network, deviation: float) -> Adapting:
    """The last layer's weights that adapt. deviation: s of quadexp.plugins.remedies.online, m/s^2."""
    outputs, units = np.shape(network.weights[-1])
    first = len(residual.theta) - outputs * (units + 1)
    root = deviation / np.sqrt(units + 1) * np.eye(units + 1)
    blocks = []
    for row, output in enumerate(network.outputs):
        if output in AXIS:
            at = np.append(first + row + outputs * np.arange(units), first + outputs * units + row)
            blocks.append(Block(AXIS[output], at, residual.theta[at], root))
    return Adapting(residual, tuple(blocks))


def _network_function(names: tuple[str, ...], network: Network, layer: Layer, backward: Backward) -> ca.Function:
    """(z, theta) -> y, dy/dz for a network of these sizes."""
    sizes = network.sizes
    lengths = []
    for columns, rows in pairwise(sizes):
        lengths += [rows * columns, rows]
    z, theta = symbols(ca.MX, z=len(names), theta=sum(lengths))
    parts = split(theta, lengths)
    weights = [ca.reshape(w, rows, columns) for w, (columns, rows) in zip(parts[::2], pairwise(sizes), strict=True)]
    places = feature_places(names, network.features, "network")
    select = _zeros_and_ones(places, len(names))
    place = _zeros_and_ones([[OUTPUTS.index(output)] for output in network.outputs], len(OUTPUTS)).T
    x = select @ z
    slopes = []
    for w, b in zip(weights[:-1], parts[1:-1:2], strict=True):
        x, slope = layer(w, b, x)
        slopes.append(slope)
    y = weights[-1] @ x + parts[-1]
    gradient = weights[-1]
    for w, slope in zip(reversed(weights[:-1]), reversed(slopes), strict=True):
        gradient = backward(gradient, slope, w)
    return residual_function("neural", z, theta, [place @ y, place @ (gradient @ select)])


def _zeros_and_ones(places: list[list[int]], columns: int) -> ca.DM:
    """A sparse matrix with a row for each list, and ones at its places."""
    return ca.sparsify(ca.DM([[float(column in ones) for column in range(columns)] for ones in places]))


def _layer(w: Expression, b: Expression, x: Expression) -> tuple[Expression, Expression]:
    return activation(w @ x + b)


def _backward(gradient: Expression, slope: Expression, w: Expression) -> Expression:
    return gradient * ca.repmat(slope.T, gradient.size1(), 1) @ w


def _compiled_layer(w: Expression, b: Expression, x: Expression) -> tuple[Expression, Expression]:
    """As _layer, by neural_layer.c."""
    (rows, columns), dense = w.shape, ca.Sparsity.dense
    arguments = {"weight": dense(rows, columns), "bias": dense(rows), "x": dense(columns)}
    sizes = {"ROWS": rows, "COLUMNS": columns}
    results = {"value": dense(rows), "slope": dense(rows)}
    value, slope = handwritten(f"neural_layer_{rows}_{columns}", LAYER, sizes, arguments, results)(w, b, x)
    return value, slope


def _compiled_backward(gradient: Expression, slope: Expression, w: Expression) -> Expression:
    """As _backward, by neural_backward.c; the gradient is stored with its outputs along the columns."""
    (rows, columns), outputs, dense = w.shape, gradient.size1(), ca.Sparsity.dense
    sizes = {"OUTPUTS": outputs, "ROWS": rows, "COLUMNS": columns}
    arguments = {"gradient": dense(outputs, rows), "slope": dense(rows), "weight": dense(rows, columns)}
    name = "_".join(map(str, ["neural_backward", *sizes.values()]))
    results = {"product": dense(outputs, columns)}
    return handwritten(name, BACKWARD, sizes, arguments, results)(gradient, slope, w)


def _train(
    x: np.ndarray, y: np.ndarray, settings: NNConfig, callback: Callback
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weights and biases of the scaled network for scaled features (k, d) and outputs (k, o)."""
    import torch
    from scipy.optimize import minimize

    rng = np.random.default_rng(settings.seed)
    shapes = []
    for columns, rows in pairwise([x.shape[1], *settings.hidden, y.shape[1]]):
        shapes.append((rows, columns))
    start = [rng.normal(size=shape) / math.sqrt(shape[1]) for shape in shapes]
    start += [rng.normal(size=rows) for rows, _ in shapes[:-1]] + [np.zeros(y.shape[1])]
    inputs = torch.as_tensor(x, dtype=torch.float64)
    target = torch.as_tensor(y, dtype=torch.float64)
    largest = None if settings.spectral is None else settings.spectral ** (1 / len(shapes))
    ends = np.cumsum([part.size for part in start])

    def parts(flat: torch.Tensor) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        pieces = torch.tensor_split(flat, ends[:-1].tolist())
        weights = [piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=False)]
        if largest is not None:
            weights = [w * torch.clamp(largest / torch.linalg.matrix_norm(w, 2), max=1.0) for w in weights]
        return weights, list(pieces[len(shapes) :])

    def loss(values: np.ndarray) -> tuple[float, np.ndarray]:
        flat = torch.tensor(values, dtype=torch.float64, requires_grad=True)
        weights, biases = parts(flat)
        x = inputs
        for w, b in zip(weights[:-1], biases[:-1], strict=True):
            t = x @ w.T + b
            x = t * (1 + t * t).rsqrt()
        error = (x @ weights[-1].T + biases[-1] - target).square().mean()
        value = error + settings.penalty * torch.stack([w.square().mean() for w in weights]).sum()
        value.backward()
        return value.item(), flat.grad.numpy()

    done = count(1)
    result = minimize(
        loss,
        np.concatenate([part.ravel() for part in start]),
        jac=True,
        method="L-BFGS-B",
        callback=lambda _: callback("fit network", next(done) / settings.max_iterations),
        options={
            "maxiter": settings.max_iterations,
            "maxfun": 2 * settings.max_iterations,
            "maxcor": 30,
            "ftol": 1e-12,
            "gtol": 1e-8,
        },
    )
    weights, biases = ([part.numpy().copy() for part in layers] for layers in parts(torch.tensor(result.x)))
    return weights, biases
