"""A residual at many points at once: what the residual says at each, on both back ends, and references made with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quadexp.air.linear_drag import linear_drag_residual
from quadexp.compile.compiler import compiler
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment.rollout import SampledReference
from quadexp.reference import Circle
from quadexp.reference.air_model import AirModel, PartialAir
from quadexp.reference.flatness import flat_reference
from tests.air.models import make_residual, with_rotors

BACKENDS = [
    "interpreted",
    pytest.param("compiled", marks=pytest.mark.skipif(compiler() is None, reason="no C compiler")),
]


def points(rng, k, n=4):
    """z at k points, (6 + n, k)."""
    return np.concatenate([4 * rng.normal(size=(3, k)), rng.normal(size=(3, k)), rng.uniform(1, 4, (n, k))])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["linear_drag", "gp_thrust", "gp_with_mean", "plant", "blade_element"])
def test_outputs_and_gradients_are_the_residuals(vehicle, rng, name, backend):
    """At 1, 7 and 300 points, in any order: the values of the residual's own function."""
    residual = make_residual(name, with_rotors(vehicle))
    model = AirModel(residual, backend)
    for k in (7, 1, 300, 7):
        z = points(rng, k)
        response = model(z)
        for i in range(k):
            y, dy_dz = (np.array(value.full()) for value in residual.function(z[:, i], residual.theta))
            assert response.outputs[:, i] == pytest.approx(y.ravel(), rel=1e-9, abs=1e-11)
            assert response.by_velocity[:, :, i] == pytest.approx(dy_dz[:, :3], rel=1e-8, abs=1e-10)
            assert response.by_thrust[:, :, i] == pytest.approx(dy_dz[:, 6:], rel=1e-8, abs=1e-10)


@pytest.mark.parametrize("backend", BACKENDS)
def test_drag_by_hand(vehicle, rng, backend):
    z = points(rng, 50)
    model = AirModel(linear_drag_residual(vehicle, (0.5, 0.25, 0.1)), backend)
    response, half = model(z), PartialAir(model, 0.5)(z)
    assert np.allclose(response.outputs[:3], -np.array([[0.5], [0.25], [0.1]]) * z[:3], rtol=1e-14)
    assert np.all(response.outputs[3:] == 0) and np.all(response.by_thrust == 0)
    assert np.allclose(response.by_velocity[:3], -np.diag([0.5, 0.25, 0.1])[:, :, None], rtol=1e-14)
    assert np.array_equal(half.outputs, 0.5 * response.outputs)


@pytest.mark.parametrize("backend", BACKENDS)
def test_two_models_of_one_structure_keep_their_parameters(vehicle, rng, backend):
    """They share compiled code; what identification renews in flight is another model of the same structure."""
    residual, z = make_residual("gp_with_mean", vehicle), points(rng, 5)
    double = replace(residual, theta=2 * residual.theta)
    one, two = AirModel(residual, backend), AirModel(double, backend)
    before = one(z).outputs
    assert np.allclose(two(z).outputs.T, double(z.T), rtol=1e-9, atol=1e-11)
    assert np.array_equal(one(z).outputs, before)


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("name", ["linear_drag", "gp_thrust", "blade_element"])
def test_the_reference_of_both_back_ends(vehicle, name):
    vehicle = with_rotors(vehicle)
    residual, t = make_residual(name, vehicle), np.arange(0.0, 12.0, 0.05)
    one, two = (
        flat_reference(Circle(speed=6.0), t, vehicle, residual, backend=backend)
        for backend in ("interpreted", "compiled")
    )
    assert one.residual == two.residual == 1.0
    assert np.abs(one.state - two.state).max() < 1e-8 and np.abs(one.input - two.input).max() < 1e-7


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_reference_is_made_on_its_controllers_back_end(vehicle, backend, monkeypatch):
    asked = []
    monkeypatch.setattr("quadexp.reference.flatness.AirModel", lambda *a: asked.append(a[1]) or AirModel(*a))
    residual = make_residual("linear_drag", vehicle)
    controller = ModelPredictiveController(vehicle, residual, MPCSettings(nodes=6), backend=backend)
    SampledReference(Circle(speed=3.0), controller)
    assert asked == [backend]


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
def test_points_of_the_wrong_size_are_refused(vehicle):
    with pytest.raises(ValueError, match="must be compiled, the values"):
        AirModel(make_residual("linear_drag", vehicle), "compiled")(np.zeros((9, 4)))
