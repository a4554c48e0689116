"""Learned models against independent solvers: gpytorch for Gaussian processes, batch least squares for recursive."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadexp.plugins.aerodynamics.blade_element import static_coefficients
from quadexp.plugins.aerodynamics.coefficients import BladeCoefficients
from quadexp.plugins.gaussian_process.posterior import gaussian_process_residual, mean_only
from quadexp.plugins.papers.lei_li.rls import AXES, RLSSettings
from tests.models.batch import batch_least_squares
from tests.plugins.aerodynamics.aerodynamic_point import aerodynamic_point
from tests.plugins.papers.estimator import Estimator
from tests.properties.strategies import GP_FEATURES, few, generators, make_blade, make_features, make_thrusts, vehicles

NAMES = ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")


def column(z, name: str):
    """One feature of z, numpy or torch."""
    if name == "thrust":
        return z[6:].sum()
    return z[NAMES.index(name) if name in NAMES else 6 + int(name[2:])]


@few
@given(vehicles(), generators)
def test_gaussian_process_is_gpytorchs(vehicle, rng):
    """Value and gradient of the residual against the posterior mean of gpytorch's exact GP and its autograd."""
    import gpytorch
    import torch

    class Exact(gpytorch.models.ExactGP):
        def __init__(self, x, y, lengthscale, variance, noise):
            likelihood = gpytorch.likelihoods.GaussianLikelihood()
            super().__init__(torch.as_tensor(x), torch.as_tensor(y), likelihood.double())
            kernel = gpytorch.kernels.RBFKernel(ard_num_dims=x.shape[1])
            self.mean_module, self.covar_module = gpytorch.means.ZeroMean(), gpytorch.kernels.ScaleKernel(kernel)
            self.double()
            kernel.lengthscale = torch.as_tensor(lengthscale)
            self.covar_module.outputscale = torch.as_tensor(variance, dtype=torch.double)  # a number is made single
            likelihood.noise = torch.as_tensor(noise, dtype=torch.double)

        def forward(self, x):
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    z, outputs, models = make_features(rng, vehicle), [], []
    for output, features in GP_FEATURES.items():
        x, y = rng.uniform(-8, 8, (12, len(features))), rng.normal(size=12)
        lengthscale, variance, noise = rng.uniform(2, 8, len(features)), rng.uniform(0.5, 3), rng.uniform(0.05, 0.5)
        distance = ((x[:, None] - x) / lengthscale) ** 2
        gram = variance * np.exp(-distance.sum(axis=2) / 2) + noise * np.eye(12)
        outputs.append(mean_only(output, features, x, variance * np.linalg.solve(gram, y), lengthscale))
        models.append((output, features, Exact(x, y, lengthscale, variance, noise).eval()))
    residual = gaussian_process_residual(vehicle, outputs)
    value, slope = (np.array(part.full()) for part in residual.function(z, residual.theta))
    rows = ("a_x", "a_y", "a_z", "tau_x", "tau_y", "tau_z")
    for output, features, model in models:
        at = torch.as_tensor(z).requires_grad_()
        mean = model(torch.stack([column(at, name) for name in features])[None]).mean[0]
        mean.backward()
        row = rows.index(output)
        assert value[row, 0] == pytest.approx(mean.item(), rel=1e-9, abs=1e-11)
        assert slope[row] == pytest.approx(at.grad.numpy(), rel=1e-9, abs=1e-11)


@few
@given(vehicles(flat=True), st.sampled_from([1.0, 0.97]), st.booleans(), generators)
def test_recursive_is_batch_least_squares(vehicle, forgetting, scaled, rng):
    """Any vehicle, noise and forgetting: the estimator of every axis is the weighted minimum over all its samples, and
    over what it fell back on between them."""
    blade = make_blade(rng)
    initial = BladeCoefficients.from_parameters(blade.parameters() * rng.uniform(0.5, 1.5, 5))
    kind = {"noise": float(rng.uniform(0.02, 1))} | ({"relative_std": 0.4} if scaled else {"covariance": 3.0})
    estimator = Estimator(vehicle, initial, RLSSettings(forgetting=forgetting, **kind))
    prior, rows, readings, before = estimator.covariance, [], [], []
    k = static_coefficients(vehicle.rotor, blade).thrust
    for _ in range(25):
        v, w = 3 * rng.normal(size=3), np.sqrt(make_thrusts(rng, vehicle) / k)
        v[2] = abs(v[2])
        force = aerodynamic_point(vehicle, blade, v, w).force / vehicle.mass + 0.05 * rng.normal(size=3)
        before.append(estimator.axis_theta)
        estimator.update(v, w, force)
        rows.append(estimator.regressors)
        readings.append(force)
    rows, readings = np.array(rows), np.array(readings)
    for axis, at in enumerate(AXES.values()):
        batch = batch_least_squares(
            rows[:, axis][:, list(at)],
            readings[:, axis],
            prior=initial.parameters()[list(at)],
            covariance=prior[axis],
            noise=kind["noise"],
            forgetting=forgetting,
            estimates=[one[axis] for one in before],
        )
        assert estimator.axis_theta[axis] == pytest.approx(batch, rel=1e-6, abs=1e-7)


@few
@given(vehicles(flat=True), generators)
def test_the_regressors_give_the_force_back(vehicle, rng):
    """Phi theta is the specific force of the model with the coefficients in use, at the start the true ones."""
    blade = make_blade(rng)
    estimator = Estimator(vehicle, blade, RLSSettings(clip=False))
    v, w = (
        3 * rng.normal(size=3),
        np.sqrt(make_thrusts(rng, vehicle) / static_coefficients(vehicle.rotor, blade).thrust),
    )
    v[2] = abs(v[2])
    point = aerodynamic_point(vehicle, blade, v, w)
    estimator.update(v, w, point.force / vehicle.mass)
    assert estimator.regressors @ blade.parameters() == pytest.approx(point.force / vehicle.mass, rel=1e-8, abs=1e-9)
    assert estimator.induced_velocity == pytest.approx(point.induced_velocity, rel=1e-9)
    assert estimator.error == pytest.approx(np.zeros(3), abs=1e-8)


@few
@given(vehicles(flat=True), st.floats(0, 1), st.sampled_from([1.0, 0.1]), generators)
def test_axes_are_combined_by_speed(vehicle, lift_weight, pace, rng):
    """(25), (26): beta_x = |v_x| / (|v_x| + |v_y|) at any speed, and C_la from all three axes with the weight of z."""
    blade = make_blade(rng)
    estimator = Estimator(vehicle, blade, RLSSettings(clip=False, lift_weight=lift_weight))
    k = static_coefficients(vehicle.rotor, blade).thrust
    for _ in range(3):
        v, w = pace * rng.normal(size=3), np.sqrt(make_thrusts(rng, vehicle) / k)
        estimator.update(v, w, 5 * rng.normal(size=3))
    x, y, z = estimator.axis_theta
    beta = abs(v[0]) / (abs(v[0]) + abs(v[1]))
    lift = lift_weight * z[0] + (1 - lift_weight) * (beta * x[1] + (1 - beta) * y[1])
    expected = [beta * x[0] + (1 - beta) * y[0], lift, x[2], y[2], z[1]]
    assert estimator.weight == pytest.approx(beta, rel=1e-12)
    assert estimator.raw == pytest.approx(expected, rel=1e-12)
