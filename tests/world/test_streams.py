"""Noise is a function of time: white and normal, drawn in its time, the same at every control rate and step."""

import math

import numpy as np
import pytest

from quadexp.physics.state import RATE, VELOCITY
from quadexp.plugins.worlds.dryden import N_FILTER, Dryden
from quadexp.plugins.worlds.motion_capture import ImuMocap
from quadexp.world.link import Latency
from quadexp.world.sensors import Sensors
from quadexp.world.simplified import PlantEffects, SimplifiedPlant
from quadexp.world.stated_estimate import StatedEstimate
from quadexp.world.streams import BLOCK, TICK, Held, Sampled, Streams, Ticking, part_stream
from quadexp.world.world import World


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


@pytest.mark.parametrize("periods", [1, 127, 128, 300])
def test_no_more_is_drawn_than_a_flight_needs_and_it_is_the_same(periods):
    """What comes behind the end, where a flight goes on all the same, is drawn too."""
    period = 1 / 60
    drawn = [Held(2, (0.0, 5e-3, period)), Ticking(1, 5e-3, period), Sampled(3, (0.0, 2e-3))]
    found = []
    for duration in (0.0, periods * period):
        streams = Streams([(np.random.default_rng(i), one) for i, one in enumerate(drawn)], period, duration)
        numbers = np.empty((periods + 5, streams.size))
        for row in numbers[:periods]:
            streams.standard_normal(out=row)
        assert streams.end == (periods if duration else BLOCK * math.ceil(periods / BLOCK))
        for row in numbers[periods:]:
            streams.standard_normal(out=row)
        found.append(numbers)
    assert np.allclose(*found, rtol=0, atol=1e-9)


def test_parts_have_streams_of_their_own_and_leave_the_generator_alone():
    rng = np.random.default_rng(4)
    before = rng.bit_generator.state
    first, other = part_stream(rng, "wind").random(4), part_stream(rng, "link").random(4)
    assert rng.bit_generator.state == before and np.array_equal(first, part_stream(rng, "wind").random(4))
    assert not np.array_equal(first, other) and not np.array_equal(first, np.random.default_rng(4).random(4))
    (child,) = rng.spawn(1)
    assert not np.array_equal(part_stream(child, "wind").random(4), first)


REST = np.r_[np.zeros(3), 1, np.zeros(9)]
ROUGH = PlantEffects((0.0,) * 3, (0.0,) * 3, 0.0)
RATES_AND_STEPS = [(50, 5e-4), (60, 5e-4), (100, 5e-4), (300, 5e-4), (500, 5e-4), (50, 2.5e-4), (50, 1e-3), (73, 7e-4)]


def flown(vehicle, effects, observe, rate, step, seconds=3.0):
    """observe(world, state) every 0.1 s or, at rates that do not meet it, every second; from the same seed."""
    world = World(SimplifiedPlant(vehicle, effects[0], step=step, backend="interpreted"), effects[1:] or [Latency()])
    noise, x, rows = world.begin(REST, 1 / rate, seconds, np.random.default_rng(3)), REST, []
    for k in range(1, round(seconds * rate) + 1):
        x, _ = world.advance(x, np.full(vehicle.n_rotors, vehicle.hover_thrust), 1 / rate, noise)
        if k % (rate // 10 if rate % 10 == 0 else rate) == 0:
            rows.append([k / rate, *observe(world, x)])
    return np.array(rows)


PARTS = {
    "plant": ([ROUGH], lambda world, x: x[[*range(*VELOCITY.indices(13)), *range(*RATE.indices(13))]]),
    # its filters: the wind of the last step is that of its beginning, which is another tick where steps are longer
    "wind": ([ROUGH, Dryden(velocity=(4.0, 0.0, 0.0), airspeed=8.0)], lambda world, x: world.inner[:N_FILTER]),
    "estimate": (
        [ROUGH, StatedEstimate(position_noise=0.1, velocity_noise=0.2, rate_noise=0.3)],
        lambda world, x: (world.measured - x)[[0, 1, 7, 8, 10]],
    ),
    "sensors": (
        [ROUGH, Sensors(gyroscope_noise=0.1, gyroscope_bias_walk=0.1, position_noise=(0.1,) * 3, velocity_drift=0.3)],
        lambda world, x: (world.measured - x)[[0, 1, 7, 8, 10, 11]],
    ),
    "readings on their way": (
        [ROUGH, Sensors(position_drift=0.3, pose_rate=50, pose_delay=0.003, pose_jitter=0.03, pose_drop=0.2)],
        lambda world, x: [world.inner[world.columns(1 / 50)["taken_position"]]],
    ),
    "walk": ([ROUGH, ImuMocap(accelerometer_bias_walk=0.1)], lambda world, x: world.inner[:3]),
}


@pytest.mark.parametrize("part", PARTS)
def test_every_rate_and_step_meets_the_same_noise(vehicle, part):
    effects, observe = PARTS[part]
    first, *others = (flown(vehicle, effects, observe, rate, step) for rate, step in RATES_AND_STEPS)
    for (rate, step), other in zip(RATES_AND_STEPS[1:], others, strict=True):
        common = first[np.isin(first[:, 0].round(9), other[:, 0].round(9))]
        assert len(common) == len(other) >= 3
        spread = first[:, 1:].std(axis=0)
        off = np.abs(common - other)[:, 1:].max(axis=0) / spread  # of the plant: by longer integration steps
        assert off.max() < (5e-3 if part == "plant" else 1e-6), (rate, step)


def test_a_jitter_is_that_of_the_time_at_which_a_command_is_sent(vehicle):
    """Commands of 50 Hz are among those of 100 Hz: they take as long."""
    arrivals = []
    for rate in (50, 100):
        link = Latency(latency=0.001, jitter=0.008, drop=0.1)
        world = World(SimplifiedPlant(vehicle, PlantEffects.none(), backend="interpreted"), [link])
        noise, x, found = world.begin(REST, 1 / rate, 1.0, np.random.default_rng(3)), REST, {}
        for k in range(rate):
            x, _ = world.advance(x, np.full(vehicle.n_rotors, 2.0), 1 / rate, noise)
            found[round(k / rate, 6)] = world.inner[2 * vehicle.n_rotors]
        arrivals.append(found)
    one, two = arrivals
    assert one == pytest.approx({t: two[t] for t in one}, abs=1e-9) and len({*one.values()}) > 20
