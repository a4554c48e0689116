"""The bank and its posterior: against a Kalman filter of one hypothesis, and on readings whose delays are known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.control.control_step import InputArrays, run
from quadexp.models.residual import no_residual
from quadexp.physics.state import ATTITUDE, RATE, VELOCITY
from quadexp.plugins.auto.bank import Bank, first_order_gain, stationary_gain
from quadexp.plugins.auto.posterior import FOUND, Search
from quadexp.plugins.auto.responses import command_weights, reading_weights
from quadexp.plugins.auto.settings import BANK
from quadexp.plugins.remedies.sent_commands import SentCommands

PERIOD = 0.02


def bank_of(vehicle, **about):
    model = no_residual(vehicle)
    about = {"noise": (0.05, 0.0, 0.0), "spans": (0.0, 0.0)} | about
    return Bank(vehicle, model, np.zeros(model.function.size1_in(1)), PERIOD, "interpreted", **about)


class Posterior(NamedTuple):
    """Of age, total and lag (s), see posterior.FOUND; odds and at_end of the coarse grid."""

    mean: np.ndarray
    deviation: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    newer: float
    age_odds: float
    total_odds: float
    at_end: bool


def posterior(bank, backend="interpreted", rounds=1):
    """As the instants of a flight look for it, see decide.py; rounds: finer grids in an instant."""
    search = Search(bank, backend, {"searches": np.ones(1), "rounds": np.full(1, float(rounds))})
    search.coarse()
    age_odds, total_odds = search.left["odds"].copy()
    at_end = search.left["at_end"] > 0
    for _ in range(BANK.passes // rounds):
        search.fine()
        run([search.moved()])
        if not search.found["moved"]:
            break
    mean, deviation, lower, upper, newer = (search.found[name].copy() for name in FOUND)
    upper[at_end[:3]] = np.inf
    return Posterior(mean, deviation, lower, upper, newer.item(), age_odds, total_odds, bool(at_end[:2].any()))


def spin_of(vehicle):
    """Angular acceleration about x and y of thrusts of 1 N, (2, n) (rad/s^2)."""
    return (np.linalg.inv(vehicle.inertia_matrix) @ vehicle.allocation[1:])[:2]


def integral(slopes, step):
    """By the trapezoidal rule, from the first row on, which is a step after the beginning."""
    before = np.concatenate([slopes[:1], slopes[:-1]])
    return np.cumsum((slopes + before) / 2 * step, axis=0)


def flown(
    vehicle, *, age=0.0, dead_time=0.0, lag=0.0, noise=0.005, correlation=0.0, steps=500, seed=0, span=0.0, missing=0.0
):
    """A bank after a flight whose commands are noise: the vehicle turns about x and y, moves under a wind that pushes
    to the side, and is given it `age` (s) late. correlation: of successive errors of the rates. span: over which
    force and rates are means (s). missing: share of the accelerometer's readings."""
    rng, n, fine = np.random.default_rng(seed), vehicle.n_rotors, 0.001
    bank, told = bank_of(vehicle, spans=(span, span)), InputArrays(vehicle.n_rotors)
    command, per = np.full(n, vehicle.hover_thrust), round(PERIOD / fine)
    total = steps * per
    commands = vehicle.hover_thrust * (1 + 0.2 * rng.normal(size=(steps, n)))
    sent = np.repeat(commands, per, axis=0)
    late = round(dead_time / fine)
    sent = np.concatenate([np.full((late, n), vehicle.hover_thrust), sent])[:total]
    thrust, decay = np.empty_like(sent), 0.0 if lag == 0 else np.exp(-fine / lag)
    held = np.full(n, vehicle.hover_thrust)
    for k in range(total):
        held = decay * held + (1 - decay) * sent[k]
        thrust[k] = held
    rates = integral(thrust @ spin_of(vehicle).T, fine)
    t = fine * np.arange(1, total + 1)
    force = np.column_stack([2 * np.sin(9 * t), 2 * np.cos(7 * t), thrust.sum(1) / vehicle.mass])
    speed = integral(force - [0, 0, vehicle.gravity], fine)
    if span:
        of = round(span / fine)
        rates, force = (np.apply_along_axis(np.convolve, 0, y, np.ones(of) / of)[:total] for y in (rates, force))
    x = np.zeros(13)
    x[3] = 1.0
    bank.memory.begin(bank.start(x, command))
    calls, error = bank.after(told, told.state, command), np.zeros(2)
    told.state[:] = x
    for k in range(steps):
        now = k * per - 1
        error = correlation * error + np.sqrt(1 - correlation**2) * noise * rng.normal(size=2)
        if k:
            old = max(now - round(age / fine), 0)
            told.state[:] = x
            told.state[RATE][:2] = rates[old] + error
            told.state[VELOCITY] = speed[old] + 1e-3 * rng.normal(size=3)
            told.accelerometer_valid[0] = rng.random() >= missing
            if told.accelerometer_valid[0]:
                told.specific_force[:] = force[now] + 0.05 * rng.normal(size=3)
        command[:] = commands[k]
        run(calls, k)
        bank.memory.commit()
    return bank


def test_commands_that_do_not_change_say_nothing_of_their_delays(vehicle):
    """At hover: what nothing moves has no likeliest scale, and that made all delays not a number."""
    rng, bank, told = np.random.default_rng(0), bank_of(vehicle), InputArrays(vehicle.n_rotors)
    hover = np.full(vehicle.n_rotors, vehicle.hover_thrust)
    bank.memory.begin(bank.start(np.eye(13)[3], hover))
    calls, told.accelerometer_valid[0] = bank.after(told, told.state, hover), 1.0
    for k in range(40):
        told.state[:] = np.eye(13)[3]
        told.state[VELOCITY], told.state[RATE] = 1e-3 * rng.normal(size=3), 5e-3 * rng.normal(size=3)
        told.specific_force[:] = [0.0, 0.0, vehicle.gravity] + 0.05 * rng.normal(size=3)
        run(calls, k)
        bank.memory.commit()
    for moments in bank.moments.values():
        moments[:, 2:, 2:] = moments[:, :2, 2:] = moments[:, 2:, :2] = 0.0  # exactly
    with np.errstate(invalid="raise", divide="raise"):
        found = posterior(bank)
    assert np.isfinite(found.mean).all() and (found.deviation[:2] > 0.001).all() and found.total_odds < 1


def test_moments_of_a_flight_that_has_hardly_begun_have_a_posterior(vehicle):
    """All of them zero: a matrix that was inverted was singular."""
    bank = bank_of(vehicle)
    bank.memory.begin(bank.start(np.eye(13)[3], np.full(vehicle.n_rotors, vehicle.hover_thrust)))
    assert np.isfinite(posterior(bank).mean).all()


def weights_of(count, total, lag, span):
    return command_weights(PERIOD, count, np.array([total]), np.array([lag]), span)[0]


def squares_of(M, h):
    """Sum of squared innovations for weights (m,)."""
    z = np.concatenate([[1, 0], -h, [0]])
    return z @ (M + np.tril(M, -1).T) @ z


def test_the_moments_are_those_of_a_kalman_filter_of_each_hypothesis(vehicle):
    """Of one hypothesis at a time, the filter written out, its gains those of a stationary one."""
    bank, rng, n = bank_of(vehicle), np.random.default_rng(3), vehicle.n_rotors
    told, command, x = InputArrays(n), np.full(n, vehicle.hover_thrust), np.eye(13)[3]
    bank.memory.begin(bank.start(x, command))
    calls, sent = bank.after(told, told.state, command), SentCommands(n, PERIOD, 0.6)
    sent.reset(command)
    age, dead_time, lag = 0.013, 0.007, 0.021
    mean = sent.weights(np.array([[-PERIOD, 0.0]]), dead_time + age, lag)[0]
    now = sent.weights(np.zeros((1, 2)), dead_time, lag)[0]
    spin, filters = spin_of(vehicle), [np.zeros((2, 2)) for _ in BANK.gyro_models]
    inertia, before, push = vehicle.inertia_matrix, np.zeros(3), command.sum() / vehicle.mass
    squares, thrust_squares, level = np.zeros(len(filters)), 0.0, push
    gain, fading = first_order_gain(BANK.thrust_walk * np.sqrt(PERIOD) / BANK.thrust_noise), PERIOD / BANK.forgetting
    for k in range(60):
        told.state[:], told.accelerometer_valid[0] = x, k > 0
        told.state[RATE] = w = 0.3 * rng.normal(size=3) if k else np.zeros(3)
        told.specific_force[:] = rng.normal(size=3) + [0, 0, 9.81]
        counted, middle = k >= BANK.settling / PERIOD, (w + before) / 2
        drive = spin @ (mean @ sent.values) - (np.linalg.inv(inertia) @ np.cross(middle, inertia @ middle))[:2]
        for i, (noise, walk) in enumerate(BANK.gyro_models):
            gains, state = stationary_gain(noise, walk, PERIOD), filters[i]
            predicted = state[0] + PERIOD * (state[1] + drive)
            nu = w[:2] - predicted
            filters[i] = np.stack([predicted + gains[0] * nu, state[1] + gains[1] * nu])
            squares[i] = np.exp(-fading) * squares[i] + counted * nu @ nu
        nu = told.accelerometer_valid[0] * (
            told.specific_force[2] - (now @ sent.values).sum() / vehicle.mass - (push - level)
        )
        push += gain * nu
        thrust_squares = np.exp(-fading) * thrust_squares + counted * nu**2
        before = w
        command[:] = vehicle.hover_thrust * (1 + 0.3 * rng.normal(size=n))
        run([*calls, *sent.after(command)], k)
        bank.memory.commit()
        sent.memory.commit()
    m, total = bank.layout.commands, dead_time + age + lag
    h = weights_of(m, total, lag, PERIOD)
    assert [squares_of(M, h) for M in bank.moments["gyro"]] == pytest.approx(squares, rel=1e-6)
    h = weights_of(m, total - age, lag, 0.0)
    assert squares_of(bank.moments["thrust"][0], h) == pytest.approx(thrust_squares, rel=1e-4)


@pytest.mark.parametrize(("age", "dead_time", "lag"), [(0, 0, 0), (0.01, 0.01, 0.03), (0.023, 0.017, 0.045)])
def test_known_delays_lie_within_what_is_said_of_them(vehicle, age, dead_time, lag):
    found = posterior(flown(vehicle, age=age, dead_time=dead_time, lag=lag))
    off = np.abs(found.mean - [age, dead_time + lag, lag])
    assert (off < 3 * found.deviation + 1e-3).all() and found.deviation[:2].max() < 3e-3
    assert (found.age_odds > 5) == (age > 0) and (found.total_odds > 5) == (dead_time > 0) and found.newer == 0
    assert (found.lower <= found.mean).all() and (found.mean <= found.upper).all() and not found.at_end


def test_readings_that_are_means_over_a_time_are_no_older_for_that(vehicle):
    found = posterior(flown(vehicle, age=0.012, dead_time=0.006, lag=0.02, span=0.01))
    assert (np.abs(found.mean[:2] - [0.012, 0.026]) < 3 * found.deviation[:2] + 1e-3).all()


@pytest.mark.parametrize("missing", [0.1, 0.3])
def test_missing_readings_make_nothing_older(vehicle, missing):
    """What was missing was skipped: of 30 % an age of 36 ms was assumed where 0 is right."""
    found = posterior(flown(vehicle, missing=missing))
    assert found.age_odds < 2 and found.mean[0] < 0.003
    late = posterior(flown(vehicle, age=0.02, missing=missing))
    assert late.mean[0] == pytest.approx(0.02, abs=0.004)


@pytest.mark.parametrize("age", [BANK.largest_age, 0.12])
def test_an_age_at_the_end_of_the_grid_is_one_at_least(vehicle, age):
    found = posterior(flown(vehicle, age=age))
    assert found.at_end and np.isinf(found.upper[0]) and found.lower[0] > 0.08


def test_a_posterior_is_a_pure_function_of_the_moments(vehicle):
    """Whatever was asked before, and of another bank with the same memory: equal bits."""
    known = {"age": 0.012, "dead_time": 0.01, "lag": 0.02, "steps": 200}
    bank, other = flown(vehicle, **known), flown(vehicle, steps=100)
    first = posterior(bank)
    posterior(other)
    other.memory.restore(bank.memory.now)
    other.sums.restore(bank.sums.now)
    for again in (posterior(bank), posterior(other)):
        assert all(np.array_equal(one, two) for one, two in zip(first, again, strict=True))


@pytest.mark.parametrize(
    "about",
    [
        {"age": 0.012, "dead_time": 0.01, "lag": 0.02},
        {"age": 0.03, "dead_time": 0.005, "lag": 0.06, "span": 0.013},
        {"dead_time": 0.055, "span": PERIOD, "missing": 0.1},
        {"age": BANK.largest_age},
        {"steps": 0},
    ],
)
def test_a_posterior_in_c_is_that_of_the_plain_one(vehicle, about):
    """C has sums by head and tail, NumPy the weights of each hypothesis on the whole matrix."""
    bank = flown(vehicle, **{"steps": 100} | about)
    plain = posterior(bank)
    for rounds in (1, BANK.passes):
        for one, two in zip(plain, posterior(bank, "compiled", rounds), strict=True):
            assert two == pytest.approx(one, rel=1e-9, abs=1e-12)
    assert all(np.array_equal(one, two) for one, two in zip(plain, posterior(bank, rounds=BANK.passes), strict=True))


@pytest.mark.parametrize("age", [0.0, 0.004, 0.013, 0.02])
def test_the_mean_between_readings_is_that_of_a_line(rng, age):
    readings, fine = rng.normal(size=8), np.arange(4000) / 4000
    line = np.interp(-(age + PERIOD * fine), -PERIOD * np.arange(8)[::-1], readings[::-1])
    weights = reading_weights(PERIOD, 8, np.array([age]))[0]
    assert weights @ readings == pytest.approx(line.mean(), abs=2e-3)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_the_bands_hold(vehicle, correlation):
    """Quantiles of 95 %, over noise that is drawn anew, white or correlated."""
    known, hits = {"age": 0.012, "dead_time": 0.01, "lag": 0.02, "steps": 200, "correlation": correlation}, []
    for seed in range(12):
        found = posterior(flown(vehicle, seed=seed, **known))
        hits.append((found.lower[:2] <= [0.012, 0.03]) & (found.upper[:2] >= [0.012, 0.03]))
    assert np.mean(hits) > 0.9


@pytest.mark.parametrize(("age", "of_rates"), [(0.0, 0.0), (0.02, 0.0), (0.05, 0.0), (0.036, 0.03)])
def test_attitudes_tell_their_age_against_rates(vehicle, age, of_rates):
    """Of a vehicle that turns at random, noise of both sensors and a bias of the gyroscope; within a second."""
    rng, fine, bias = np.random.default_rng(5), 0.002, np.array([0.02, -0.01, 0.01])
    noise = 0.005, 0.0035
    model = no_residual(vehicle)
    given = vehicle, model, np.zeros(model.function.size1_in(1)), PERIOD / 2, "interpreted", (0.05, *noise)
    bank = Bank(*given, spans=(0.0, 0.0))
    t = fine * np.arange(600)
    turns = sum(rng.normal(size=3) * np.sin(f * t[:, None] + rng.normal(size=3)) for f in (3.0, 7.0, 11.0))
    attitudes = [Rotation.identity()]
    for rate in turns[1:]:
        attitudes.append(attitudes[-1] * Rotation.from_rotvec(fine * rate))
    told, command, x = InputArrays(vehicle.n_rotors), np.full(vehicle.n_rotors, vehicle.hover_thrust), np.eye(13)[3]
    bank.memory.begin(bank.start(x, command))
    calls, told.accelerometer_valid[0] = bank.after(told, told.state, command), 1.0
    for k, now in enumerate(range(0, len(t), round(bank.period / fine))):
        attitude = attitudes[max(now - round(age / fine), 0)] * Rotation.from_rotvec(noise[1] * rng.normal(size=3))
        told.state[:] = x
        told.state[ATTITUDE] = attitude.as_quat(scalar_first=True)
        told.state[RATE] = turns[max(now - round(of_rates / fine), 0)] + bias + noise[0] * rng.normal(size=3)
        run(calls, k)
        bank.memory.commit()
    found = posterior(bank)
    newer = age - of_rates
    assert found.newer == pytest.approx(newer, abs=0.002) and found.mean[0] > newer - 0.003
    assert found.age_odds > 5 and found.mean[0] < newer + 0.003 if age else found.age_odds < 1
