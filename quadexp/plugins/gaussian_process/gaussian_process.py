"""Gaussian processes of the residual: one scalar GP per output (Torrente et al. 2021, section III-C).

Posterior of an output, and the residual that a controller flies: posterior.py; the fit: sgpr.py. The prior mean is
linear drag, a sum of identified terms (quadexp.plugins.aerodynamics.terms), a constant, or zero.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec.structs import replace

from quadexp.errors import DataError, UsageError
from quadexp.log.schema import describe
from quadexp.models.adapting import Adapting, Block
from quadexp.models.base import (
    AXIS,
    Callback,
    Model,
    ModelPart,
    Prediction,
    one_thread,
    origin,
    quiet,
    require_variation,
)
from quadexp.models.common_scale import with_common_scale
from quadexp.models.dataset import ResidualDataset
from quadexp.models.linear_drag import LinearDrag, baseline, constant_mean
from quadexp.models.residual import OUTPUTS, Residual, check_features
from quadexp.parts.settings import SEEDS, Setting, Settings, key, keyed, lists, made
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.terms import MEANS, TermMean, fit_term_mean
from quadexp.plugins.gaussian_process.posterior import OutputPosterior, gaussian_process_residual

LIBRARIES = ("numpy", "scipy", "torch", "gpytorch")  # that a fit depends on
JITTER = 1e-8  # added to K of weights that adapt, as in the fit


def _features(output: str, *features: str) -> Any:
    return key(features, Setting(f"features of the GP of {output}; []: no correction"))


@keyed
class GPFeatures(Settings):
    """For every output the features of its GP; an empty list leaves the output uncorrected."""

    prefix = "model.features."

    a_x: tuple[str, ...] = _features("a_x")
    a_y: tuple[str, ...] = _features("a_y")
    a_z: tuple[str, ...] = _features("a_z")
    tau_x: tuple[str, ...] = _features("tau_x")
    tau_y: tuple[str, ...] = _features("tau_y")
    tau_z: tuple[str, ...] = _features("tau_z")

    def check_together(self) -> None:
        for output in OUTPUTS:
            features = getattr(self, output)
            check_features(f"model.features.{output}", features)
            if len(set(features)) < len(features):
                raise UsageError(f"model.features.{output}: {', '.join(features)} names a feature twice")
        if not self.of_output:
            raise UsageError("model.features: no output has a feature; name some, e.g. model.features.a_x=[v_x]")

    @property
    def of_output(self) -> dict[str, tuple[str, ...]]:
        """Output -> features (B_z), of the outputs that are corrected (B_d)."""
        return {output: getattr(self, output) for output in OUTPUTS if getattr(self, output)}


DEFAULT_FEATURES = GPFeatures(a_x=("v_x",), a_y=("v_y",), a_z=("v_z", "thrust"))


@keyed
class GPConfig(ModelPart):
    """How the Gaussian processes are fitted; see quadexp/plugins/gaussian_process/gaussian_process.py."""

    features: GPFeatures = key(DEFAULT_FEATURES, "features of every output")
    inducing: int = key(20, "inducing points of an output", "[2, 1000]", "points")
    method: Literal["sgpr", "subset"] = key(
        "sgpr", "variational bound of Titsias 2009, or exact GP on a subset as in the paper"
    )
    mean: Literal["zero", "constant", "linear_drag", "quadratic", "blade_element"] = key(
        "zero", "mean function under the GP"
    )
    seed: int = key(0, "seed of the choice of held-out flights and initial inducing points", SEEDS)
    max_rows: int | None = key(
        None, "largest number of rows, drawn at random; null: all rows", "[10, 10000000]", "rows"
    )
    refit: bool = key(True, "after the report, fit again to all flights", when="holdout")
    max_iterations: int = key(60, "largest number of L-BFGS iterations", "[1, 10000]")
    jitter: float = key(1e-8, "added to K_ZZ, relative to the signal variance", "(0, 1e-6]")

    def __post_init__(self) -> None:
        if isinstance(self.features, Mapping):
            object.__setattr__(self, "features", made(GPFeatures, self.features))
        super().__post_init__()

    def fit(self, rows: ResidualDataset, **options: Any) -> GaussianProcessModel:
        """See ModelPart."""
        return fit_gp(rows, self, **options)


class GaussianProcessModel(Model, frozen=True, tag="gaussian_process"):
    """Gaussian processes of one or more outputs, and linear drag fitted to the same rows.

    mean: prior mean of the accelerations (terms, or LinearDrag, without drag for a constant), or None for zero; torque
        outputs have prior mean zero.
    linear_drag: the RDRv baseline, fitted to the same rows.
    """

    outputs: Annotated[tuple[OutputPosterior, ...], msgspec.Meta(min_length=1)]
    mean: LinearDrag | TermMean | None
    linear_drag: LinearDrag
    predictor = "gp"
    figure = "quadexp.plugins.page.model_figures:fit_figure"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_each_once([posterior.output for posterior in self.outputs])

    def predict(self, rows: ResidualDataset) -> dict[str, Prediction]:
        """See Model.predict; prior mean included."""
        prior = None if self.mean is None else self.mean.acceleration(rows)
        predictions = {}
        for posterior in self.outputs:
            prediction = posterior.predict(rows.matrix(posterior.features))
            if prior is not None and posterior.output in AXIS:
                prediction = prediction._replace(mean=prediction.mean + prior[:, AXIS[posterior.output]])
            predictions[posterior.output] = prediction
        return predictions

    def acceleration(self, rows: ResidualDataset) -> np.ndarray:
        """See Model.acceleration; where an axis has no output, the prior mean."""
        value = np.zeros((rows.n_rows, 3)) if self.mean is None else self.mean.acceleration(rows)
        for output, prediction in self.predict(rows).items():
            if output in AXIS:
                value[:, AXIS[output]] = prediction.mean
        return value

    def residual(self, vehicle: Vehicle, source: str = "", part: str = "best") -> Residual:
        self.require(part, source)
        return self._form(vehicle, source)

    def weighed(self, vehicle: Vehicle, residual: Residual) -> Residual:
        """See Model.weighed."""
        form = self._form(vehicle, weighed=True)
        return dataclasses.replace(residual, function=form.function, to_compile=form.to_compile, theta=form.theta)

    def _form(self, vehicle: Vehicle, source: str = "", *, weighed: bool = False) -> Residual:
        parameters = None if self.mean is None else self.mean.parameters
        terms = self.mean.structure if isinstance(self.mean, TermMean) else None
        return gaussian_process_residual(vehicle, self.outputs, parameters, source, mean_terms=terms, weighed=weighed)

    def adapting(self, vehicle: Vehicle, residual: Residual, deviation: float) -> Adapting:
        return adapting_process(residual, self.outputs, deviation)

    @property
    def summary(self) -> str:
        chosen = "; ".join(f"{o.output} <- {', '.join(o.features)}" for o in self.outputs)
        return f"Gaussian processes {chosen} ({self.settings['inducing']} points, {self.settings['method']})"

    def described(self, report: Callable[[], Mapping[str, Any]]) -> tuple[dict[str, Any], list[str]]:
        outputs = {}
        lines = []
        for output in self.outputs:
            scales = output.lengthscale.tolist()
            signal = float(np.sqrt(output.signal_variance))
            noise = float(np.sqrt(output.noise_variance))
            outputs[output.output] = {
                "features": list(output.features),
                "inducing": len(output.alpha),
                "lengthscale": scales,
                "signal_std": signal,
                "noise_std": noise,
            }
            text = ", ".join(f"{name} {scale:.3g}" for name, scale in zip(output.features, scales, strict=True))
            stds = f"signal {signal:.3g}, noise {noise:.3g} {describe(output.output, 'residuals').unit}"
            lines.append(f"{output.output:<12}{len(output.alpha)} points, length scales {text}; {stds}")
        return {"outputs": outputs}, [*lines, *super().described(report)[1]]


def adapting_process(residual: Residual, outputs: Sequence[OutputPosterior], s: float) -> Adapting:
    """Weights alpha that adapt. s: as in quadexp.plugins.remedies.online, m/s^2."""
    sizes = [len(output.alpha) for output in outputs]
    ends = len(residual.theta) - sum(sizes) + np.cumsum([0, *sizes])
    blocks = []
    for output, first, end in zip(outputs, ends[:-1], ends[1:], strict=True):
        if output.output in AXIS:
            scaled = output.inducing / output.lengthscale
            distance = ((scaled[:, None] - scaled[None]) ** 2).sum(axis=2)
            kernel = np.exp(-0.5 * distance) + JITTER * np.eye(end - first)
            lower = np.linalg.cholesky(kernel)
            root = s * np.linalg.inv(lower).T
            at = np.arange(first, end)
            blocks.append(Block(AXIS[output.output], at, residual.theta[at], root, s**2))
    return Adapting(residual, tuple(blocks))


def fit_gp(
    dataset: ResidualDataset,
    settings: GPConfig | None = None,
    *,
    start: GaussianProcessModel | None = None,
    callback: Callback = quiet,
    intervals: bool = True,
) -> GaussianProcessModel:
    """Fit every output named in `settings.features` to all rows (up to settings.max_rows) of the dataset.

    start: model with the same outputs and sizes, whose values replace the first stages; a quarter of the iterations
    then do. callback, intervals: see Model.fit.
    Raises DataError where the dataset is empty, lacks a feature or output, has fewer rows than inducing points, or a
    constant feature.
    """
    from quadexp.plugins.gaussian_process.sgpr import fit_output  # imports PyTorch

    settings = settings or GPConfig()
    chosen = settings.features.of_output
    iterations = settings.max_iterations if start is None else max(settings.max_iterations // 4, 1)
    rng = np.random.default_rng(settings.seed)
    if settings.max_rows is not None and dataset.n_rows > settings.max_rows:
        dataset = dataset.rows(np.sort(rng.choice(dataset.n_rows, settings.max_rows, replace=False)))
    for output, features in chosen.items():
        require_variation(dataset, features, [output], f"model.features.{output}")
    if dataset.n_rows < settings.inducing:
        few = f"model.inducing: {settings.inducing} points from {dataset.n_rows} rows"
        raise DataError(f"{few}; collect more, or ask for fewer points")
    drag = baseline(dataset, intervals=intervals)
    scaled = with_common_scale(dataset)
    dataset = scaled.dataset
    mean: LinearDrag | TermMean | None = drag if settings.mean == "linear_drag" else None
    if settings.mean in MEANS:
        mean = fit_term_mean(dataset, settings.mean)
    elif settings.mean == "constant":
        mean = constant_mean(dataset.matrix(list(AXIS)).mean(axis=0))
    prior = None if mean is None else mean.acceleration(dataset)
    earlier = {posterior.output: posterior for posterior in start.outputs} if start else {}
    posteriors: list[OutputPosterior] = []
    with one_thread():
        for i, (output, features) in enumerate(chosen.items()):
            target = dataset.matrix([output])[:, 0]
            if prior is not None and output in AXIS:
                target = target - prior[:, AXIS[output]]

            def report(done: float, output: str = output, i: int = i) -> None:
                callback(f"fit {output}", (i + done) / len(chosen))

            before = earlier.get(output)
            fitted = fit_output(dataset.matrix(features), target, settings, iterations, rng, before, report)
            posterior = OutputPosterior(output, features, *fitted)
            spread = scaled.variance if output == "a_z" else 0.0
            posteriors.append(replace(posterior, noise_variance=posterior.noise_variance + spread))
    callback("fit done", 1.0)
    stated = origin(dataset, list(chain(*chosen.values())), settings, LIBRARIES)
    stated["settings"]["features"] = lists(chosen)
    return GaussianProcessModel(tuple(posteriors), mean, drag, **stated)
