"""Compiled code and the virtual machine give the same numbers, for inputs of every size."""

import numpy as np
import pytest
from hypothesis import given

from quadexp.compile.backend import BufferedFunction, compiler, realise
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.physics.sensitivity import rk4_sensitivity_function
from quadexp.plugins.papers.lei_li.plant import BladeElementPlant
from quadexp.reference.flatness import flat_reference
from quadexp.world import SimplifiedPlant
from tests.properties.paths import Wander, near
from tests.properties.strategies import (
    generators,
    make_blade,
    make_residual,
    make_state,
    make_thrusts,
    make_upright_state,
    make_vehicle,
)

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")
BOTH = ("interpreted", "compiled")
VEHICLE = make_vehicle(np.random.default_rng(11), 4, flat=True)  # one of each: compiling takes seconds


def model(name: str):
    return make_residual(name, VEHICLE, np.random.default_rng(12))


@pytest.fixture(scope="module", params=["gaussian_process", "blade_element"])
def nodes(request):
    function = rk4_sensitivity_function(VEHICLE, model(request.param), scalar=True)
    return model(request.param).theta, [BufferedFunction(realise(function, backend)) for backend in BOTH]


@given(generators)
def test_linearised_node(nodes, rng):
    theta, functions = nodes
    x, u, h, results = make_state(rng, speed=10.0), make_thrusts(rng, VEHICLE), 10 ** rng.uniform(-3, -1), []
    for function in functions:
        for name, value in (("x", x), ("u", u), ("theta", theta), ("dt", h)):
            function.arguments[name].reshape(-1)[:] = value
        function()
        results.append(np.concatenate([function.results[name].ravel() for name in ("x_next", "A", "B")]))
    assert np.allclose(*results, rtol=1e-9, atol=1e-9)


@pytest.fixture(scope="module")
def controllers():
    settings = MPCSettings(nodes=5, horizon=0.5)
    return [ModelPredictiveController(VEHICLE, model("linear_drag"), settings, backend=b) for b in BOTH]


@given(generators)
def test_controller(controllers, rng):
    """Four warm steps along a random path with states that jump: thrusts agree to 1e-7 of hover, and status."""
    reference = flat_reference(Wander(rng), 0.2 + controllers[0].node_times, VEHICLE)
    states, inputs = reference.state, reference.input[:-1]
    measured = [near(states[0], rng, d) for d in (0.01, 0.05, 0.3, 0.1)]
    answers = []
    for controller in controllers:
        controller.reset(measured[0], states, inputs)
        answers.append([controller.command(x, states, inputs) for x in measured])
    for (one, record), (two, record_two) in zip(*answers, strict=True):
        assert np.abs(one - two).max() < 1e-7 * VEHICLE.hover_thrust
        assert (record.status, record.active) == (record_two.status, record_two.active)


@pytest.fixture(scope="module")
def plants():
    blade = make_blade(np.random.default_rng(13))
    return {
        "simplified": [SimplifiedPlant(VEHICLE, step=2e-3, backend=b) for b in BOTH],
        "blade_element": [BladeElementPlant(VEHICLE, blade, step=1e-3, backend=b) for b in BOTH],
    }


@pytest.mark.parametrize("name", ["simplified", "blade_element"])
@given(generators)
def test_plants(plants, name, rng):
    """A control period with the plant's noise."""
    x, u, seed = make_upright_state(rng), make_thrusts(rng, VEHICLE), int(rng.integers(2**32))
    (one, read_one), (two, read_two) = (
        plant.advance(x, u, 0.02, np.random.default_rng(seed)) for plant in plants[name]
    )
    assert np.allclose(one, two, rtol=1e-9, atol=1e-9)
    assert np.allclose(read_one, read_two, rtol=1e-9, atol=1e-9)
