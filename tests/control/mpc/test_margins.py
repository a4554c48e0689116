"""Delay and lag margins: the measured table, the exact discretisation, flights at hover on both sides of a margin."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from quadexp.control.mpc.margins import LIMIT, HoverLoop, Margins, _exponential, _first_unstable, margins
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.physics.integrator import rk4_step
from quadexp.physics.rigid_body import corrected_function
from quadexp.reference.hover import Hover
from quadexp.world import PlantEffects, SimplifiedPlant
from tests.control.mpc.delayed import DelayedPlant
from tests.control.mpc.test_dead_time import controller_of
from tests.models.residuals import make_residual


@pytest.mark.parametrize(
    ("first_node", "delay", "lag"), [(0.02, 17, 45), (0.04, 33, 66), (0.06, 46, 79), (0.08, 57, 87), (0.0, 67, 93)]
)
def test_the_margins_of_the_published_vehicle(vehicle, first_node, delay, lag):
    """Measured before by another program, in ms: the price of a short first node."""
    found = margins(controller_of(vehicle, make_residual("none", vehicle), first_node=first_node))
    assert (round(1e3 * found.delay), abs(1e3 * found.lag - lag) < 1, found.early) == (delay, True, 0.0)


CASES = [
    ({"first_node": 0.02}, {}),
    ({"first_node": 0.04, "rate": 100.0, "nodes": 8}, {}),
    ({"first_node": 0.04, "dead_time": 0.05}, {"latency": 0.05}),
    ({"dead_time": 0.013}, {"latency": 0.013}),
    ({"first_node": 0.02, "dead_time": 0.02, "motor_lag": 0.03}, {"latency": 0.02, "lag": 0.03}),
    ({"first_node": 0.02, "dead_time": 0.013, "motor_lead": 0.03}, {"latency": 0.013, "lag": 0.03}),
]


@pytest.mark.parametrize(("settings", "known"), CASES)
@pytest.mark.parametrize("kind", ["delay", "lag", "early"])
def test_flights_at_hover_end_well_within_a_margin_and_badly_beyond(vehicle, settings, known, kind):
    """2 mm beside the set-point: 10 % below the margin the vehicle settles, 10 % above it swings ever further."""
    if kind == "lag" and "lag" in known:
        pytest.skip("the test's world has one lag")
    controller = controller_of(vehicle, make_residual("none", vehicle), "auto", **settings)
    margin = getattr(margins(controller), kind)
    if kind == "early" and margin >= 0.9 * settings.get("dead_time", 0.0):
        pytest.skip("no shorter dead time is left to fly with")
    plant, start, swings = SimplifiedPlant(vehicle, PlantEffects.none(), step=1e-3), np.r_[2e-3, np.zeros(12)], []
    start[3] = 1.0
    reference = SampledReference(Hover(position=(0, 0, 0), duration=6.0), controller)
    for share in (0.9, 1.1):
        world = {"latency": 0.0, "lag": 0.0, **known}
        world["lag" if kind == "lag" else "latency"] += -share * margin if kind == "early" else share * margin
        flight = fly(DelayedPlant(plant, **world), controller, reference, np.random.default_rng(0), start=start)
        x = flight.state[:, [0, 1, 2, 4, 5, 6]]
        swings.append(np.abs(x[-50:]).max() / np.abs(x[25:75]).max())
    assert swings[0] < 0.7 and swings[1] > 1


class OwnModel:
    """A controller's own model as the world."""

    def __init__(self, vehicle, residual) -> None:
        self.vehicle, model = vehicle, corrected_function(vehicle, residual)
        x, u, dt = ca.MX.sym("x", 13), ca.MX.sym("u", vehicle.n_rotors), ca.MX.sym("dt")
        self._step = ca.Function("step", [x, u, dt], [rk4_step(lambda s: model(s, u, residual.theta), x, dt)])

    def reset(self) -> None:
        return None

    def advance(self, x, u, duration, rng):
        return self._step(x, u, duration).full().ravel(), np.zeros(3)


@pytest.mark.parametrize("drag", [(0.0, 0.0, 0.0), (1.5, 0.8, 0.3)])
@pytest.mark.parametrize(
    "way",
    [
        {"attitude_error": "plain", "motor_lag": 0.04},
        {"attitude_error": "body", "motor_lag": 0.04},
        {"motor_lead": 0.04},
    ],
)
def test_the_loop_is_a_flight_to_first_order(vehicle, drag, way):
    """A small deviation from hover, flown by the model itself, moves as the loop's matrix says."""
    settings = {"dead_time": 0.027, "first_node": 0.04, **way}
    residual = linear_drag_residual(vehicle, drag)
    controller = controller_of(vehicle, residual, **settings)
    loop, states, size = HoverLoop(controller), [], 1e-4
    reference = SampledReference(Hover(position=(0, 0, 0), duration=0.5), controller)
    rng = np.random.default_rng(3)
    move = size * rng.normal(size=13)
    move[3] = 0.0
    for shift in (move, -move):
        start = np.r_[0, 0, 0, 1, np.zeros(9)] + shift
        world = DelayedPlant(OwnModel(vehicle, residual), latency=0.027, lag=0.04)
        world.command = world.thrust = np.full(4, vehicle.hover_thrust)
        world.reset = lambda: None
        states.append(fly(world, controller, reference, np.random.default_rng(0), start=start).state)
    half = (states[0] - states[1]) / 2
    moving = np.delete(half, 3, axis=1)
    matrix = loop.matrix()
    z = np.zeros(len(matrix))
    z[:12] = moving[0]
    scale = np.abs(moving).max(axis=0)
    for k in range(len(moving)):
        assert np.all(np.abs(z[:12] - moving[k]) < 3e-3 * scale), k
        z = matrix @ z


def test_the_exponential_of_a_matrix(rng):
    for size in (0.0, 1e-3, 0.1, 3.0, 30.0):
        M = size * rng.normal(size=(16, 16))
        M[0] = 0.0  # of a state that stays
        assert _exponential(M) == pytest.approx(expm(M), rel=1e-10, abs=1e-10 * np.abs(expm(M)).max())


def test_where_stability_first_ends():
    assert _first_unstable(lambda t: 0.9 + t, LIMIT) == pytest.approx(0.1, abs=2e-4)
    assert _first_unstable(lambda t: 0.9 if t < 0.123 or t > 0.2 else 1.1, LIMIT) == pytest.approx(0.123, abs=2e-4)
    assert _first_unstable(lambda t: 0.9, LIMIT) == LIMIT
    assert _first_unstable(lambda t: 1.1, LIMIT) == 0.0
    assert _first_unstable(lambda t: np.nan, LIMIT) == 0.0


def test_a_loop_that_hover_leaves_says_so(vehicle):
    """Without a weight on the position nothing keeps it: neutral, not unstable. Rates alone are no hover either way."""
    held = margins(controller_of(vehicle, make_residual("none", vehicle), position_weight=(0.0, 0.0, 0.0)))
    assert isinstance(held, Margins) and held.delay > 0
