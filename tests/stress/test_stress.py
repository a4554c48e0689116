"""The control step keeps its promise in any situation: an input within its bounds, or a failure with a name."""

import numpy as np
import pytest

from benchmarks.stress import SITUATIONS, STEPS_EACH, make_controllers, stress, stress_residuals, stress_vehicle
from quadexp.compile.backend import compiler
from quadexp.control.mpc.active_set import Status
from quadexp.errors import QuadexpError
from tests.slow import slow

MODELS = tuple(stress_residuals(stress_vehicle()))


def check(outcome, steps: int) -> None:
    assert outcome.wrong == []
    assert sum(outcome.counts.values()) == steps
    assert outcome.sweeps <= 10 * 40  # exchanges for every input: work is bounded, whatever the machine
    for name, counts in outcome.by_situation.items():
        if name.startswith("broken"):
            assert set(counts) == {"refused"}
        else:
            assert "refused" not in counts
            assert name == "extreme" or not counts[Status.FAILED.name], name


@pytest.mark.parametrize("model", ["gaussian_process", "blade_element", *slow("none", "linear_drag")])
def test_hundreds_of_steps(model):
    """One or two of every situation, interpreted."""
    steps = 16 * STEPS_EACH
    outcome = stress(make_controllers(model, "interpreted"), steps, seed=2)
    check(outcome, steps)
    assert set(outcome.by_situation) == set(SITUATIONS)
    assert outcome.counts[Status.ACTIVE_SET.name] > 20


@pytest.mark.slow
@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("model", MODELS)
def test_ten_thousand_steps(model):
    """Compiled with -ffast-math, where not-a-number is not looked for by the generated code itself."""
    check(stress(make_controllers(model, "compiled"), 10_000, seed=0), 10_000)


@pytest.mark.parametrize("backend", ["interpreted", "auto"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_not_finite_is_named_and_leaves_no_trace(backend, value):
    """One bad entry anywhere in the measurement or the reference is refused; the next step is as if it had not been."""
    disturbed, calm = (make_controllers("none", backend)[0] for _ in range(2))
    rng = np.random.default_rng(3)
    x, states, inputs = SITUATIONS["flight"](rng, calm.vehicle, calm.settings.nodes)
    for controller in (disturbed, calm):
        controller.reset(x, states, inputs)
        controller.command(x, states, inputs)
    for which, message in ((0, "measured state"), (1, "reference"), (2, "reference")):
        for _ in range(5):
            window = [x.copy(), states.copy(), inputs.copy()]
            window[which].reshape(-1)[rng.integers(window[which].size)] = value
            with pytest.raises(QuadexpError, match=f"the {message} is not finite"):
                disturbed.command(*window)
    assert np.array_equal(disturbed.command(x, states, inputs)[0], calm.command(x, states, inputs)[0])


def test_a_pinched_vehicle_has_only_its_bounds_to_choose_from():
    """Thrust between 0.999 and 1.001 of hover: for a target above all rotors take the upper bound."""
    vehicle = make_controllers("none", "interpreted")[1].vehicle
    for height, bound in ((5.0, vehicle.thrust_max), (-5.0, vehicle.thrust_min)):
        controller = make_controllers("none", "interpreted")[1]
        nodes = controller.settings.nodes
        x = np.r_[np.zeros(3), 1, np.zeros(9)]
        states = np.tile(np.r_[0, 0, height, 1, np.zeros(9)], (nodes + 1, 1))
        controller.reset(x, states, np.full((nodes, 4), vehicle.hover_thrust))
        u, record = controller.command(x, states, np.full((nodes, 4), vehicle.hover_thrust))
        assert record.status == Status.ACTIVE_SET
        assert u == pytest.approx(np.full(4, bound), abs=1e-9)
