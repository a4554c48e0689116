"""Inertial sensors and their aids: readings of known motions, their noise, when a fix comes, what is compared."""

from dataclasses import replace
from itertools import groupby

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.physics.state import RATE
from quadexp.plugins.worlds import error_state
from quadexp.plugins.worlds.gnss import ImuGnss
from quadexp.plugins.worlds.inertial import Aid, means, read, sample
from quadexp.plugins.worlds.motion_capture import ImuMocap
from tests.plugins.worlds.aided_flights import GRAVITY, AidedRun, motion, standing
from tests.states import random_state


def means_between(before: np.ndarray, after: np.ndarray, duration: float) -> np.ndarray:
    return np.array(ca.DM(means(ca.DM(before), ca.DM(after), duration, GRAVITY)).full()).ravel()


def test_at_rest_it_reads_gravity_upwards_in_body_axes():
    x = standing(np.zeros(1))[0]
    tilted = Rotation.from_euler("xyz", [0.3, -0.5, 2.0])
    x[3:7] = tilted.as_quat(scalar_first=True)
    assert np.allclose(means_between(x, x, 0.01), [*tilted.inv().apply([0, 0, GRAVITY]), 0, 0, 0])


def test_in_free_fall_it_reads_nothing():
    before, after = standing(np.zeros(2))
    after[9] -= GRAVITY * 0.01
    assert np.allclose(means_between(before, after, 0.01), 0, atol=1e-12)


def test_a_motion_is_read_to_second_order_in_the_interval():
    """Against the specific force R'(a - g) and the rates at the middle of the interval, with a from finite
    differences; a quarter of the interval leaves a sixteenth of the difference."""
    found = []
    for h in (0.04, 0.01):
        t = 0.7 + np.array([-h / 2, -1e-5, 0, 1e-5, h / 2])
        before, near, middle, beyond, after = motion(t, seed=5)
        force = (beyond[7:10] - near[7:10]) / 2e-5 + [0, 0, GRAVITY]
        truth = np.r_[Rotation.from_quat(middle[3:7], scalar_first=True).inv().apply(force), middle[RATE]]
        found.append(np.abs(means_between(before, after, h) - truth))
    assert found[1].max() < 0.02
    assert np.allclose(found[0] / found[1], 16, rtol=0.1)


def test_noise_and_walk_have_the_stated_densities():
    """Mean square of white noise over an interval h: density^2 / h; of a walk after t: density^2 t."""
    densities, h, runs, steps = np.array([2e-3, 1.7e-4, 3e-3, 1.9e-5]), 0.005, 400, 100
    symbols = [ca.SX.sym("b", 6), ca.SX.sym("n", 12)]
    one = ca.Function("read", symbols, list(read(ca.SX.zeros(6), symbols[0], h, symbols[1], ca.DM(densities))))
    noise, bias, white = np.random.default_rng(1).standard_normal((steps, 12, runs)), np.zeros((6, runs)), []
    for k in range(steps):
        reading, after = one(bias, noise[k])
        white.append(np.array(reading.full()) - bias)
        bias = np.array(after.full())
    spread = np.sqrt(np.mean(np.square(white), axis=(0, 2))).reshape(2, 3).mean(1)
    assert np.allclose(spread, densities[:2] / np.sqrt(h), rtol=0.02)
    assert np.allclose(
        np.sqrt(np.mean(bias.reshape(2, -1) ** 2, axis=1)), densities[2:] * np.sqrt(steps * h), rtol=0.08
    )


def test_biases_are_drawn_for_every_flight_and_read():
    sensors = ImuMocap(
        accelerometer_noise_density=0, gyroscope_noise_density=0, accelerometer_bias_walk=0, gyroscope_bias_walk=0
    )
    run = AidedRun(sensors)
    states = standing(np.arange(11))
    drawn = []
    for seed in range(200):
        run.go(states, seed)
        assert np.allclose(run.reading[-1], run.bias[-1, :3] + [0, 0, GRAVITY])
        drawn.append(run.bias[-1])
    spread = np.sqrt(np.mean(np.square(drawn).reshape(-1, 2, 3), axis=(0, 2)))
    assert np.allclose(spread, [sensors.accelerometer_bias_std, sensors.gyroscope_bias_std], rtol=0.1)


AIDS = [*ImuMocap().aids, *ImuGnss().aids]
each_aid = pytest.mark.parametrize("aid", AIDS, ids=[aid.name for aid in AIDS])


def taken(aid: Aid, durations: np.ndarray, seed: int = 0) -> np.ndarray:
    """Whether a fix comes at the end of each interval (s)."""
    symbols = [ca.SX.sym("clock", 2), ca.SX.sym("h"), ca.SX.sym("n")]
    found = ca.Function("sample", symbols, list(sample(*symbols, ca.DM(aid.sampling())))[::-1])
    noise = np.random.default_rng(seed).standard_normal(len(durations))
    _, comes = found.mapaccum(len(durations))(np.zeros(2), durations[None], noise[None])
    return np.array(comes.full()).ravel()


@pytest.mark.parametrize("rate", [100.0, 77.0, 33.3, 10.0])
def test_fixes_come_at_their_rate_whether_it_divides_the_imus_or_not(rate):
    """The k-th fix is at the first reading at or after k / rate."""
    times = np.arange(1, 2001) * 0.005
    comes = taken(replace(AIDS[0], rate=rate, dropout=0.0), np.full(2000, 0.005))
    due = np.arange(1, int(10 * rate + 1e-9) + 1) / rate
    expected = times[np.searchsorted(times, due - 1e-9)]
    assert np.allclose(times[comes > 0], expected)


@pytest.mark.parametrize(("share", "outage"), [(0.3, 0.0), (0.1, 0.2), (0.5, 1.0)])
def test_the_stated_share_of_fixes_is_lost_in_outages_of_the_stated_length(share, outage):
    aid = replace(AIDS[0], rate=100.0, dropout=share, outage=outage)
    comes = taken(aid, np.full(200_000, 0.01))
    lengths = [len(list(group)) for lost, group in groupby(comes == 0) if lost]
    assert np.isclose(1 - comes.mean(), share, rtol=0.1)
    assert np.isclose(np.mean(lengths), max(outage * 100, 1 / (1 - share)), rtol=0.1)


@each_aid
def test_innovations_and_their_derivatives(aid):
    """At any attitude, also nose up: none at the truth, and of a small error H times the error."""
    rng = np.random.default_rng(2)
    nominal, x, fix = ca.SX.sym("n", 16), ca.SX.sym("x", 13), ca.SX.sym("f", aid.size)
    d = ca.SX.sym("d", 15)
    exact = ca.Function("exact", [x], [aid.measure(x, ca.SX.zeros(aid.noise), ca.DM(aid.deviations))])
    values = [one.value for one in aid.compare(nominal, fix)]
    seen = ca.Function("seen", [nominal, fix], [ca.vertcat(*values)])
    told = [sum(c * d[i] for i, c in one.row.items()) for one in aid.compare(nominal, fix)]
    H = ca.Function("H", [nominal], [ca.jacobian(ca.vertcat(*told), d)])
    for k in range(10):
        state = random_state(rng)
        if k == 0:
            state[3:7] = Rotation.from_euler("y", -np.pi / 2).as_quat(scalar_first=True)
        true, error = np.r_[state[:10], rng.normal(size=6)], 1e-5 * rng.normal(size=15)
        away = error_state.inject(ca.DM(true), ca.DM(-error))
        assert np.allclose(seen(true, exact(state)).full(), 0, atol=1e-12)
        assert np.allclose(seen(away, exact(state)).full().ravel(), H(away).full() @ error, atol=2e-9)


@each_aid
def test_innovations_have_the_stated_deviations_and_are_independent(aid):
    rng = np.random.default_rng(3)
    state = random_state(rng)
    nominal, noise = ca.DM(np.r_[state[:10], np.zeros(6)]), ca.SX.sym("n", aid.noise)
    found = aid.compare(nominal, aid.measure(ca.DM(state), noise, ca.DM(aid.deviations)))
    function = ca.Function("f", [noise], [ca.vertcat(*(one.value for one in found))])
    values = np.array(function(rng.standard_normal((aid.noise, 20_000))).full())
    stated = np.diag([aid.deviations[one.deviation] for one in found])
    normal = np.linalg.solve(stated, values)
    assert np.allclose(normal @ normal.T / 20_000, np.eye(len(found)), atol=0.03)


def test_heading_tells_nothing_of_tilt():
    """The vehicle tilts further about north or east: no innovation beyond the second order."""
    aid, q = AIDS[2], Rotation.from_euler("xyz", [0.4, -0.3, 1.1])
    for axis in ([1, 0, 0], [0, 1, 0]):
        tilted = Rotation.from_rotvec(1e-4 * np.array(axis)) * q
        state = np.r_[np.zeros(3), tilted.as_quat(scalar_first=True), np.zeros(6)]
        fix = aid.measure(ca.DM(state), ca.DM.zeros(1), ca.DM(aid.deviations))
        nominal = ca.DM(np.r_[np.zeros(3), q.as_quat(scalar_first=True), np.zeros(9)])
        assert abs(float(aid.compare(nominal, fix)[0].value)) < 1e-7
