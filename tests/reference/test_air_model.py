"""A residual at many points at once: what the residual says at each; and the iteration on it, compiled and in numpy."""

from dataclasses import replace

import numpy as np
import pytest

from quadexp.compile.compiler import compiler
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.errors import UsageError
from quadexp.experiment.rollout import SampledReference
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.reference.air_step import AirModel, predicted_and_next
from quadexp.reference.circle import Circle
from quadexp.reference.flatness import flat_reference
from quadexp.reference.motion import Air, Demand
from quadexp.reference.time_grid import TimeGrid
from quadexp.reference.traced import CompiledStep
from tests.models.residuals import make_residual, with_rotors
from tests.properties.paths import Wander
from tests.reference.test_flatness import Straight

compiled = pytest.mark.skipif(compiler() is None, reason="no C compiler")
NAMES = ["linear_drag", "gp_thrust", "gp_with_mean", "plant", "blade_element"]


def points(rng, k, n=4):
    """z at k points, (6 + n, k)."""
    return np.concatenate([4 * rng.normal(size=(3, k)), rng.normal(size=(3, k)), rng.uniform(1, 4, (n, k))])


@pytest.mark.parametrize("name", NAMES)
def test_outputs_and_gradients_are_the_residuals(vehicle, rng, name):
    """At 1, 7 and 300 points, in any order: the values of the residual's own function."""
    residual = make_residual(name, with_rotors(vehicle))
    model = AirModel(residual)
    for k in (7, 1, 300, 7):
        z = points(rng, k)
        response = model(z)
        for i in range(k):
            y, dy_dz = (np.array(value.full()) for value in residual.function(z[:, i], residual.theta))
            assert response.outputs[:, i] == pytest.approx(y.ravel(), rel=1e-9, abs=1e-11)
            assert response.by_velocity[:, :, i] == pytest.approx(dy_dz[:, :3], rel=1e-8, abs=1e-10)
            assert response.by_thrust[:, :, i] == pytest.approx(dy_dz[:, 6:], rel=1e-8, abs=1e-10)


def test_drag_by_hand(vehicle, rng):
    z = points(rng, 50)
    model = AirModel(linear_drag_residual(vehicle, (0.5, 0.25, 0.1)))
    response, half = model(z), model.scaled(0.5)(z)
    assert np.allclose(response.outputs[:3], -np.array([[0.5], [0.25], [0.1]]) * z[:3], rtol=1e-14)
    assert np.all(response.outputs[3:] == 0) and np.all(response.by_thrust == 0)
    assert np.allclose(response.by_velocity[:3], -np.diag([0.5, 0.25, 0.1])[:, :, None], rtol=1e-14)
    assert np.array_equal(half.outputs, 0.5 * response.outputs)


def random_air(rng, k):
    """Outputs, l' and l'' of the size that flights have; some ask for more than the rotors have."""
    outputs = rng.normal(size=(6, k)) * np.array([2, 2, 2, 0.1, 0.1, 0.02])[:, None]
    return Air(outputs, 3 * rng.normal(size=(2, k)), 20 * rng.normal(size=(2, k)))


@compiled
@pytest.mark.parametrize(("name", "yaw"), zip(NAMES, [False, True, True, False, True], strict=True))
def test_the_compiled_step_is_numpys(vehicle, rng, name, yaw):
    """On any path and air, rotors at their limits among them, whole models and shares of them."""
    vehicle = replace(with_rotors(vehicle), thrust_max=1.6 * vehicle.hover_thrust, thrust_min=1.0)
    residual, grid = make_residual(name, vehicle), TimeGrid.over(0.0, 1.5, 0.01)
    demand = Demand.of(Wander(rng, yaw=yaw), grid.times, vehicle.gravity)
    for share in (1.0, 0.4):
        one, two = (AirModel(residual, backend) for backend in ("interpreted", "compiled"))
        if share < 1:
            one, two = one.scaled(share), two.scaled(share)
        step = CompiledStep(demand, vehicle, two, grid)
        for _ in range(3):
            air = random_air(rng, len(grid.times))
            expected = predicted_and_next(demand, vehicle, one, air, grid)
            for found, known in zip(step(air), expected, strict=True):
                assert found.shape == known.shape
                assert np.allclose(found, known, rtol=1e-8, atol=1e-8)


@compiled
def test_both_say_where_there_is_no_attitude(vehicle):
    falling = Demand.of(Straight((0, 0, -9.81), yaw=(0, 0, 0)), np.array([0.5, 1.0]), vehicle.gravity)
    air, grid = Air.still(2), TimeGrid.over(0.0, 1.0, 0.1)
    model = AirModel(make_residual("linear_drag", vehicle), "compiled")
    with pytest.raises(UsageError) as first:
        CompiledStep(falling, vehicle, model, grid)(air)
    with pytest.raises(UsageError) as second:
        predicted_and_next(falling, vehicle, AirModel(model.residual), air, grid)
    assert str(first.value) == str(second.value) and "free fall" in str(first.value)


@compiled
def test_two_models_of_one_structure_keep_their_parameters(vehicle, rng):
    """They share compiled code; what identification renews in flight is another model of the same structure."""
    residual, grid = make_residual("gp_with_mean", vehicle), TimeGrid.over(0.0, 1.5, 0.05)
    demand, air = Demand.of(Wander(rng), grid.times, vehicle.gravity), random_air(rng, len(grid.times))
    double = replace(residual, theta=2 * residual.theta)
    one, two = (CompiledStep(demand, vehicle, AirModel(model, "compiled"), grid) for model in (residual, double))
    before = one(air)[0]
    assert np.allclose(two(air)[0], predicted_and_next(demand, vehicle, AirModel(double), air, grid)[0], atol=1e-9)
    assert np.array_equal(one(air)[0], before)


@compiled
@pytest.mark.parametrize(("name", "yaw"), [("gp_thrust", 0.3), ("blade_element", None)])
def test_the_reference_of_both_back_ends(vehicle, name, yaw):
    vehicle = with_rotors(vehicle)
    residual, t = make_residual(name, vehicle), np.arange(0.0, 12.0, 0.05)
    path = Circle(speed=6.0, yaw=yaw)
    one, two = (flat_reference(path, t, vehicle, residual, backend=name) for name in ("interpreted", "compiled"))
    assert one.residual == two.residual == 1.0
    assert np.abs(one.state - two.state).max() < 1e-8 and np.abs(one.input - two.input).max() < 1e-7


@pytest.mark.parametrize("backend", ["interpreted", "compiled"])
def test_a_reference_is_made_on_its_controllers_back_end(vehicle, backend, monkeypatch):
    asked, residual = [], make_residual("linear_drag", vehicle)
    monkeypatch.setattr("quadexp.reference.flatness.AirModel", lambda *a: asked.append(a[1]) or AirModel(a[0]))
    controller = ModelPredictiveController(vehicle, residual, MPCSettings(nodes=6), backend="interpreted")
    controller.backend = backend
    SampledReference(Circle(speed=3.0), controller)
    assert asked == [backend]
