"""Random numbers by time: what is drawn is white and normal, and comes in its time."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.world.streams import TICK, Held, Sampled, Ticking, part_stream


@pytest.mark.parametrize("bounds", [(0.0, 5e-4), (0.0, 2e-4, 1.7e-3, 2e-3), (0.0, 1 / 60), (0.0, 3.1e-3, 0.0123)])
def test_means_of_held_noise_add_up_to_one_path(bounds):
    """Whatever the intervals: sqrt(h) times the mean is the path between their ends, which is linear within ticks."""
    blocks, period = 3, bounds[-1]
    take = Held(2, bounds).begin(np.random.default_rng(1))
    found = []
    for block in range(blocks):
        begins = period * np.arange(40 * block, 40 * block + 41)
        found.append(take(begins[:-1], begins[-1]).reshape(-1, 2))
    ends = (period * np.arange(40 * blocks)[:, None] + bounds[1:]).ravel()
    path = np.cumsum(np.concatenate(found) * np.sqrt(np.tile(np.diff(bounds), 40 * blocks))[:, None], axis=0)
    ticks = np.random.default_rng(1).standard_normal((round(ends[-1] / TICK) + 2, 2))
    corners = np.concatenate([np.zeros((1, 2)), np.cumsum(np.sqrt(TICK) * ticks, axis=0)])
    for i in range(2):
        assert path[:, i] == pytest.approx(np.interp(ends, TICK * np.arange(len(corners)), corners[:, i]), abs=1e-9)


@pytest.mark.parametrize("rate", [60, 300, 1000])
def test_every_tick_comes_once_and_in_its_time(rate):
    ticking = Ticking(2, 5e-3, 1 / rate)
    begins = np.arange(rate + 1) / rate
    found = ticking.begin(np.random.default_rng(2))(begins[:-1], begins[-1]).reshape(rate, ticking.slots, 3)
    there = found[..., 0] < 2.0
    assert found[there][:, 0] == pytest.approx(5e-3 * np.arange(1, 200), abs=1e-12)
    inside = (found[..., 0] >= begins[:-1, None] - 1e-9) & (found[..., 0] < begins[1:, None] - 1e-9)
    assert (inside == there).all()
    assert np.array_equal(found[there][:, 1:], np.random.default_rng(2).standard_normal((199, 2)))


def test_sampled_numbers_are_independent_and_normal():
    n = 200_000
    x = Sampled(3, (0.0,)).begin(part_stream(np.random.default_rng(0), "any"))(TICK * np.arange(n), 0.0)
    moments = [(x**k).mean(axis=0) for k in (1, 2, 3, 4)]
    for moment, wanted, spread in zip(moments, (0, 1, 0, 3), (1, 2, 15, 96), strict=True):
        assert moment == pytest.approx(np.full(3, wanted), abs=4.5 * np.sqrt(spread / n))
    for lag in (0, 1, 2, 40):  # 40: 50 Hz
        found = x[: n - lag].T @ x[lag:] / (n - lag)
        assert found == pytest.approx(np.eye(3) * (lag == 0), abs=4.5 * np.sqrt(2 / n))
    one = Sampled(3, (0.0,)).begin(part_stream(np.random.default_rng(1), "any"))(TICK * np.arange(n), 0.0)
    assert np.abs((x * one).mean(axis=0)).max() < 4.5 / np.sqrt(n)


def test_parts_have_streams_of_their_own_and_leave_the_generator_alone():
    rng = np.random.default_rng(4)
    before = rng.bit_generator.state
    first, other = part_stream(rng, "wind").random(4), part_stream(rng, "link").random(4)
    assert rng.bit_generator.state == before and np.array_equal(first, part_stream(rng, "wind").random(4))
    assert not np.array_equal(first, other) and not np.array_equal(first, np.random.default_rng(4).random(4))
    (child,) = rng.spawn(1)
    assert not np.array_equal(part_stream(child, "wind").random(4), first)
