"""Observers: their filters as designed, and no offset under a constant force and torque, whatever the weights."""

from dataclasses import replace
from functools import partial

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.control.base import Measurement, Window
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.errors import UsageError
from quadexp.experiment.rollout import SampledReference
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.models.residual import Residual, scaled_residual, symbolic_residual
from quadexp.physics.integrator import rk4_step
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.remedies.observers import observer as observer_module
from quadexp.plugins.remedies.observers import wind as wind_module
from quadexp.plugins.remedies.observers.disturbance import DisturbanceObserver
from quadexp.plugins.remedies.observers.filters import N_SCALED_STATE, SURPRISE, scaled_force_update
from quadexp.plugins.remedies.observers.observer import COLUMNS
from quadexp.plugins.remedies.observers.wind import WindObserver
from quadexp.reference.circle import Circle
from quadexp.reference.hover import Hover
from tests.control.held import Held
from tests.models.residuals import make_residual
from tests.states import random_state

PERIOD = 0.02


class Truth:
    """A rigid body with its air, in a force, a torque and a wind; RK4 in steps of a millisecond."""

    def __init__(
        self, vehicle: Vehicle, residual: Residual, force=(0, 0, 0), torque=(0, 0, 0), wind=(0, 0, 0), scale=1.0
    ):
        force, torque, wind = (np.array(value, float) for value in (force, torque, wind))
        corrected, x, u = corrected_function(vehicle, residual), ca.MX.sym("x", 13), ca.MX.sym("u", vehicle.n_rotors)
        push = ca.vertcat(ca.MX.zeros(7), force / vehicle.mass, np.linalg.solve(vehicle.inertia_matrix, torque))
        blown = np.concatenate([np.zeros(7), wind, np.zeros(3)])

        def slope(s):
            found = corrected(s - blown, u * scale, residual.theta) + push
            return ca.vertcat(s[7:10], found[3:])

        z = x
        for _ in range(20):
            z = rk4_step(slope, z, PERIOD / 20)
        reading = ca.mtimes(_rotation(z).T, slope(z)[7:10] + ca.vertcat(0, 0, vehicle.gravity))
        self._advance = ca.Function("truth", [x, u], [z, reading]).expand()

    def advance(self, x, u):
        """State (13,) and the accelerometer's reading after a control period."""
        x, reading = (np.array(part).ravel() for part in self._advance(x, u))
        x[3:7] /= np.linalg.norm(x[3:7])
        return x, reading


def _rotation(x):
    w, a, b, c = x[3], x[4], x[5], x[6]
    rows = [
        [w * w + a * a - b * b - c * c, 2 * (a * b - w * c), 2 * (a * c + w * b)],
        [2 * (a * b + w * c), w * w - a * a + b * b - c * c, 2 * (b * c - w * a)],
        [2 * (a * c - w * b), 2 * (b * c + w * a), w * w - a * a - b * b + c * c],
    ]
    return ca.vertcat(*(ca.horzcat(*row) for row in rows)) / ca.sumsqr(x[3:7])


def mpc_of(vehicle, residual, backend="auto", **settings) -> PredictiveController:
    settings = {"nodes": 5, "horizon": 0.5} | settings
    mpc = ModelPredictiveController(vehicle, residual, MPCSettings(**settings), backend=backend, disturbed=True)
    return PredictiveController(mpc)


def disturbance(controller, **settings):
    return DisturbanceObserver(name="disturbance", **settings).around(controller)


def wind(controller, **settings):
    return WindObserver(name="wind", **settings).around(controller)


def flown(truth, observer, reference, steps, noise=0.0, rng=None):
    """Fly from the reference's start: states (steps, 13) and the beliefs before each command."""
    x, reading = reference.at(0)[0].copy(), None
    observer.reset(x, reference.window(0))
    states, beliefs = [], []
    for k in range(steps):
        row = min(k, len(reference) - 1)
        u, _ = observer.step(Measurement(k * PERIOD, x, reading, None), reference.window(row))
        states.append(x)
        beliefs.append(np.array([*observer.log().values()]))
        x, reading = truth.advance(x, u)
        if noise:
            reading = reading + noise * rng.normal(size=3)
    return np.array(states), np.array(beliefs)


# ------------------------------------------------------------------------------------------- no offset, any weights
def weights(rng):
    """Weights over a decade each, none of them zero: attitude, rates and thrusts pull too."""
    spread = 10.0 ** rng.uniform(-0.5, 0.5, 5)
    return {
        "position_weight": (10.0 * spread[0],) * 3,
        "attitude_weight": (0.0, *(0.5 * spread[1],) * 3),
        "velocity_weight": (0.5 * spread[2],) * 3,
        "rate_weight": (0.05 * spread[3],) * 3,
        "input_weight": 0.3 * spread[4],
    }


def hover_error(vehicle, believed, residual, observed, push, seed, **form):
    truth = Truth(vehicle, residual, *push)
    settings = weights(np.random.default_rng(seed)) | form
    controller = observed(mpc_of(believed, residual, **settings))
    reference = SampledReference(Hover(position=(0, 0, 1), duration=0.5), controller)
    states, beliefs = flown(truth, controller, reference, 1800)
    return np.linalg.norm(states[-1, :3] - [0, 0, 1]), beliefs[-1]


@pytest.mark.parametrize(("name", "seed"), [("none", 1), ("linear_drag", 2), ("linear_drag", 3)])
def test_a_constant_force_and_torque_leave_no_error(vehicle, name, seed):
    force, torque = (1.5, -2.0, -3.0), (0.05, -0.08, 0.01)
    residual = make_residual(name, vehicle)
    error, belief = hover_error(vehicle, vehicle, residual, disturbance, (force, torque), seed)
    assert belief[:6] == pytest.approx([*force, *torque], abs=1e-6)
    assert error < 1e-6


def test_no_error_on_six_odd_rotors_with_the_thrust_of_the_reference_in_the_nodes(odd_vehicle):
    force, torque = (2.0, 1.0, 2.0), (0.03, 0.05, -0.02)
    form = {"input_hold": "deviation", "first_node": 0.04, "attitude_error": "body"}
    residual = make_residual("none", odd_vehicle)
    assert hover_error(odd_vehicle, odd_vehicle, residual, disturbance, (force, torque), 4, **form)[0] < 1e-6


@pytest.mark.parametrize("share", [0.7, 1.3])
def test_no_error_with_another_mass(vehicle, share):
    """What flies weighs 30 % less or more than the controller believes."""
    heavy = replace(vehicle, mass=share * vehicle.mass)
    residual = make_residual("none", vehicle)
    error, belief = hover_error(heavy, vehicle, residual, disturbance, (), 5)
    assert belief[2] == pytest.approx((1 - share) * vehicle.mass * vehicle.gravity, rel=1e-3)
    assert error < 1e-6


@pytest.mark.parametrize("settings", [{}, {"scale_walk": 0.0, "noise": (0.1, 0.1, 0.3)}], ids=["default", "wind only"])
def test_no_error_in_a_constant_wind(vehicle, settings):
    """At rest a wind and a thrust scale cannot be distinguished, and need not be; the wind alone is found."""
    residual = make_residual("gp_with_mean", vehicle)
    push = ((0, 0, 0), (0.02, -0.01, 0.0), (5.0, -2.0, 0.5))

    observed = partial(wind, **settings)
    error, belief = hover_error(vehicle, vehicle, residual, observed, push, 6)
    assert not settings or belief[6:9] == pytest.approx(push[2], abs=1e-3)
    assert error < 1e-4


def test_without_targets_an_offset_stays(vehicle):
    """The weights on attitude and thrust pull against the correction: what the test above would miss on its own."""
    residual = make_residual("none", vehicle)

    plain = partial(disturbance, targets=False)
    assert hover_error(vehicle, vehicle, residual, plain, ((1.5, -2.0, -3.0),), 1)[0] > 1e-3


@pytest.mark.parametrize("source", ["accelerometer", "velocity"])
def test_a_force_on_a_path_is_found_in_the_world(vehicle, source):
    """Along a circle the body turns and a constant force of the world does not."""
    residual, force = make_residual("linear_drag", vehicle), (2.0, -1.0, 1.0)
    controller = disturbance(mpc_of(vehicle, residual), source=source)
    reference = SampledReference(Circle(speed=5.0, acceleration=2.5), controller)
    states, beliefs = flown(Truth(vehicle, residual, force), controller, reference, 200)
    limit = 0.05 if source == "accelerometer" else 0.4  # a held thrust turns with the body within a period
    assert np.abs(beliefs[100:, :3] - force).max() < limit


def test_wind_and_thrust_scale_are_told_apart(vehicle, rng):
    """A reading of three axes, four unknowns: along a path they separate."""
    residual, blown, torque = make_residual("linear_drag", vehicle), (3.0, -2.0, 0.0), (0.15, -0.12, 0.0)
    controller = wind(mpc_of(vehicle, residual), scale_walk=0.01, wind_walk=0.3)
    reference = SampledReference(Circle(speed=6.0, acceleration=3.0), controller)
    states, beliefs = flown(Truth(vehicle, residual, torque=torque, wind=blown, scale=0.92), controller, reference, 300)
    assert beliefs[150:, 3:6].mean(axis=0) == pytest.approx(torque, abs=0.005)
    assert beliefs[150:, 6:8].mean(axis=0) == pytest.approx(blown[:2], abs=0.2)
    assert beliefs[150:, 9].mean() == pytest.approx(0.92, abs=0.01)
    errors = np.linalg.norm(states[150:, :3] - reference.along()[0][150:300, :3], axis=1)
    assert errors.mean() < 0.03


@pytest.mark.parametrize("share", [0.7, 1.0, 1.3])
def test_force_and_thrust_scale_are_told_apart(vehicle, share):
    """A thrust that is delivered in part turns with the body, a force does not: on a path both are found at once."""
    residual = linear_drag_residual(vehicle, (0.4, 0.3, 0.1), (0.0, 0.0, 0.0), -0.2)  # a share of the thrust gets lost
    force, torque = np.array([0.8, -0.5, 0.3]), np.array([0.06, -0.05, 0.0])
    observed = disturbance(mpc_of(vehicle, residual), scale_walk=0.01)
    reference = SampledReference(Circle(speed=6.0, acceleration=3.0, radius=3.0), observed)
    _, beliefs = flown(Truth(vehicle, residual, force, torque, scale=share), observed, reference, 300)
    assert beliefs[200:, 9] == pytest.approx(share, abs=0.01)
    assert beliefs[200:, :3].mean(axis=0) == pytest.approx(force, abs=0.1)
    assert beliefs[200:, 3:6].mean(axis=0) == pytest.approx(torque, abs=0.005)  # the rotors' own is scaled too


def test_another_mass_turns_with_the_body(vehicle):
    """30 % less mass on a circle: the force alone lags behind the turning thrust, the scale is that of the thrust."""
    residual, light = make_residual("none", vehicle), replace(vehicle, mass=0.7 * vehicle.mass)
    errors, scales = [], []
    for walk in (0.0, 0.01):
        observed = disturbance(mpc_of(vehicle, residual), scale_walk=walk)
        reference = SampledReference(Circle(speed=6.0, acceleration=3.0, radius=3.0), observed)
        states, beliefs = flown(Truth(light, residual), observed, reference, 300)
        errors.append(np.linalg.norm(states[150:, :3] - reference.along()[0][150:300, :3], axis=1).mean())
        scales.append(beliefs[-1, 9])
    assert scales == pytest.approx([1.0, 1 / 0.7], abs=0.02)
    assert errors[1] < 0.5 * errors[0]


def test_scales_need_the_accelerometer_and_a_model_that_has_them(vehicle):
    mpc = mpc_of(vehicle, make_residual("none", vehicle))
    for key in ("scale_walk", "air_walk"):
        with pytest.raises(UsageError, match=key):
            disturbance(mpc, source="velocity", **{key: 0.01})
    with pytest.raises(UsageError, match="air_walk: the MPC was made without"):
        disturbance(mpc, air_walk=0.01)


# ---------------------------------------------------------------------------------------------- filters as designed
def a_hover(vehicle) -> Window:
    x = np.concatenate([np.zeros(3), [1.0], np.zeros(9)])[None]
    return Window(x, np.full((1, vehicle.n_rotors), vehicle.hover_thrust), np.zeros((5, 3)), np.zeros(3))


def still(vehicle, observed, reading, steps, rates=None, velocities=None, residual=None):
    """The beliefs of an observer of a hovering vehicle that reads what it is given, (steps, 3), rates and velocities
    (steps, 3) likewise."""
    hover = np.full(vehicle.n_rotors, vehicle.hover_thrust)
    told = Held(vehicle, hover, PERIOD, residual=residual or make_residual("none", vehicle))
    controller = observed(told)
    x = np.concatenate([np.zeros(3), [1.0], np.zeros(9)])
    controller.reset(x, a_hover(vehicle))
    found = []
    for k in range(steps):
        x[10:] = 0 if rates is None else rates[k]
        x[7:10] = 0 if velocities is None else velocities[k]
        controller.step(Measurement(0.0, x, reading[k], None), a_hover(vehicle))
        found.append(np.concatenate(told.belief[:3]))
    return np.array(found)


def test_the_force_is_a_low_pass_of_the_chosen_bandwidth(vehicle):
    """With the variance begun at its steady value: 1 - exp(-b t) after a step, at every instant."""
    bandwidth, noise = 12.0, 0.3
    K = 1 - np.exp(-bandwidth * PERIOD)
    steady = noise * np.sqrt(K)  # P = (1 - K) P-, P- = r K / (1 - K)

    observed = partial(disturbance, force_bandwidth=bandwidth, force_noise=noise, force_initial=steady)
    reading = np.tile([0.7, -0.4, vehicle.gravity + 1.1], (60, 1))
    found = still(vehicle, observed, reading, 60)[:, :3] / vehicle.mass
    t = PERIOD * np.arange(1, 61)
    assert found == pytest.approx((1 - np.exp(-bandwidth * t))[:, None] * [0.7, -0.4, 1.1], abs=1e-9)


def test_first_estimates_are_fast_and_later_ones_smooth(vehicle, rng):
    """The variance of the estimate under white noise: r K / (2 - K)."""
    bandwidth, noise, steps = 8.0, 0.5, 20000
    reading = [0, 0, vehicle.gravity] + noise * rng.normal(size=(steps, 3))

    observed = partial(disturbance, force_bandwidth=bandwidth, force_noise=noise, force_initial=10.0)
    found = still(vehicle, observed, reading, steps)[:, :3] / vehicle.mass
    K = 1 - np.exp(-bandwidth * PERIOD)
    assert found[200:].var() == pytest.approx(noise**2 * K / (2 - K), rel=0.05)
    first = reading[0] - [0, 0, vehicle.gravity]
    assert found[0] == pytest.approx(first * 100 / (100 + noise**2), rel=0.01)


def test_the_torque_observer_has_its_poles_where_they_were_put(vehicle):
    """An angular acceleration that steps: rates as it makes them, the estimate as two equal poles give it."""
    bandwidth, spin, steps = 10.0, np.array([3.0, -2.0, 1.0]), 80
    z, k = np.exp(-bandwidth * PERIOD), np.arange(1, steps + 1)[:, None]
    rates = 0.5 * spin * k * PERIOD  # small inertia differences: gyroscopic terms are known to the model

    observed = partial(disturbance, torque_bandwidth=bandwidth)
    reading = np.tile([0, 0, vehicle.gravity], (steps, 1))
    expected = 0.5 * spin * (1 - z**k - k * (1 - z) * z**k)
    principal = replace(vehicle, inertia=((0.03, 0, 0), (0, 0.03, 0), (0, 0, 0.03)))  # then w x J w is zero
    found = still(principal, observed, reading, steps, rates)[:, 3:6] / 0.03
    assert found == pytest.approx(expected, abs=1e-9)


def test_a_torque_of_the_air_that_the_model_knows_is_no_disturbance(vehicle):
    """A model with a constant torque, and rates that do not change: what is found is its opposite."""
    z, theta, known = ca.SX.sym("z", 10), ca.SX.sym("theta", 0), [0.02, -0.01, 0.03]
    model = symbolic_residual("torque", ca.vertcat(0, 0, 0, *known), z, theta, [])
    found = still(vehicle, disturbance, np.tile([0, 0, 9.81], (60, 1)), 60, residual=model)
    assert found[-1, 3:6] == pytest.approx(-np.array(known), abs=1e-6)


def test_what_the_wind_leaves_of_the_reading_is_a_force(vehicle):
    """Where the wind is known to be still: a low pass of the chosen bandwidth, in N."""
    heavy, bandwidth = replace(vehicle, mass=1.7), 9.0

    def observed(controller):
        still_air = {"wind_walk": 1e-9, "wind_initial": 1e-9, "scale_walk": 0.0}
        return wind(controller, force_bandwidth=bandwidth, least_bandwidth=0.0, **still_air)

    reading, residual = np.tile([0.7, -0.4, heavy.gravity + 1.1], (30, 1)), make_residual("none", heavy)
    found = still(heavy, observed, reading, 30, residual=residual)[:, :3]
    low_pass = 1 - np.exp(-bandwidth * PERIOD * np.arange(1, 31))
    assert found == pytest.approx(1.7 * low_pass[:, None] * [0.7, -0.4, 1.1], abs=1e-6)


def test_a_body_that_tumbles_by_itself_has_no_torque(vehicle):
    """Euler's equations without a torque: what turns the rates is known to the model."""
    body = replace(vehicle, inertia=((0.02, 0, 0), (0, 0.03, 0), (0, 0, 0.05)))
    J, w, rates, h = body.inertia_matrix, np.array([4.0, -3.0, 2.0]), [], PERIOD / 20
    gyroscopic = max(np.abs(np.cross(w, J @ w)))
    for _ in range(60):
        rates.append(w)
        for _ in range(20):
            middle = w - h / 2 * np.linalg.solve(J, np.cross(w, J @ w))
            w = w - h * np.linalg.solve(J, np.cross(middle, J @ middle))
    found = still(body, disturbance, np.tile([0, 0, 9.81], (60, 1)), 60, np.array(rates))[40:, 3:6]  # it began at rest
    assert np.abs(found).max() < 0.05 * gyroscopic


def test_the_force_by_the_velocity_has_its_poles_where_they_were_put(vehicle):
    """As the torque by the rates."""
    bandwidth, push, steps = 10.0, np.array([1.5, -1.0, 0.5]), 80
    z, k = np.exp(-bandwidth * PERIOD), np.arange(1, steps + 1)[:, None]

    observed = partial(disturbance, source="velocity", force_bandwidth=bandwidth)
    reading = np.full((steps, 3), 7.0)  # is not used
    found = still(vehicle, observed, reading, steps, velocities=push * k * PERIOD)[:, :3] / vehicle.mass
    assert found == pytest.approx(push * (1 - z**k - k * (1 - z) * z**k), abs=1e-9)


def test_what_noise_of_the_rates_makes_of_the_torque(vehicle, rng):
    """The transfer function from rate to torque is that from torque to torque times J (1 - q^-1) / T, poles at z twice:
    its variance under white noise is the sum of the squares of its impulse response."""
    bandwidth, noise, steps = 10.0, 0.02, 20000
    z, k = np.exp(-bandwidth * PERIOD), np.arange(400)
    to_torque = np.append(0, (1 - z) ** 2 * (k + 1) * z**k)  # q (1 - z)^2 / (q - z)^2, a sample late
    response = np.diff(to_torque) / PERIOD
    principal = replace(vehicle, inertia=((0.03, 0, 0), (0, 0.03, 0), (0, 0, 0.03)))
    rates = noise * rng.normal(size=(steps, 3))

    observed = partial(disturbance, torque_bandwidth=bandwidth, torque_limit=1e6)
    found = still(principal, observed, np.tile([0, 0, 9.81], (steps, 1)), steps, rates)[200:, 3:6] / 0.03
    assert found.var() == pytest.approx(noise**2 * np.sum(response**2), rel=0.05)


def test_the_wind_filter_is_an_extended_kalman_filter(vehicle, rng):
    """Against the textbook's equations in numpy, with the model's derivative by differences."""
    residual = make_residual("gp_with_mean", vehicle)
    settings = {
        "scale_walk": 0.05,
        "wind_walk": 0.8,
        "noise": (0.2, 0.3, 0.5),
        "wind_initial": 3.0,
        "scale_initial": 0.1,
    }
    told = Held(vehicle, np.zeros(4), PERIOD, residual=residual)
    controller = wind(told, **settings)
    controller.reset(a_hover(vehicle).state[0], a_hover(vehicle))
    told.thrust = rng.uniform(2, 4, 4)
    controller.step(Measurement(0.0, random_state(rng), None, None), a_hover(vehicle))  # nothing is measured yet
    s, P = np.zeros(4), np.diag([9.0, 9.0, 9.0, 0.1**2])
    N = np.diag(np.square(settings["noise"]))
    for _ in range(6):
        x, thrust = random_state(rng, speed=3.0, rate=0.5), told.thrust
        told.thrust = rng.uniform(2, 4, 4)
        reading = np.array([0.3, -0.2, thrust.sum()]) + rng.normal(size=3)
        R = Rotation.from_quat(x[3:7], scalar_first=True).as_matrix()

        def expected(s, R=R, x=x, thrust=thrust):
            y = residual(np.concatenate([R.T @ (x[7:10] - s[:3]), x[10:], thrust * (1 + s[3])]))[0, :3]
            return y + [0, 0, (1 + s[3]) * thrust.sum() / vehicle.mass]

        H = np.stack([(expected(s + 1e-6 * e) - expected(s - 1e-6 * e)) / 2e-6 for e in np.eye(4)], axis=1)
        P = P + np.diag([0.8**2 * PERIOD] * 3 + [0.05**2 * PERIOD])
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + N)
        s, P = s + K @ (reading - expected(s)), (np.eye(4) - K @ H) @ P
        if np.trace(P[:3, :3]) > 27:
            by = np.diag([*[np.sqrt(27 / np.trace(P[:3, :3]))] * 3, 1])
            P = by @ P @ by
        controller.step(Measurement(0.0, x, reading, None), a_hover(vehicle))
        found = np.array([*told.belief.wind, told.belief.thrust_scale - 1])
        assert found == pytest.approx(s, abs=1e-5)


def test_the_filter_of_force_and_scale_is_a_kalman_filter(rng):
    """Against the textbook's information form, in numpy: P^-1 = P-^-1 + H' H / r."""
    update, gain, r = scaled_update(), 0.4, 0.3
    x, P, q, rest = np.zeros(5), np.diag([4.0, 4.0, 4.0, 0.09, 0.25]), np.array([0.2, 0.01, 0.02]), np.zeros(3)
    state = np.concatenate([x, P.ravel(), rest])
    for _ in range(30):
        by_thrust, by_air, reading = 10 * rng.normal(size=3), 4 * rng.normal(size=3), 0.5 * rng.normal(size=3)
        H = np.column_stack([np.eye(3), by_thrust, by_air])
        P = np.linalg.inv(np.linalg.inv(P + np.diag([*q[[0, 0, 0]], *q[1:]])) + H.T @ H / r)
        x = x + P @ H.T @ (reading - H @ x) / r
        rest = rest + gain * (reading - H @ x - rest)
        state = update(state, reading, by_thrust, by_air, q, r, gain)
        assert state == pytest.approx(np.concatenate([x, P.ravel(), rest]), abs=1e-9)


def scaled_update():
    s, y, h, g = ca.SX.sym("s", N_SCALED_STATE), ca.SX.sym("y", 3), ca.SX.sym("h", 3), ca.SX.sym("g", 3)
    walks, r, gain = ca.SX.sym("w", 3), ca.SX.sym("r"), ca.SX.sym("gain")
    parts = scaled_force_update(s, y, h, g, walks, r, gain)
    function = ca.Function("f", [s, y, h, g, walks, r, gain], [ca.vertcat(*parts)])
    return lambda *given: np.array(function(*given)).ravel()


def test_a_sudden_force_is_no_scale():
    """A reading that nobody expects goes into the force; the scales take a share that falls with it, and the variance
    is that of these gains (Joseph's form is of any gain)."""
    update, none = scaled_update(), np.zeros(3)
    P = np.diag([0.1, 0.1, 0.1, 0.01, 0.01])
    state, h, g = np.concatenate([np.zeros(5), P.ravel(), none]), np.array([0, 0, 10.0]), np.array([3.0, 0, 0])
    H = np.column_stack([np.eye(3), h, g])
    S = H @ P @ H.T + 0.1 * np.eye(3)
    K = P @ H.T @ np.linalg.inv(S)
    for size in (1.0, 10.0, 40.0):
        reading = size * np.array([0.6, 0.0, 0.8])
        found = update(state, reading, h, g, none, 0.1, 0.0)
        trust = min(1, SURPRISE / np.sqrt(reading @ np.linalg.solve(S, reading)))
        used = np.diag([1, 1, 1, trust, trust]) @ K
        assert (trust < 1) == (size > 5)
        assert found[:5] == pytest.approx(used @ reading, abs=1e-9)
        left = np.eye(5) - used @ H
        assert found[5:30] == pytest.approx((left @ P @ left.T + 0.1 * used @ used.T).ravel(), abs=1e-9)


def test_the_noise_of_readings_is_no_scale(vehicle, rng):
    """A fast force observer answers noise with thrust; what it answered with must not be taken for a scale."""
    residual = make_residual("none", vehicle)
    observed = disturbance(mpc_of(vehicle, residual), scale_walk=0.005, force_bandwidth=100.0)
    reference = SampledReference(Circle(speed=4.0, acceleration=2.0, radius=3.0), observed)
    _, beliefs = flown(Truth(vehicle, residual), observed, reference, 300, 0.15, rng)
    assert beliefs[100:, 9].mean() == pytest.approx(1.0, abs=0.1)  # 1.2 where the filter has the bandwidth of the force


def test_drag_that_is_twice_the_models_is_found_and_planned_with(vehicle):
    """A scale of the air turns with the velocity over the horizon, a force does not."""
    residual, errors = make_residual("linear_drag", vehicle), []
    twice = scaled_residual(residual)
    twice = replace(twice, theta=np.append(residual.theta, 2.0))
    for walk in (0.0, 0.02):
        observed = disturbance(mpc_of(vehicle, scaled_residual(residual)), scale_walk=0.005, air_walk=walk)
        reference = SampledReference(Circle(speed=6.0, acceleration=3.0, radius=3.0), observed)
        states, beliefs = flown(Truth(vehicle, twice), observed, reference, 300)
        errors.append(np.linalg.norm(states[150:, :3] - reference.along()[0][150:300, :3], axis=1).mean())
    assert beliefs[200:, 9] == pytest.approx(1.0, abs=0.02) and beliefs[200:, 10] == pytest.approx(2.0, abs=0.05)
    assert np.abs(beliefs[200:, :3]).max() < 0.1
    assert errors[1] < 0.5 * errors[0]


def test_one_that_plans_nothing_is_told_of_drag_as_a_scale_too(vehicle):
    """Force and scales are what the reading means where the vehicle is."""
    residual, velocity = make_residual("linear_drag", vehicle), np.array([5.0, -2.0, 0.0])
    told = Held(vehicle, np.full(4, vehicle.hover_thrust), PERIOD, residual=residual)
    controller = disturbance(told, scale_walk=0.005, air_walk=0.02)
    x = np.concatenate([np.zeros(3), [1.0], np.zeros(3), velocity, np.zeros(3)])
    controller.reset(x, a_hover(vehicle))
    drag = residual(np.concatenate([velocity, np.zeros(3), told.thrust]))[0, :3]
    for _ in range(100):
        controller.step(Measurement(0.0, x, [0, 0, vehicle.gravity] + 1.5 * drag, None), a_hover(vehicle))
    assert told.belief.air_scale > 1.1
    together = told.belief.force / vehicle.mass + [0, 0, (told.belief.thrust_scale - 1) * vehicle.gravity]
    together += (told.belief.air_scale - 1) * drag
    assert together == pytest.approx(0.5 * drag, abs=0.02)


@pytest.mark.parametrize(
    ("observed", "lag", "measured"),
    [(disturbance, 0.03, False), (disturbance, 0.0, True), (wind, 0.03, True), (wind, 0.0, False)],
)
def test_as_a_part_of_the_step_or_before_it(vehicle, monkeypatch, observed, lag, measured):
    """The update within the MPC's own function, and by itself with DeliveredThrust: the same flight."""
    known = replace(vehicle, thrust_coefficient=2e-5)
    residual, flights = make_residual("gp_with_mean", known), []
    settings = {"dead_time": 0.03, "motor_lag": lag}
    for within in (True, False):
        if not within:
            monkeypatch.setattr(observer_module, "PredictiveController", type("NoMPC", (), {}))
            monkeypatch.setattr(observer_module, "air_of", lambda controller: residual)
            monkeypatch.setattr(observer_module, "parameters_of", lambda controller: residual.theta)
            monkeypatch.setattr(wind_module, "air_of", lambda controller: residual)
            monkeypatch.setattr(wind_module, "parameters_of", lambda controller: residual.theta)
        mpc = mpc_of(known, residual, backend="interpreted", **settings)
        mpc.targets = True
        controller = observed(mpc)
        reference = SampledReference(Circle(speed=5.0, acceleration=2.5), controller)
        rng, found = np.random.default_rng(1), []
        controller.reset(reference.at(0)[0], reference.window(0))
        for k in range(12):
            x = reference.at(k)[0] + 0.01 * rng.normal(size=13)
            x[3:7] /= np.linalg.norm(x[3:7])
            reading = [0, 0, 9.81] + 0.3 * rng.normal(size=3) if k else None
            speed = rng.uniform(300, 400, 4) if k and measured else None
            u, _ = controller.step(Measurement(k * PERIOD, x, reading, speed), reference.window(k))
            found.append([*u, *controller.log().values()])
        flights.append(found)
    assert np.abs(np.array(flights[0])[-1, 4:7]).max() > 0 or observed is wind
    assert np.array(flights[0]) == pytest.approx(np.array(flights[1]), abs=1e-6)


# ------------------------------------------------------------------------------------------------ limits and refusals
def test_estimates_stay_within_their_limits(vehicle):
    observed = partial(disturbance, force_limit=2.0, torque_limit=5.0)
    reading = np.tile([30.0, 0, vehicle.gravity], (50, 1))
    found = still(vehicle, observed, reading, 50, rates=np.arange(50)[:, None] * [1.0, 0, 0])
    assert found[-1, 0] == pytest.approx(2.0 * vehicle.mass) and found[-1, 3] == pytest.approx(5.0 * 0.03)


def test_the_bandwidth_of_an_anemometer(vehicle):
    """Drag slopes of a fitted model, by differences, in both directions of both horizontal axes."""
    residual, config = make_residual("gp_with_mean", vehicle), WindObserver(name="w", noise=(0.2, 0.4, 1.0))
    slopes = np.zeros((2, 2))
    for axis in (0, 1):
        for k, airspeed in enumerate((-5.0, 5.0)):
            z, step = np.r_[np.zeros(6), np.full(4, vehicle.hover_thrust)], 1e-5 * np.eye(10)[axis]
            z[axis] = airspeed
            slopes[axis, k] = abs(residual(z + step) - residual(z - step))[0, axis] / 2e-5
    found = wind_module.wind_bandwidth(vehicle, residual, residual.theta, config, PERIOD)
    each = config.wind_walk * slopes.mean(axis=1) / (np.array([0.2, 0.4]) * np.sqrt(PERIOD))
    assert found == pytest.approx(each.min(), rel=1e-5)
    assert abs(slopes[:, 0] / slopes[:, 1] - 1).min() > 0.01  # it is another one in the other direction


def test_a_poor_anemometer_is_refused_by_name(vehicle):
    with pytest.raises(UsageError, match="knows too little drag .* take observer=disturbance"):
        wind(mpc_of(vehicle, make_residual("none", vehicle), backend="interpreted"))


def test_the_flight_has_the_estimates(vehicle):
    controller = disturbance(mpc_of(vehicle, make_residual("none", vehicle), backend="interpreted"))
    reference = SampledReference(Hover(duration=0.1), controller)
    controller.reset(reference.at(0)[0], reference.window(0))
    controller.step(Measurement(0.0, reference.at(0)[0], None, None), reference.window(0))
    assert tuple(controller.log()) == COLUMNS and controller.log()["observer_thrust_scale"] == 1.0


def test_back_ends_estimate_alike(vehicle, rng):
    found = []
    for backend in ("interpreted", "auto"):
        controller = wind(mpc_of(vehicle, make_residual("gp_with_mean", vehicle), backend=backend))
        reference = SampledReference(Circle(speed=5.0, acceleration=2.5), controller)
        truth = Truth(vehicle, make_residual("linear_drag", vehicle), wind=(3, 1, 0))
        found.append(flown(truth, controller, reference, 30)[1])
    assert found[0] == pytest.approx(found[1], abs=1e-6)
