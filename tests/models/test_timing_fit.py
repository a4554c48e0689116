"""Motor lag and delays found in flights of known worlds, with and without rotor speeds, noise, sag and spread."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quadexp.log.schema import Flight
from quadexp.models.dataset import as_told, residual_dataset, transitions
from quadexp.models.rotor_thrust import Timing, fit_timing, mean_thrust
from quadexp.physics.state import ATTITUDE, RATE, STATE_COLUMNS
from quadexp.world.actuator import Actuator
from quadexp.world.battery import Battery
from quadexp.world.link import Latency
from quadexp.world.simplified import PlantEffects, SimplifiedPlant
from quadexp.world.stated_estimate import StatedEstimate
from quadexp.world.world import World

PERIOD, K = 0.02, 1e-5  # s; N s^2
UP, DOWN = 0.0125, 0.025  # s


def wandering(vehicle, effects, *, seconds=5.0, seed=0):
    """A flight under held random commands, kept upright by a gentle feedback of attitude and rates."""
    plant = SimplifiedPlant(vehicle, PlantEffects(), step=1e-3, backend="interpreted")
    world, rng = World(plant, effects), np.random.default_rng(seed)
    x = np.r_[np.zeros(3), 1, np.zeros(9)]
    streams = world.begin(x, PERIOD, seconds, rng)
    draw = np.random.default_rng([seed, 1])
    mix, places = np.linalg.pinv(vehicle.allocation), world.columns(PERIOD)
    rows = []
    for _ in range(int(seconds / PERIOD)):
        told = world.measured
        angle = -3.0 * told[ATTITUDE][1:] - 2.0 * told[RATE] + draw.normal(0.0, 4.0, 3)
        wrench = [vehicle.mass * vehicle.gravity * draw.uniform(0.7, 1.35), *(vehicle.inertia_matrix @ angle)]
        u = np.clip(mix @ wrench, 0.05 * vehicle.thrust_max, vehicle.thrust_max)
        rows.append(np.concatenate([x, told, u, world.inner[list(places.values())]]))
        x, _ = world.advance(x, u, PERIOD, streams)
    names = [*STATE_COLUMNS, *(f"est_{name}" for name in STATE_COLUMNS), *(f"u_{i}" for i in range(4)), *places]
    columns = {"t": PERIOD * np.arange(len(rows))} | dict(zip(names, np.array(rows).T, strict=True))
    return as_told(Flight(columns, {}))


def fitted(vehicle, effects, **options):
    flights = [wandering(vehicle, effects, seed=seed, **options) for seed in range(2)]
    return fit_timing(flights, vehicle, [transitions(flight, vehicle) for flight in flights]), flights


@pytest.fixture(scope="module")
def clean(vehicle):
    """What remains of flights whose commands act at once."""
    return np.array(fitted(vehicle, [Latency()])[0].after)


LAGGING = Actuator(time_constant_up=UP, time_constant_down=DOWN)


def test_where_commands_act_at_once_they_stay(vehicle):
    found, flights = fitted(vehicle, [Latency()])
    assert found.timing == Timing() and found.before == found.after
    assert "no motor lag" in found.line
    known = replace(vehicle, thrust_coefficient=K)
    assert fitted(known, [Actuator()])[0].timing == Timing()  # rotor speeds that say the same as the commands
    assert np.array_equal(mean_thrust(flights[0], vehicle, found.timing), flights[0].input[:-1])


@pytest.mark.parametrize(
    ("effects", "lags", "kind", "delay"),
    [
        ([LAGGING], (UP, DOWN), "rotor_speed", 0.0),
        ([Actuator(time_constant_up=0.03, time_constant_down=0.03, lag_of="thrust")], (0.03, 0.03), "thrust", 0.0),
        ([Latency(latency=0.025)], (0.0, 0.0), None, 0.025),
        ([LAGGING, Latency(latency=0.008)], (UP, DOWN), "rotor_speed", 0.008),
        ([LAGGING, StatedEstimate(delay=0.01)], (UP, DOWN), "rotor_speed", 0.01),
    ],
    ids=["up and down", "thrust", "latency", "lag and latency", "lag and late estimate"],
)
def test_the_lag_and_the_delay_are_found_by_what_remains(vehicle, clean, effects, lags, kind, delay):
    """Without rotor speeds a late estimate is as a late command; with what is found the noise of the plant remains."""
    found, _ = fitted(vehicle, effects)
    timing = found.timing
    assert not timing.measured and timing.state_delay == 0
    # a loss that goes with the thrust squared makes a jump within a transition look like a lag of half a millisecond
    assert (timing.lag_up, timing.lag_down) == pytest.approx(lags, rel=0.04, abs=6e-4)
    assert timing.delay == pytest.approx(delay, abs=6e-4) and kind in (None, timing.lag_of)
    assert np.all(np.array(found.after) < 1.3 * clean)
    assert found.before[0] > 5 * found.after[0]


@pytest.mark.parametrize(
    "effects",
    [
        [LAGGING, Latency(latency=0.008)],
        [LAGGING, Battery(), Latency(latency=0.008)],
        [replace(LAGGING, rotor_scale_std=0.05, flight_scale_std=0.05), Battery(), Latency(latency=0.008)],
    ],
    ids=["lag", "battery", "battery and spread"],
)
def test_rotor_speeds_say_what_the_rotors_delivered(vehicle, clean, effects):
    """Whatever scale and voltage do; a late state is then told from late commands. A scale of c_t, which no speed
    shows, stays in the residual."""
    vehicle = replace(vehicle, thrust_coefficient=K)
    found, _ = fitted(vehicle, [*effects, StatedEstimate(delay=0.012)])
    assert found.timing.measured and found.timing.lag_of == "rotor_speed"
    assert (found.timing.lag_up, found.timing.lag_down) == pytest.approx((UP, DOWN), rel=0.05)
    # behind a battery the speeds that are logged are those of the middle of the last integration step, of 1 ms
    assert found.timing.delay == pytest.approx(0.008, abs=8e-4)
    # a vehicle's scale is in no speed: over four pairs of flights the delay is then 11.2 to 11.4 ms, without it 11.4
    assert found.timing.state_delay == pytest.approx(0.012, abs=1e-3)
    spread = max(getattr(effect, "flight_scale_std", 0.0) for effect in effects)
    assert np.all(np.array(found.after) < 1.5 * clean) or (spread and found.after[0] < 2 * spread * vehicle.gravity)


def test_noise_of_the_estimate_leaves_the_mean_lag(vehicle):
    """3 cm/s and .05 rad/s leave 2 m/s^2 of noise in the target; the lag is still found, as one."""
    noise = StatedEstimate(velocity_noise=0.03, rate_noise=0.05)
    found, _ = fitted(vehicle, [Actuator(time_constant_up=0.03, time_constant_down=0.03), noise], seconds=8.0)
    assert found.timing.lag + found.timing.delay == pytest.approx(0.03, rel=0.2)
    assert "controller.motor_lag=0.0" in found.line


def test_known_noise_lets_a_delay_be_seen_that_it_would_hide(vehicle):
    """A state 12 ms late under 5 cm/s and .1 rad/s of noise, with rotor speeds: told of the noise, it is found."""
    vehicle = replace(vehicle, thrust_coefficient=K)
    told = StatedEstimate(velocity_noise=0.05, rate_noise=0.1, delay=0.012)
    _, flights = fitted(vehicle, [LAGGING, told], seconds=8.0)
    tables = [transitions(flight, vehicle) for flight in flights]
    inertia = np.diag(vehicle.inertia_matrix)
    noise = {"a_z": np.sqrt(2) * 0.05 / PERIOD} | {
        f"tau_{axis}": np.sqrt(2) * 0.1 * inertia[i] / PERIOD for i, axis in enumerate("xy")
    }
    found = fit_timing(flights, vehicle, tables, noise=noise).timing
    assert found.measured and found.state_delay == pytest.approx(0.012, abs=0.004)


def test_the_delivered_thrust_takes_the_lag_out_of_the_target(vehicle):
    """a_z of the data set less the plant's own equations: noise of the plant, where the commands left metres a second
    squared; the first rows, which a late state does not cover, are left out."""
    effects = [Actuator(time_constant_up=0.03, time_constant_down=0.03), StatedEstimate(delay=0.02)]
    found, flights = fitted(vehicle, effects)
    names = ["v_x", "v_y", "v_z", "w_x", "w_y", "w_z", "u_0", "u_1", "u_2", "u_3"]
    model = SimplifiedPlant(vehicle, PlantEffects(), backend="interpreted").residual()

    def left(thrusts):
        data = residual_dataset(flights, vehicle, thrusts=thrusts)
        settled = np.asarray(data.columns["t"]) > 0.2
        return data.n_rows, (data.matrix(["a_z"])[:, 0] - model(data.matrix(names))[:, 2])[settled].std()

    count, commanded = left(None)
    fewer, delivered = left([mean_thrust(flight, vehicle, found.timing) for flight in flights])
    assert commanded > 2.0 and delivered < 0.15 and count - fewer in (2, 4)
