"""The thrust-scale error: by how much a vehicle's thrust differs from its thrust curve, from flight to flight.

    a_z = e_f T / m + acceleration of the air        e_f: of flight f; T / m: the thrust curve's acceleration, m/s^2

A used battery, another propeller or a warmer motor changes the thrust of a command by a few per cent, and no function
of the velocity can predict that. A regression over several flights would attribute it to whatever differs between them
(speed, mean thrust) and be wrong on the next one. So models are fitted to recorded flights after every flight's e_f has
been brought to their mean (`with_common_scale`), and the spread of e_f is added to the predicted variance.

On a new flight e is unknown at take-off and can be tracked from the accelerometer (`tracked_scale`):

    f_z - a_z(v) = g c + e        g_k = (p r^k + sum_{j<k} r^{k-j} c_j y_j) / (p r^k + sum_{j<k} r^{k-j} c_j^2)

with c the thrust curve's collective acceleration, y the measured one, r = exp(-dt / memory). g_k uses samples before k
only, so that such a prediction could be made in flight. It starts at 1 with prior weight p, that of half a second of
data. The memory is long (10 s): a short one would reproduce the last residual rather than a scale.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadexp.models.dataset import ResidualDataset
from quadexp.models.residual import THRUST

MEMORY = 10.0  # s
PRIOR = 0.5  # s


class CommonScale(NamedTuple):
    """dataset: rows with one thrust scale on all flights. errors: e_f by flight index. level: mean T / m, m/s^2."""

    dataset: ResidualDataset
    errors: dict[int, float]
    level: float

    @property
    def variance(self) -> float:
        """Variance of a_z on a new flight due to the spread of e_f, (m/s^2)^2; 0 with one flight."""
        values = list(self.errors.values())
        return float(np.var(values, ddof=1)) * self.level**2 if len(values) > 1 else 0.0


def has_thrust_scale(dataset: ResidualDataset) -> bool:
    """Whether the rows come from recorded flights under a thrust curve, whose scale may differ between flights."""
    return bool(dataset.metadata.get("recorded")) and "mass" in (dataset.metadata.get("vehicle") or {})


def with_common_scale(dataset: ResidualDataset) -> CommonScale:
    """Bring e_f, the least-squares scale of a_z on the thrust, to its mean over the flights, where these have one."""
    if not has_thrust_scale(dataset):
        return CommonScale(dataset, {}, 0.0)
    mass = dataset.metadata["vehicle"]["mass"]
    acceleration = dataset.matrix([THRUST])[:, 0] / mass
    a_z = dataset.matrix(["a_z"])[:, 0].copy()
    flight = np.asarray(dataset.columns["flight"])
    errors = {}
    for index in np.unique(flight):
        thrust = acceleration[flight == index]
        errors[int(index)] = float(thrust @ a_z[flight == index] / (thrust @ thrust))
    mean = float(np.mean(list(errors.values())))
    for index, error in errors.items():
        a_z[flight == index] -= (error - mean) * acceleration[flight == index]
    columns = dict(dataset.columns) | {"a_z": a_z}
    return CommonScale(ResidualDataset(columns, dataset.metadata), errors, float(acceleration.mean()))


def tracked_scale(collective: np.ndarray, measured: np.ndarray, dt: float) -> np.ndarray:
    """g of the module before every sample of one flight, (k,); collective c, measured y: (k,) m/s^2. dt: s."""
    from scipy.signal import lfilter

    decay = float(np.exp(-dt / MEMORY))
    prior = PRIOR / dt * collective[0] ** 2 * decay ** np.arange(len(collective))
    past = lfilter([0.0, 1.0], [1.0, -decay], np.stack([collective * measured, collective * collective]), axis=1)
    return (prior + past[0]) / (prior + past[1])
