"""Worlds around an airframe: by independent means, on three airframes each.

A wind is a moving frame; a latency is a shift of the commands; a delay is a shift of the states. The same seed gives
each part its own numbers, whatever else is switched on.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from quadexp.physics.state import ATTITUDE, POSITION, VELOCITY
from quadexp.plugins.worlds.battery import Battery
from quadexp.world.actuator import Actuator
from quadexp.world.constant_wind import ConstantWind
from quadexp.world.link import Latency
from quadexp.world.stated_estimate import StatedEstimate
from quadexp.world.streams import part_stream
from quadexp.world.world import World
from tests.world.airframes import AIRFRAMES, PERIOD, STEP, airframe, commands, fly, sampled, start


@pytest.mark.parametrize("kind", AIRFRAMES)
def test_a_constant_wind_is_a_moving_frame(vehicle, kind):
    """Seen from the moving frame, the flight in the wind is the flight in still air, accelerometer included."""
    wind, x = np.array([4.0, -2.0, 1.0]), start()
    plant = airframe(kind, vehicle)
    world = World(airframe(kind, vehicle), [ConstantWind(velocity=tuple(wind))])
    moving = x.copy()
    moving[VELOCITY] -= wind
    u = commands(vehicle, 40)
    still, felt, _ = fly(plant, moving, u)
    windy, reading, _ = fly(world, x, u)
    t = PERIOD * np.arange(len(still))[:, None]
    windy[:, POSITION] -= wind * t
    windy[:, VELOCITY] -= wind
    assert np.abs(windy - still).max() < 1e-9 and np.abs(reading - felt).max() < 1e-8
    assert np.abs(still[-1, VELOCITY] - moving[VELOCITY]).max() > 0.3  # it did fly


IDLE = {
    "no part": ([Latency(), ConstantWind(), StatedEstimate()], 1e-12),
    "motors": ([Actuator()], 1e-9),  # without lag, limits or spread
    "battery": ([Battery(resistance=0.0, rc_resistance=0.0, capacity=1000.0)], 1e-5),
}


@pytest.mark.parametrize("kind", AIRFRAMES)
@pytest.mark.parametrize("effects", IDLE)
def test_effects_that_do_nothing_change_nothing(vehicle, kind, effects):
    u, x = commands(vehicle, 10), start(3)
    effects, off = IDLE[effects]
    flown, readings, told = fly(World(airframe(kind, vehicle), effects), x, u)
    expected, felt, _ = fly(airframe(kind, vehicle), x, u)
    assert np.abs(flown - expected).max() < off and np.abs(readings - felt).max() < 100 * off
    assert np.array_equal(told, flown)


@pytest.mark.parametrize("kind", AIRFRAMES)
@pytest.mark.parametrize("late", [1, 2, 3])
def test_a_latency_of_whole_periods_shifts_the_commands(vehicle, kind, late):
    u, x = commands(vehicle, 15), start(1)
    world = World(airframe(kind, vehicle), [Latency(latency=late * PERIOD)])
    shifted = np.concatenate([np.full((late, vehicle.n_rotors), vehicle.hover_thrust), u[:-late]])
    assert np.abs(fly(world, x, u)[0] - fly(airframe(kind, vehicle), x, shifted)[0]).max() < 1e-12


@pytest.mark.parametrize("latency", [0.0003, 0.007, 0.0134, 0.031])
def test_a_latency_below_a_period_is_exact(vehicle, latency):
    """Against the same airframe commanded every integration step, with the commands shifted and averaged by hand."""
    plant = airframe("simplified", vehicle, noise=False)
    plant.effects = replace(plant.effects, torque_noise_density=0.0)
    plant._parameters = plant.effects.parameters()
    u, x, steps = commands(vehicle, 12), start(2), round(PERIOD / STEP)
    world = fly(World(plant, [Latency(latency=latency)]), x, u)[0]
    fine = np.repeat(u, steps, axis=0)
    late, share = divmod(latency / STEP + 1e-9, 1)
    fine = np.concatenate([np.full((int(late) + 1, vehicle.n_rotors), vehicle.hover_thrust), fine])
    fine = ((1 - share) * fine[1:] + share * fine[:-1])[: len(u) * steps]
    plant.reset()
    for k, command in enumerate(fine):
        if k % steps == 0:
            assert np.abs(x - world[k // steps]).max() < 1e-9
        x, _ = plant.advance(x, command, STEP, np.random.default_rng(0))


def test_jitter_and_loss_as_a_list_of_messages_has_them(vehicle):
    """The newest command that has arrived is flown; what was overtaken is ignored: by an event list in plain Python."""
    latency, jitter, drop, n = 0.004, 0.05, 0.3, vehicle.n_rotors
    link = Latency(latency=latency, jitter=jitter, drop=drop)
    plant = airframe("simplified", vehicle, noise=False)
    plant._parameters = replace(plant.effects, torque_noise_density=0.0).parameters()
    u, x, steps = commands(vehicle, 60), start(4), round(PERIOD / STEP)
    world = fly(World(plant, [link]), x, u, seed=7)[0]

    from scipy.stats import norm

    draws = sampled(part_stream(np.random.default_rng(7), "link 0"), PERIOD * np.arange(len(u)), 2)
    arrival = PERIOD * np.arange(len(u)) + latency + jitter * norm.cdf(draws[:, 0])
    arrival[norm.cdf(draws[:, 1]) < drop] = np.inf
    finite = arrival[np.isfinite(arrival)]
    assert (np.diff(finite) < 0).sum() > 3 and 5 < np.isinf(arrival).sum() < 40  # some are overtaken, some are lost
    plant.reset()
    for k in range(len(u) * steps):
        if k % steps == 0:
            assert np.abs(x - world[k // steps]).max() < 1e-9
        inside = arrival[(arrival > k * STEP) & (arrival < (k + 1) * STEP)]
        command, edges = 0, [k * STEP, *np.sort(inside), (k + 1) * STEP]
        for begin, end in pairwise(edges):
            come = np.flatnonzero(arrival <= begin + 1e-9)
            newest = u[come[-1]] if len(come) else np.full(n, vehicle.hover_thrust)
            command += (end - begin) / STEP * newest
        x, _ = plant.advance(x, command, STEP, np.random.default_rng(0))


@pytest.mark.parametrize("kind", AIRFRAMES)
def test_a_late_estimate_is_an_earlier_state(vehicle, kind):
    u, x = commands(vehicle, 12), start(5)
    world = World(airframe(kind, vehicle), [StatedEstimate(delay=2 * PERIOD)])
    states, _, told = fly(world, x, u)
    assert np.array_equal(told[2:], states[:-2]) and np.array_equal(told[:2], states[[0, 0]])


@pytest.mark.parametrize("kind", AIRFRAMES)
@pytest.mark.parametrize("delay", [0.007, PERIOD, 2 * PERIOD])
def test_a_fresh_gyroscope_beside_a_late_pose(vehicle, kind, delay):
    """Only the rate differs from the estimate that is late as a whole, and it is that of now."""
    u, x = commands(vehicle, 12), start(5)
    estimates = (StatedEstimate(delay=delay, gyro=gyro) for gyro in ("late", "fresh"))
    late, fresh = (fly(World(airframe(kind, vehicle), [one]), x, u) for one in estimates)
    assert np.array_equal(fresh[0], late[0]) and np.array_equal(fresh[2][:, :10], late[2][:, :10])
    assert np.array_equal(fresh[2][:, 10:], fresh[0][:, 10:])
    assert np.abs(fresh[2][3:, 10:] - late[2][3:, 10:]).max() > 1e-3


@pytest.mark.parametrize(("delay", "off"), [(0.0003, 1e-5), (0.007, 1e-9), (0.0344, 1e-5)])
def test_a_delay_is_exact_whatever_the_integration_step(vehicle, delay, off):
    """Against the same commands on control periods of a tenth of an integration step."""
    u, x = commands(vehicle, 12), start(6)
    plant = airframe("simplified", vehicle, noise=False)
    plant._parameters = replace(plant.effects, torque_noise_density=0.0).parameters()
    _, _, told = fly(World(plant, [StatedEstimate(delay=delay)]), x, u)
    tenth, fine = STEP / 10, [x]
    steps = round(PERIOD / tenth)
    for command in np.repeat(u, steps, axis=0):
        fine.append(plant.advance(fine[-1], command, tenth, np.random.default_rng(0))[0])
    for k in range(1, len(u) + 1):
        assert np.abs(told[k] - fine[max(k * steps - round(delay / tenth), 0)]).max() < off


def test_the_noise_of_an_estimate_is_as_stated(vehicle):
    stated = StatedEstimate(position_noise=0.005, velocity_noise=0.03, attitude_noise=0.01, rate_noise=0.05)
    world = World(airframe("simplified", vehicle), [stated])
    states, _, told = fly(world, start(), commands(vehicle, 400))
    found = (told - states)[1:]
    w, v = states[1:, 3:4], states[1:, 4:7]
    turned = w * told[1:, 4:7] - told[1:, 3:4] * v - np.cross(v, told[1:, 4:7])  # vector part of q^-1 o q^
    for noise, std in (
        (found[:, POSITION], 0.005),
        (found[:, VELOCITY], 0.03),
        (found[:, 10:], 0.05),
        (2 * turned, 0.01),
    ):
        assert np.abs(noise.std(axis=0) / std - 1).max() < 4 / np.sqrt(2 * len(noise))
        assert np.abs(noise.mean(axis=0)).max() < 4 * std / np.sqrt(len(noise))
    assert np.abs(np.linalg.norm(told[:, ATTITUDE], axis=1) - 1).max() < 1e-12


def test_switching_a_part_on_changes_no_other_part(vehicle):
    """The airframe's noise and the estimate's are the same with and without a link that draws."""
    u, x = commands(vehicle, 20), start()
    stated = StatedEstimate(position_noise=0.1)
    alone = fly(World(airframe("simplified", vehicle), [stated]), x, u)
    lossy = Latency(drop=1e-12)  # which draws, and loses nothing
    both = fly(World(airframe("simplified", vehicle), [stated, lossy]), x, u)
    clean = fly(airframe("simplified", vehicle), x, u)
    assert np.abs(alone[0] - both[0]).max() < 1e-12 and np.abs(alone[2] - both[2]).max() < 1e-12
    assert np.abs(alone[0] - clean[0]).max() < 1e-12 and np.abs(alone[2] - alone[0])[1:, 0].min() > 0
