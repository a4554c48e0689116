"""Prediction of a late state by the model: against SciPy's integration with thrusts that follow their commands."""

import math

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from quadexp.control.base import Belief, Measurement, Window
from quadexp.control.control_step import run
from quadexp.control.mpc import mpc as landed
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import StepRecord
from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.wrapped import WrappedController
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.models.residual import no_residual
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.state import ATTITUDE, POSITION, VELOCITY
from quadexp.plugins.remedies.delay.prediction import Prediction
from quadexp.plugins.remedies.sent_commands import SentCommands
from tests.control.held import Held

PERIOD = 0.02


PUSHED = Belief(np.array([0.5, -1, 0.3]), np.array([0.02, 0, 0.01]), np.array([3.0, -2, 1]), 0.9)


def thrust_at(t, commands, dead_time, lag):
    """Thrust at a time t (s) where commands[k] is sent at k PERIOD - len(commands) PERIOD, so that now is 0."""
    sent = PERIOD * (np.arange(len(commands)) - len(commands)) + dead_time
    change = np.diff(commands, axis=0)
    since = np.maximum(t - sent[1:], 0.0)
    share = 1 - np.exp(-since / lag) if lag else (t >= sent[1:]).astype(float)
    return commands[0] + share @ change


@pytest.mark.parametrize("lag", [0.0, 0.03])
@pytest.mark.parametrize("dead_time", [0.0, 0.013, 0.04])
def test_mean_thrusts_are_those_of_the_commands(dead_time, lag):
    rng = np.random.default_rng(1)
    history = SentCommands(2, PERIOD, 0.4)
    history.reset(np.array([3.0, 4.0]))
    for u in rng.uniform(0, 10, (30, 2)):
        run(history.after(u))
    spans = np.array([[-0.05, -0.041], [-0.041, -0.02], [-0.02, 0.0], [-0.033, -0.033], [0.0, 0.01]])
    found = history.weights(spans, dead_time, lag) @ history.values
    for (a, b), mean in zip(spans, found, strict=True):
        kinks = [k * PERIOD + dead_time for k in range(-20, 2)]
        inside = [point for point in kinks if a < point < b]
        for i in range(2):
            own = history.values[:, i]
            true = (
                quad(thrust_at, a, b, (own, dead_time, lag), points=inside)[0] / (b - a)
                if b > a
                else thrust_at(a, own, dead_time, lag)
            )
            assert mean[i] == pytest.approx(true, abs=2e-6)


class Recording(WrappedController):
    """Keeps what it is given, sends what it is given, and believes something."""

    def __init__(self, inner, commands, belief=None):
        super().__init__(inner)
        self.commands, self.states = iter(commands), []
        if belief is not None:
            self.numbers = np.hstack([*belief])

    def reset(self, x, window):
        pass

    def step(self, measurement, window):
        self.states.append(measurement.state)
        return next(self.commands), StepRecord(0.0, 0, 0, 0, 0.0)


def made(vehicle, residual, **settings):
    mpc = landed.ModelPredictiveController(vehicle, residual, MPCSettings(**settings), backend="interpreted")
    return PredictiveController(mpc)


@pytest.mark.parametrize("which", ["vehicle", "odd_vehicle"])
@pytest.mark.parametrize("belief", [None, PUSHED])
@pytest.mark.parametrize(("delay", "dead_time", "lag"), [(0.01, 0.0, 0.0), (0.035, 0.0, 0.0), (0.05, 0.013, 0.03)])
def test_the_state_of_now_is_found(request, which, belief, delay, dead_time, lag):
    """The model itself flies, with rotors that follow late and in a wind and under a force that are assumed."""
    vehicle = request.getfixturevalue(which)
    residual = linear_drag_residual(vehicle, (0.4, 0.3, 0.1))
    model, (theta, n) = corrected_function(vehicle, residual), (residual.theta, vehicle.n_rotors)
    rng = np.random.default_rng(4)
    commands = vehicle.hover_thrust * (1 + 0.1 * rng.standard_normal((12, n)))
    told = Recording(made(vehicle, residual), commands, belief)
    wrapped = Prediction(time=delay, dead_time=dead_time, motor_lag=lag).around(told)
    world = belief or Belief(np.zeros(3), np.zeros(3), np.zeros(3))

    def slope(t, x, now):
        sent = np.vstack([np.tile(vehicle.hover_thrust, (40, n)), commands[:now]])
        thrust = world.thrust_scale * thrust_at(t - now * PERIOD, sent, dead_time, lag)
        air = x.copy()
        air[VELOCITY] -= world.wind
        found = model(air, thrust, theta).full().ravel()
        found[POSITION] = x[VELOCITY]
        found[VELOCITY] += world.force / vehicle.mass
        found[10:] += np.linalg.solve(vehicle.inertia_matrix, world.torque)
        return found

    x = np.concatenate([[0, 0, 1], [0.98, 0.1, -0.1, 0.15], [2, 1, 0.5], [0.3, -0.2, 0.1]])
    x[ATTITUDE] /= np.linalg.norm(x[ATTITUDE])
    times, states = np.zeros(1), [x]
    for k in range(12):  # finely, so that late states can be read off
        grid = (k * 20 + np.arange(21)) * 1e-3
        precise = {"rtol": 1e-7, "atol": 1e-9, "max_step": 5e-3}
        found = solve_ivp(slope, (grid[0], grid[-1]), states[-1], args=(12,), t_eval=grid[1:], **precise)
        times, states = np.append(times, grid[1:]), [*states, *found.y.T]
    states = np.array(states)
    states[:, ATTITUDE] /= np.linalg.norm(states[:, ATTITUDE], axis=1)[:, None]
    window = Window(np.zeros((2, 13)), np.full((1, n), vehicle.hover_thrust), np.zeros((5, 3)), np.zeros(3))
    wrapped.reset(states[0], window)
    for k in range(12):
        late = states[max(k * 20 - round(delay * 1e3), 0)]
        wrapped.step(Measurement(k * PERIOD, late, None, None), window)
    error = np.abs(np.array(told.states) - states[:240:20])
    assert error[:, POSITION].max() < 2e-5 and error[:, VELOCITY].max() < 2e-3
    assert error[:, ATTITUDE].max() < 1e-3 and error[:, 10:].max() < 5e-3
    assert np.abs(states[20:240:20] - states[:220:20])[:, POSITION].min(axis=0).max() > 1e-2  # it does fly


def test_dead_time_and_lag_of_the_mpc_inside_are_known(vehicle):
    inner = made(vehicle, linear_drag_residual(vehicle, (0.4, 0.3, 0.1)), dead_time=0.013, motor_lag=0.03)
    own = Prediction(time=0.02).around(inner)
    given = Prediction(time=0.02, dead_time=0.0, motor_lag=0.01).around(inner)
    assert (own.part.time, own.about.dead_time, own.about.lag) == (0.02, 0.013, 0.03)
    assert (given.about.dead_time, given.about.lag) == (0.0, 0.01)


@pytest.mark.parametrize("age", [0.0, 0.015])
def test_another_controller_is_told_when_its_command_will_act(vehicle, age):
    """State and reference of now + dead time, by the rigid body under the commands already sent."""
    dead_time, n = 0.035, vehicle.n_rotors
    commands = vehicle.hover_thrust * (1 + 0.1 * np.random.default_rng(2).standard_normal((10, n)))
    plain = Held(vehicle, iter(commands), PERIOD, (0.0, 0.1))
    wrapped = Prediction(time=age, dead_time=dead_time).around(plain)
    model = corrected_function(vehicle, no_residual(vehicle))
    sent = np.vstack([np.tile(vehicle.hover_thrust, (40, n)), commands])

    def slope(t, x):
        return model(x, thrust_at(t - 10 * PERIOD, sent, dead_time, 0.0), []).full().ravel()

    x = np.concatenate([np.zeros(3), [1, 0, 0, 0], [1, 2, 0.5], [0.2, -0.1, 0.3]])
    grid = np.arange(260) * 1e-3
    states = solve_ivp(slope, (0, grid[-1]), x, t_eval=grid, rtol=1e-7, atol=1e-9, max_step=2e-3).y.T
    jets = np.random.default_rng(3).normal(size=(5, 3))
    window = Window(np.zeros((2, 13)), np.full((1, n), vehicle.hover_thrust), jets, np.array([0.1, 0.2, 0.3]))
    wrapped.reset(x, window)
    for k in range(10):
        wrapped.step(Measurement(k * PERIOD, states[max(20 * k - round(1e3 * age), 0)], None, None), window)
    for k, (told, reference) in enumerate(plain.inputs):
        assert np.abs(told - states[20 * k + 35])[:10].max() < 2e-3 and np.abs(told - states[20 * k])[:3].max() > 1e-2
        expected = sum(jets[i] * dead_time**i / math.factorial(i) for i in range(5))
        assert np.allclose(reference.position[0], expected, atol=1e-12)
        assert np.allclose(reference.position[4], jets[4])
        assert reference.yaw[0] == pytest.approx(0.1 + 0.2 * dead_time + 0.15 * dead_time**2)
    assert np.allclose(wrapped.node_times, [dead_time, 0.1 + dead_time])
