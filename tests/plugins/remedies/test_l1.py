"""L1: the estimate is the mean of the last period's disturbance, the command its low pass, and what that leads to."""

import math

import numpy as np
import pytest

from quadexp.control.base import Measurement
from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller, build_vehicle
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.physics.state import POSITION
from quadexp.plugins.laws.geometric import Geometric
from quadexp.plugins.remedies.l1 import L1, LOGGED
from tests.control.held import Held
from tests.control.laws.flown import Body, at_rest, fly, hovering, rotation, vehicle_of

INTERPRETED = {"backend": "interpreted"}


def geometric(vehicle, rate=100.0, **keys):
    inner = Geometric(rate=rate, **INTERPRETED).controller(vehicle)
    return L1(**keys).around(inner)


def estimate(controller):
    """Force along body axes and torque, (6,)."""
    return np.array([controller.log()[name] for name in LOGGED])


@pytest.mark.parametrize("pole", [0.5, 5.0, 30.0])
@pytest.mark.parametrize("name", ["torrente", "lei_li"])
def test_the_estimate_is_the_mean_disturbance_of_the_last_period(name, pole):
    """Dead beat: the factor a T/(e^{a T} - 1) is all that the pole does, from the second sample on."""
    vehicle, period = vehicle_of(name), 0.01
    weight, J = vehicle.mass * 9.81, np.diag(vehicle.inertia_matrix)
    force = lambda t: weight * np.array([0.3 * np.sin(9 * t), 0.2, 0.4 * np.cos(23 * t)])  # noqa: E731
    torque = lambda t: J * np.array([3 * np.sin(17 * t), -2.0, np.cos(31 * t)])  # noqa: E731
    inner = Held(vehicle, np.full(4, vehicle.hover_thrust), period)
    keys = L1(velocity_pole=pole, rate_pole=pole, force_limit=0.0, torque_limit=0.0)
    controller, body, found = keys.around(inner), Body(vehicle, force, torque), []
    x = at_rest()
    controller.reset(x, hovering(vehicle))
    for k in range(80):
        u, _ = controller.step(Measurement(k * period, x, None, None), hovering(vehicle))
        assert u == pytest.approx(inner.thrust)  # limits of 0: nothing is added
        values = estimate(controller)
        found.append(np.concatenate([rotation(x).apply(values[:3]), values[3:]]))
        x = body.advance(x, u, k * period, period)
    factor = pole * period / math.expm1(pole * period)
    parts = np.linspace(0, 1, 41)
    for k in range(2, 80):
        times = (k - 1 + parts) * period
        mean = np.trapezoid([np.concatenate([force(t), torque(t)]) for t in times], dx=1 / 40, axis=0)
        scale = np.concatenate([np.full(3, weight), 3 * J])
        assert np.abs(found[k] - factor * mean).max() < 5e-3 * scale.max()
        assert (np.abs(found[k] - factor * mean) < 6e-3 * scale).all()


@pytest.mark.parametrize("frequency", [2.0, 10.0, 40.0])
def test_the_command_is_the_low_pass_of_the_disturbance(frequency):
    """Yaw torque d = sin wt: added torque over d, by Fourier, against -(1 - b)/(1 - b z^-1) times the mean of the last
    period, held over the next one."""
    vehicle, period = vehicle_of("torrente", torque_coefficient=0.5), 0.01
    J, keys = vehicle.inertia[2][2], L1(velocity_pole=0.2, rate_pole=0.2, bandwidth=12.0)
    body = Body(vehicle, torque=lambda t: np.array([0, 0, J * np.sin(frequency * t)]))
    inner = Held(vehicle, np.full(4, vehicle.hover_thrust), period)
    controller = keys.around(inner)
    duration = 2 * math.pi / frequency * max(3, round(frequency / 2)) + 1.0
    _, commands = fly(body, controller, at_rest(), duration, lambda t: hovering(vehicle))
    added = (commands @ vehicle.allocation.T)[:, 3] / J
    t = period * np.arange(len(added))
    after = t > 1.0
    basis = np.stack([np.sin(frequency * t), np.cos(frequency * t), np.ones_like(t)], axis=1)[after]
    found = np.linalg.lstsq(basis, added[after], rcond=None)[0]
    z, b = np.exp(1j * frequency * period), math.exp(-12.0 * period)
    mean = (1 - 1 / z) / (1j * frequency * period)
    factor = 0.2 * period / math.expm1(0.2 * period)
    expected = -factor * (1 - b) / (1 - b / z) * mean
    assert found[0] + 1j * found[1] == pytest.approx(expected, abs=3e-3)


def test_what_rotors_can_cancel_is_cancelled_and_what_they_cannot_is_only_estimated():
    vehicle, window = vehicle_of("torrente"), hovering(vehicle_of("torrente"))
    torque = np.array([0.2, -0.1, 0.02])
    for force in ([0.0, 0.0, 3.0], [0.0, 0.0, -4.0]):
        body = Body(vehicle, lambda t, force=force: np.array(force), lambda t: torque)
        states, _ = fly(body, controller := geometric(vehicle), at_rest(), 6.0, lambda t: window)
        factor = 0.01 / math.expm1(0.01)  # of the pole of 1/s at 100 Hz
        left = (1 - factor) * abs(force[2]) / 16  # that share stays on the spring
        assert np.abs(states[-1, POSITION]).max() < left + 3e-4
        logged = estimate(controller)
        assert logged[2] == pytest.approx(factor * force[2], rel=2e-3)
        assert logged[3:] == pytest.approx(factor * torque, abs=2e-4)
    force = np.array([1.5, -1.0, 0.0])
    plain, _ = fly(Body(vehicle, lambda t: force), geometric(vehicle).wrapped, at_rest(), 6.0, lambda t: window)
    states, _ = fly(Body(vehicle, lambda t: force), controller := geometric(vehicle), at_rest(), 6.0, lambda t: window)
    assert np.linalg.norm(states[-1, POSITION][:2]) == pytest.approx(np.linalg.norm(plain[-1, POSITION][:2]), rel=0.05)
    estimated = rotation(states[-1]).apply(estimate(controller)[:3])
    assert estimated == pytest.approx(0.995 * force, abs=5e-3)
    told, _ = fly(Body(vehicle, lambda t: force), geometric(vehicle, unmatched=True), at_rest(), 8.0, lambda t: window)
    assert np.abs(told[-1, POSITION]).max() < 2e-3


@pytest.mark.parametrize("name", ["torrente", "lei_li", "crazyflie"])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_it_adds_no_more_thrust_than_its_limit(name, sense):
    """A fifth of the weight, of the three fifths that are missing or too much."""
    vehicle = vehicle_of(name)
    weight, inner = vehicle.mass * vehicle.gravity, Held(vehicle, np.full(4, vehicle.hover_thrust), 0.01)
    body = Body(vehicle, lambda t: np.array([0, 0, -0.6 * sense * weight]))
    controller = L1(force_limit=0.2).around(inner)
    _, commands = fly(body, controller, at_rest(), 0.3, lambda t: hovering(vehicle))
    assert (commands[-1] - inner.thrust).sum() == pytest.approx(0.2 * sense * weight, rel=1e-9)


def test_the_predictor_sees_the_command_as_it_was_clipped():
    """A base beyond what the rotors give: nothing is missing, so nothing is estimated."""
    vehicle, period = vehicle_of("torrente"), 0.01
    inner = Held(vehicle, [30.0, 30.0, 30.0, 30.0], period)
    controller = L1().around(inner)
    states, commands = fly(Body(vehicle), controller, at_rest(), 0.3, lambda t: hovering(vehicle))
    assert commands == pytest.approx(vehicle.thrust_max)
    assert np.abs(estimate(controller)).max() < 1e-6


@pytest.mark.parametrize(("lag", "dead_time"), [(0.03, 0.0), (0.0, 0.013), (0.04, 0.02), (0.0, 0.03)])
def test_a_known_lag_and_dead_time_are_no_disturbance(lag, dead_time):
    """Commands that change all the time, through the lag and the delay, integrated finely here."""
    vehicle, period, fine = vehicle_of("torrente"), 0.01, 100
    rng = np.random.default_rng(5)
    inner = Held(vehicle, np.full(4, vehicle.hover_thrust), period)
    controller = L1(force_limit=0.0, torque_limit=0.0, motor_lag=lag, dead_time=dead_time).around(inner)
    window, body = hovering(vehicle), Body(vehicle)
    x = at_rest()
    controller.reset(x, window)
    sent, rotors, estimates = [], inner.thrust.copy(), []
    for k in range(60):
        inner.thrust = vehicle.hover_thrust + rng.normal(0, 0.3, 4)
        u, _ = controller.step(Measurement(k * period, x, None, None), window)
        estimates.append(estimate(controller))
        sent.append(u)
        for i in range(fine):
            t = k * period + (i + 0.5) * period / fine - dead_time
            acting = sent[math.floor(t / period)] if t >= 0 else np.full(4, vehicle.hover_thrust)
            before = rotors
            rotors = acting + (rotors - acting) * (math.exp(-period / fine / lag) if lag else 0.0)
            x = body.advance(x, (before + rotors) / 2 if lag else rotors, 0.0, period / fine)
    assert np.abs(np.array(estimates)[:, 2]).max() < 0.02 and np.abs(np.array(estimates)[:, 3:]).max() < 6e-3
    blind = L1().around(inner)
    assert blind.about.delays.pending == 0 and blind.memory.sizes["sent"] == 4


LAGGING = [
    "controller=geometric",
    "controller.allow_unstable=true",
    "actuator=lag_30ms",
    "adaptive=l1",
    "trajectory=hover",
    "trajectory.duration=5",
]


def test_a_bandwidth_far_above_the_motors_loses_the_vehicle_unless_it_knows_them():
    """A third of 1/tau is 11 rad/s; 500 rad/s is no low pass at all."""

    def error(*extra):
        flight = fly_one(compose([*LAGGING, *extra]))
        return flight.metadata["row"]["max_error"] if flight.outcome == "ok" else np.inf

    assert error("adaptive.bandwidth=11") < 0.01
    assert error("adaptive.bandwidth=500") > 0.5
    assert error("adaptive.bandwidth=500", "adaptive.motor_lag=0.03") < 0.01


def test_ninety_percent_more_mass_as_hanover_et_al_fly_it():
    """Published: 0.434 -> 0.007 m at 2.5 m/s (98 %); the first second, in which it falls, is in ours."""
    given = ["controller=nominal_mpc", "plant=ideal", "truth.mass=1.9", "trajectory.speed=2.5"]
    plain, adapted = (
        fly_one(compose([*given, *extra])).metadata["row"]["mean_error"] for extra in ([], ["adaptive=l1"])
    )
    assert plain > 0.08 and adapted < 0.1 * plain


def test_an_mpc_does_not_pull_against_what_is_added():
    """Its own commands go back to the reference's, and no offset stays: the addition is not in its cost."""
    given = ["controller=nominal_mpc", "plant=ideal", "truth.mass=1.2", "trajectory=hover", "trajectory.duration=6"]
    config = compose([*given, "adaptive=l1"])
    flight = fly_one(config)
    columns, vehicle = flight.columns, build_vehicle(config.vehicle)
    assert abs(columns["p_z"][-1] - 1.0) < 2e-3
    added = -columns["l1_force_z"][-1] / 4
    assert columns["u_0"][-1] == pytest.approx(1.2 * vehicle.hover_thrust, rel=1e-3)
    assert columns["u_0"][-1] - added == pytest.approx(vehicle.hover_thrust, rel=5e-3)


PERFECT = ["controller=perfect_mpc", "adaptive=l1", "controller.backend=interpreted", "plant.backend=interpreted"]


def test_it_knows_what_its_controller_knows():
    """Lag, dead time and the model of the air are those of the controller inside."""
    config = compose(
        ["controller=perfect_mpc", "adaptive=l1", "controller.dead_time=0.03", "controller.motor_lag=0.02"]
    )
    from quadexp.experiment.build import build_world

    vehicle = build_vehicle(config.vehicle)
    controller = build_controller(config, vehicle, build_world(config, vehicle), None)
    assert controller.about.delays.pending == 2 and controller.about.lag == 0.02
    known = fly_one(compose(PERFECT))
    drag = np.abs(known.columns["l1_force_x"][50:]).mean()
    unknown = fly_one(compose(["controller=nominal_mpc", "adaptive=l1"]))
    assert drag < 0.02 * np.abs(unknown.columns["l1_force_x"][50:]).mean()


@pytest.mark.parametrize("controller", ["nominal_mpc", "geometric", "pid", "dfbc", "static_feedback"])
def test_around_every_controller(controller):
    vehicle = ["vehicle=lei_li", "plant=blade_element"] if controller == "static_feedback" else []
    flight = fly_one(compose([f"controller={controller}", "adaptive=l1", "trajectory=hover", *vehicle]))
    assert flight.outcome == "ok" and flight.metadata["row"]["controller"] == f"{controller}+l1"


def test_what_it_cannot_be_put_around_is_said():
    with pytest.raises(UsageError, match="adaptive.unmatched=true: this controller cannot be given a force"):
        fly_one(compose(["controller=pid", "adaptive=l1", "adaptive.unmatched=true"]))
    from quadexp.control.wrapped import WrappedController

    with pytest.raises(UsageError, match="explains the same error by what it learns in flight"):
        fly_one(compose(["controller=rls_mpc", "adaptive=l1", "vehicle=lei_li", "plant=blade_element"]))
    vehicle = vehicle_of("torrente")
    inner = WrappedController(Geometric(**INTERPRETED).controller(vehicle))
    with pytest.raises(UsageError, match="an observer estimates the same disturbance"):
        compose(["adaptive=l1"]).adaptive.around(inner)
