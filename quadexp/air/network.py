"""A multilayer perceptron: its weights, and its values in numpy. Equations: quadexp/air/neural.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


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


def evaluated(network: Network, features: np.ndarray) -> np.ndarray:
    """Outputs (k, o) at features (k, d)."""
    x = features
    for w, b in zip(network.weights[:-1], network.biases[:-1], strict=True):
        t = x @ w.T + b
        x = t / np.sqrt(1 + t * t)
    return x @ network.weights[-1].T + network.biases[-1]
