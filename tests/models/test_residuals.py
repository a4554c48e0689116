"""What every residual promises, and what each one is."""

import casadi as ca
import numpy as np
import pytest

from quadexp.compile.backend import realise
from quadexp.errors import UsageError
from quadexp.models.residual import no_residual, scaled_residual, symbolic_residual
from quadexp.plugins.gaussian_process.posterior import gaussian_process_residual, mean_only
from quadexp.world import SimplifiedPlant
from tests.models.residuals import RESIDUALS, interpolating, make_residual, weighed_outputs


def features(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.hstack([rng.normal(0, 6, (count, 3)), rng.normal(0, 3, (count, 3)), rng.uniform(0.5, 12, (count, 4))])


@pytest.mark.parametrize("name", RESIDUALS)
class TestContract:
    def test_shapes(self, vehicle, rng, name):
        residual = make_residual(name, vehicle)
        assert residual.function.size_in(0) == (10, 1)
        assert residual.function.size_in(1) == (len(residual.theta), 1)
        assert residual.function.size_out(0) == (6, 1)
        assert residual.function.size_out(1) == (6, 10)
        assert residual(features(rng, 7)).shape == (7, 6)

    def test_jacobian_is_the_derivative(self, vehicle, rng, name):
        residual, h = make_residual(name, vehicle), 1e-6
        for z in features(rng, 5):
            _, jacobian = residual.function(z, residual.theta)
            steps = np.vstack([z + h * np.eye(10), z - h * np.eye(10)])
            y = residual(steps)
            assert np.allclose(np.array(jacobian.full()), ((y[:10] - y[10:]) / (2 * h)).T, atol=2e-7)

    def test_batch_equals_single(self, vehicle, rng, name):
        residual, z = make_residual(name, vehicle), features(rng, 4)
        assert np.array_equal(residual(z), np.vstack([residual(one) for one in z]))

    def test_parameters_are_inputs(self, vehicle, rng, name):
        """New numbers go through the same function: nothing of theta is baked in."""
        residual, z = make_residual(name, vehicle), features(rng, 1)[0]
        if not len(residual.theta):
            return
        one = np.array(residual.function(z, residual.theta)[0].full())
        other = np.array(residual.function(z, residual.theta * 1.01)[0].full())
        assert not np.allclose(one, other)


def test_what_knows_nothing_of_the_air(vehicle):
    """Only a residual without outputs does; one that is the same everywhere still pushes."""
    assert no_residual(vehicle).is_zero
    assert not any(make_residual(name, vehicle).is_zero for name in RESIDUALS if name != "none")
    z, theta = ca.SX.sym("z", 10), ca.SX.sym("theta", 1)
    gust = symbolic_residual("gust", ca.vertcat(theta, ca.SX(5, 1)), z, theta, [0.0])
    assert gust.function.nnz_out(1) == 0 and not gust.is_zero


def test_unknown_features_are_refused(vehicle):
    points = mean_only("a_x", ("speed",), np.zeros((3, 1)), np.zeros(3), np.ones(1))
    with pytest.raises(UsageError, match="gp feature 'speed': allowed are"):
        gaussian_process_residual(vehicle, [points])


def test_torrente_numbers(vehicle):
    """a = -(0.3, 0.3, 0) v - 0.08 v |v| per axis; loss 0.1 (u/1.3)^2 of the normalised thrust."""
    residual = SimplifiedPlant(vehicle, backend="interpreted").residual()
    z = np.array([8.0, -3.0, 2.0, 0, 0, 0, 4.0, 4.0, 4.0, 4.0])
    loss = 4 * 20 * 0.1 * (4 / 20 / 1.3) ** 2
    expected = [-0.3 * 8 - 0.08 * 64, 0.3 * 3 + 0.08 * 9, -0.08 * 4 - loss, 0, 0, 0]
    assert np.allclose(residual(z)[0], expected)


def test_weighed_by_its_variance_it_is_the_combination_of_least_squared_error(vehicle, rng):
    """w = s^2 / (s^2 + variance) inside and outside the data, from the posterior's prediction; s^2: what drag, fitted
    to the GP at its points, misses there. A torque has no drag to fall back to."""
    residual, z = make_residual("gp_weighed", vehicle), features(rng, 40)
    z[:, 0] = np.linspace(-40, 40, 40)
    thrust = z[:, 6:].sum(axis=1)
    prior = np.stack([-0.1 * z[:, 0], 0 * z[:, 0], -0 * z[:, 2] + 0.1 - 0.02 * thrust], axis=1)
    columns = {"v_x": z[:, 0], "v_z": z[:, 2], "w_y": z[:, 4], "thrust": thrust}
    expected = np.zeros((40, 6))
    expected[:, :3] = prior + [0, 0.01, 0]
    for gp in weighed_outputs():
        mean, variance, _ = gp.predict(np.stack([columns[name] for name in gp.features], axis=1))
        here, at_points = np.zeros((40, 1)), np.zeros((15, 1))
        if gp.output != "tau_y":

            def drag(v, *more):
                return np.stack([np.ones_like(v), v, v * np.abs(v), *more], axis=1)

            here, at_points = drag(*(columns[name] for name in gp.features)), drag(*gp.inducing.T)
        found = gp.predict(gp.inducing).mean
        c = np.linalg.lstsq(at_points, found, rcond=None)[0]
        misfit = np.sum((found - at_points @ c) ** 2) / (15 - np.linalg.matrix_rank(at_points))
        weight = misfit / (misfit + variance)
        expected[:, {"a_x": 0, "a_z": 2, "tau_y": 4}[gp.output]] += here @ c + weight * (mean - here @ c)
    assert residual(z) == pytest.approx(expected, abs=1e-6)


def test_outside_its_data_drag_goes_on(vehicle):
    """Of a zero-mean GP of drag up to 10 m/s: four times as fast it is nothing, weighed it is still the drag."""
    v = np.linspace(-10, 10, 15)[:, None]
    gp = interpolating("a_x", ("v_x",), v, -0.3 * v[:, 0] - 0.08 * v[:, 0] * np.abs(v[:, 0]))
    for speed in (5.0, 40.0):
        z, drag = np.r_[speed, np.zeros(5), np.full(4, 2.0)], -0.3 * speed - 0.08 * speed**2
        plain, weighed = (gaussian_process_residual(vehicle, [gp], weighed=w)(z)[0, 0] for w in (False, True))
        assert weighed == pytest.approx(drag, rel=5e-3)
        assert plain == pytest.approx(drag if speed < 10 else 0.0, rel=5e-3, abs=1e-6)


FORMS = ["gp_per_axis", "gp_thrust", "gp_with_mean", "gp_weighed", "neural", "sum"]


@pytest.mark.parametrize("name", FORMS)
def test_it_takes_and_gives_the_same(vehicle, name):
    """Shapes and structural zeros, with or without a compiler."""
    residual = make_residual(name, vehicle)
    for side in ("sparsity_in", "sparsity_out"):
        for i in range(2):
            assert getattr(residual.to_compile, side)(i) == getattr(residual.function, side)(i)


@pytest.mark.parametrize("name", FORMS)
def test_hand_written_sums_are_the_matrix_ones(vehicle, name, rng):
    residual = make_residual(name, vehicle)
    compiled = realise(residual.to_compile, "compiled")
    for size in (1.0, 8.0, 80.0):  # the last one is out of every point's reach
        z = size * rng.normal(size=6 + vehicle.n_rotors)
        for there, here in zip(compiled(z, residual.theta), residual.function(z, residual.theta), strict=True):
            assert there.sparsity() == here.sparsity()
            assert np.allclose(there.nonzeros(), here.nonzeros(), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("name", ["none", "linear_drag", "gp_with_mean"])
def test_it_scales_outputs_and_derivatives(vehicle, rng, name):
    residual = make_residual(name, vehicle)
    scaled, z = scaled_residual(residual), rng.normal(size=6 + vehicle.n_rotors)
    assert scaled.unscaled is residual and scaled.is_zero == residual.is_zero and scaled.name == residual.name
    values = [np.array(part) for part in residual.function(z, residual.theta)]
    for scale in (1.0, 0.0, 1.7):
        found = scaled.function(z, np.append(residual.theta, scale))
        for one, value in zip(found, values, strict=True):
            assert np.array(one) == pytest.approx(scale * value, abs=1e-14)
    assert scaled(z) == pytest.approx(residual(z), abs=0)
