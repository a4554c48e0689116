"""input_hold=deviation: the reference's thrust within a node, and loops that follow it on any grid."""

from itertools import product

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.prediction import held_deviation
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.physics.motor import lagging_rk4_step
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.sensitivity import rk4_sensitivity_function
from quadexp.plugins.margins.loop_margins import hover_loop, margins
from quadexp.reference.circle import Circle
from quadexp.reference.lemniscate import Lemniscate
from quadexp.world import PlantEffects, SimplifiedPlant
from tests.control.mpc.delayed import DelayedPlant
from tests.models.residuals import make_residual
from tests.slow import slow
from tests.states import random_state

QUIET = PlantEffects(motor_noise_density=0.0, force_noise_density=0.0, torque_noise_density=0.0)
ROBUST = {"first_node": 0.06, "horizon": 0.8, "input_hold": "deviation"}
LAG, LATENCY = 0.03, 0.02


def controller_of(vehicle, residual, backend="auto", **settings) -> PredictiveController:
    return PredictiveController(ModelPredictiveController(vehicle, residual, MPCSettings(**settings), backend=backend))


def evaluated(thrusts, dt, first_share, tau=None, low=0.0, high=20.0):
    n, limits = len(thrusts), (np.full(len(thrusts), low), np.full(len(thrusts), high))
    found = held_deviation(ca.MX(thrusts), *map(ca.MX, limits), ca.MX(dt), ca.MX(first_share), tau and ca.MX(tau))
    command, *added = (np.array(value) for value in ca.Function("f", [], [found.U_ref, *found.added])().values())
    assert command.shape == (n, len(dt)) and all(part.shape == (n, 3) for part in added)
    return command, added


@pytest.mark.parametrize("tau", [None, 0.03])
def test_the_thrust_in_a_node_is_the_references_and_the_deviation(rng, tau):
    """A quadratic T*(t), its held command by quadrature, and a deviation through the lag by SciPy's integrator."""
    dt, first_share, n = np.array([0.06, 0.11]), 1 / 3, 3
    bend, slope, start = rng.uniform(-200, 200, n), rng.uniform(-50, 50, n), rng.uniform(8, 12, n)

    def thrust(t):
        return start + slope * t + bend * t * t

    def command_for(t):
        return thrust(t) + (tau or 0.0) * (slope + 2 * bend * t)

    starts = np.array([0.0, dt[0]])
    thrusts = np.stack([thrust(t) for k in (0, 1) for t in (starts[k], starts[k] + dt[k] / 2)], axis=1)
    command, added = evaluated(thrusts, dt, first_share, tau)
    held = first_share * dt[0]
    for i in range(n):
        assert command[i, 0] == pytest.approx(quad(lambda t, i=i: command_for(t)[i], 0, held)[0] / held)
    deviation, first = rng.uniform(-1, 1, n), thrust(0) + rng.uniform(-1, 1, n)
    for column, t in enumerate((0.0, dt[0] / 2, dt[0])):
        if tau is None:
            expected, found = thrust(t) + deviation, command[:, 0] + deviation + added[0][:, column]
        else:
            late = solve_ivp(lambda _, d: (deviation - d) / tau, (0, t), first - thrust(0), rtol=1e-10, atol=1e-12)
            expected, share = thrust(t) + late.y[:, -1], np.exp(-t / tau)
            found = share * first + (1 - share) * (command[:, 0] + deviation) + added[0][:, column]
        assert found == pytest.approx(expected)


def test_a_thrust_that_no_rotor_can_give_is_no_part_of_it():
    """A spike of the reference: limited where it is sampled, and so is the command that should follow it."""
    thrusts = np.array([[19.0, 45.0, 19.0, -36.0]])
    command, added = evaluated(thrusts, np.array([0.1, 0.1]), 1.0, 0.03)
    limited, _ = evaluated(np.clip(thrusts, 0, 20), np.array([0.1, 0.1]), 1.0, 0.03)
    assert np.array_equal(command, limited) and command.min() >= 0 and command.max() <= 20
    assert max(np.abs(part).max() for part in added) < 40


@pytest.mark.parametrize("lag", [False, True])
@pytest.mark.parametrize("scalar", [True, False])
@pytest.mark.parametrize("name", ["none", "gp_with_mean", "gp_thrust", "plant"])
def test_the_linearisation_with_an_added_thrust_equals_automatic_differentiation(vehicle, rng, name, scalar, lag):
    residual, dt = make_residual(name, vehicle), 0.07
    corrected = corrected_function(vehicle, residual)
    m = 13 + 4 * lag
    x, u, added = ca.MX.sym("x", m), ca.MX.sym("u", 4), ca.MX.sym("added", 4, 3)
    if lag:
        x_next = lagging_rk4_step(lambda s, T: corrected(s, T, residual.theta), x, u, dt, LAG, added)
    else:  # the classical tableau, written out
        k = corrected(x, u + added[:, 0], residual.theta)
        total = k / 6
        for c, column, weight in ((dt / 2, 1, 1 / 3), (dt / 2, 1, 1 / 3), (dt, 2, 1 / 6)):
            k = corrected(x + c * k, u + added[:, column], residual.theta)
            total += weight * k
        x_next = x + dt * total
    whole = ca.Function("whole", [x, u, added], [x_next, ca.jacobian(x_next, x), ca.jacobian(x_next, u)])
    chained = rk4_sensitivity_function(vehicle, residual, scalar=scalar, lag=lag, added=True)
    for _ in range(3):
        point = np.r_[random_state(rng), rng.uniform(2, 10, 4)][:m], rng.uniform(2, 10, 4)
        beyond = rng.uniform(-2, 2, (4, 3))
        found = chained(*point, residual.theta, dt, *([LAG] if lag else []), beyond)
        for expected, value in zip(whole(*point, beyond), found, strict=True):
            assert np.allclose(expected, value, rtol=1e-10, atol=1e-10)


def flown(vehicle, path, settings, latency=0.0, lag=0.0):
    """Mean error (mm) and the commands of a flight without noise."""
    plant = SimplifiedPlant(vehicle, QUIET)
    controller = controller_of(vehicle, plant.residual(), **settings)
    world = DelayedPlant(plant, latency=latency, lag=lag) if latency or lag else plant
    flight = fly(world, controller, SampledReference(path, controller), np.random.default_rng(0))
    assert flight.metadata["outcome"] == "ok"
    error = flight.stack(["p_x", "p_y", "p_z"]) - flight.stack(["ref_p_x", "ref_p_y", "ref_p_z"])
    return 1e3 * np.linalg.norm(error, axis=1).mean(), flight


@pytest.mark.parametrize(
    ("path", "settings", "most"),  # mm, measured / with the command held
    [
        (Circle(speed=8.0), {}, 0.03),  # 0.011 / 0.383
        (Lemniscate(speed=8.0), {}, 0.4),  # 0.190 / 5.03
        (Lemniscate(speed=8.0), {"first_node": 0.06, "horizon": 0.8}, 0.15),  # 0.077
        (Lemniscate(speed=8.0), {"first_node": 0.02, "horizon": 0.6}, 0.08),  # 0.041 / 0.118
    ],
    ids=["circle, published grid", "lemniscate, published grid", "lemniscate, robust", "lemniscate, precise"],
)
def test_the_grid_costs_no_accuracy_on_the_reference(vehicle, path, settings, most):
    assert flown(vehicle, path, {**settings, "input_hold": "deviation"})[0] < most


@pytest.mark.parametrize("settings", [{}, {"first_node": 0.04, "dead_time": 0.03}, {"motor_lag": 0.03}])
def test_the_margins_are_those_of_the_held_command(vehicle, settings):
    residual, plant = make_residual("linear_drag", vehicle), SimplifiedPlant(vehicle, PlantEffects.none(), step=1e-3)
    held, deviation = (
        margins(hover_loop(controller_of(vehicle, residual, input_hold=hold, **settings), plant))
        for hold in ("command", "deviation")
    )
    assert deviation == pytest.approx(held, abs=2e-4)


CIRCLE, LEMNISCATE = Circle(speed=8.0), Lemniscate(speed=8.0)
MOST = {
    (CIRCLE, 13): 0.05,
    (CIRCLE, 17): 0.02,
    (LEMNISCATE, 13): 1.0,
    (LEMNISCATE, 17): 0.15,
}  # mm; measured 0.016, 0.006, 0.748 and 0.090
LATE = [*product((CIRCLE, LEMNISCATE), (0.0, -0.02, 0.02), (13, 17))]
# Both paths and both forms with what is known, and each error of 20 ms.
FEW = [(CIRCLE, 0.0, 17), (LEMNISCATE, 0.0, 13), (LEMNISCATE, -0.02, 17), (LEMNISCATE, 0.02, 13)]


@pytest.mark.parametrize(("path", "wrong", "states"), [*FEW, *slow(*(one for one in LATE if one not in FEW))])
def test_delays_that_are_known_or_wrong_by_20_ms(vehicle, path, wrong, states):
    """horizon=robust behind 30 ms of lag and 20 ms of latency: small errors, and where the dead time is wrong no lost
    flight and no chatter. On the lemniscate the reference's own command changes by 2.8 N from step to step."""
    known = {"dead_time": 0.05} if states == 13 else {"dead_time": LATENCY, "motor_lag": LAG}
    known["dead_time"] += wrong
    error, flight = flown(vehicle, path, {**ROBUST, **known}, LATENCY, LAG)
    if not wrong:
        assert error < MOST[path, states]
    assert error < 8
    assert np.abs(np.diff(flight.input[5:], axis=0)).max() < (0.3 if isinstance(path, Circle) else 4)
