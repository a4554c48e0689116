"""Fit Gaussian processes to a residual dataset: one scalar GP per output (Torrente et al. 2021, section III-C).

Steps for each output: scaling (features to mean 0 and standard deviation 1, the target by its root mean square) ->
hyperparameters of an exact GP on a few rows -> inducing points where the remaining variance is largest -> both
optimised together by the variational bound, first on part of the rows, then on all -> posterior in physical units.
Recorded flights are first brought to a common thrust scale (quadexp.learn.thrust_scale).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version

import numpy as np

from quadexp.errors import DataError
from quadexp.learn.dataset import ResidualDataset
from quadexp.learn.inducing import greedy_points
from quadexp.learn.linear_drag import LinearDrag, constant_mean, fit_linear_drag
from quadexp.learn.model import GPModel, GPSettings, OutputPosterior
from quadexp.learn.predict import AXIS
from quadexp.learn.support import feature_ranges
from quadexp.learn.term_mean import KINDS as TERM_MEANS
from quadexp.learn.term_mean import TermMean, fit_term_mean
from quadexp.learn.thrust_scale import has_thrust_scale, with_common_scale

PILOT_ROWS = 400  # of the exact GP that initialises the hyperparameters
CANDIDATE_ROWS = 4000  # from which the initial inducing points are chosen; also those of the first stage of the bound
PILOT_ITERATIONS = 60
STAGE_ITERATIONS = 150
LIBRARIES = ("numpy", "scipy", "torch", "gpytorch")

Callback = Callable[[str, float], None]


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
    drag_intervals: bool = True,
) -> GPModel:
    """Fit every output named in `settings.features` to all rows (up to settings.max_rows) of the dataset.

    start: model with the same outputs and sizes, whose values replace the first stages. callback: called with a message
    and the completed share, 0 .. 1. drag_intervals: False omits the intervals of the linear-drag baseline.
    Raises DataError where the dataset is empty, lacks a feature or output, has fewer rows than inducing points or more
    than an exact GP can take, or where a feature is constant.
    """
    settings = settings or GPSettings()
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
    drag = fit_linear_drag(dataset, thrust=thrust, intervals=drag_intervals)
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

            fitted = _fit_output(output, features, dataset, target, settings, rng, before, report)
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
        dict(dataset.metadata.get("vehicle") or {}),
        dataset.summary(),
        settings.as_dict(),
        feature_ranges(dataset, used),
        {library: version(library) for library in LIBRARIES},
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
    if settings.mean in TERM_MEANS:
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
    rng: np.random.Generator,
    start: OutputPosterior | None,
    report: Callable[[float], None],
) -> OutputPosterior:
    from quadexp.learn import sgpr

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
        bound = sgpr.maximise(whole, settings.max_iterations, lambda k: report(0.4 + 0.6 * k / settings.max_iterations))
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
