"""A fitted neural network of the residual, and its predictions in numpy. Equations: quadexp/air/neural.py."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from quadexp.air.network import Network, evaluated
from quadexp.config.learning import NNKeys
from quadexp.config.settings import record
from quadexp.errors import UsageError
from quadexp.learn.dataset import ResidualDataset
from quadexp.learn.linear_drag import LinearDrag
from quadexp.physics.correction import OUTPUTS


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


@dataclass(frozen=True)
class NeuralModel:
    """A network with weights in physical units.

    weights: W_1 .. W_L, W_o. biases: b_1 .. b_L, b_o. residual_std: root mean square error on the rows of the fit, per
    output. lipschitz: product of the layers' spectral norms, in units of the standard deviations of features and
    outputs: a bound on the slope of the scaled network. linear_drag: baseline fitted to the same rows. Others
    as in GPModel.
    """

    features: tuple[str, ...]
    outputs: tuple[str, ...]
    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    residual_std: np.ndarray
    lipschitz: float
    linear_drag: LinearDrag
    vehicle: dict[str, Any]
    dataset: dict[str, Any]
    settings: dict[str, Any]
    feature_range: dict[str, list[float]]
    versions: dict[str, str] = field(default_factory=dict)

    @property
    def network(self) -> Network:
        """The network alone."""
        return Network(self.features, self.outputs, self.weights, self.biases)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of features, of the units of every hidden layer, and of outputs."""
        return self.network.sizes

    def predict(self, dataset: ResidualDataset) -> Mapping[str, np.ndarray]:
        """Output -> prediction at the rows of a dataset, (k,). Raises DataError if it lacks a feature."""
        return dict(zip(self.outputs, evaluated(self.network, dataset.matrix(self.features)).T, strict=True))

    def shapes_fit(self) -> bool:
        """Whether the weights and biases belong to these features and outputs."""
        right = [(rows, columns) for columns, rows in pairwise(self.sizes)]
        return (
            len(self.weights) == len(self.biases) > 1
            and [w.shape for w in self.weights] == right
            and self.biases[-1].shape == (len(self.outputs),)
            and all(b.ndim == 1 for b in self.biases)
        )
