"""Error of the predicted specific force on flights that a model was not fitted to.

    e = f - f_model,       f_model = (0, 0, sum_i a_i) + a(v, w, a_1 .. a_n)        body FLU, m/s^2

A predictor is a thrust curve and an acceleration beyond it: an identified vehicle gives one for each of its models,
every other checkpoint one, and "nominal" is the curve alone. RMS of the vector, sqrt(mean ||e||^2), and of each axis.
Every model is scored as fitted, and with its thrust scale tracked in flight from earlier samples
(quadexp.models.thrust_scale). Intervals: percentile bootstrap over flights if there are FLIGHT_CLUSTERS or more,
otherwise over blocks of BLOCK seconds, because neighbouring errors are correlated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from quadexp.errors import UsageError
from quadexp.models.base import Model, rms
from quadexp.models.checkpoint import record_of
from quadexp.models.dataset import feature_rows
from quadexp.models.regression import FLIGHT_CLUSTERS
from quadexp.models.residual import AXES
from quadexp.models.samples import FlightRows
from quadexp.models.support import outside_shares
from quadexp.models.terms import TermModel
from quadexp.models.thrust_curve import ThrustCurve
from quadexp.models.thrust_scale import tracked_scale
from quadexp.models.torque import TorqueModel
from quadexp.models.vehicle_model import VehicleModel
from quadexp.physics.vehicle import Vehicle

BLOCK = 2.0  # s, of the bootstrap
DRAWS = 1000
CONFIDENCE = 0.95
BANDS = 4
NOMINAL = "nominal"
_KIND_NAMES = {"linear": "linear drag", "quadratic": "quadratic drag", "blade_element": "blade element"}
Acceleration = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
Row = dict[str, Any]


@dataclass(frozen=True)
class Predictor:
    """name: in tables. curve: thrust. beyond: (v (k, 3), w (k, 3), rotor accelerations (k, n)) -> (k, 3), m/s^2.

    seen: names of the flights of the fit. ranges: of the fit, see quadexp.models.support. mass: kg, to convert rotor
    accelerations to the thrusts in the ranges. torque: fitted torque model or None.
    """

    name: str
    curve: ThrustCurve
    beyond: Acceleration
    seen: tuple[str, ...] = ()
    ranges: dict[str, Any] = field(default_factory=dict)
    mass: float = 1.0
    torque: TorqueModel | None = None


def nominal(curve: ThrustCurve, seen: tuple[str, ...] = (), torque: TorqueModel | None = None) -> Predictor:
    """The thrust curve only."""
    return Predictor(NOMINAL, curve, lambda v, w, a: np.zeros((len(v), 3)), seen, torque=torque)


def predictors(model: Model, label: str, vehicle: Vehicle, curve: ThrustCurve | None) -> list[Predictor]:
    """The predictors of a checkpoint: the models of an identified vehicle, of every other one itself.

    label: name of a model without a thrust curve of its own. curve: for it. Raises UsageError where there is none.
    """
    seen = tuple(model.dataset.get("names", ()))
    if isinstance(model, VehicleModel):

        def identified(kind: str, terms: TermModel) -> Predictor:
            def beyond(v: np.ndarray, w: np.ndarray, a: np.ndarray) -> np.ndarray:
                return terms.acceleration(v, a)

            return Predictor(_KIND_NAMES[kind], model.thrust, beyond, seen, model.feature_range, torque=model.torque)

        own = [identified(kind, terms) for kind, terms in model.models.items()]
        return [nominal(model.thrust, seen, model.torque), *own]
    record = model.dataset.get("thrust")
    thrust = record_of(record, ThrustCurve) if record else curve
    if thrust is None:
        raise UsageError(f"{label}: was not fitted to recorded flights; also give an identified vehicle (a folder of"
                         " `quadexp identify`) for its thrust curve")  # fmt: skip

    def beyond(v: np.ndarray, w: np.ndarray, a: np.ndarray) -> np.ndarray:
        return model.acceleration(feature_rows(v, w, vehicle.mass * a))

    return [Predictor(label, thrust, beyond, seen, model.feature_range, vehicle.mass)]


@dataclass(frozen=True)
class Residuals:
    """Errors of a predictor, (k, 3) m/s^2: as fitted (error), with tracked scale (tracked); others (k,)."""

    predictor: str
    error: np.ndarray
    tracked: np.ndarray
    scale: np.ndarray
    flight: np.ndarray
    block: np.ndarray
    speed: np.ndarray
    outside: float | None


def residuals(predicted: Sequence[tuple[Predictor, FlightRows]]) -> Residuals:
    """One-step residuals of a predictor on flights, each with the predictor as it was fitted for it."""
    parts: list[tuple[np.ndarray, ...]] = []
    blocks, outside, rows = 0, 0, 0
    for index, (predictor, one) in enumerate(predicted):
        samples = one.samples
        rotors = predictor.curve.of_signal(samples.signal, samples.voltage)
        collective = rotors.sum(axis=1)
        beyond = predictor.beyond(samples.velocity, one.rate, rotors)
        error = samples.force - beyond
        scale = tracked_scale(collective, error[:, 2], one.dt)
        tracked = error.copy()
        error[:, 2] -= collective
        tracked[:, 2] -= scale * collective
        block = blocks + (np.arange(len(samples)) * one.dt // BLOCK).astype(int)
        blocks = int(block[-1]) + 1
        parts.append((error, tracked, scale, np.full(len(samples), index), block, one.speed))
        if predictor.ranges:
            features = feature_rows(samples.velocity, one.rate, predictor.mass * rotors)
            outside += round(outside_shares(predictor.ranges, features)["any"] * len(samples))
            rows += len(samples)
    error, tracked, scale, flight, block, speed = map(np.concatenate, zip(*parts, strict=True))
    share = outside / rows if rows else None
    return Residuals(predicted[0][0].name, error, tracked, scale, flight, block, speed, share)


def score_rows(results: Sequence[Residuals], baseline: str = "nominal") -> list[Row]:
    """Per predictor one row as fitted and one tracked: RMS per axis and of the vector, with interval.

    share: ratio to the baseline's RMS as fitted. share_alike: ratio to the baseline's RMS, tracked if this row is. Both
    with the interval of the ratio over the same resamples.
    """
    base = next((result for result in results if result.predictor == baseline), None)
    rows = []
    for result in results:
        draws = Draws(result)
        for tracked in (False, True):
            error = result.tracked if tracked else result.error
            low, high = draws.limits(error)
            row: Row = {"predictor": result.predictor, "thrust_tracked": tracked, "rows": len(error)}
            row |= {f"rms_{axis}": rms(component) for axis, component in zip(AXES, error.T, strict=True)}
            row |= {"rms": rms(error), "rms_low": low, "rms_high": high, "outside": result.outside}
            row["rms_about_mean"] = rms(error - _flight_means(error, result.flight))
            if base is not None and len(base.error) == len(error):
                alike = base.tracked if tracked else base.error
                for name, other in (("share", base.error), ("share_alike", alike)):
                    low, high = draws.limits(error, other)
                    row |= {name: rms(error) / rms(other), f"{name}_low": low, f"{name}_high": high}
            rows.append(row)
    return rows


def _flight_means(error: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Mean error of the flight of each row, (k, 3)."""
    numbers, group = np.unique(flight, return_inverse=True)
    sums = np.stack([np.bincount(group, column, len(numbers)) for column in error.T], axis=1)
    return (sums / np.bincount(group)[:, None])[group]


class Draws:
    """Resamples of a predictor's errors: of flights, or of blocks where there are few. group: block of every sample,
    (k,). counts: of every block in each resample, (DRAWS, blocks)."""

    def __init__(self, errors: Residuals) -> None:
        groups = errors.flight if len(np.unique(errors.flight)) >= FLIGHT_CLUSTERS else errors.block
        _, self.group = np.unique(groups, return_inverse=True)
        count = int(self.group.max()) + 1
        self.counts = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), DRAWS)

    def squares(self, error: np.ndarray) -> np.ndarray:
        """Sum of the squared errors (k, 3) in every resample, (DRAWS,)."""
        return self.counts @ np.bincount(self.group, np.sum(error**2, axis=1), self.counts.shape[1])

    def limits(self, error: np.ndarray, base: np.ndarray | None = None) -> list[float]:
        """Ends of the interval of the RMS, or of its ratio to that of other errors."""
        number = self.counts @ np.bincount(self.group) if base is None else self.squares(base)
        tail = 50 * (1 - CONFIDENCE)
        return np.percentile(np.sqrt(self.squares(error) / number), [tail, 100 - tail]).tolist()


def band_rows(results: Sequence[Residuals]) -> list[Row]:
    """RMS of the vector by speed, one row per predictor and band: {predictor, low, high, rows, rms, rms_tracked}."""
    speed = np.concatenate([result.speed for result in results])
    # Edges of bands of equal width from standstill to the largest speed, rounded to 0.1 m/s.
    edges = np.round(np.linspace(0.0, float(speed.max()) + 0.05, BANDS + 1), 1)
    rows = []
    for result in results:
        for low, high in pairwise(edges.tolist()):
            inside = (result.speed >= low) & (result.speed < high if high < edges[-1] else result.speed <= high + 0.1)
            if inside.sum() >= 20:
                row = {"predictor": result.predictor, "low": low, "high": high, "rows": int(inside.sum())}
                rows.append(row | {"rms": rms(result.error[inside]), "rms_tracked": rms(result.tracked[inside])})
    return rows
