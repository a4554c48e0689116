"""One scale of the thrust for flights under a thrust curve: that of another battery is no question of the air."""

from __future__ import annotations

import numpy as np

from quadexp.models.common_scale import CommonScale
from quadexp.models.dataset import ResidualDataset
from quadexp.models.residual import THRUST, VELOCITY
from quadexp.plugins.aerodynamics.blocks import autocorrelation_time

ROUNDS = 60  # of expectation and maximisation


def common_scale(dataset: ResidualDataset) -> CommonScale:
    """Bring e_f, the error of the thrust's scale on each flight, to its mean over the flights."""
    mass = dataset.metadata["vehicle"]["mass"]
    acceleration = dataset.matrix([THRUST])[:, 0] / mass
    a_z = dataset.matrix(["a_z"])[:, 0].copy()
    indices, flight = np.unique(dataset.columns["flight"], return_inverse=True)
    scales = _scales_of_flights(a_z, acceleration, dataset.matrix(VELOCITY), flight)
    a_z -= (scales - scales.mean())[flight] * acceleration
    columns = dict(dataset.columns) | {"a_z": a_z}
    errors = {int(index): float(scale) for index, scale in zip(indices, scales, strict=True)}
    return CommonScale(ResidualDataset(columns, dataset.metadata), errors, float(acceleration.mean()))


def _scales_of_flights(a_z: np.ndarray, thrust: np.ndarray, velocity: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """e + e_f, (flights,), of the mixed model. a_z, thrust (T / m): (k,); velocity: (k, 3) body; flight: (k,) index."""
    count = int(flight.max()) + 1
    v_z = velocity[:, 2]
    air = np.column_stack([velocity[:, 0] ** 2 + velocity[:, 1] ** 2, v_z, np.abs(v_z) * v_z])
    air = air[:, air.any(axis=0)]
    each = np.zeros((len(a_z), count))
    each[np.arange(len(a_z)), flight] = thrust
    design = np.column_stack([thrust, air, each])
    size = np.sqrt(np.mean(design**2, axis=0)) + 1e-12
    size[-count:] = size[0]  # a scale of one flight is compared with that of all
    design = design / size
    fixed = design.shape[1] - count
    normal, mixed = design.T @ design, design.T @ a_z
    alone = np.linalg.lstsq(design, a_z, rcond=None)[0]
    together = max(autocorrelation_time((a_z - design @ alone)[flight == index]) for index in range(count))
    noise, spread = float(np.mean((a_z - design @ alone) ** 2)) + 1e-12, float(np.mean(alone[fixed:] ** 2)) + 1e-12
    for _ in range(ROUNDS):
        precision = normal / (noise * together)
        precision[np.arange(fixed, len(precision)), np.arange(fixed, len(precision))] += 1 / spread
        covariance = np.linalg.pinv(precision, hermitian=True)
        scales = covariance @ mixed / (noise * together)
        noise = float(np.mean((a_z - design @ scales) ** 2)) + 1e-12
        spread = float(np.mean(scales[fixed:] ** 2 + np.diag(covariance)[fixed:])) + 1e-12
    return (scales[0] + scales[fixed:]) / size[0]
