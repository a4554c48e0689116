"""Gaussian processes of the residual: one scalar GP per output (Torrente et al. 2021, section III-C).

Posterior of one output at features z, in physical units, with e_j = exp(-1/2 sum_i ((z_i - Z_ji) / l_i)^2):

    mean(z)     = sum_j alpha_j e_j + prior mean(z)
    variance(z) = sigma_f^2 - ||F e||^2             of the function; add sigma_n^2 for a new measurement

Kernel: Torrente et al. 2021, eq. 8; posterior: Titsias 2009, eqs 6 and 10. numpy only.

Steps of the fit, for each output: scaling (features to mean 0 and standard deviation 1, the target by its root mean
square) -> hyperparameters of an exact GP on a few rows -> inducing points where the remaining variance is largest ->
both optimised together by the variational bound (sgpr.py), first on part of the rows, then on all -> posterior in
physical units. Recorded flights are first brought to a common thrust scale (quadexp.models.thrust_scale).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np
from msgspec.structs import replace

from quadexp.models.settings import GPKeys
from quadexp.errors import DataError, UsageError
from quadexp.models.base import AXIS, Callback, Model, Output, Positive, Prediction, Record, Shape, Share
from quadexp.models.dataset import ResidualDataset
from quadexp.models.linear_drag import LinearDrag, constant_mean, fit_linear_drag
from quadexp.models.support import feature_ranges
from quadexp.models.terms import MEANS, TermMean, fit_term_mean
from quadexp.models.thrust_scale import has_thrust_scale, with_common_scale
from quadexp.physics.correction import OUTPUTS

if TYPE_CHECKING:
    from quadexp.air.adapting import Adapting
    from quadexp.air.base import Residual
    from quadexp.physics.vehicle import Vehicle

CHUNK = 4096  # rows predicted at a time, to limit memory
PILOT_ROWS = 400  # of the exact GP that initialises the hyperparameters
CANDIDATE_ROWS = 4000  # from which the initial inducing points are chosen; also those of the first stage of the bound
PILOT_ITERATIONS = 60
STAGE_ITERATIONS = 150
LIBRARIES = ("numpy", "scipy", "torch", "gpytorch")

RELATIVE_FLOOR = 1e-10  # of the prior variance; below it a further point is redundant
DEFAULT_FEATURES = {"a_x": ("v_x",), "a_y": ("v_y",), "a_z": ("v_z", "thrust")}


@dataclass(frozen=True)
class GPSettings(GPKeys):
    """How the Gaussian processes are fitted (see GPKeys for the keys of the `gp` configuration group).

    features: output -> feature names (B_z); an output that is absent, or has none, is not corrected (B_d).
    """

    features: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: dict(DEFAULT_FEATURES))

    def __post_init__(self) -> None:
        super().__post_init__()
        chosen = {output: tuple(names) for output, names in self.features.items() if names}
        object.__setattr__(self, "features", chosen)
        if not chosen:
            raise UsageError("gp.features: no output has a feature; name some, e.g. gp.features.a_x=[v_x]")
        for output, names in chosen.items():
            if output not in OUTPUTS:
                raise UsageError(f"gp.features.{output}: no such output; allowed are {', '.join(OUTPUTS)}")
            if len(set(names)) < len(names):
                raise UsageError(f"gp.features.{output}: {', '.join(names)} names a feature twice")

    def as_dict(self) -> dict[str, Any]:
        record = {"features": {output: list(names) for output, names in self.features.items()}}
        record = record | {name: value for name, value in asdict(self).items() if name not in record}
        if self.split == "flight":
            del record["split"]
        return record


class OutputPosterior(Record, frozen=True):
    """Posterior of one output (equations: see the module).

    output: its unit is m/s^2 or N m. features: d names. inducing: M points, in the features' units, like the
    lengthscale. alpha: in the output's unit. signal_variance, noise_variance: in the output's unit squared.
    variance_factor: F, upper triangular, in the output's unit (F'F would lose half the digits).
    bound: log marginal likelihood, or its variational lower bound, per row, in the output's unit.
    """

    output: Output
    features: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]
    inducing: Annotated[np.ndarray, Shape("alpha features")]
    alpha: Annotated[np.ndarray, Shape("alpha")]
    lengthscale: Annotated[np.ndarray, Shape("features")]
    signal_variance: Positive
    noise_variance: Share
    variance_factor: Annotated[np.ndarray, Shape("alpha alpha")]
    bound: float
    rows: int

    def __post_init__(self) -> None:
        super().__post_init__()
        if not len(self.alpha) or not np.all(self.lengthscale > 0):
            raise ValueError("inducing points and a lengthscale above 0 are needed")

    def predict(self, features: np.ndarray) -> Prediction:
        """Without the prior mean; features (k, d) in physical units."""
        mean, variance = np.empty(len(features)), np.empty(len(features))
        for start in range(0, len(features), CHUNK):
            rows = slice(start, start + CHUNK)
            distance = (features[rows, None, :] - self.inducing) / self.lengthscale
            e = np.exp(-0.5 * np.einsum("kmd,kmd->km", distance, distance))
            mean[rows] = e @ self.alpha
            variance[rows] = self.signal_variance - np.sum((e @ self.variance_factor.T) ** 2, axis=1)
        return Prediction(mean, np.maximum(variance, 0.0), self.noise_variance)


class GPModel(Model, frozen=True, tag="gaussian_process"):
    """Gaussian processes of one or more outputs, and linear drag fitted to the same rows.

    mean: prior mean of the accelerations (terms, or LinearDrag, without drag for a constant), or None for zero; torque
        outputs have prior mean zero.
    linear_drag: the RDRv baseline, fitted to the same rows.
    """

    outputs: Annotated[tuple[OutputPosterior, ...], msgspec.Meta(min_length=1)]
    mean: LinearDrag | TermMean | None
    linear_drag: LinearDrag
    predictor = "gp"
    Settings = GPSettings

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [posterior.output for posterior in self.outputs]
        if len(set(names)) < len(names):
            raise ValueError(f"outputs are {', '.join(names)}; each is allowed once")

    def predict(self, rows: ResidualDataset) -> dict[str, Prediction]:
        """See Model.predict; prior mean included."""
        prior = None if self.mean is None else self.mean.acceleration(rows)
        predictions = {}
        for posterior in self.outputs:
            found = posterior.predict(rows.matrix(posterior.features))
            if prior is not None and posterior.output in AXIS:
                found = found._replace(mean=found.mean + prior[:, AXIS[posterior.output]])
            predictions[posterior.output] = found
        return predictions

    def acceleration(self, rows: ResidualDataset) -> np.ndarray:
        """See Model.acceleration; where an axis has no output, the prior mean."""
        value = np.zeros((rows.n_rows, 3)) if self.mean is None else self.mean.acceleration(rows)
        for output, found in self.predict(rows).items():
            if output in AXIS:
                value[:, AXIS[output]] = found.mean
        return value

    def residual(self, vehicle: Vehicle, source: str = "", part: str = "best") -> Residual:
        """See Model.residual."""
        from quadexp.air.gaussian_process import gaussian_process_residual

        if part not in ("best", "gaussian_process"):
            raise UsageError(f"{source}: holds a Gaussian process, not '{part}'")
        parameters = None if self.mean is None else self.mean.parameters
        terms = self.mean.structure if isinstance(self.mean, TermMean) else None
        return gaussian_process_residual(vehicle, self.outputs, parameters, source, mean_terms=terms)

    def adapting(self, vehicle: Vehicle, residual: Residual, deviation: float | None) -> Adapting:
        """See Model.adapting."""
        from quadexp.air.adapting import adapting_process

        return adapting_process(residual, self.outputs, deviation)

    @classmethod
    def fit(cls, rows: ResidualDataset, settings: GPSettings, **options: Any) -> GPModel:
        """See Model.fit."""
        return fit_gp(rows, settings, **options)

    @property
    def summary(self) -> str:
        """See Model.summary."""
        chosen = "; ".join(f"{o.output} <- {', '.join(o.features)}" for o in self.outputs)
        return f"Gaussian processes {chosen} ({self.settings['inducing']} points, {self.settings['method']})"


@dataclass(frozen=True)
class _Scale:
    """Features x = (z - centre) / spread, target y = a / unit."""

    centre: np.ndarray
    spread: np.ndarray
    unit: float


def fit_gp(
    dataset: ResidualDataset,
    settings: GPSettings | None = None,
    *,
    start: GPModel | None = None,
    callback: Callback | None = None,
    intervals: bool = True,
) -> GPModel:
    """Fit every output named in `settings.features` to all rows (up to settings.max_rows) of the dataset.

    start: model with the same outputs and sizes, whose values replace the first stages; a quarter of the iterations
    then do. callback, intervals: see Model.fit.
    Raises DataError where the dataset is empty, lacks a feature or output, has fewer rows than inducing points or more
    than an exact GP can take, or where a feature is constant.
    """
    settings = settings or GPSettings()
    iterations = settings.max_iterations if start is None else max(settings.max_iterations // 4, 1)
    if not dataset.n_rows:
        raise DataError("dataset: it has no rows")
    rng = np.random.default_rng(settings.seed)
    if settings.max_rows is not None and dataset.n_rows > settings.max_rows:
        dataset = dataset.rows(np.sort(rng.choice(dataset.n_rows, settings.max_rows, replace=False)))
    _check(dataset, settings)
    recorded = has_thrust_scale(dataset)
    scale_variance = 0.0
    if recorded:
        scaled = with_common_scale(dataset)
        dataset, scale_variance = scaled.dataset, scaled.variance
    thrust = not recorded  # under a thrust curve the thrust term would duplicate the curve's scale
    drag = fit_linear_drag(dataset, thrust=thrust, intervals=intervals)
    mean = _prior_mean(dataset, settings, drag)
    prior = None if mean is None else mean.acceleration(dataset)
    posteriors: list[OutputPosterior] = []
    with one_thread():
        for i, (output, features) in enumerate(settings.features.items()):
            target = dataset.matrix([output])[:, 0]
            if prior is not None and output in AXIS:
                target = target - prior[:, AXIS[output]]
            before = _matching(start, output, features, settings)

            def report(done: float, output: str = output, i: int = i) -> None:
                if callback is not None:
                    callback(f"fit {output}", (i + done) / len(settings.features))

            fitted = _fit_output(output, features, dataset, target, settings, iterations, rng, before, report)
            if output == "a_z":
                fitted = replace(fitted, noise_variance=fitted.noise_variance + scale_variance)
            posteriors.append(fitted)
    if callback is not None:
        callback("fit done", 1.0)
    used = [name for features in settings.features.values() for name in features]
    return GPModel(
        tuple(posteriors),
        mean,
        drag,
        vehicle=dict(dataset.metadata.get("vehicle") or {}),
        dataset=dataset.summary(),
        settings=settings.as_dict(),
        feature_range=feature_ranges(dataset, used),
        versions={library: version(library) for library in LIBRARIES},
    )


def _check(dataset: ResidualDataset, settings: GPSettings) -> None:
    n = dataset.n_rows
    if settings.method == "exact" and n > settings.max_exact_rows:
        raise DataError(
            f"gp.method=exact: {n} rows are more than gp.max_exact_rows={settings.max_exact_rows};"
            " use gp.method=sgpr, or draw fewer with gp.max_rows"
        )
    if settings.method != "exact" and n < settings.inducing:
        raise DataError(f"gp.inducing: {settings.inducing} points from {n} rows; collect more, or ask for fewer points")
    for output, features in settings.features.items():
        values = dataset.matrix([*features, output])
        constant = [name for name, std in zip(features, values.std(axis=0), strict=False) if std < 1e-9]
        if constant:
            raise DataError(f"gp.features.{output}: '{constant[0]}' never changes over the {n} rows; leave it out")


def _prior_mean(dataset: ResidualDataset, settings: GPSettings, drag: LinearDrag) -> LinearDrag | TermMean | None:
    if settings.mean in MEANS:
        return fit_term_mean(dataset, settings.mean)
    if settings.mean == "linear_drag":
        return drag
    if settings.mean == "constant":
        return constant_mean(dataset.matrix(["a_x", "a_y", "a_z"]).mean(axis=0))
    return None


def _matching(
    start: GPModel | None, output: str, features: tuple[str, ...], settings: GPSettings
) -> OutputPosterior | None:
    """The posterior of this output in `start`, None if it has other features or another number of inducing points."""
    for posterior in start.outputs if start is not None else ():
        if (posterior.output, posterior.features, len(posterior.alpha)) == (output, features, settings.inducing):
            return posterior
    return None


def _fit_output(
    output: str,
    features: tuple[str, ...],
    dataset: ResidualDataset,
    target: np.ndarray,
    settings: GPSettings,
    iterations: int,
    rng: np.random.Generator,
    start: OutputPosterior | None,
    report: Callable[[float], None],
) -> OutputPosterior:
    from quadexp.models import sgpr

    z = dataset.matrix(features)
    unit = float(np.sqrt(np.mean(target**2))) or 1.0
    scale = _Scale(z.mean(axis=0), z.std(axis=0), unit)
    x, y = (z - scale.centre) / scale.spread, target / scale.unit
    order = rng.permutation(len(x))

    if start is not None and settings.method == "sgpr":
        points = (start.inducing - scale.centre) / scale.spread
        guess = sgpr.Hyperparameters(
            start.lengthscale / scale.spread,
            start.signal_variance / scale.unit**2,
            start.noise_variance / scale.unit**2,
        )
    else:
        few = order if settings.method == "exact" else order[:PILOT_ROWS]
        first = sgpr.Hyperparameters(np.ones(x.shape[1]), 1.0, 0.01)
        pilot = sgpr.GPRegression(x[few], y[few], first, None, settings.jitter)
        bound = sgpr.maximise(pilot, PILOT_ITERATIONS, lambda k: report(0.15 * k / PILOT_ITERATIONS))
        guess = pilot.hyperparameters
        candidates = order[: max(CANDIDATE_ROWS, settings.inducing)]
        if settings.method != "exact":
            chosen = candidates[greedy_points(x[candidates], guess.lengthscale, settings.inducing)]
            points = x[chosen]

    if settings.method == "sgpr":
        if start is None and len(x) > CANDIDATE_ROWS:
            part = sgpr.GPRegression(x[candidates], y[candidates], guess, points, settings.jitter)
            sgpr.maximise(part, STAGE_ITERATIONS, lambda k: report(0.15 + 0.25 * k / STAGE_ITERATIONS))
            points, guess = part.inducing_points, part.hyperparameters
        whole = sgpr.GPRegression(x, y, guess, points, settings.jitter)
        bound = sgpr.maximise(whole, iterations, lambda k: report(0.4 + 0.6 * k / iterations))
        points, guess = whole.inducing_points, whole.hyperparameters
        alpha, factor = sgpr.sparse_posterior(x, y, points, guess, settings.jitter)
    else:
        rows = order if settings.method == "exact" else chosen
        points = x[rows]
        alpha, factor = sgpr.exact_posterior(points, y[rows], guess)

    return OutputPosterior(
        output, features,
        points * scale.spread + scale.centre,
        alpha * scale.unit,
        guess.lengthscale * scale.spread,
        guess.signal_variance * scale.unit**2,
        guess.noise_variance * scale.unit**2,
        factor * scale.unit,
        bound - float(np.log(scale.unit)),
        len(alpha) if settings.method == "subset" else len(x),
    )  # fmt: skip


@contextmanager
def one_thread() -> Iterator[None]:
    """torch on one thread, so that the order of summation, and with it the result, does not depend on the machine."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def greedy_points(x: np.ndarray, lengthscale: np.ndarray, count: int) -> np.ndarray:
    """Indices (count,) of the chosen rows, most informative first: greedily, where the prior variance is largest.

    Each step takes argmax_i k_ii - q_ii, q = K_XZ K_ZZ^-1 K_ZX, by a partial pivoted Cholesky factorisation, O(n M^2)
    (Burt, Rasmussen & van der Wilk 2020, "Convergence of sparse variational inference in GP regression", section 6.2).
    x: rows to choose from, (n, d), n >= count. lengthscale: (d,), same units. Where fewer rows reduce the variance to
    zero, the remaining ones are taken in their order.
    """
    n = len(x)
    if count > n:
        raise ValueError(f"{count} points of {n} rows")
    scaled = x / lengthscale
    variance = np.ones(n)
    factor = np.empty((count, n))
    chosen: list[int] = []
    while len(chosen) < count:
        pivot = int(np.argmax(variance))
        if variance[pivot] < RELATIVE_FLOOR:
            rest = np.setdiff1d(np.arange(n), chosen, assume_unique=True)
            return np.concatenate([chosen, rest[: count - len(chosen)]]).astype(int)
        k = np.exp(-0.5 * np.sum((scaled - scaled[pivot]) ** 2, axis=1))
        row = (k - factor[: len(chosen), pivot] @ factor[: len(chosen)]) / np.sqrt(variance[pivot])
        factor[len(chosen)] = row
        variance = np.maximum(variance - row**2, 0.0)
        variance[pivot] = 0.0
        chosen.append(pivot)
    return np.array(chosen)
