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
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import UsageError
from quadexp.models.base import Model, rms
from quadexp.models.checkpoint import record_of
from quadexp.models.dataset import feature_rows
from quadexp.models.regression import FLIGHT_CLUSTERS
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
        return [nominal(model.thrust, seen, model.torque)] + [
            Predictor(_KIND_NAMES[kind], model.thrust, _of_terms(terms), seen, model.feature_range, torque=model.torque)
            for kind, terms in model.models.items()
        ]
    record = model.dataset.get("thrust")
    own = record_of(record, ThrustCurve) if record else curve
    if own is None:
        raise UsageError(f"{label}: was not fitted to recorded flights; also give an identified vehicle (a folder of"
                         " `quadexp identify`) for its thrust curve")  # fmt: skip

    def beyond(v: np.ndarray, w: np.ndarray, a: np.ndarray) -> np.ndarray:
        return model.acceleration(feature_rows(v, w, vehicle.mass * a))

    return [Predictor(label, own, beyond, seen, model.feature_range, vehicle.mass)]


def _of_terms(terms: TermModel) -> Acceleration:
    return lambda v, w, a: terms.acceleration(v, a)


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
    base = next((one for one in results if one.predictor == baseline), None)
    rows = []
    for one in results:
        for tracked in (False, True):
            error = one.tracked if tracked else one.error
            draws = _draws(one)
            limits = _resampled(error, draws)
            row: Row = {"predictor": one.predictor, "thrust_tracked": tracked, "rows": len(error)}
            row |= {
                f"rms_{axis}": float(value)
                for axis, value in zip("xyz", np.sqrt(np.mean(error**2, axis=0)), strict=True)
            }
            row |= {"rms": rms(error), "rms_low": limits[0], "rms_high": limits[1], "outside": one.outside}
            row["rms_about_mean"] = rms(error - _flight_means(error, one.flight))
            if base is not None and len(base.error) == len(error):
                row["share"] = rms(error) / rms(base.error)
                row["share_low"], row["share_high"] = _ratio(error, base.error, draws)
                alike = base.tracked if tracked else base.error
                row["share_alike"] = rms(error) / rms(alike)
                row["share_alike_low"], row["share_alike_high"] = _ratio(error, alike, draws)
            rows.append(row)
    return rows


def _flight_means(error: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Mean error of the flight of each row, (k, 3)."""
    numbers, group = np.unique(flight, return_inverse=True)
    sums = np.stack([np.bincount(group, column, len(numbers)) for column in error.T], axis=1)
    return (sums / np.bincount(group)[:, None])[group]


class Draws(NamedTuple):
    """group: block of every sample, (k,). counts: of every block in each resample, (DRAWS, blocks)."""

    group: np.ndarray
    counts: np.ndarray


def _draws(one: Residuals) -> Draws:
    groups = one.flight if len(np.unique(one.flight)) >= FLIGHT_CLUSTERS else one.block
    _, group = np.unique(groups, return_inverse=True)
    count = int(group.max()) + 1
    return Draws(group, np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), DRAWS))


def _sums(error: np.ndarray, draws: Draws) -> tuple[np.ndarray, np.ndarray]:
    count = draws.counts.shape[1]
    square = np.bincount(draws.group, np.sum(error**2, axis=1), count)
    return draws.counts @ square, draws.counts @ np.bincount(draws.group, minlength=count)


def _resampled(error: np.ndarray, draws: Draws) -> list[float]:
    square, number = _sums(error, draws)
    return _limits(np.sqrt(square / number))


def _ratio(error: np.ndarray, base: np.ndarray, draws: Draws) -> list[float]:
    return _limits(np.sqrt(_sums(error, draws)[0] / _sums(base, draws)[0]))


def _limits(values: np.ndarray) -> list[float]:
    tail = 50 * (1 - CONFIDENCE)
    return np.percentile(values, [tail, 100 - tail]).tolist()


def speed_bands(speed: np.ndarray) -> np.ndarray:
    """Edges of bands of equal width from standstill to the largest speed, rounded to 0.1 m/s, (BANDS + 1,)."""
    return np.round(np.linspace(0.0, float(speed.max()) + 0.05, BANDS + 1), 1)


def band_rows(results: Sequence[Residuals]) -> list[Row]:
    """RMS of the vector by speed, one row per predictor and band: {predictor, low, high, rows, rms, rms_tracked}."""
    edges = speed_bands(np.concatenate([one.speed for one in results]))
    rows = []
    for one in results:
        for low, high in zip(edges[:-1], edges[1:], strict=True):
            inside = (one.speed >= low) & (one.speed < high if high < edges[-1] else one.speed <= high + 0.1)
            if inside.sum() >= 20:
                rows.append(
                    {"predictor": one.predictor, "low": float(low), "high": float(high), "rows": int(inside.sum())}
                    | {"rms": rms(one.error[inside]), "rms_tracked": rms(one.tracked[inside])}
                )
    return rows
