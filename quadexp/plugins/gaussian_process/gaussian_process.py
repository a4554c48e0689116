"""Gaussian processes of the residual: one scalar GP per output (Torrente et al. 2021, section III-C).

Posterior of one output at features phi (B_z selects them among body velocity, rates, rotor thrusts and their sum), in
physical units, with e_j = exp(-1/2 sum_i ((phi_i - Z_ji) / l_i)^2):

    mean     = sum_j alpha_j e_j + prior mean
    variance = sigma_f^2 - ||F e||^2             of the function; add sigma_n^2 for a new measurement

Weighed by what it knows (`GaussianProcessModel.weighed`), where data end it falls back to its prior mean m, continued
by q:

    y = m + q + w (sum_j alpha_j e_j - q),     w = s^2 / (s^2 + variance),     s^2 = misfit of q at the points Z

the combination of two independent estimates, the GP with the posterior variance and m + q with s^2, that has the least
mean squared error. q is quadratic drag, c_0 + c_1 v_i + c_2 v_i |v_i| (+ c_3 thrust on z), by least squares through the
GP's own points, where m is no drag model that was fitted (terms) and the features are these; else q = 0.

Kernel: Torrente et al. 2021, eq. 8; posterior: Titsias 2009, eqs 6 and 10; the fit: sgpr.py. The prior mean
is linear drag, a sum of identified terms (quadexp.models.terms), a constant, or zero.

The residual is written in matrix operations with the analytic derivative; the cost is linear in the number of points.
Points and weights are parameters, so fits of the same size share one function. With s = 1 / (sqrt(2) l) the code
evaluates d = s phi - s Z, k = exp(-sum d^2), dy/dphi = -2 s (alpha k)^T d. The weighed form has besides
w = 1 / (1 + sigma_f^2/s^2 - ||F k||^2/s^2), a ratio of parameters.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from quadexp.compile.backend import handwritten
from quadexp.compile.symbolic import ca
from quadexp.errors import DataError, UsageError
from quadexp.log.schema import describe
from quadexp.models.adapting import Adapting, Block
from quadexp.models.base import (
    AXIS,
    Callback,
    Model,
    ModelPart,
    Output,
    Positive,
    Prediction,
    Record,
    Shape,
    Share,
    one_thread,
    origin,
    quiet,
    require_variation,
)
from quadexp.models.common_scale import with_common_scale
from quadexp.models.dataset import ResidualDataset
from quadexp.models.linear_drag import N_PARAMETERS, LinearDrag, baseline, constant_mean, linear_drag_acceleration
from quadexp.models.residual import (
    FEATURES,
    N_OUTPUTS,
    OUTPUTS,
    THRUST,
    Residual,
    check_features,
    feature_names,
    feature_places,
    residual_function,
)
from quadexp.models.terms import MEANS, TermMean, TermStructure, fit_term_mean
from quadexp.parts.settings import SEEDS, Setting, Settings, key, keyed, lists, made
from quadexp.physics.expression import Expression, split, symbols
from quadexp.physics.vehicle import Vehicle

LIBRARIES = ("numpy", "scipy", "torch", "gpytorch")  # that a fit depends on
CHUNK = 4096  # rows predicted at a time, to limit memory
JITTER = 1e-8  # added to K of weights that adapt, as in the fit
SUMS = Path(__file__).with_name("gp_sums.c")

# Output -> features that q of it can express.
CONTINUED = {"a_x": {"v_x"}, "a_y": {"v_y"}, "a_z": {"v_z", THRUST}}
LEAST = 1e-12  # of the signal variance: smallest s^2, where q goes through the points
N_FALLBACK = 5  # numbers of an output's fallback: sigma_f^2 / s^2, c_0 .. c_3

Sums = tuple[
    list[Expression], ...
]  # over the points: values per output, slopes per feature; likewise of ||F k||^2 / s^2
Structure = tuple[tuple[str, tuple[str, ...], int], ...]  # output, its features, its number of points


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
        mean = np.empty(len(features))
        variance = np.empty(len(features))
        for start in range(0, len(features), CHUNK):
            rows = slice(start, start + CHUNK)
            distance = (features[rows, None, :] - self.inducing) / self.lengthscale
            e = np.exp(-0.5 * np.einsum("kmd,kmd->km", distance, distance))
            mean[rows] = e @ self.alpha
            variance[rows] = self.signal_variance - np.sum((e @ self.variance_factor.T) ** 2, axis=1)
        return Prediction(mean, np.maximum(variance, 0.0), self.noise_variance)


def mean_only(
    output: str,
    features: tuple[str, ...],
    points: np.ndarray,
    alpha: np.ndarray,
    length: np.ndarray,
    signal: float = 1.0,
) -> OutputPosterior:
    """A posterior mean with these numbers, without a variance: points (n, d), alpha (n,), length (d,)."""
    return OutputPosterior(output, features, points, alpha, length, signal, 0.0, np.zeros((len(alpha),) * 2), 0.0, 0)


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
            lower = np.linalg.cholesky(np.exp(-0.5 * distance) + JITTER * np.eye(end - first))
            at = np.arange(first, end)
            blocks.append(Block(AXIS[output.output], at, residual.theta[at], s * np.linalg.inv(lower).T, s**2))
    return Adapting(residual, tuple(blocks))


def gaussian_process_residual(
    vehicle: Vehicle,
    outputs: Sequence[OutputPosterior],
    mean_parameters: npt.ArrayLike | None = None,
    source: str = "",
    *,
    mean_terms: TermStructure | None = None,
    weighed: bool = False,
) -> Residual:
    """Residual of one or more GP outputs.

    mean_parameters: [D (3,), b (3,), kappa] of the linear-drag mean function (quadexp.models.linear_drag), or None.
    mean_terms: the mean function as terms, whose coefficients are then mean_parameters. weighed: by the variance.
    Raises UsageError for an unknown feature.
    """
    n_mean = N_PARAMETERS if mean_terms is None else mean_terms.n_parameters
    mean = np.zeros(n_mean) if mean_parameters is None else np.asarray(mean_parameters, float)
    scales = [1.0 / (np.sqrt(2.0) * o.lengthscale) for o in outputs]
    points = []
    for o, scale in zip(outputs, scales, strict=True):
        points.append((o.inducing * scale).T.ravel())
    known = [fallback(o, continued=mean_terms is None) for o in outputs] if weighed else []
    factors = []
    for o, f in zip(outputs, known, strict=False):
        factors.append((o.variance_factor * np.sqrt(f[0] / o.signal_variance)).T.ravel())
    theta = np.concatenate([mean, *scales, *points, *(o.alpha for o in outputs), *known, *factors])

    names = feature_names(vehicle.n_rotors)
    structure = tuple((o.output, tuple(o.features), len(o.alpha)) for o in outputs)
    n_alpha, n_point = _sizes(structure)
    z_, theta_ = symbols(ca.MX, z=len(names), theta=len(theta))
    sizes = [n_mean, len(n_point), sum(n_point), sum(n_alpha), len(known) * N_FALLBACK, sum(map(len, factors))]
    mean_, scale_, points_, alpha_, known_, factor_ = split(theta_, sizes)
    select, assemble = _scalar_functions(
        names, structure, n_mean, with_mean=bool(np.any(mean)), mean_terms=mean_terms, weighed=weighed
    )

    def posterior_mean(sums: Callable[..., Sums]) -> ca.Function:
        of_points = [ca.vertcat(*part) for part in sums(structure, select(z_, scale_), points_, alpha_, factor_)]
        return residual_function("gaussian_process", z_, theta_, assemble(z_, mean_, scale_, known_, *of_points))

    return Residual("gaussian_process", posterior_mean(_matrix_sums), theta, source, posterior_mean(_compiled_sums))


def fallback(posterior: OutputPosterior, *, continued: bool) -> np.ndarray:
    """sigma_f^2 / s^2 and c_0 .. c_3 of q, (N_FALLBACK,); see the module.

    continued: whether q may be fitted; else it is 0, as where the features are not those of q.
    """
    output = posterior.output
    points = posterior.inducing
    at_points = posterior.predict(points).mean
    freedom = len(points)
    c = np.zeros(N_FALLBACK - 1)
    along = f"v_{output[-1]}"
    if continued and along in posterior.features and {*posterior.features} <= CONTINUED.get(output, set()):
        columns = {name: points[:, i] for i, name in enumerate(posterior.features)}
        v = columns[along]
        thrust = columns.get(THRUST, np.zeros(freedom))
        design = np.column_stack([np.ones(freedom), v, v * np.abs(v), thrust])
        c, _, rank, _ = np.linalg.lstsq(design, at_points)
        at_points = at_points - design @ c
        freedom = freedom - rank
        if freedom < 1:  # as many coefficients as points: nothing says how wrong q is
            return fallback(posterior, continued=False)
    misfit = max(float(at_points @ at_points) / freedom, LEAST * posterior.signal_variance)
    return np.array([posterior.signal_variance / misfit, *c])


def _matrix_sums(
    structure: Structure, scaled: Expression, points: Expression, alpha: Expression, factor: Expression
) -> Sums:
    """(alpha k) 1 of every output and (alpha k)^T d of every feature, in matrix operations; with factors F also
    ||F k||^2 and (F^T F k k)^T d."""
    n_alpha, n_point = _sizes(structure)
    distance = []
    for feature, point in zip(ca.vertsplit(scaled), split(points, n_point), strict=True):
        distance.append(feature - point)
    of_output = []
    for i, (_, features, _) in enumerate(structure):
        of_output += [i] * len(features)
    exponent = []
    for o in range(len(structure)):
        exponent.append(sum(d * d for d, i in zip(distance, of_output, strict=True) if i == o))
    kernel = ca.exp(-ca.vertcat(*exponent))  # all outputs in one vectorised loop
    weighted = split(alpha * kernel, n_alpha)
    kernels = split(kernel, n_alpha)
    values = []
    for a, k in zip(split(alpha, n_alpha), kernels, strict=True):
        values.append(ca.dot(a, k))
    sums = values, [ca.dot(weighted[i], d) for d, i in zip(distance, of_output, strict=True)]
    if not factor.numel():
        return *sums, [], []
    roots = []
    for f, m in zip(split(factor, [m * m for m in n_alpha]), n_alpha, strict=True):
        roots.append(ca.reshape(f, m, m))
    known = [f @ k for f, k in zip(roots, kernels, strict=True)]
    back = [f.T @ q * k for f, q, k in zip(roots, known, kernels, strict=True)]
    slopes = [ca.dot(back[i], d) for d, i in zip(distance, of_output, strict=True)]
    return *sums, [ca.dot(q, q) for q in known], slopes


def _compiled_sums(
    structure: Structure, scaled: Expression, points: Expression, alpha: Expression, factor: Expression
) -> Sums:
    """As _matrix_sums, by gp_sums.c, one call per output."""
    shapes = [(m, len(features)) for _, features, m in structure]
    dense = ca.Sparsity.dense
    weighed = bool(factor.numel())
    kernels = {}
    for m, d in shapes:
        kernels[m, d] = handwritten(
            f"gp_sums_{m}_{d}{'_weighed' * weighed}",
            SUMS,
            {"POINTS": m, "FEATURES": d, "FACTOR": m * weighed},
            {"feature": dense(d), "points": dense(m * d), "alpha": dense(m), "factor": dense(m * m * weighed)},
            {"value": dense(1), "slope": dense(d), "known": dense(weighed), "known_slope": dense(d * weighed)},
        )
    sizes = zip(*((d, m * d, m, m * m * weighed) for m, d in shapes), strict=True)
    arguments = zip(*map(split, (scaled, points, alpha, factor), sizes), strict=True)
    results = [kernels[shape](*of_output) for shape, of_output in zip(shapes, arguments, strict=True)]
    return tuple(map(list, zip(*results, strict=True)))


def _sizes(structure: Structure) -> tuple[list[int], list[int]]:
    """Number of points of every output, and of every feature."""
    return [m for _, _, m in structure], [m for _, features, m in structure for _ in features]


def _scalar_functions(
    names: Sequence[str],
    structure: Structure,
    n_mean: int,
    *,
    with_mean: bool,
    mean_terms: TermStructure | None,
    weighed: bool,
) -> tuple[ca.Function, ca.Function]:
    """The functions before and after the sums over points.

    (z, s) -> s phi of all features; (z, mean, s, fallback, sums ..) -> y, dy/dz with structural zeros. mean: parameters
    of the mean function. fallback: numbers of all outputs, see `fallback`; none where they are not weighed.
    """
    z, mean = symbols(ca.SX, z=len(names), mean=n_mean)
    n_features = sum(len(features) for _, features, _ in structure)
    scale, slope, value, known, known_slope, numbers = symbols(
        ca.SX,
        scale=n_features,
        slope=n_features,
        value=len(structure),
        known=weighed * len(structure),
        known_slope=weighed * n_features,
        fallback=weighed * N_FALLBACK * len(structure),
    )
    y = ca.SX(N_OUTPUTS, 1)
    dy_dz = ca.SX(N_OUTPUTS, len(names))
    if with_mean:
        y[:3] = linear_drag_acceleration(z, mean) if mean_terms is None else mean_terms.acceleration(z, mean)
        dy_dz[:3, :] = ca.jacobian(y[:3], z)
    phi: list[Expression] = []
    for i, (output, features, _) in enumerate(structure):
        row = OUTPUTS.index(output)
        share = 1.0
        correction = value[i]
        d_share = 0.0
        if weighed:
            ratio, *c = ca.vertsplit(numbers[N_FALLBACK * i : N_FALLBACK * (i + 1)])
            share = 1 / (1 + ratio - known[i])
            far = ca.SX(0)
            if mean_terms is None and {*features} <= CONTINUED.get(output, set()):
                v = z[AXIS[output]]
                far = c[0] + c[1] * v + c[2] * v * abs(v) + c[3] * ca.sum1(z[len(FEATURES) :])
            d_share = (value[i] - far) * share**2
            correction = far + share * (value[i] - far)
            dy_dz[row, :] += (1 - share) * ca.jacobian(far, z)
        y[row] += correction
        for columns in feature_places(names, features, "gp"):
            dy_dz[row, columns] -= 2 * scale[len(phi)] * (share * slope[len(phi)])
            if weighed:
                dy_dz[row, columns] -= 4 * scale[len(phi)] * (d_share * known_slope[len(phi)])
            phi.append(ca.sum1(z[columns]))
    select = ca.Function("select", [z, scale], [scale * ca.vertcat(*phi)])
    arguments = [z, mean, scale, numbers, value, slope, known, known_slope]
    return select, ca.Function("assemble", arguments, [ca.sparsify(y), ca.sparsify(dy_dz)])


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
    stated = origin(dataset, [name for names in chosen.values() for name in names], settings, LIBRARIES)
    stated["settings"]["features"] = lists(chosen)
    return GaussianProcessModel(tuple(posteriors), mean, drag, **stated)
