"""Thrusts that rotors deliver late: against SciPy's integration, and found in flights of known worlds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, solve_ivp

from quadexp.errors import DataError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import fly_one
from quadexp.log.schema import Flight
from quadexp.models.dataset import as_told, residual_dataset, transitions
from quadexp.parts.compose import compose
from quadexp.physics.state import ATTITUDE, RATE, STATE_COLUMNS, input_columns
from quadexp.plugins.identification.predictors import predictors
from quadexp.plugins.identification.rotor_thrust import HeldCommands, Timing, fit_timing, mean_thrust, measured_thrust
from quadexp.plugins.identification.validation import Track, rollout_errors
from quadexp.plugins.identification.vehicle_model import FitSettings, fit_vehicle_model
from quadexp.plugins.logs.samples import read_rows
from quadexp.plugins.worlds.battery import Battery
from quadexp.world.actuator import Actuator
from quadexp.world.link import Latency
from quadexp.world.simplified import PlantEffects, SimplifiedPlant
from quadexp.world.stated_estimate import StatedEstimate
from quadexp.world.world import World
from tests.slow import slow

DT = 0.02


def commands(rng, samples=30, rotors=4):
    return np.arange(samples) * DT, rng.uniform(1.0, 5.0, (samples, rotors))


def flight_of(t, u, **columns):
    return Flight({"t": t, **{f"u_{i}": u[:, i] for i in range(u.shape[1])}, **columns}, {})


@pytest.mark.parametrize(
    "timing",
    [
        Timing(0.03, 0.03),
        Timing(0.03, 0.03, delay=0.013),
        Timing(0.004, 0.06, delay=0.045),
        Timing(0.0125, 0.025, "rotor_speed"),
        Timing(0.2, 0.01, "rotor_speed", 0.02),
    ],
)
def test_the_thrust_of_held_commands_is_the_integrated_lag(rng, timing):
    """value and integral at any times; the right side is integrated piece by piece, from change to change."""
    t, u = commands(rng)
    squared = timing.lag_of == "rotor_speed"
    root, thrust = (np.sqrt, np.square) if squared else (np.asarray, np.asarray)
    first = np.full(4, 2.5)
    model = HeldCommands(t, u, timing, first)
    at = np.sort(rng.uniform(-0.02, t[-1] + timing.delay, 60))
    begin, y, area = -0.02, root(first), np.zeros(4)
    expected, integrals = [], []
    changes = [*(t + timing.delay), np.inf]
    for end in at:
        while begin < end:
            k = np.searchsorted(changes, begin, side="right") - 1
            command = root(u[k] if k >= 0 else first)
            until = min(end, changes[k + 1])

            def slope(_, s, c=command):
                return np.r_[(c - s[:4]) / np.where(c > s[:4], timing.lag_up, timing.lag_down), thrust(s[:4])]

            found = solve_ivp(slope, (begin, until), np.r_[y, area], rtol=1e-11, atol=1e-12).y[:, -1]
            begin, y, area = until, found[:4], found[4:]
        expected.append(thrust(y))
        integrals.append(area)
    assert model.value(at) == pytest.approx(np.array(expected), abs=1e-7)
    assert np.diff(model.integral(at), axis=0) == pytest.approx(np.diff(integrals, axis=0), abs=1e-8)


def test_without_lag_a_delay_shifts_the_commands(rng, vehicle):
    t, u = commands(rng)
    shifted = mean_thrust(flight_of(t, u), vehicle, Timing(delay=DT))
    assert np.isnan(shifted[0]).all() and shifted[1:] == pytest.approx(u[:-2], rel=1e-9)
    half = mean_thrust(flight_of(t, u), vehicle, Timing(delay=DT / 2))
    assert half[1:] == pytest.approx((u[:-2] + u[1:-1]) / 2, rel=1e-9)
    assert np.array_equal(mean_thrust(flight_of(t, u), vehicle, Timing()), u[:-1])


@pytest.mark.parametrize(
    ("speed", "recorded", "before"),
    [(3.0, False, "reference"), (1e-12, False, "hover"), (None, False, "hover"), (3.0, True, "command")],
)
def test_a_flight_begins_with_what_its_rotors_gave(rng, vehicle, speed, recorded, before):
    """In motion the thrusts of its reference within their limits; the mean over a held command u, from y on, is
    u + (y - u) (1 - exp(-dt / tau)) tau / dt."""
    t, u = commands(rng)
    lag, reference = 0.03, np.array([2.0, -3.0, 25.0, 4.0])
    columns = {}
    if speed is not None:
        first = np.r_[np.zeros(3), 1, np.zeros(3), speed, np.zeros(5), reference]
        names = [f"ref_{name}" for name in (*STATE_COLUMNS, *input_columns(4))]
        columns = {name: np.full(len(t), value) for name, value in zip(names, first, strict=True)}
    flight = flight_of(t, u, **columns)
    flight.metadata["recorded"] = recorded
    y = {"reference": [2.0, 0.0, 20.0, 4.0], "hover": np.full(4, vehicle.hover_thrust), "command": u[0]}[before]
    share = (1 - np.exp(-DT / lag)) * lag / DT
    assert mean_thrust(flight, vehicle, Timing(lag, lag))[0] == pytest.approx(u[0] + (y - u[0]) * share, abs=1e-12)


def test_measured_thrusts_correct_a_model_that_is_wrong(rng, lei_li):
    """Thrusts with a scale, and a lag that the model has 30 % too long: the speeds at the samples mend the means."""
    t, u = commands(rng, 60)
    scale, lag = np.array([1.1, 0.9, 1.0, 0.8]), 0.03
    fine = np.linspace(0.0, t[-1], 100 * (len(t) - 1) + 1)
    truth = HeldCommands(t, scale * u, Timing(lag, lag), scale * u[0])
    speed = np.sqrt(truth.value(t) / lei_li.thrust_coefficient)
    flight = flight_of(t, u, **{f"rotor_speed_{i}": speed[:, i] for i in range(4)})
    assert measured_thrust(flight, lei_li) == pytest.approx(truth.value(t))
    area = cumulative_trapezoid(truth.value(fine), fine, axis=0, initial=0.0)
    mean = np.diff(area[::100], axis=0) / DT
    found = mean_thrust(flight, lei_li, Timing(1.3 * lag, 1.3 * lag, measured=True))
    commanded = mean_thrust(flight, lei_li, Timing(1.3 * lag, 1.3 * lag))
    rms = [np.sqrt(np.mean((one - mean) ** 2)) for one in (found, commanded)]
    assert rms[0] < 0.03 < 0.3 < rms[1]


def test_a_state_that_is_late_belongs_to_earlier_thrusts(rng, lei_li):
    """With the speeds known the state's delay shifts measured thrusts; it is the same as a delay of commands alone."""
    t, u = commands(rng, 60)
    speed = np.sqrt(HeldCommands(t, u, Timing(0.03, 0.03, delay=0.01), u[0]).value(t) / lei_li.thrust_coefficient)
    flight = flight_of(t, u, **{f"rotor_speed_{i}": speed[:, i] for i in range(4)})
    late = mean_thrust(flight, lei_li, Timing(0.03, 0.03, delay=0.01, state_delay=0.015, measured=True))
    both = mean_thrust(flight, lei_li, Timing(0.03, 0.03, delay=0.025))
    assert late[15:] == pytest.approx(both[15:], abs=1e-3)


def test_without_a_thrust_coefficient_rotor_speeds_say_nothing(vehicle, rng):
    t, u = commands(rng)
    assert measured_thrust(flight_of(t, u, **{f"rotor_speed_{i}": u[:, i] for i in range(4)}), vehicle) is None


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


def test_flights_that_are_too_short_to_tell_are_refused_in_one_line(vehicle):
    """numpy said that there is no array to concatenate."""
    with pytest.raises(DataError, match=r"longer than 0\.3 s.*collect\.thrust=commanded"):
        fitted(vehicle, [Latency()], seconds=0.2)


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
        ([Actuator(time_constant_up=0.03, time_constant_down=0.03, lag_of="thrust")], (0.03, 0.03), "thrust", 0.0),
        ([LAGGING, Latency(latency=0.008)], (UP, DOWN), "rotor_speed", 0.008),
        *slow(
            ([LAGGING], (UP, DOWN), "rotor_speed", 0.0),
            ([Latency(latency=0.025)], (0.0, 0.0), None, 0.025),
            ([LAGGING, StatedEstimate(delay=0.01)], (UP, DOWN), "rotor_speed", 0.01),
        ),
    ],
    ids=["thrust", "lag and latency", "up and down", "latency", "lag and late estimate"],
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
        [replace(LAGGING, rotor_scale_std=0.05, flight_scale_std=0.05), Battery(), Latency(latency=0.008)],
        *slow([LAGGING, Battery(), Latency(latency=0.008)]),
    ],
    ids=["lag", "battery and spread", "battery"],
)
def test_rotor_speeds_say_what_the_rotors_delivered(vehicle, clean, effects):
    """Whatever scale and voltage do; a late state is then given from late commands. A scale of c_t, which no speed
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
    """3 cm/s and 0.05 rad/s leave 2 m/s^2 of noise in the target; the lag is still found, as one."""
    noise = StatedEstimate(velocity_noise=0.03, rate_noise=0.05)
    found, _ = fitted(vehicle, [Actuator(time_constant_up=0.03, time_constant_down=0.03), noise], seconds=8.0)
    assert found.timing.lag + found.timing.delay == pytest.approx(0.03, rel=0.2)
    assert "timing.motor_lag=0.0" in found.line


def test_known_noise_lets_a_delay_be_seen_that_it_would_hide(vehicle):
    """A state 12 ms late under 5 cm/s and 0.1 rad/s of noise, with rotor speeds: given the noise, it is found."""
    vehicle = replace(vehicle, thrust_coefficient=K)
    told = StatedEstimate(velocity_noise=0.05, rate_noise=0.1, delay=0.012)
    flights = [wandering(vehicle, [LAGGING, told], seconds=8.0, seed=seed) for seed in range(2)]
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


CLEAN = [f"plant.{name}_noise_density=0" for name in ("force", "motor", "torque")]


def flown(latency: float, rate: int, seeds=(0, 1), settings=()):
    path = ["trajectory=random", "trajectory.speed=8", f"controller.rate={rate}", *settings]
    world = ["link=latency", f"link.latency={latency}"] if latency else []
    return [fly_one(compose([*path, *world, f"seed={seed}"])) for seed in seeds]


@pytest.mark.parametrize(("latency", "rate", "found"), [(0.0, 50, 0.0), (0.04, 50, 0.04), (0.025, 60, 1 / 60)])
def test_a_latency_is_no_drag(latency, rate, found):
    """The drag along z is quadratic, not linear. A delay is found up to a period, over which a command is held."""
    vehicle = build_vehicle(compose([]).vehicle)
    model = fit_vehicle_model(flown(latency, rate), vehicle, FitSettings(kinds=("quadratic",)))
    late = model.thrust.delay + model.thrust.lag
    assert found - 1e-9 <= late < found + 0.8 / rate if found else late == 0.0
    rows = {row["term"]: row for row in model.models["quadratic"].records() if row["axis"] == "z"}
    assert rows["linear"]["low"] < 0.0 < rows["linear"]["high"] < rows["linear"]["low"] + 0.1
    assert rows["quadratic"]["low"] < 0.08 < rows["quadratic"]["high"] < rows["quadratic"]["low"] + 0.03


@pytest.mark.parametrize("latency", [0.0, 0.04])
def test_open_loop_flies_the_command_of_each_interval(latency):
    """Half a second without noise: 26 and 48 mm with the commands of the interval before."""
    vehicle = build_vehicle(compose([]).vehicle)
    model = fit_vehicle_model(flown(latency, 50, settings=CLEAN), vehicle, FitSettings(kinds=("quadratic",)))
    one = next(one for one in predictors(model, "m", vehicle, None) if one.name == "quadratic drag")
    (test,) = flown(latency, 50, (2,), CLEAN)
    track = Track(read_rows(test, "test", one.curve.signal, one.curve.delay), one)
    modes = {"full": vehicle, "attitude": None}
    errors = {
        mode: rollout_errors([track], [0.5], tracked=False, vehicle=of, mode=mode)[0]["position"]
        for mode, of in modes.items()
    }
    assert errors["attitude"] < 5e-3 and max(errors.values()) < 0.012
