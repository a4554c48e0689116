"""The bound, the posterior and the greedy choice against their equations written out densely."""

import gpytorch
import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from quadexp.plugins.gaussian_process import sgpr
from quadexp.plugins.gaussian_process.posterior import OutputPosterior
from quadexp.plugins.gaussian_process.sgpr import greedy_points

JITTER = 1e-8


def problem(n=300, d=2, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-2, 2, (n, d))
    y = np.sin(2 * x[:, 0]) + 0.3 * x[:, -1] * np.abs(x[:, -1]) + 0.1 * rng.normal(size=n)
    return x, y, sgpr.Hyperparameters(np.linspace(0.8, 1.3, d), 1.7, 0.013)


def kernel(a, b, p):
    scaled = (a[:, None] - b[None]) / p.lengthscale
    return p.signal_variance * np.exp(-0.5 * np.sum(scaled**2, axis=2))


class InducingKernel(gpytorch.kernels.InducingPointKernel):
    """gpytorch's sparse kernel with a fixed jitter (gpytorch adds jitter only where a factorisation fails)."""

    @property
    def _inducing_mat(self) -> torch.Tensor:
        matrix = super()._inducing_mat
        return matrix + JITTER * self.base_kernel.outputscale * torch.eye(len(matrix), dtype=matrix.dtype)


def exported(points, alpha, factor, p) -> OutputPosterior:
    names = tuple(f"v_{axis}" for axis in "xyz"[: points.shape[1]])
    return OutputPosterior(
        "a_x", names, points, alpha, p.lengthscale, p.signal_variance, p.noise_variance, factor, 0.0, 0
    )


@pytest.mark.parametrize("chunk", [sgpr.CHUNK, 64])
@pytest.mark.parametrize("m", [1, 7, 40])
def test_objective_is_titsias_bound(m, chunk, monkeypatch):
    """Titsias 2009, eq. 9: log N(y | 0, Q + s^2 I) - tr(K - Q) / (2 s^2), with the n x n matrices formed."""
    monkeypatch.setattr(sgpr, "CHUNK", chunk)
    x, y, p = problem()
    z = x[:m] + 0.05
    q = kernel(x, z, p) @ np.linalg.solve(kernel(z, z, p) + JITTER * p.signal_variance * np.eye(m), kernel(z, x, p))
    marginal = multivariate_normal(np.zeros(len(x)), q + p.noise_variance * np.eye(len(x))).logpdf(y)
    bound = marginal - np.trace(kernel(x, x, p) - q) / (2 * p.noise_variance)
    model = sgpr.GPRegression(x, y, p, z, JITTER)
    model.train()
    assert model.objective().item() * len(x) == pytest.approx(bound, rel=1e-9)


def test_the_gradient_of_the_bound_is_gpytorchs(monkeypatch):
    """Of hyperparameters and inducing points, in chunks, against gpytorch's sparse kernel and marginal likelihood."""
    monkeypatch.setattr(sgpr, "CHUNK", 64)
    x, y, p = problem()
    ours, theirs = (sgpr.GPRegression(x, y, p, x[:7] + 0.05, JITTER) for _ in range(2))
    theirs.covar_module = InducingKernel(theirs.base, torch.tensor(x[:7] + 0.05), theirs.likelihood)
    theirs.points = None
    values = [model.train().objective() for model in (ours, theirs)]
    assert values[0].item() == pytest.approx(values[1].item(), rel=1e-9)
    for value in values:
        value.backward()
    np.testing.assert_allclose(ours.points.grad, theirs.covar_module.inducing_points.grad, rtol=1e-6, atol=1e-9)
    for one, other in zip(ours.base.parameters(), theirs.base.parameters(), strict=True):
        np.testing.assert_allclose(one.grad, other.grad, rtol=1e-6, atol=1e-9)
    noise = [next(model.likelihood.parameters()).grad for model in (ours, theirs)]
    np.testing.assert_allclose(*noise, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("m", "d"), [(10, 1), (20, 1), (20, 3), (100, 1), (100, 2)])
def test_exported_posterior_equals_gpytorch(m, d):
    """Mean and variance in plain numpy against gpytorch's own prediction in eval mode, to 1e-8."""
    x, y, p = problem(n=1500, d=d)
    z = x[greedy_points(x, p.lengthscale, m)]
    model = sgpr.GPRegression(x, y, p, z, JITTER)
    model.covar_module = InducingKernel(model.base, torch.tensor(z), model.likelihood)
    at = np.random.default_rng(1).uniform(-2.5, 2.5, (200, d))
    fitted = model.hyperparameters
    ours = exported(z, *sgpr.sparse_posterior(x, y, z, fitted, JITTER), fitted).predict(at)
    model.eval()
    with torch.no_grad():
        # Titsias' posterior has Q alone as covariance of the training rows (with the diagonal correction it is FITC's),
        # but the full kernel at the test rows: so fill gpytorch's caches without the correction, then predict with it.
        with gpytorch.settings.sgpr_diagonal_correction(False):
            assert model(torch.as_tensor(at)).variance.shape == (200,)
        theirs = model(torch.as_tensor(at))
    np.testing.assert_allclose(ours.mean, theirs.mean.numpy(), rtol=0, atol=1e-8)
    np.testing.assert_allclose(ours.variance, theirs.variance.numpy(), rtol=0, atol=1e-8)


def test_exact_posterior_equals_gpytorch():
    x, y, p = problem(n=150)
    model = sgpr.GPRegression(x, y, p, None, JITTER)
    at = np.random.default_rng(1).uniform(-2.5, 2.5, (200, 2))
    ours = exported(x, *sgpr.exact_posterior(x, y, model.hyperparameters), model.hyperparameters).predict(at)
    model.eval()
    with torch.no_grad():
        theirs = model(torch.as_tensor(at))
    np.testing.assert_allclose(ours.mean, theirs.mean.numpy(), rtol=0, atol=1e-8)
    np.testing.assert_allclose(ours.variance, theirs.variance.numpy(), rtol=0, atol=1e-8)


def test_sparse_posterior_with_all_points_is_the_exact_one():
    x, y, p = problem(n=100)
    at = np.random.default_rng(1).uniform(-2, 2, (50, 2))
    sparse = exported(x, *sgpr.sparse_posterior(x, y, x, p, 1e-12), p).predict(at)
    exact = exported(x, *sgpr.exact_posterior(x, y, p), p).predict(at)
    np.testing.assert_allclose(sparse.mean, exact.mean, atol=1e-6)
    np.testing.assert_allclose(sparse.variance, exact.variance, atol=1e-6)


def test_maximise_climbs_and_a_gradient_vanishes():
    x, y, p = problem(n=400, d=1)
    model = sgpr.GPRegression(x, y, p, x[:6], JITTER)
    model.train()
    before = model.objective().item()
    after = sgpr.maximise(model, 200)
    assert after > before + 0.1
    assert after == pytest.approx(model.objective().item(), abs=1e-12)
    loss = -model.objective()
    loss.backward()
    assert max(q.grad.abs().max().item() for q in model.parameters()) < 1e-3
    assert model.hyperparameters.noise_variance == pytest.approx(0.01, rel=0.3)


def test_greedy_points_take_the_largest_variance_left():
    """Each pick against argmax of k - k_Z K_ZZ^-1 k_Z formed anew (Burt et al. 2020)."""
    x, _, p = problem(n=80)
    unit = sgpr.Hyperparameters(p.lengthscale, 1.0, 1.0)
    chosen = greedy_points(x, p.lengthscale, 12)
    for k in range(1, 12):
        z = x[chosen[:k]]
        left = 1 - np.sum(kernel(x, z, unit) * np.linalg.solve(kernel(z, z, unit), kernel(z, x, unit)).T, axis=1)
        assert left[chosen[k]] == pytest.approx(left.max(), abs=1e-9)


def test_greedy_points_are_distinct_even_where_the_kernel_is_exhausted():
    x = np.linspace(0, 1, 200)[:, None]
    chosen = greedy_points(x, np.array([5.0]), 100)
    assert len(set(chosen)) == 100
