"""A Gaussian process that learns sample by sample is, without forgetting, the one fitted to all samples at once."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.models.gaussian_process import JITTER, OutputPosterior, adapting_process, gaussian_process_residual
from quadexp.models.online import Law, from_zero
from quadexp.models.sgpr import Hyperparameters, sparse_posterior
from tests.models.test_online import Learner


def data(rows=800, seed=0):
    rng = np.random.default_rng(seed)
    v, u = rng.uniform(-10, 10, (rows, 3)), rng.uniform(1, 6, (rows, 4))
    a = np.sin(v / 3) - 0.02 * v * np.abs(v) + 0.05 * rng.normal(size=(rows, 3))
    a[:, 2] -= 0.02 * u.sum(axis=1)
    return v, u, a


P = {
    "a_x": (Hyperparameters(np.array([3.0]), 1.5, 0.04), ("v_x",)),
    "a_y": (Hyperparameters(np.array([2.5]), 0.9, 0.04), ("v_y",)),
    "a_z": (Hyperparameters(np.array([4.0, 6.0]), 2.0, 0.04), ("v_z", "thrust")),
}


def process(points=12):
    """Outputs with weights zero and signal variances, and the inducing points of each."""
    rng, outputs = np.random.default_rng(1), []
    for name, (p, features) in P.items():
        where = rng.uniform(-9, 9, (points, len(features)))
        where[:, 1:] = rng.uniform(5, 23, (points, len(features) - 1))
        outputs.append(
            OutputPosterior.mean_only(name, features, where, np.zeros(points), p.lengthscale, p.signal_variance)
        )
    return outputs


def stream(vehicle, law, v, u, a, forgetting=0.0):
    outputs = process()
    adapting = adapting_process(gaussian_process_residual(vehicle, outputs), outputs, None)
    learner = Learner(vehicle, adapting, law, variance=0.04, decay=1 - forgetting)
    for sample in zip(v, u, a, strict=True):
        learner.sample(*sample)
    return adapting, outputs, learner.blocks, learner.theta.copy()


def features(names, v, u):
    columns = {"v_x": v[:, 0], "v_y": v[:, 1], "v_z": v[:, 2], "thrust": u.sum(axis=1)}
    return np.stack([columns[name] for name in names], axis=1)


def kernel(a, b, p):
    return p.signal_variance * np.exp(-0.5 * (((a[:, None] - b[None]) / p.lengthscale) ** 2).sum(axis=2))


def test_the_variational_form_is_our_sgpr(vehicle):
    """Mean and covariance of the function at new points, to 1e-8, against quadexp.models.sgpr on all rows."""
    v, u, a = data()
    adapting, outputs, blocks, theta = stream(vehicle, Law(), v, u, a)
    new_v, new_u, _ = data(40, seed=9)
    predicted = type(adapting.residual)("", adapting.residual.function, theta)(
        np.hstack([new_v, np.zeros_like(new_v), new_u])
    )
    for axis, (output, block, (_, S)) in enumerate(zip(outputs, adapting.blocks, blocks, strict=True)):
        p = P[output.output][0]
        x, new = features(output.features, v, u), features(output.features, new_v, new_u)
        alpha, factor = sparse_posterior(x, a[:, axis], output.inducing, p, JITTER)
        e = kernel(new, output.inducing, p) / p.signal_variance
        assert np.abs(predicted[:, axis] - e @ alpha).max() < 1e-8
        phi = e @ block.root  # variance: s^2 - phi phi' of what the points do not determine, phi S phi' of the rest
        variance = p.signal_variance - np.sum(phi**2, axis=1) + np.einsum("ki,ij,kj->k", phi, S, phi)
        assert np.abs(variance - (p.signal_variance - np.sum((e @ factor.T) ** 2, axis=1))).max() < 1e-8


def test_fitc_is_its_equation_on_all_samples(vehicle):
    """b = (I + X' D^-1 X)^-1 X' D^-1 y, D = diag(r + k(z, z) - q(z, z)): Snelson and Ghahramani's sparse process."""
    v, u, a = data(200)
    adapting, outputs, blocks, _ = stream(vehicle, Law(fitc=True), v, u, a)
    for axis, (output, block, (b, _)) in enumerate(zip(outputs, adapting.blocks, blocks, strict=True)):
        p = P[output.output][0]
        X = kernel(features(output.features, v, u), output.inducing, p) / p.signal_variance @ block.root
        weight = 1 / (0.04 + p.signal_variance - np.sum(X**2, axis=1))
        expected = np.linalg.solve(np.eye(X.shape[1]) + (X.T * weight) @ X, (X.T * weight) @ a[:, axis])
        assert np.allclose(X @ b, X @ expected, atol=1e-8)


def test_it_follows_a_world_that_changes(vehicle):
    """After a change of sign of the air's force, the stream with forgetting is right and the one without is not."""
    v, u, a = data(600)
    changed = np.vstack([a[:300], -a[300:]])
    errors = []
    for forgetting in (0.0, 0.02):
        adapting, outputs, blocks, _ = stream(vehicle, Law(), v, u, changed, forgetting)
        p = P["a_x"][0]
        X = kernel(v[300:, :1], outputs[0].inducing, p) / p.signal_variance @ adapting.blocks[0].root
        errors.append(np.sqrt(np.mean((X @ blocks[0][0] + a[300:, 0]) ** 2)))
    assert errors[1] < 0.3 * errors[0]


def test_it_begins_at_a_checkpoint_or_at_the_prior(vehicle):
    outputs = [
        OutputPosterior.mean_only("a_x", ("v_x",), np.linspace(-5, 5, 6)[:, None], np.arange(6.0), np.array([2.0])),
        OutputPosterior.mean_only("tau_x", ("w_x",), np.linspace(-5, 5, 6)[:, None], np.arange(6.0), np.array([2.0])),
    ]
    adapting = adapting_process(gaussian_process_residual(vehicle, outputs), outputs, 1.0)
    z = np.random.default_rng(0).normal(size=(4, 10))
    assert np.array_equal(adapting.residual(z), gaussian_process_residual(vehicle, outputs)(z))
    assert len(adapting.blocks) == 1  # torques are not measured, so they do not adapt
    fresh = from_zero(adapting).residual(z)
    assert not fresh[:, 0].any() and np.array_equal(fresh[:, 3], adapting.residual(z)[:, 3])
    assert np.allclose(adapting.blocks[0].mean, np.arange(6.0)) and pytest.approx(0) == fresh[0, 1]
