"""The controller, iterated to stationarity, is at the optimum of its nonlinear programme, for random problems."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import MAX_TURN, ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.reference.flatness import flat_reference
from tests.control.mpc.converged import ConvergedProblem
from tests.properties.paths import Wander, near
from tests.properties.strategies import few, generators, make_residual, rotor_counts, vehicles


@pytest.mark.parametrize(
    ("error", "terminal"),
    [
        ("plain", 0.0),
        ("body", 2.0),
        pytest.param("plain", 2.0, marks=pytest.mark.slow),
        pytest.param("body", 0.0, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("air", ["none", "linear_drag", "gaussian_process"])
@few
@given(rotor_counts.flatmap(lambda n: vehicles(rotors=n)), st.sampled_from([0.05, 0.6]), generators)
def test_stationary_point_is_ipopts(air, terminal, error, vehicle, distance, rng):
    """First input of the controller on a first step, which iterates, against IPOPT on the whole problem.

    Far from the reference bounds are active. Any weights, not those of the paper alone. A problem may have several
    stationary points: where IPOPT finds another one, it must stay at the controller's when it begins there. A first
    step that does not converge says so; too many of them fail the test (hypothesis counts what `assume` rejects).
    """
    settings = MPCSettings(
        nodes=4,
        horizon=0.4,
        terminal_weight=terminal,
        attitude_error=error,
        position_weight=tuple(rng.uniform(3, 12, 3)),
        attitude_weight=tuple(rng.uniform(0.05, 0.3, 4)),
        velocity_weight=tuple(rng.uniform(0.02, 0.1, 3)),
        rate_weight=tuple(rng.uniform(0.02, 0.1, 3)),
    )
    vehicle = replace(vehicle, thrust_min=0.3 * vehicle.hover_thrust, thrust_max=1.8 * vehicle.hover_thrust)
    residual = make_residual(air, vehicle, rng)
    controller = ModelPredictiveController(vehicle, residual, settings, backend="interpreted")
    reference = flat_reference(Wander(rng), 0.2 + controller.node_times, vehicle)
    states, inputs = reference.state, reference.input[:-1]
    x = near(states[0], rng, distance)
    controller.reset(x, states, inputs)
    u, record = controller.command(x, states, inputs)
    assume(record.converged)
    assert record.status in (Status.OK, Status.ACTIVE_SET)  # near a solution the sweeps find the set by themselves
    if states[0, 3:7] @ x[3:7] < 0:
        states = states * np.r_[np.ones(3), -np.ones(4), np.ones(6)]
    given_point = (x, states, inputs, controller.prediction)
    best = ConvergedProblem(vehicle, residual, settings).first_input(*given_point)
    if np.abs(u - best).max() >= 1e-4 * vehicle.hover_thrust:
        best = ConvergedProblem(vehicle, residual, settings, local=True).first_input(*given_point)
    assert np.abs(u - best).max() < 1e-4 * vehicle.hover_thrust


@few
@given(vehicles(rotors=4), generators)
def test_a_step_that_would_turn_too_far_is_shortened_not_bent(vehicle, rng):
    """Wide bounds, a reference on its head: one iteration changes no quaternion by more than MAX_TURN, along the
    full Newton step, and a step shortened n-fold has all its changes divided by n."""
    vehicle = replace(vehicle)  # a copy, with bounds that no vehicle has and no step meets
    object.__setattr__(vehicle, "thrust_min", -1e4)
    object.__setattr__(vehicle, "thrust_max", 1e4)
    settings = MPCSettings(
        nodes=4, horizon=0.4, initial_iterations=1, attitude_weight=(0.1,) * 4, input_weight=float(1e4 * vehicle.mass)
    )
    controller = ModelPredictiveController(
        vehicle, make_residual("none", vehicle, rng), settings, backend="interpreted"
    )
    level = np.tile(np.r_[np.zeros(3), 1, np.zeros(9)], (5, 1))
    target, hover = level.copy(), np.full((4, 4), vehicle.hover_thrust)
    turn = rng.uniform(1.5, 2.5)
    target[:, 3], target[:, 4:7] = np.cos(turn / 2), np.sin(turn / 2) * level_axis(rng)
    target[:, :3] = 50.0 * rng.normal(size=3)
    controller.reset(level[0], level, hover)
    u, record = controller.command(level[0], target, hover)
    states, inputs = (part.copy() for part in controller.prediction)
    assert record.status == Status.OK
    change, full = states - level, controller._X_new - level
    largest = np.linalg.norm(full[:, 3:7], axis=1).max()
    share = min(1.0, MAX_TURN / largest)
    assert np.allclose(change[1:], share * full[1:], rtol=1e-9, atol=1e-9)
    assert np.allclose(inputs - hover, share * (controller._U_new - hover), rtol=1e-9, atol=1e-9)
    assert np.abs(change[:, 3:7]).max() <= MAX_TURN + 1e-12
    assert share < 1, "the example turns too little to say anything"


def level_axis(rng) -> np.ndarray:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0])
