"""The first step from kicked starts: at a stationary point of the whole problem, by IPOPT, or flagged."""

from itertools import product

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.first_solve import ARMIJO, ROLLOUT, FirstSolve, rollout_function
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.node import Form
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.parts.compose import compose
from quadexp.physics.state import ATTITUDE
from quadexp.reference.circle import Circle
from quadexp.reference.lemniscate import Lemniscate
from quadexp.report.metrics import flight_metrics
from quadexp.world import PlantEffects, SimplifiedPlant
from tests.control.mpc.converged import ConvergedProblem
from tests.models.residuals import make_residual
from tests.slow import slow

TURNED = np.r_[np.ones(3), -np.ones(4), np.ones(6)]  # the same state with the other quaternion


def kicked(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """x half a metre away, turned by 80 degrees, at another 5 m/s and 7 rad/s."""
    made = x + np.r_[0.5 * rng.normal(size=3), np.zeros(4), 3.0 * rng.normal(size=3), 4.0 * rng.normal(size=3)]
    turn = Rotation.from_rotvec(0.8 * rng.normal(size=3))
    made[ATTITUDE] = (Rotation.from_quat(x[ATTITUDE], scalar_first=True) * turn).as_quat(scalar_first=True)
    return made


def first_steps(name, air, settings, seed, starts=10, path=None):
    """Controller, measured state, horizon, input and record of first steps from kicked starts."""
    vehicle = build_vehicle(compose([f"vehicle={name}"]).vehicle)
    controller = ModelPredictiveController(vehicle, make_residual(air, vehicle), settings, backend="interpreted")
    reference = SampledReference(path or Circle(speed=6.0), controller)
    rng = np.random.default_rng(seed)
    for _ in range(starts):
        states, inputs = reference.horizon(int(rng.integers(len(reference))))
        x = kicked(states[0], rng)
        controller.reset(x, states, inputs)
        u, record = controller.command(x, states, inputs)
        yield controller, x, states, inputs, u, record


STARTS = [*product(("torrente", "crazyflie"), ("none", "linear_drag", "gaussian_process"), ("plain", "body"))]
EACH = [("torrente", "gaussian_process", "plain"), ("torrente", "linear_drag", "body"), ("crazyflie", "none", "body")]


@pytest.mark.parametrize(("name", "air", "error"), [*EACH, *slow(*(start for start in STARTS if start not in EACH))])
def test_kicked_starts_converge_or_say_so(name, air, error):
    """120 in all. IPOPT, begun at the answer, stays there; at most one in ten may be flagged instead."""
    settings = MPCSettings(attitude_error=error)
    flagged, problem = 0, None
    for controller, x, states, inputs, u, record in first_steps(name, air, settings, seed=7):
        problem = problem or ConvergedProblem(controller.vehicle, controller.residual, settings, local=True)
        assert record.status in (Status.OK, Status.ACTIVE_SET)
        if not record.converged:
            flagged += 1
            continue
        near = states if states[0, ATTITUDE] @ x[ATTITUDE] > 0 else states * TURNED
        best = problem.first_input(x, near, inputs, controller.prediction)
        assert np.abs(u - best).max() < 2e-4 * controller.vehicle.thrust_max
    assert flagged <= 1


def test_a_first_step_that_may_not_iterate_says_so(vehicle):
    """One iteration from a kick is no solution: the record says it, and the flight's row counts it."""
    settings = MPCSettings(initial_iterations=1)
    for *_, record in first_steps("torrente", "none", settings, seed=3, starts=3):
        assert not record.converged
    plant = SimplifiedPlant(vehicle, PlantEffects.none(), backend="interpreted")
    for allowed, expected in ((1, 1), (400, 0)):
        settings = MPCSettings(initial_iterations=allowed)
        controller = ModelPredictiveController(vehicle, plant.residual(), settings, backend="interpreted")
        reference = SampledReference(Circle(speed=3.0), controller)
        start = kicked(reference.at(0)[0], np.random.default_rng(0))
        flight = fly(plant, controller, reference, np.random.default_rng(0), start=start)
        assert flight["unconverged"].tolist() == [expected] + [0] * (len(flight) - 1)
        assert flight_metrics(flight, 0.0, 20.0)["unconverged_count"] == expected


@pytest.mark.parametrize("error", ["plain", "body"])
def test_the_cost_of_a_rollout_is_the_problem_s(vehicle, rng, error):
    """Against the sum written out in numpy, with the states of the rollout itself."""
    settings = MPCSettings(terminal_weight=1.7, attitude_error=error)
    residual = make_residual("linear_drag", vehicle)
    form = Form(4, len(residual.theta), attitude_error=error)
    rollout = rollout_function(vehicle, residual, form, settings.nodes)
    q = rng.normal(size=(11, 4))
    X_ref = np.hstack([rng.normal(size=(11, 3)), q / np.linalg.norm(q, axis=1)[:, None], rng.normal(size=(11, 6))])
    U, U_ref, Q, R = (rng.uniform(1, 4, (10, n)) for n in (4, 4, 13, 4))
    dt = rng.uniform(0.02, 0.15, 10)
    given = (X_ref[0], U.T, X_ref.T, U_ref.T, residual.theta, Q.T, 1.7 * Q[0], R.T, dt)
    X, cost = rollout.call(dict(zip(ROLLOUT, map(ca.DM, given), strict=False))).values()
    deviation = X.full().T - X_ref
    if error == "body":
        wanted, flown = (Rotation.from_quat(x[:, ATTITUDE], scalar_first=True) for x in (X_ref, X.full().T))
        sign = np.sign(np.einsum("ki,ki->k", X_ref[:, ATTITUDE], X.full().T[:, ATTITUDE]))
        length = np.linalg.norm(X.full().T[:, ATTITUDE], axis=1)
        turn = (wanted.inv() * flown).as_quat(scalar_first=True, canonical=True)
        deviation[:, ATTITUDE] = (sign * length)[:, None] * turn - [1, 0, 0, 0]
    weights = np.vstack([Q, 1.7 * Q[0]])
    expected = (weights * deviation**2).sum() + (R * (U - U_ref) ** 2).sum()
    assert float(cost) == pytest.approx(expected / 2, rel=1e-9)


def at_hover(vehicle):
    """The first solve of a controller that has converged at hover, and the inputs (N, n) there."""
    controller = ModelPredictiveController(vehicle, make_residual("none", vehicle), backend="interpreted")
    state = np.tile(np.r_[np.zeros(3), 1, np.zeros(9)], (len(controller.node_times), 1))
    hover = np.full((len(state) - 1, vehicle.n_rotors), vehicle.hover_thrust)
    controller.reset(state[0], state, hover)
    controller.command(state[0], state, hover)
    rollout = rollout_function(vehicle, controller.residual, controller.step.form, controller.settings.nodes)
    return FirstSolve(rollout, controller.step, controller._direction), controller, hover


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_it_begins_at_the_guess_of_the_least_cost(vehicle, order):
    """At hover, which costs nothing; then R (1 N)^2 for every input and what the climb costs, then what is infinite."""
    solve, controller, hover = at_hover(vehicle)
    guesses = [hover, hover + 1.0, np.full_like(hover, np.nan)]
    assert solve.cost(guesses[0]) == pytest.approx(0, abs=1e-20) and solve.cost(guesses[2]) == np.inf
    R = controller.settings.thrust_weight(vehicle)
    assert solve.cost(guesses[1]) > len(hover) * R.sum() / 2
    found = solve.solve([guesses[i] for i in order], 0)
    assert np.array_equal(controller.prediction[1], hover) and found.kkt < 1e-9


@pytest.mark.parametrize("kept", [0.5, 2.0])
def test_a_step_keeps_its_share_of_the_promised_decrease(vehicle, monkeypatch, kept):
    """J(U + a d) = J - kept ARMIJO a |d|_R^2 up to a = 1/8, and no decrease beyond: 1/8 is taken where kept > 1."""
    solve, controller, hover = at_hover(vehicle)
    d, R = np.linspace(-1.0, 1.0, hover.size).reshape(hover.shape), controller.settings.thrust_weight(vehicle)
    slope = (R * d**2).sum()

    def cost(inputs):
        length = (inputs - hover)[0, 0] / d[0, 0]
        return 7.0 - kept * ARMIJO * length * slope * (length < 0.126)

    monkeypatch.setattr(solve, "cost", cost)
    length, lower = solve._search(hover, d, 7.0)
    assert length == (0.125 if kept > 1 else 0.0)
    assert lower == pytest.approx(7.0 - kept * ARMIJO * length * slope, rel=1e-15)


@pytest.mark.parametrize("error", ["plain", "body"])
def test_the_sign_of_a_measured_quaternion_changes_nothing(vehicle, error):
    """A flight whose measurements change sign at random equals the one whose measurements do not, to the last bit."""
    plant = SimplifiedPlant(vehicle, PlantEffects(), backend="interpreted")
    settings = MPCSettings(attitude_error=error)
    flown = []
    for flips in (False, True):
        controller = ModelPredictiveController(vehicle, plant.residual(), settings, backend="interpreted")
        reference = SampledReference(Lemniscate(speed=8.0), controller)
        noise, coin = np.random.default_rng(0), np.random.default_rng(1)
        x = reference.at(0)[0].copy()
        controller.reset(x, *reference.horizon(0))
        inputs = []
        for k in range(150):
            measured = x * TURNED if flips and coin.random() < 0.5 else x
            u, _ = controller.command(measured, *reference.horizon(k))
            inputs.append(u)
            x, _ = plant.advance(x, u, settings.control_period, noise)
        flown.append(np.array(inputs))
    assert np.array_equal(*flown)
