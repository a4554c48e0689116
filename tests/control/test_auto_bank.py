"""The bank and its posterior: against a Kalman filter of one hypothesis, and on readings whose delays are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.control.auto.bank import FADING, SKIPPED, SPINS, THRUST, Bank, spin_of, stationary
from quadexp.control.auto.posterior import Posterior
from quadexp.control.auto.weights import command_weights, reading_weights
from quadexp.control.delivered import SentCommands
from quadexp.control.instant import Told, run
from quadexp.models.residual import no_residual
from quadexp.physics.state import ATTITUDE, RATE, VELOCITY

PERIOD = 0.02


def bank_of(vehicle, **about):
    model = no_residual(vehicle)
    return Bank(vehicle, model, np.zeros(model.function.size1_in(1)), PERIOD, 0.05, "interpreted", **about)


def integral(slopes, step):
    """By the trapezoidal rule, from the first row on, which is a step after the beginning."""
    before = np.concatenate([slopes[:1], slopes[:-1]])
    return np.cumsum((slopes + before) / 2 * step, axis=0)


def flown(vehicle, *, age=0.0, dead_time=0.0, lag=0.0, noise=0.005, correlation=0.0, steps=500, seed=0, span=0.0):
    """A bank after a flight whose commands are noise: the vehicle turns about x and y, moves under a wind that pushes
    to the side, and is told of it `age` (s) late. correlation: of successive errors of the rates. span: over which
    force and rates are means (s)."""
    rng, n, fine = np.random.default_rng(seed), vehicle.n_rotors, 0.001
    bank, told = bank_of(vehicle, spans=(span, span)), Told(vehicle.n_rotors)
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
    bank.reset(x, command)
    operations, error = bank.after(told, told.state, command), np.zeros(2)
    for k in range(steps):
        now = k * per - 1
        error = correlation * error + np.sqrt(1 - correlation**2) * noise * rng.normal(size=2)
        if k:
            old = max(now - round(age / fine), 0)
            told.state[:] = x
            told.state[RATE][:2] = rates[old] + error
            told.state[VELOCITY] = speed[old] + 1e-3 * rng.normal(size=3)
            told.force[:], told.read[0] = force[now] + 0.05 * rng.normal(size=3), 1.0
        command[:] = commands[k]
        run(operations, k)
    return bank


def test_commands_that_do_not_change_say_nothing_of_their_delays(vehicle):
    """At hover: what nothing moves has no likeliest scale, and that made all delays not a number."""
    rng, bank, told = np.random.default_rng(0), bank_of(vehicle), Told(vehicle.n_rotors)
    hover = np.full(vehicle.n_rotors, vehicle.hover_thrust)
    bank.reset(np.eye(13)[3], hover)
    operations, told.read[0] = bank.after(told, told.state, hover), 1.0
    for k in range(40):
        told.state[:] = np.eye(13)[3]
        told.state[VELOCITY], told.state[RATE] = 1e-3 * rng.normal(size=3), 5e-3 * rng.normal(size=3)
        told.force[:] = [0.0, 0.0, vehicle.gravity] + 0.05 * rng.normal(size=3)
        run(operations, k)
    bank.sums[:, 2:, 2:] = bank.sums[:, :2, 2:] = bank.sums[:, 2:, :2] = 0.0  # exactly
    with np.errstate(invalid="raise", divide="raise"):
        found = Posterior(bank).evidence()
    assert np.isfinite(found.mean).all() and (found.deviation[:2] > 0.01).all() and found.slow < 1


def squares_of(G, W):
    """Sum of squared innovations for weights (m,)."""
    z = np.concatenate([[1, 0], -W, [0]])
    return z @ G @ z


def test_the_sums_are_those_of_a_kalman_filter_of_each_hypothesis(vehicle):
    """Of one hypothesis at a time, the filter written out, its gains those of a stationary one."""
    bank, rng, n = bank_of(vehicle), np.random.default_rng(3), vehicle.n_rotors
    told, command, x = Told(n), np.full(n, vehicle.hover_thrust), np.eye(13)[3]
    bank.reset(x, command)
    operations, sent = bank.after(told, told.state, command), SentCommands(n, PERIOD, 0.6)
    sent.reset(command)
    age, dead_time, lag = 0.013, 0.007, 0.021
    mean = sent.weights(np.array([[-PERIOD, 0.0]]), dead_time + age, lag)[0]
    now = sent.weights(np.zeros((1, 2)), dead_time, lag)[0]
    spin, filters = spin_of(vehicle), [np.zeros((2, 2)) for _ in SPINS]
    inertia, before, push = vehicle.inertia_matrix, np.zeros(3), command.sum() / vehicle.mass
    squares, thrust_squares, level = np.zeros(len(SPINS)), 0.0, push
    ratio = (THRUST[1] / THRUST[0]) ** 2 * PERIOD
    variance = ratio / 2 + np.sqrt(ratio**2 / 4 + ratio)
    for k in range(60):
        told.state[:], told.read[0] = x, k > 0
        told.state[RATE] = w = 0.3 * rng.normal(size=3) if k else np.zeros(3)
        told.force[:] = rng.normal(size=3) + [0, 0, 9.81]
        if k:
            counted, middle = k > SKIPPED / PERIOD, (w + before) / 2
            drive = spin @ (mean @ sent.values) - (np.linalg.inv(inertia) @ np.cross(middle, inertia @ middle))[:2]
            for i, (noise, walk) in enumerate(SPINS):
                gains, state = stationary(noise, walk, PERIOD), filters[i]
                predicted = state[0] + PERIOD * (state[1] + drive)
                nu = w[:2] - predicted
                filters[i] = np.stack([predicted + gains[0] * nu, state[1] + gains[1] * nu])
                squares[i] = np.exp(-PERIOD / FADING) * squares[i] + counted * nu @ nu
            nu = told.force[2] - (now @ sent.values).sum() / vehicle.mass - (push - level)
            push += variance / (variance + 1) * nu
            thrust_squares = np.exp(-PERIOD / FADING) * thrust_squares + counted * nu**2
        before = w
        command[:] = vehicle.hover_thrust * (1 + 0.3 * rng.normal(size=n))
        run([*operations, *sent.after(command)], k)
    m, products = bank.layout.commands, bank.products([*range(len(SPINS))])
    total, lags = np.array([dead_time + age + lag]), np.array([lag])
    W = command_weights(PERIOD, m, total.tobytes(), lags.tobytes(), PERIOD)[0, 0]
    assert [squares_of(G, W) for G in products[:-1]] == pytest.approx(squares, rel=1e-6)
    W = command_weights(PERIOD, m, (total - age).tobytes(), lags.tobytes(), 0.0)[0, 0]
    assert squares_of(products[-1], W) == pytest.approx(thrust_squares, rel=1e-4)


@pytest.mark.parametrize(("age", "dead_time", "lag"), [(0, 0, 0), (0.01, 0.01, 0.03), (0.023, 0.017, 0.045)])
def test_known_delays_lie_within_what_is_said_of_them(vehicle, age, dead_time, lag):
    evidence = Posterior(flown(vehicle, age=age, dead_time=dead_time, lag=lag)).evidence()
    off = np.abs(evidence.mean - [age, dead_time + lag, lag])
    assert (off < 3 * evidence.deviation + 1e-3).all() and evidence.deviation[:2].max() < 2e-3
    assert (evidence.late > 6) == (age > 0) and (evidence.slow > 6) == (dead_time > 0) and not evidence.fresh


def test_readings_that_are_means_over_a_time_are_no_older_for_that(vehicle):
    known = {"age": 0.012, "dead_time": 0.006, "lag": 0.02, "span": 0.01}
    evidence = Posterior(flown(vehicle, **known)).evidence()
    assert (np.abs(evidence.mean[:2] - [0.012, 0.026]) < 3 * evidence.deviation[:2] + 1e-3).all()
    assert evidence.deviation[:2].max() < 2e-3


def test_a_posterior_wider_than_the_steps_of_its_grid_is_not_cut_off(vehicle):
    """Without lag, and where nothing but the rates tells, an age is worth as much as a dead time: all splits alike."""
    posterior = Posterior(flown(vehicle, dead_time=0.01))
    posterior._velocity, posterior._share = lambda *grids, **about: 0.0, lambda: 0.0
    evidence = posterior.evidence()
    assert evidence.mean[:2].sum() == pytest.approx(0.01, abs=1e-3)
    assert evidence.deviation[0] == pytest.approx(0.01 / np.sqrt(12), rel=0.15)


@pytest.mark.parametrize(("age", "wait", "lag"), [(0.0, 0.0, 0.0), (0.004, 0.013, 0.0), (0.013, 0.005, 0.012)])
@pytest.mark.parametrize("span", [0.0, 0.005])
def test_the_mean_between_readings_is_that_of_a_force_that_jumps_with_commands(rng, age, wait, lag, span):
    """Against the integral of the response to commands that jump at random, on a fine grid."""
    fine, count, m = 2e-5, 8, 60
    commands = np.cumsum(rng.normal(size=m))  # the oldest first, the newest a period ago
    t = np.arange(-m * PERIOD, 0, fine) + fine / 2
    sent = commands[np.clip(((t - wait) / PERIOD + m).astype(int), 0, m - 1)]
    sent[t < wait - m * PERIOD] = commands[0]
    force, share = np.empty_like(sent), -np.expm1(-fine / lag) if lag else 1.0
    held = commands[0]
    for k, u in enumerate(sent):
        held += share * (u - held)
        force[k] = held

    def over(end, length):
        last, length = round(end / fine), max(round(length / fine), 1)
        return force[len(force) - last - length : len(force) - last]

    def mean(end, length):
        return over(end, length).mean()

    readings = [mean(PERIOD * i, span) for i in range(count)]
    each = (np.array([value]).tobytes() for value in (age, wait + lag, lag))
    W, moment, _ = -reading_weights(PERIOD, count, m, *each, span)[0, 0, 1:].reshape(3, count)
    assert W.sum() == pytest.approx(1, abs=1e-3) and moment.sum() == pytest.approx(0, abs=1e-3)
    assert W @ readings == pytest.approx(mean(age, PERIOD), abs=0.03)
    inside = over(age, PERIOD)
    assert moment @ readings == pytest.approx(inside @ np.linspace(-0.5, 0.5, len(inside)) / len(inside), abs=0.02)
    line = (
        np.interp(-(age + PERIOD * (np.arange(100) + 0.5) / 100), -PERIOD * np.arange(count)[::-1], readings[::-1])
    ).mean()
    assert abs(line - mean(age, PERIOD)) > 0.05


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_the_bands_hold(vehicle, correlation):
    """At two deviations, over noise that is drawn anew, white or correlated."""
    known, off = {"age": 0.012, "dead_time": 0.01, "lag": 0.02, "steps": 200, "correlation": correlation}, []
    for seed in range(12):
        evidence = Posterior(flown(vehicle, seed=seed, **known)).evidence()
        off.append((evidence.mean[:2] - [0.012, 0.03]) / evidence.deviation[:2])
    assert np.mean(np.abs(off) < 2) > 0.8 and np.abs(off).max() < 4


@pytest.mark.parametrize("age", [0.0, 0.02, 0.05])
def test_attitudes_tell_their_age_against_rates_of_now(vehicle, age):
    """Of a vehicle that turns at random, noise of both sensors and a bias of the gyroscope; within a second."""
    rng, fine, bias = np.random.default_rng(5), 0.002, np.array([0.02, -0.01, 0.01])
    noise = 0.005, 0.0035
    model = no_residual(vehicle)
    bank = Bank(vehicle, model, np.zeros(model.function.size1_in(1)), PERIOD / 2, 0.05, "interpreted", noise)
    t = fine * np.arange(600)
    turns = sum(rng.normal(size=3) * np.sin(f * t[:, None] + rng.normal(size=3)) for f in (3.0, 7.0, 11.0))
    attitudes = [Rotation.identity()]
    for rate in turns[1:]:
        attitudes.append(attitudes[-1] * Rotation.from_rotvec(fine * rate))
    told, command, x = Told(vehicle.n_rotors), np.full(vehicle.n_rotors, vehicle.hover_thrust), np.eye(13)[3]
    bank.reset(x, command)
    operations, told.read[0] = bank.after(told, told.state, command), 1.0
    for k, now in enumerate(range(0, len(t), round(bank.period / fine))):
        attitude = attitudes[max(now - round(age / fine), 0)] * Rotation.from_rotvec(noise[1] * rng.normal(size=3))
        told.state[:] = x
        told.state[ATTITUDE] = attitude.as_quat(scalar_first=True)
        told.state[RATE] = turns[now] + bias + noise[0] * rng.normal(size=3)
        run(operations, k)
    found, odds = Posterior(bank).early()
    assert abs(found - age) < 0.003
    assert odds > 8 if age else odds < 1


@pytest.mark.parametrize("known", [{"age": 0.01}, {"dead_time": 0.01, "lag": 0.02}, {}])
def test_the_odds_of_a_delay_are_those_of_the_whole_grid(vehicle, known):
    """Between two looks at the whole of it, a few ages tell the same."""
    posterior = Posterior(flown(vehicle, **known))
    whole, few = posterior.evidence(), posterior.evidence()
    np.testing.assert_allclose([few.late, few.slow], [whole.late, whole.slow], rtol=0.05, atol=0.2)
