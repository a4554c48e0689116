"""Predictions of a fitted Gaussian process in numpy, without torch and CasADi. Equations: model.py."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.learn.dataset import ResidualDataset
from quadexp.learn.model import GPModel, OutputPosterior

AXIS = {"a_x": 0, "a_y": 1, "a_z": 2}  # outputs that linear drag predicts
CHUNK = 4096  # rows at a time, to limit memory


@dataclass(frozen=True)
class Prediction:
    """mean: (k,), unit of the output. variance: (k,), of the function. noise_variance: of one measurement."""

    mean: np.ndarray
    variance: np.ndarray
    noise_variance: float

    @property
    def std(self) -> np.ndarray:
        """Standard deviation of a new measurement, (k,)."""
        return np.sqrt(self.variance + self.noise_variance)


def posterior(output: OutputPosterior, features: np.ndarray) -> Prediction:
    """Posterior of one output without its prior mean; features (k, d) in physical units."""
    mean, variance = np.empty(len(features)), np.empty(len(features))
    for start in range(0, len(features), CHUNK):
        rows = slice(start, start + CHUNK)
        distance = (features[rows, None, :] - output.inducing) / output.lengthscale
        e = np.exp(-0.5 * np.einsum("kmd,kmd->km", distance, distance))
        mean[rows] = e @ output.alpha
        variance[rows] = output.signal_variance - np.sum((e @ output.variance_factor.T) ** 2, axis=1)
    return Prediction(mean, np.maximum(variance, 0.0), output.noise_variance)


def predict(model: GPModel, dataset: ResidualDataset) -> dict[str, Prediction]:
    """Prediction of every output of the model at the rows of a dataset, prior mean included.

    Raises DataError if the dataset lacks a feature.
    """
    prior = None if model.mean is None else model.mean.acceleration(dataset)
    predictions = {}
    for output in model.outputs:
        result = posterior(output, dataset.matrix(output.features))
        if prior is not None and output.output in AXIS:
            result = Prediction(result.mean + prior[:, AXIS[output.output]], result.variance, result.noise_variance)
        predictions[output.output] = result
    return predictions
