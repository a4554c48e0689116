"""A neural network of the residual, its predictions in numpy, and its fit. Equations: quadexp/air/neural.py.

Features are scaled to mean 0 and standard deviation 1, every output by its root mean square. The mean squared error,
and a small penalty on the weights, is minimised over all rows at once by L-BFGS: residuals of simulated flights have so
little noise that stochastic steps with batches stop at ten times the error.

With nn.spectral = G, every one of the L + 1 weight matrices W is W' min(1, g / |W'|_2), g = G^(1 / (L + 1)), and W' is
what is optimised (Miyato et al. 2018; Shi et al. 2019): the scaled network then has slopes of at most G, because those
of the activation are at most 1. The scaling of the data goes into the first and the last layer in the end.

The same seed gives the same weights on one machine: double precision, one thread, an own random generator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.metadata import version
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from quadexp.air.network import Network, evaluated
from quadexp.models.settings import NNKeys
from quadexp.parts.settings import record
from quadexp.errors import DataError, UsageError
from quadexp.models.base import Callback, Model, Output, Prediction, Shape
from quadexp.models.dataset import ResidualDataset
from quadexp.models.gaussian_process import one_thread
from quadexp.models.linear_drag import LinearDrag, fit_linear_drag
from quadexp.models.support import feature_ranges
from quadexp.models.thrust_scale import has_thrust_scale, with_common_scale
from quadexp.physics.correction import OUTPUTS

if TYPE_CHECKING:
    import torch

    from quadexp.air.adapting import Adapting
    from quadexp.air.base import Residual
    from quadexp.physics.vehicle import Vehicle


@dataclass(frozen=True)
class NNSettings(NNKeys):
    """How the network is made and trained (see NNKeys for the keys of the `nn` configuration group)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for output in self.outputs:
            if output not in OUTPUTS:
                raise UsageError(f"nn.outputs: {output!r} is no output; allowed are {', '.join(OUTPUTS)}")
        for key in ("features", "outputs"):
            names = getattr(self, key)
            if not names or len(set(names)) < len(names):
                raise UsageError(f"nn.{key}=[{','.join(names)}]: at least one is needed, and each only once")
        if not self.hidden:
            raise UsageError("nn.hidden=[]: at least one hidden layer is needed")

    def as_dict(self) -> dict[str, Any]:
        return record(self)


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
    Settings = NNSettings

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.outputs)) < len(self.outputs):
            raise ValueError(f"outputs are {', '.join(self.outputs)}; each is allowed once")
        if not all(b.ndim == 1 for b in self.biases) or len(self.biases) < 2 or self.sizes[-1] != len(self.outputs):
            raise ValueError("biases must be one list for every layer, the last as long as the outputs")
        right = [(rows, columns) for columns, rows in pairwise(self.sizes)]
        if [w.shape for w in self.weights] != right:
            shapes = ", ".join(str(w.shape) for w in self.weights)
            raise ValueError(f"weights are of the shapes {shapes}; features, biases and outputs need {right}")

    @property
    def network(self) -> Network:
        """The network alone."""
        return Network(self.features, self.outputs, self.weights, self.biases)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of features, of the units of every hidden layer, and of outputs."""
        return self.network.sizes

    def predict(self, rows: ResidualDataset) -> dict[str, Prediction]:
        """See Model.predict."""
        means = evaluated(self.network, rows.matrix(self.features)).T
        parts = zip(self.outputs, means, self.residual_std**2, strict=True)
        return {output: Prediction(mean, None, float(variance)) for output, mean, variance in parts}

    def residual(self, vehicle: Vehicle, source: str = "", part: str = "best") -> Residual:
        """See Model.residual."""
        from quadexp.air.neural import neural_residual

        if part not in ("best", "neural"):
            raise UsageError(f"{source}: holds a network, not '{part}'")
        return neural_residual(vehicle, self.network, source)

    def adapting(self, vehicle: Vehicle, residual: Residual, deviation: float | None) -> Adapting:
        """See Model.adapting."""
        from quadexp.air.adapting import adapting_network

        assert deviation is not None
        return adapting_network(residual, self.network, deviation)

    @classmethod
    def fit(cls, rows: ResidualDataset, settings: NNSettings, **options: Any) -> NeuralModel:
        """See Model.fit; always from the start that the seed gives."""
        return fit_network(rows, settings, callback=options.get("callback"))

    @property
    def summary(self) -> str:
        """See Model.summary."""
        layers = "-".join(map(str, self.sizes))
        return (
            f"neural network {layers}, {', '.join(self.outputs)} <- {', '.join(self.features)}, largest slope"
            f" of the scaled network at most {self.lipschitz:.3g},"
        )

    @property
    def numbers(self) -> dict[str, Any]:
        """See Model.numbers."""
        return {"lipschitz": self.lipschitz}


def fit_network(
    dataset: ResidualDataset,
    settings: NNSettings | None = None,
    *,
    callback: Callback | None = None,
) -> NeuralModel:
    """Train a network on all rows of the dataset; callback: called with a message and the completed share, 0 .. 1.

    Raises DataError where the dataset is empty or lacks a feature or output, or where a feature is constant; UsageError
    where nn.device=cuda and there is none.
    """
    settings = settings or NNSettings()
    if not dataset.n_rows:
        raise DataError("dataset: it has no rows")
    device = _device(settings.device)
    recorded = has_thrust_scale(dataset)
    if recorded:
        dataset = with_common_scale(dataset).dataset
    x, y = dataset.matrix(settings.features), dataset.matrix(settings.outputs)
    centre, spread = x.mean(axis=0), x.std(axis=0)
    constant = [name for name, std in zip(settings.features, spread, strict=True) if std < 1e-9]
    if constant:
        raise DataError(f"nn.features: '{constant[0]}' never changes over the {len(x)} rows; leave it out")
    unit = np.sqrt(np.mean(y**2, axis=0))
    unit[unit == 0] = 1.0
    with one_thread():
        weights, biases = _train((x - centre) / spread, y / unit, settings, device, callback)
    lipschitz = math.prod(float(np.linalg.norm(w, 2)) for w in weights)
    weights[0] = weights[0] / spread
    biases[0] = biases[0] - weights[0] @ centre
    weights[-1], biases[-1] = unit[:, None] * weights[-1], unit * biases[-1]
    model = NeuralModel(
        settings.features,
        settings.outputs,
        tuple(weights),
        tuple(biases),
        np.zeros(len(settings.outputs)),
        lipschitz,
        fit_linear_drag(dataset, thrust=not recorded, intervals=False),
        vehicle=dict(dataset.metadata.get("vehicle") or {}),
        dataset=dataset.summary(),
        settings=settings.as_dict(),
        feature_range=feature_ranges(dataset, settings.features),
        versions={library: version(library) for library in ("numpy", "scipy", "torch")},
    )
    left = y - evaluated(model.network, x)
    model.residual_std[:] = np.sqrt(np.mean(left**2, axis=0))
    return model


def _device(name: str) -> torch.device:
    import torch

    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise UsageError("nn.device=cuda: torch finds no CUDA device; use nn.device=cpu")
    return torch.device(name)


def _train(
    x: np.ndarray, y: np.ndarray, settings: NNSettings, device: torch.device, callback: Callback | None
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weights and biases of the scaled network for scaled features (k, d) and outputs (k, o)."""
    import torch
    from scipy.optimize import minimize

    rng = np.random.default_rng(settings.seed)  # the same draws on every device
    shapes = [(rows, columns) for columns, rows in pairwise([x.shape[1], *settings.hidden, y.shape[1]])]
    start = [rng.normal(size=shape) / math.sqrt(shape[1]) for shape in shapes]
    start += [rng.normal(size=rows) for rows, _ in shapes[:-1]] + [np.zeros(y.shape[1])]
    given, target = (torch.as_tensor(values, dtype=torch.float64).to(device) for values in (x, y))
    largest = None if settings.spectral is None else settings.spectral ** (1 / len(shapes))
    ends = np.cumsum([part.size for part in start])

    def parts(flat: torch.Tensor) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        pieces = torch.tensor_split(flat, ends[:-1].tolist())
        weights = [piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=False)]
        if largest is not None:
            weights = [w * torch.clamp(largest / torch.linalg.matrix_norm(w, 2), max=1.0) for w in weights]
        return weights, list(pieces[len(shapes) :])

    def loss(values: np.ndarray) -> tuple[float, np.ndarray]:
        flat = torch.tensor(values, dtype=torch.float64, device=device, requires_grad=True)
        weights, biases = parts(flat)
        error = (_forward(given, weights, biases) - target).square().mean()
        value = error + settings.penalty * torch.stack([w.square().mean() for w in weights]).sum()
        value.backward()
        return value.item(), flat.grad.cpu().numpy()

    done = 0

    def step(_: np.ndarray) -> None:
        nonlocal done
        done += 1
        if callback is not None:
            callback("fit network", done / settings.max_iterations)

    result = minimize(
        loss, np.concatenate([part.ravel() for part in start]), jac=True, method="L-BFGS-B", callback=step,
        options={"maxiter": settings.max_iterations, "maxfun": 2 * settings.max_iterations, "maxcor": 30,
                 "ftol": 1e-12, "gtol": 1e-8},
    )  # fmt: skip
    found = [[part.detach().cpu().numpy().copy() for part in some] for some in parts(torch.tensor(result.x))]
    return found[0], found[1]


def _forward(x: torch.Tensor, weights: list[torch.Tensor], biases: list[torch.Tensor]) -> torch.Tensor:
    for w, b in zip(weights[:-1], biases[:-1], strict=True):
        t = x @ w.T + b
        x = t * (1 + t * t).rsqrt()
    return x @ weights[-1].T + biases[-1]
