"""Noise is a function of time: the same at every control rate and integration step."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.physics.state import RATE, VELOCITY
from quadexp.world.dryden import Dryden
from quadexp.world.link import Latency
from quadexp.world.motion_capture import ImuMocap
from quadexp.world.sensors import Sensors
from quadexp.world.simplified import PlantEffects, SimplifiedPlant
from quadexp.world.stated_estimate import StatedEstimate
from quadexp.world.world import World

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
    "wind": ([ROUGH, Dryden(velocity=(4.0, 0.0, 0.0), airspeed=8.0)], lambda world, x: world.inner[-3:]),
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
