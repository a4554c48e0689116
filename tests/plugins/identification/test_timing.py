"""The search for delays: its sums against the samples."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.control.control_step import run
from quadexp.physics.state import ATTITUDE, VELOCITY
from quadexp.plugins.identification.moments import BEGINS, ROUND, SPAN, Moments, Stream, half_of
from quadexp.plugins.identification.timing import LARGEST, SMALL_STEP, Search
from quadexp.plugins.remedies.sent_commands import SentCommands

PERIOD = 0.02


@pytest.fixture
def stream(rng) -> Stream:
    """Told and sent at random, smooth."""
    t = PERIOD * np.arange(260)

    def waves(n):
        phases, rates = rng.uniform(0, 6, (5, n)), rng.uniform(0.5, 9, (5, n))
        return np.sin(t[:, None, None] * rates + phases).sum(axis=1) / 3

    turns = Rotation.from_rotvec(0.4 * waves(3))
    state = np.hstack([waves(3), turns.as_quat(scalar_first=True), 4 * waves(3), waves(3)])
    force = np.array([0, 0, 9.8]) + 2 * waves(3) + 0.1 * rng.standard_normal((len(t), 3))
    return Stream(t, state, force, 2 + 0.6 * waves(4) + 0.2 * rng.standard_normal((len(t), 4)))


@pytest.mark.parametrize("at", [(0.013, 0.03, 0.008), (0.04, 0.0, 0.0), (0.0, 0.06, 0.05)])
def test_a_cost_by_sums_is_that_of_the_samples(vehicle, stream, at):
    """Against a regression on every sample, by numpy."""
    dead_time, lag, age = at
    search = Search(Moments(stream, vehicle))
    sent = SentCommands(4, PERIOD, (search.sizes.commands - 1) * PERIOD)
    sent.reset(stream.command[0])
    spans, J = np.array([[0.0, 0.0], [-PERIOD - age, -age]]), vehicle.inertia_matrix
    weights, designs, targets = sent.weights(spans, dead_time, lag), [], []
    for k in range(len(stream.t)):
        x, before = stream.state[k], stream.state[max(k - 1, 0)]
        v = Rotation.from_quat(x[ATTITUDE], scalar_first=True).inv().apply(x[VELOCITY])
        air = [1.0, *v, *(np.abs(v) * v)]
        total = sent.values.sum(axis=1) / vehicle.mass
        now, squares = weights[0] @ total, weights[0] @ total**2
        torque = vehicle.allocation[1:3] @ (weights[1] @ sent.values)
        needed = J @ (x[10:] - before[10:]) / PERIOD + np.cross(x[10:], J @ x[10:])
        designs.append(([*air, now, squares, now * stream.t[k]], [*air, torque[0]], [*air, torque[1]]))
        targets.append((stream.specific_force[k, 2], *needed[:2]))
        run(sent.after(stream.command[k]))
    first, cost = round(BEGINS / PERIOD), 0.0
    for i in range(3):
        X, y = np.array([one[i] for one in designs])[first:], np.array(targets)[first:, i]
        left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
        cost += len(y) * np.log(np.sqrt(np.mean(left**2)))
    assert search.cost(np.array(at)) == pytest.approx(cost, rel=1e-6)


def following(stream, vehicle, dead_time, lag) -> Stream:
    """The same, with the thrust of its commands in the reading of z but for noise of 0.01 m/s^2."""
    sent, late = SentCommands(4, PERIOD, dead_time + 8 * lag), []
    sent.reset(stream.command[0])
    weights = sent.weights(np.array([[0.0, 0.0]]), dead_time, lag)[0]
    for command in stream.command:
        late.append(weights @ sent.values.sum(axis=1) / vehicle.mass)
        run(sent.after(command))
    force = stream.specific_force.copy()
    force[:, 2] = late + 0.01 * np.random.default_rng(1).standard_normal(len(late))
    return replace(stream, specific_force=force)


@pytest.mark.parametrize("at", [(0.021, 0.03, 0.004), (0.013, 0.024, 0.004)])
def test_the_slopes_of_the_cost_are_its_derivatives(vehicle, stream, at):
    """Along dead time and lag, where the thrust follows the commands but for 0.01 m/s^2: 8 ms off the truth, and on it.

    Against central differences of the cost. Taken at the end of their step of 1 ms the slopes would be off by what the
    step changes them by, the normal matrix times it; they are held to a tenth of that."""
    search, found, h = Search(Moments(following(stream, vehicle, 0.013, 0.024), vehicle)), np.empty(2), 1e-5
    for i, step in enumerate(h * np.eye(3)[:2]):
        found[i] = (search.cost(np.array(at) + step) - search.cost(np.array(at) - step)) / (2 * h)
    cost, gradient, normal = search._slopes(np.array(at), (0, 1))
    assert cost == pytest.approx(search.cost(np.array(at)))
    assert (np.abs(gradient - found) < 0.1 * SMALL_STEP * np.diag(normal)).all()


def test_every_candidate_is_within_the_limits(vehicle, stream, monkeypatch):
    """Up to the step of a difference; also where a dead time and a lag, and so each alone, are nearly the largest."""
    tried, search = [], Search(Moments(following(stream, vehicle, 0.06, 0.03), vehicle))
    cost = search.cost
    monkeypatch.setattr(search, "cost", lambda at: (tried.append(at.copy()), cost(at))[1])
    found = search.find()
    assert (np.array(tried) >= 0).all() and (np.array(tried) <= LARGEST + SMALL_STEP + 1e-12).all()
    assert found.dead_time == pytest.approx(0.06, abs=2e-3) and found.lag == pytest.approx(0.03, abs=2e-3)


@pytest.mark.parametrize("shift", [0.0, 0.013, 0.02, 0.071])
def test_what_a_shift_leaves_is_that_of_the_samples(vehicle, stream, shift):
    """Readings linear in between, integrated over each period by quadrature, turned by the attitude in its middle."""
    search = Search(Moments(stream, vehicle))
    search.find()
    search._velocity._mean = np.zeros(search.sizes.commands + 1)
    q = stream.state[:, ATTITUDE]
    middle = Rotation.from_quat(q[1:] + q[:-1], scalar_first=True)
    fine = (np.arange(400) + 0.5) / 400 * PERIOD
    steps = np.zeros((len(q), 3))
    for k in range(1, len(q)):
        at = stream.t[k - 1] + fine - shift
        mean = [np.interp(at, stream.t, stream.specific_force[:, i]).mean() for i in range(3)]
        steps[k] = middle[k - 1].apply(mean) * PERIOD
    total, span = np.cumsum(steps, axis=0), round(SPAN / PERIOD)
    first, v = search.sizes.lags, stream.state[:, VELOCITY]
    fallen = [0, 0, vehicle.gravity * PERIOD * span]
    error = (fallen + v[span:] - v[:-span] - total[span:] + total[:-span])[first:]
    at = Rotation.from_quat(q[first + span // 2 :][: len(error)], scalar_first=True)
    left = np.var(at.inv().apply(error), axis=0)
    assert search._velocity.left(shift) == pytest.approx(left, rel=1e-6)


def test_half_the_samples_are_half_of_the_sums(vehicle, stream):
    """What is kept of the first half is what a shorter flight has."""
    moments = Moments(stream, vehicle)
    count, *halves = moments.half
    until = len(stream.t) - moments.spans + count
    part = Moments(Stream(*(values[:until] for values in vars(stream).values())), vehicle)
    assert part.spans == count and abs(2 * count - moments.spans) <= ROUND
    for ours, theirs in zip((part.velocity, part.attitude), halves, strict=True):
        assert (ours[:, -1, -1] == count).all()
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12 * np.abs(ours).max())  # sums in another order


def test_the_half_is_one_to_an_eighth_of_it():
    assert all(abs(half_of(n) - n / 2) <= max(n / 16, ROUND / 2) for n in range(20_000))
