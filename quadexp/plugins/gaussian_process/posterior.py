"""Posterior of a Gaussian process of the residual, and the expression of it that a controller flies.

At features phi (B_z selects them among body velocity, rates, rotor thrusts and their sum), in physical units, with
e_j = exp(-1/2 sum_i ((phi_i - Z_ji) / l_i)^2):

    mean     = sum_j alpha_j e_j + prior mean
    variance = sigma_f^2 - ||F e||^2             of the function; add sigma_n^2 for a new measurement

Kernel: Torrente et al. 2021, eq. 8; posterior: Titsias 2009, eqs 6 and 10; the fit: sgpr.py.

Weighed by what it knows (`GaussianProcessModel.weighed`), where data end it falls back to its prior mean m, continued
by q:

    y = m + q + w (sum_j alpha_j e_j - q),     w = s^2 / (s^2 + variance),     s^2 = misfit of q at the points Z

the combination of two independent estimates, the GP with the posterior variance and m + q with s^2, that has the least
mean squared error. q is quadratic drag, c_0 + c_1 v_i + c_2 v_i |v_i| (+ c_3 thrust on z), by least squares through the
GP's own points, where m is no drag model that was fitted (terms) and the features are these; else q = 0.

It is written in matrix operations with the analytic derivative; the cost is linear in the number of points. Points and
weights are parameters, so fits of the same size share one function. With s = 1 / (sqrt(2) l) the code evaluates
d = s phi - s Z, k = exp(-sum d^2), dy/dphi = -2 s (alpha k)^T d. The weighed form has besides
w = 1 / (1 + sigma_f^2/s^2 - ||F k||^2/s^2), a ratio of parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from quadexp.compile.backend import handwritten
from quadexp.compile.symbolic import ca
from quadexp.models.base import AXIS, Output, Positive, Prediction, Record, Shape, Share
from quadexp.models.linear_drag import N_PARAMETERS, linear_drag_acceleration
from quadexp.models.residual import (
    FEATURES,
    N_OUTPUTS,
    OUTPUTS,
    THRUST,
    Residual,
    feature_names,
    feature_places,
    residual_function,
)
from quadexp.physics.expression import Expression, split, symbols
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.terms import TermStructure

CHUNK = 4096  # rows predicted at a time, to limit memory
SUMS = Path(__file__).with_name("gp_sums.c")

# Output -> features that q of it can express.
CONTINUED = {"a_x": {"v_x"}, "a_y": {"v_y"}, "a_z": {"v_z", THRUST}}
LEAST = 1e-12  # of the signal variance: smallest s^2, where q goes through the points
N_FALLBACK = 5  # numbers of an output's fallback: sigma_f^2 / s^2, c_0 .. c_3

Sums = tuple[
    list[Expression], ...
]  # over the points: values per output, slopes per feature; likewise of ||F k||^2 / s^2
Structure = tuple[tuple[str, tuple[str, ...], int], ...]  # output, its features, its number of points


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
            whitened = e @ self.variance_factor.T
            mean[rows] = e @ self.alpha
            variance[rows] = self.signal_variance - np.sum(whitened**2, axis=1)
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
    scales = []
    points = []
    for o in outputs:
        scale = 1.0 / (np.sqrt(2.0) * o.lengthscale)
        scales.append(scale)
        points.append((o.inducing * scale).T.ravel())
    known = []
    factors = []
    for o in outputs if weighed else ():
        of_output = fallback(o, continued=mean_terms is None)
        factor = o.variance_factor * np.sqrt(of_output[0] / o.signal_variance)
        known.append(of_output)
        factors.append(factor.T.ravel())
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
        parts = sums(structure, select(z_, scale_), points_, alpha_, factor_)
        correction = assemble(z_, mean_, scale_, known_, *(ca.vertcat(*part) for part in parts))
        return residual_function("gaussian_process", z_, theta_, correction)

    interpreted = posterior_mean(_matrix_sums)
    return Residual("gaussian_process", interpreted, theta, source, posterior_mean(_compiled_sums))


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
    places = zip(ca.vertsplit(scaled), split(points, n_point), strict=True)
    distances: list[list[Expression]] = []  # of every output, of its features
    for _, features, _ in structure:
        distances.append([feature - point for feature, point in islice(places, len(features))])
    exponents = []
    for of_output in distances:
        exponents.append(sum(d * d for d in of_output))
    kernel = ca.exp(-ca.vertcat(*exponents))  # all outputs in one vectorised loop
    kernels = split(kernel, n_alpha)
    values = [ca.dot(a, k) for a, k in zip(split(alpha, n_alpha), kernels, strict=True)]
    slopes = _slopes(split(alpha * kernel, n_alpha), distances)
    if not factor.numel():
        return values, slopes, [], []
    known = []
    back = []
    for f, m, k in zip(split(factor, [m * m for m in n_alpha]), n_alpha, kernels, strict=True):
        root = ca.reshape(f, m, m)
        whitened = root @ k
        known.append(ca.dot(whitened, whitened))
        back.append(root.T @ whitened * k)
    return values, slopes, known, _slopes(back, distances)


def _slopes(weights: Sequence[Expression], distances: Sequence[Sequence[Expression]]) -> list[Expression]:
    """The weights (M,) of every output on the distances (M,) of its features."""
    return [ca.dot(weight, d) for weight, of_output in zip(weights, distances, strict=True) for d in of_output]


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
    features = split(scaled, [d for _, d in shapes])
    parts = split(points, [m * d for m, d in shapes])
    alphas = split(alpha, [m for m, _ in shapes])
    factors = split(factor, [m * m * weighed for m, _ in shapes])
    results = []
    for shape, *arguments in zip(shapes, features, parts, alphas, factors, strict=True):
        results.append(kernels[shape](*arguments))
    return tuple(map(list, zip(*results, strict=True)))


def _sizes(structure: Structure) -> tuple[list[int], list[int]]:
    """Number of points of every output, and of every feature."""
    n_alpha = []
    n_point = []
    for _, features, m in structure:
        n_alpha.append(m)
        n_point += [m] * len(features)
    return n_alpha, n_point


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
            apart = value[i] - far
            d_share = apart * share**2
            correction = far + share * apart
            dy_dz[row, :] += (1 - share) * ca.jacobian(far, z)
        y[row] += correction
        for columns in feature_places(names, features, "gp"):
            k = len(phi)
            dy_dz[row, columns] -= 2 * scale[k] * (share * slope[k])
            if weighed:
                dy_dz[row, columns] -= 4 * scale[k] * (d_share * known_slope[k])
            phi.append(ca.sum1(z[columns]))
    select = ca.Function("select", [z, scale], [scale * ca.vertcat(*phi)])
    arguments = [z, mean, scale, numbers, value, slope, known, known_slope]
    return select, ca.Function("assemble", arguments, [ca.sparsify(y), ca.sparsify(dy_dz)])
