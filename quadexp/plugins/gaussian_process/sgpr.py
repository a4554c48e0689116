"""The fit of Gaussian processes: maximum marginal likelihood with gpytorch, in scaled coordinates.

Steps for each output: scaling (features to mean 0 and standard deviation 1, the target by its root mean square) ->
hyperparameters of an exact GP on a few rows -> inducing points where the remaining variance is largest -> both
optimised together, first on part of the rows, then on all -> posterior in physical units. Recorded flights are first
brought to a common thrust scale (quadexp.plugins.identification.recorded).

Exact GP: log N(y | 0, K_XX + sigma_n^2 I). Sparse: Titsias' collapsed variational bound (2009, eq. 9),

    log N(y | 0, Q + sigma_n^2 I) - tr(K_XX - Q) / (2 sigma_n^2),        Q = K_XZ (K_ZZ + jitter sigma_f^2 I)^-1 K_ZX

over all rows, maximised jointly over Z and the hyperparameters by L-BFGS. The fixed jitter adds independent noise to
the inducing variables f(Z): the bound remains valid, and fit and prediction use the same model. With L L' = K_ZZ +
jitter, A = L^-1 K_ZX, S = A A' and b = A y, the two terms are

    -1/2 [n log 2 pi + (n - M) log sigma_n^2 + log |S + sigma_n^2 I|
          + (y'y - b' (S + sigma_n^2 I)^-1 b) / sigma_n^2 + (n sigma_f^2 - tr S) / sigma_n^2]

S and b are sums over the rows, taken CHUNK at a time and computed again for the gradient: so many rows need no memory.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any

import gpytorch
import numpy as np
import torch
from linear_operator.utils.errors import NanError, NotPSDError
from linear_operator.utils.warnings import NumericalWarning
from scipy.linalg import cholesky, eigh, solve_triangular
from scipy.optimize import minimize
from torch.nn.utils import parameters_to_vector, vector_to_parameters
from torch.utils.checkpoint import checkpoint

from quadexp.physics.state import root_mean_square

PILOT_ROWS = 400  # of the exact GP that initialises the hyperparameters
CANDIDATE_ROWS = 4000  # from which the initial inducing points are chosen; also those of the first stage of the bound
PILOT_ITERATIONS = 60  # steps at most, of the pilot that only begins what follows
STAGE_ITERATIONS = 150  # steps at most, of each stage
RELATIVE_FLOOR = 1e-10  # of the prior variance; below it a further point is redundant
NOISE_FLOOR = 1e-8  # of the output's mean square
EXACT_LIMIT = 5000  # rows up to which gpytorch uses a Cholesky factorisation instead of conjugate gradients
FAILED = 1e10  # objective where the covariance cannot be factorised
CHUNK = 10_000  # rows


@dataclass(frozen=True)
class Hyperparameters:
    """lengthscale (d,), signal_variance, noise_variance, in scaled coordinates."""

    lengthscale: np.ndarray
    signal_variance: float
    noise_variance: float


def fit_output(
    z: np.ndarray,
    target: np.ndarray,
    settings: Any,
    iterations: int,
    rng: np.random.Generator,
    start: Any,
    report: Callable[[float], None],
) -> tuple[Any, ...]:
    """The numbers of one output's posterior (OutputPosterior, from inducing on) from its features z (k, d) and target.

    settings: GPConfig, of which method, inducing and jitter are read. start: the same output's posterior, its values
    replace the first stages. report: called with the completed share.
    """
    centre = z.mean(axis=0)
    spread = z.std(axis=0)
    unit = root_mean_square(target) or 1.0
    x = (z - centre) / spread
    y = target / unit
    order = rng.permutation(len(x))

    if start is not None and settings.method == "sgpr":
        points = (start.inducing - centre) / spread
        guess = Hyperparameters(
            start.lengthscale / spread, start.signal_variance / unit**2, start.noise_variance / unit**2
        )
    else:
        few = order[:PILOT_ROWS]
        pilot = GPRegression(x[few], y[few], Hyperparameters(np.ones(x.shape[1]), 1.0, 0.01), None, settings.jitter)
        bound = maximise(pilot, PILOT_ITERATIONS, lambda k: report(0.15 * k / PILOT_ITERATIONS))
        guess = pilot.hyperparameters
        candidates = order[: max(CANDIDATE_ROWS, settings.inducing)]
        informative = greedy_points(x[candidates], guess.lengthscale, settings.inducing)
        rows = candidates[informative]
        points = x[rows]

    if settings.method == "sgpr":
        if start is None and len(x) > CANDIDATE_ROWS:
            part = GPRegression(x[candidates], y[candidates], guess, points, settings.jitter)
            maximise(part, STAGE_ITERATIONS, lambda k: report(0.15 + 0.25 * k / STAGE_ITERATIONS))
            points = part.inducing_points
            guess = part.hyperparameters
        whole = GPRegression(x, y, guess, points, settings.jitter)
        bound = maximise(whole, iterations, lambda k: report(0.4 + 0.6 * k / iterations))
        points = whole.inducing_points
        guess = whole.hyperparameters
        alpha, factor = sparse_posterior(x, y, points, guess, settings.jitter)
    else:
        alpha, factor = exact_posterior(points, y[rows], guess)

    return (
        points * spread + centre,
        alpha * unit,
        guess.lengthscale * spread,
        guess.signal_variance * unit**2,
        guess.noise_variance * unit**2,
        factor * unit,
        bound - float(np.log(unit)),
        len(alpha) if settings.method == "subset" else len(x),
    )


def greedy_points(x: np.ndarray, lengthscale: np.ndarray, count: int) -> np.ndarray:
    """Indices (count,) of the chosen rows, most informative first: greedily, where the prior variance is largest.

    Each step takes argmax_i k_ii - q_ii, q = K_XZ K_ZZ^-1 K_ZX, by a partial pivoted Cholesky factorisation, O(n M^2)
    (Burt, Rasmussen & van der Wilk 2020, "Convergence of sparse variational inference in GP regression", section 6.2).
    x: rows to choose from, (n, d), n >= count. lengthscale: (d,), same units. Where fewer rows reduce the variance to
    zero, the remaining ones are taken in their order.
    """
    n = len(x)
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
        n_chosen = len(chosen)
        known = factor[:n_chosen, pivot] @ factor[:n_chosen]
        row = (k - known) / np.sqrt(variance[pivot])
        factor[n_chosen] = row
        variance = np.maximum(variance - row**2, 0.0)
        variance[pivot] = 0.0
        chosen.append(pivot)
    return np.array(chosen)


class GPRegression(gpytorch.models.ExactGP):
    """Zero-mean GP with an RBF kernel with one length scale per feature, exact or sparse.

    x: (n, d), y: (n,), scaled. inducing: (M, d), or None for the exact GP.
    """

    def __init__(
        self, x: np.ndarray, y: np.ndarray, start: Hyperparameters, inducing: np.ndarray | None, jitter: float
    ) -> None:
        likelihood = gpytorch.likelihoods.GaussianLikelihood(
            noise_constraint=gpytorch.constraints.GreaterThan(NOISE_FLOOR)
        )
        super().__init__(torch.as_tensor(x), torch.as_tensor(y), likelihood)
        kernel = gpytorch.kernels.RBFKernel(ard_num_dims=x.shape[1])
        base = gpytorch.kernels.ScaleKernel(kernel)
        self.mean_module = gpytorch.means.ZeroMean()
        self.jitter = jitter
        self.covar_module = self.base = base
        self.points = None if inducing is None else torch.nn.Parameter(torch.tensor(inducing))
        self.double()
        base.base_kernel.lengthscale = torch.as_tensor(start.lengthscale)
        base.outputscale = torch.tensor(start.signal_variance, dtype=torch.float64)
        likelihood.noise = torch.tensor(max(start.noise_variance, 2 * NOISE_FLOOR), dtype=torch.float64)

    def forward(self, x: torch.Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    @property
    def inducing_points(self) -> np.ndarray:
        """Inducing points of the sparse GP, (M, d), scaled."""
        assert self.points is not None
        return self.points.detach().numpy().copy()

    @property
    def hyperparameters(self) -> Hyperparameters:
        lengthscale = self.base.base_kernel.lengthscale.detach().numpy().reshape(-1).copy()
        return Hyperparameters(lengthscale, self.base.outputscale.item(), self.likelihood.noise.item())

    def objective(self) -> torch.Tensor:
        """Log marginal likelihood or its bound, per row."""
        if self.points is not None:
            return self._bound(self.points)
        marginal = gpytorch.mlls.ExactMarginalLogLikelihood(self.likelihood, self)
        return marginal(self(*self.train_inputs), self.train_targets)

    def _bound(self, z: torch.Tensor) -> torch.Tensor:
        """Titsias' bound per row; see the module."""
        signal = self.base.outputscale
        noise = self.likelihood.noise
        eye = torch.eye(len(z), dtype=z.dtype)
        (x,) = self.train_inputs
        y = self.train_targets
        lower = torch.linalg.cholesky(self.base(z).to_dense() + self.jitter * signal * eye)

        def sums(x: torch.Tensor, y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            a = torch.linalg.solve_triangular(lower, self.base(z, x).to_dense(), upper=False)
            return a @ a.T, a @ y

        n = len(x)
        again = partial(checkpoint, sums, use_reentrant=False) if n > CHUNK else sums
        outers = []
        inners = []
        for chunk in zip(x.split(CHUNK), y.split(CHUNK), strict=True):
            outer, inner = again(*chunk)
            outers.append(outer)
            inners.append(inner)
        s = torch.stack(outers).sum(dim=0)
        b = torch.stack(inners).sum(dim=0)
        factor = torch.linalg.cholesky(s + noise * eye)
        whitened = torch.linalg.solve_triangular(factor, b[:, None], upper=False)
        quadratic = (y @ y - whitened.square().sum()) / noise
        determinant = (n - len(z)) * noise.log() + 2 * factor.diagonal().log().sum()
        trace = (n * signal - s.trace()) / noise
        misfit = (determinant + quadratic + trace).squeeze()
        return -0.5 * (math.log(2 * math.pi) + misfit / n)


def maximise(model: GPRegression, iterations: int, report: Callable[[int], None] = lambda done: None) -> float:
    """Maximise the model's objective in place by L-BFGS-B; returns it, per row.

    report: called with the number of iterations done.
    """
    model.train()
    parameters = [p for p in model.parameters() if p.requires_grad]
    done = count(1)

    def loss(flat: np.ndarray) -> tuple[float, np.ndarray]:
        vector_to_parameters(torch.tensor(flat), parameters)
        model.zero_grad()
        try:
            value = -model.objective()
            value.backward()
        except (NotPSDError, NanError, torch.linalg.LinAlgError):
            return FAILED, np.zeros_like(flat)
        gradient = parameters_to_vector([p.grad for p in parameters]).numpy()
        if np.isfinite(value.item()) and np.isfinite(gradient).all():
            return value.item(), gradient
        return FAILED, np.zeros_like(flat)

    flat = parameters_to_vector(parameters).detach().numpy()
    with warnings.catch_warnings(), gpytorch.settings.max_cholesky_size(EXACT_LIMIT):
        warnings.simplefilter("ignore", NumericalWarning)
        result = minimize(
            loss,
            flat,
            jac=True,
            method="L-BFGS-B",
            callback=lambda _: report(next(done)),
            options={"maxiter": iterations, "maxcor": 20, "ftol": 1e-9, "gtol": 1e-6},
        )
    vector_to_parameters(torch.tensor(result.x), parameters)
    return -float(result.fun)


def rbf(a: np.ndarray, b: np.ndarray, lengthscale: np.ndarray) -> np.ndarray:
    """exp(-1/2 sum_i ((a_i - b_i) / l_i)^2), (len(a), len(b))."""
    squares = np.zeros((len(a), len(b)))
    for i, length in enumerate(lengthscale):
        distance = (a[:, None, i] - b[None, :, i]) / length
        squares += distance * distance
    return np.exp(-0.5 * squares)


def sparse_posterior(
    x: np.ndarray, y: np.ndarray, inducing: np.ndarray, p: Hyperparameters, jitter: float
) -> tuple[np.ndarray, np.ndarray]:
    """Weights alpha (M,) and variance factor F (M, M) of the optimal variational posterior (Titsias 2009, eqs 6, 10).

    With L L' = K_ZZ + jitter, A = L^-1 K_ZX / sigma_n, B = I + A A': alpha = sigma_f^2 L^-T B^-1 A y / sigma_n and
    F'F = sigma_f^4 L^-T (I - B^-1) L^-1. All through L, whose condition number is the square root of that of K_ZZ.
    """
    m = len(inducing)
    sf2 = p.signal_variance
    sn = np.sqrt(p.noise_variance)
    covariance = sf2 * (rbf(inducing, inducing, p.lengthscale) + jitter * np.eye(m))
    lower = cholesky(covariance, lower=True)
    a = solve_triangular(lower, sf2 * rbf(inducing, x, p.lengthscale), lower=True) / sn
    eigenvalue, vector = eigh(a @ a.T)
    eigenvalue = np.maximum(eigenvalue, 0.0)
    projected = vector.T @ (a @ y)
    whitened = vector @ (projected / (1 + eigenvalue)) / sn
    alpha = sf2 * solve_triangular(lower, whitened, lower=True, trans="T")
    root = (vector * np.sqrt(eigenvalue / (1 + eigenvalue))).T  # root' root = I - B^-1
    factor = sf2 * solve_triangular(lower, root.T, lower=True, trans="T").T
    return alpha, np.asarray(np.linalg.qr(factor, mode="r"))


def exact_posterior(x: np.ndarray, y: np.ndarray, p: Hyperparameters) -> tuple[np.ndarray, np.ndarray]:
    """Weights alpha (n,) and variance factor F (n, n) of the exact GP: (K + sigma_n^2 I)^-1 y and its root."""
    n = len(x)
    sf2 = p.signal_variance
    covariance = sf2 * rbf(x, x, p.lengthscale) + p.noise_variance * np.eye(n)
    lower = cholesky(covariance, lower=True)
    inverse = solve_triangular(lower, np.eye(n), lower=True)
    return sf2 * (inverse.T @ (inverse @ y)), np.asarray(np.linalg.qr(sf2 * inverse, mode="r"))
