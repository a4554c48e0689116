"""The dead time: the model integrated over the commands sent, and a delayed loop that is the undelayed one, later."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from quadexp.compile.symbolic import ca
from quadexp.control.control_step import run
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.dead_time import DeadTimePredictor
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.errors import UsageError
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.physics.rigid_body import corrected_function
from quadexp.plugins.auto.ahead import CommandsAhead, prediction_numbers, span_weights
from quadexp.plugins.identification.from_model import FromModelPlant
from quadexp.plugins.margins.loop_margins import hover_loop
from quadexp.reference.circle import Circle
from quadexp.reference.hover import Hover
from quadexp.world import PlantEffects, SimplifiedPlant
from quadexp.world.actuator import Actuator
from quadexp.world.link import Latency
from quadexp.world.world import World
from tests.control.mpc.delayed import DelayedPlant
from tests.models.residuals import RESIDUALS, make_residual
from tests.slow import slow
from tests.states import random_state

QUIET = PlantEffects(motor_noise_density=0.0, force_noise_density=0.0, torque_noise_density=0.0)


def controller_of(vehicle, residual, backend="interpreted", **settings) -> PredictiveController:
    return PredictiveController(ModelPredictiveController(vehicle, residual, MPCSettings(**settings), backend=backend))


def integrated(vehicle, residual, x, thrust, commands, dead_time, lag, period=0.02):
    """The same by SciPy's integrator: command j of the K last begins to act dead_time after it was sent."""
    model = corrected_function(vehicle, residual)
    begins = dead_time - period * np.arange(len(commands), 0, -1)  # s from now
    state = np.concatenate([x, thrust])
    for command, start, end in zip(commands, begins, [*begins[1:], dead_time], strict=True):

        def slope(_, z, u=command):
            acting = z[13:] if lag else u
            body = model(z[:13], acting, residual.theta).full().ravel()
            return np.concatenate([body, (u - z[13:]) / lag if lag else np.zeros(len(u))])

        state = solve_ivp(slope, (max(start, 0.0), end), state, rtol=1e-10, atol=1e-12).y[:, -1]
    state[3:7] /= np.linalg.norm(state[3:7])
    return state if lag else state[:13]


def pend(predictor, commands):
    """These commands, (K, 4), have been sent last."""
    memory = predictor.memory
    memory.of_now["commands"][4:], memory.of_now["sent"][...] = commands[:-1].ravel(), commands[-1]


@pytest.mark.parametrize("lag", [0.0, 0.03])
@pytest.mark.parametrize("dead_time", [0.013, 0.02, 0.047])
@pytest.mark.parametrize("name", RESIDUALS)
def test_the_prediction_is_the_model_integrated_over_the_commands_sent(vehicle, rng, name, dead_time, lag):
    """With dead times that are no multiples of the control period too."""
    residual = make_residual(name, vehicle)
    predictor = controller_of(vehicle, residual, dead_time=dead_time, motor_lag=lag).predictor
    x, thrust = random_state(rng, speed=3.0, rate=1.0), rng.uniform(1, 5, 4)
    commands = rng.uniform(1, 5, (int(np.ceil(dead_time / 0.02)), 4))
    predictor.reset(thrust)
    pend(predictor, commands)
    found = predictor.predict(x)
    thrust = predictor.memory.of_next.get("thrust", thrust)  # now
    expected = integrated(vehicle, residual, x, thrust, commands, dead_time, lag)
    error = 5e-4 if lag or name == "gp_thrust" else 3e-6  # of one Runge-Kutta step over a control period
    assert found == pytest.approx(expected, rel=error, abs=error)


@pytest.mark.parametrize("dead_time", [0.0, 0.013, 0.02, 0.047])
def test_the_thrust_follows_the_commands_as_they_arrive(vehicle, rng, dead_time):
    """No sensor measures it: the filter on the commands, against the lag integrated over a late step-wise input."""
    lag, period = 0.03, 0.02
    predictor = controller_of(vehicle, make_residual("none", vehicle), dead_time=dead_time, motor_lag=lag).predictor
    first, commands = rng.uniform(1, 5, 4), rng.uniform(1, 5, (6, 4))
    predictor.reset(first)
    for command in commands:
        predictor.predict(np.eye(13)[3])
        run(predictor.after(command))
        predictor.memory.commit()
    predictor.predict(np.eye(13)[3])
    thrust, fine = first.copy(), 1e-3
    for i in range(round(len(commands) * period / fine)):
        sent = int(np.floor((i * fine - dead_time) / period + 1e-9))
        acting = commands[sent] if sent >= 0 else first
        thrust = acting + (thrust - acting) * np.exp(-fine / lag)
    assert predictor.memory.of_next["thrust"] == pytest.approx(thrust)


@pytest.mark.parametrize("settings", [{}, {"motor_lag": 0.03}], ids=["thrusts", "lagging rotors"])
@pytest.mark.parametrize("dead_time", [0.02, 0.04, 0.031])
@pytest.mark.parametrize("name", ["none", "linear_drag"])
def test_a_predicted_dead_time_leaves_the_poles_where_they_are(vehicle, name, dead_time, settings):
    """Smith's predictor in a linear loop: the poles are those without the dead time, the others are zero. The lag's
    prediction has the error of one Runge-Kutta step."""
    residual, first_node = make_residual(name, vehicle), 0.04

    def poles(dead_time):
        lag = settings.get("motor_lag", 0.0)
        motors = Actuator(time_constant_up=lag, time_constant_down=lag, lag_of="thrust")
        world = World(FromModelPlant(vehicle, residual, backend="interpreted"), [Latency(latency=dead_time), motors])
        controller = controller_of(vehicle, residual, dead_time=dead_time, first_node=first_node, **settings)
        ((A, B, C),) = hover_loop(controller, world).phases
        found = np.linalg.eigvals(A + B @ C)
        return found[np.abs(found) > 0.2]  # a multiple pole at zero is found only to a root of the error

    with_it, without = poles(dead_time), poles(0.0)
    assert len(with_it) == len(without)
    left = list(without)
    for pole in with_it:
        nearest = int(np.argmin(np.abs(np.array(left) - pole)))
        assert abs(left.pop(nearest) - pole) < (3e-3 if settings else 2e-4)


@pytest.mark.parametrize("lag", [0.0, 0.03])
@pytest.mark.parametrize("dead_time", [0.02, 0.04])
def test_the_flight_is_the_undelayed_one_later(vehicle, dead_time, lag):
    """From rest beside the set-point, where nothing happens until the first command acts."""
    plant, flown = SimplifiedPlant(vehicle, PlantEffects.none(), step=1e-3), []
    start = np.r_[0.3, -0.2, 0.1, 1, np.zeros(9)]
    hover = np.full(4, vehicle.hover_thrust)
    for delay in (0.0, dead_time):
        world = DelayedPlant(plant, latency=delay, lag=lag)
        controller = controller_of(
            vehicle, make_residual("none", vehicle), dead_time=delay, motor_lag=lag, first_node=0.02
        )
        reference = SampledReference(Hover(position=(0, 0, 0), duration=2.0), controller)
        world.command = world.thrust = hover
        world.reset = lambda: None
        flown.append(fly(world, controller, reference, np.random.default_rng(0), start=start).state)
    late = round(dead_time / 0.02)
    assert np.abs(flown[0] - flown[0][0]).max() > 0.2
    assert flown[1][late:] == pytest.approx(flown[0][: len(flown[0]) - late], abs=1e-3 if lag else 2e-5)


def test_the_reference_begins_where_the_command_acts_and_the_log_now(vehicle):
    controller = controller_of(vehicle, make_residual("none", vehicle), dead_time=0.03)
    trajectory, node_times = Circle(speed=4.0), MPCSettings().node_times
    reference = SampledReference(trajectory, controller)
    for k in (0, 7, len(reference) - 1):
        expected = trajectory.flat_output(reference.t[k] + 0.03 + node_times).position[:, 0]
        assert reference.window(k).state[:, :3] == pytest.approx(expected, abs=1e-9)
        assert reference.at(k)[0][:3] == pytest.approx(trajectory.flat_output(reference.t[k : k + 1]).position[0, 0])
    assert reference.along()[0][:, :3] == pytest.approx(trajectory.flat_output(reference.t).position[:, 0])


def test_parameters_that_change_in_flight_enter_the_prediction(vehicle, rng):
    """As those do that are identified in flight."""
    residual = make_residual("linear_drag", vehicle)
    changed = replace(residual, theta=residual.theta * 2)
    x = random_state(rng)
    controllers = [controller_of(vehicle, made, dead_time=0.05) for made in (residual, changed)]
    controllers[0].mpc.set_parameters(changed.theta)
    for controller in controllers:
        controller.predictor.reset(np.full(4, 3.0))
    one, other = (controller.predictor.predict(x) for controller in controllers)
    assert np.array_equal(one, other)


def test_back_ends_predict_alike(vehicle, rng):
    x = random_state(rng)
    found = []
    for backend in ("interpreted", "auto"):
        made = controller_of(vehicle, make_residual("gp_with_mean", vehicle), backend, dead_time=0.05, motor_lag=0.03)
        made.predictor.reset(np.array([2.0, 3.0, 4.0, 5.0]))
        found.append(made.predictor.predict(x))
    assert found[0] == pytest.approx(found[1], rel=1e-12, abs=1e-12)


def test_without_dead_time_and_lag_nothing_is_predicted(vehicle):
    controller = controller_of(vehicle, make_residual("none", vehicle))
    assert controller.predictor is None and controller.node_times[0] == 0


@pytest.mark.parametrize("key", ["dead_time", "motor_lag"])
@pytest.mark.parametrize("value", [-0.01, 0.6, np.nan])
def test_a_time_out_of_range_is_refused(key, value):
    with pytest.raises(UsageError, match=rf"controller.{key}=.*: must be in \[0, 0.5\] s"):
        MPCSettings(**{key: value})


@pytest.mark.parametrize("trajectory", [Circle(speed=8.0)])
@pytest.mark.parametrize(
    ("settings", "latency", "lag", "most"),
    [
        ({"dead_time": 0.05}, 0.02, 0.03, 0.05),  # measured 0.028 mm
        ({"dead_time": 0.02, "motor_lag": 0.03, "first_node": 0.02, "horizon": 0.6}, 0.02, 0.03, 0.02),  # 0.001
        *slow(
            ({"dead_time": 0.02, "motor_lag": 0.03}, 0.02, 0.03, 0.04),  # 0.026
            ({"dead_time": 0.033}, 0.033, 0.0, 0.05),
        ),
    ],
)
def test_known_delays_cost_no_accuracy(vehicle, trajectory, settings, latency, lag, most):
    """The circle at 8 m/s with the grid of horizon=robust, mean error in mm; not predicted, these are lost."""
    plant = SimplifiedPlant(vehicle, QUIET)
    controller = controller_of(vehicle, plant.residual(), "auto", **{"first_node": 0.04, "horizon": 0.8, **settings})
    flight = fly(
        DelayedPlant(plant, latency=latency, lag=lag),
        controller,
        SampledReference(trajectory, controller),
        np.random.default_rng(0),
    )
    assert flight.metadata["outcome"] == "ok"
    error = flight.stack(["p_x", "p_y", "p_z"]) - flight.stack(["ref_p_x", "ref_p_y", "ref_p_z"])
    assert 1e3 * np.linalg.norm(error, axis=1).mean() < most
    assert np.abs(np.diff(flight.input, axis=0)).max() < 1  # no chatter


@pytest.mark.parametrize(("dead_time", "lag"), [(0.01, 0.0), (0.035, 0.03), (0.06, 0.02)])
def test_the_prediction_that_may_change_is_that_of_fixed_times(vehicle, rng, dead_time, lag):
    """Against DeadTimePredictor, whose dead time is a part of its structure."""
    settings = MPCSettings(dead_time=dead_time, motor_lead=lag)
    mpc = ModelPredictiveController(vehicle, make_residual("none", vehicle), settings, backend="interpreted")
    fixed, free = DeadTimePredictor(mpc), CommandsAhead(mpc)
    commands = vehicle.hover_thrust * (1 + 0.2 * rng.standard_normal((60, 4)))
    fixed.reset(commands[0])
    for u in commands:
        fixed.predict(np.eye(13)[3])
        run(fixed.after(u))
        fixed.memory.commit()
    free.sent.values[...] = commands[-len(free.sent.values) :]
    weights = span_weights(len(free.sent.values), settings.control_period)
    numbers = prediction_numbers("ahead", weights, free.ahead.parts, (0.0, dead_time), dead_time, lag)
    numbers["delivered"] = weights([dead_time, dead_time, dead_time, lag])
    for name, array in (free.ahead.tuned("ahead") | {"delivered": free.delivered.arguments["weights"]}).items():
        array[...] = np.array(ca.DM(numbers[name])).T.reshape(array.shape)
    x = np.r_[1.0, 2, 3, 1, 0, 0, 0, 2, -1, 0.5, 0.3, 0.2, -0.4]
    ours, theirs = free.predict(x), fixed.predict(x)
    assert len(ours) == 17 and np.abs(ours[: len(theirs)] - theirs).max() < 2e-3  # the thrusts always stand behind
    if lag:
        assert np.abs(ours[13:] - theirs[13:]).max() < 1e-6
