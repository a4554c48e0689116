"""Each sensor against an analytic case: noise, drift, age, steps, losses, vibration, low pass, and its data sheet."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest

from quadexp.control.part import Compensation
from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller, build_vehicle, build_world, sensor_spec_of
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.parts.sensor_spec import SensorSpec, Stated
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.physics.telegram import dshot_speed, in_steps
from quadexp.plugins.worlds.battery import Battery
from quadexp.world.actuator import Actuator
from quadexp.world.channel import DRIFT
from quadexp.world.effect import Clock
from quadexp.world.history import History
from quadexp.world.sensors import Sensors
from quadexp.world.stated_estimate import StatedEstimate
from quadexp.world.streams import part_stream
from quadexp.world.world import World
from tests import paper
from tests.deleted import needs
from tests.models.residuals import with_rotors
from tests.slow import slow
from tests.world.airframes import REST, commands, ideal, sampled, start

PERIOD = 0.02
TURNING = ("vehicle.thrust_coefficient=1.2e-5", "actuator=speed_lag_30ms")
LAGGING = Actuator(time_constant_up=0.03, time_constant_down=0.03)


def flown(vehicle, sensors, seconds, *effects, period=PERIOD, x=REST, thrusts=None, seed=1):
    """Columns by name (k + 1, ..) of an open-loop flight in hover, or under thrusts (k, n)."""
    world = World(ideal(with_rotors(vehicle)), [sensors, LAGGING, *effects])
    count = round(seconds / period) if thrusts is None else len(thrusts)
    thrusts = np.full((count, vehicle.n_rotors), vehicle.hover_thrust) if thrusts is None else thrusts
    noise = world.begin(x, period, count * period, np.random.default_rng(seed))
    places, rows = world.columns(period), []
    told = [np.r_[x, world.measured, np.full(3, np.nan), world.inner[[*places.values()]]]]
    for u in thrusts:
        x, reading = world.advance(x, u, period, noise)
        told.append(np.r_[x, world.measured, reading, world.inner[[*places.values()]]])
    rows = np.array(told)
    columns = {"t": period * np.arange(count + 1), "x": rows[:, :13], "told": rows[:, 13:26], "force": rows[:, 26:29]}
    return columns | {name: rows[:, 29 + i] for i, name in enumerate(places)} | {"world": world}


def autocorrelation(values, lag):
    """Of the columns of values (k, n) with mean zero, together."""
    return (values[lag:] * values[:-lag]).mean() / (values**2).mean()


def allan_variance(values, cluster):
    """Overlapping, of (k, n) at clusters of so many samples (IEEE Std 952, annex C), mean of the columns."""
    sums = np.concatenate([np.zeros((1, values.shape[1])), values.cumsum(axis=0)])
    means = (sums[cluster:] - sums[:-cluster]) / cluster
    return ((means[cluster:] - means[:-cluster]) ** 2).mean() / 2


def test_numbers_of_the_paper():
    """B_accel = (0.001, -.001, 0.001) in FRD, deviation 0.05 m/s^2 (Lei & Li 2017, equation 22)."""
    lei_li = compose(["sensor=lei_li"]).sensor
    assert paper.flip(lei_li.accelerometer_bias) == pytest.approx([0.001, -0.001, 0.001])
    assert lei_li.accelerometer_noise == (0.05, 0.05, 0.05)


def test_white_noise_of_every_reading(vehicle):
    sensors = Sensors(
        accelerometer_noise=(0.05, 0.1, 0.2),
        accelerometer_bias=(0.3, -0.2, 0.1),
        gyroscope_noise=0.02,
        position_noise=(0.01, 0.02, 0.03),
        velocity_noise=0.1,
        attitude_noise=0.01,
        rotor_speed_noise=0.02,
        battery_noise=0.1,
    )
    flight = flown(vehicle, sensors, 40.0, Battery(thrust_exponent=0.0))
    x, told = flight["x"][1:], flight["told"][1:]
    exact = {name: flight[name][1:, None] for name in ("rotor_speed_1", "battery_voltage")}
    errors = {
        "force": (flight["force"][1:] - [0, 0, vehicle.gravity] - [0.3, -0.2, 0.1], (0.05, 0.1, 0.2)),
        "position": ((told - x)[:, POSITION], (0.01, 0.02, 0.03)),
        "velocity": ((told - x)[:, VELOCITY], 0.1),
        "rates": ((told - x)[:, RATE], 0.02),
        "attitude": (2 * told[:, ATTITUDE][:, 1:], 0.01),  # of a vehicle that stays level
        "speed": (flight["est_rotor_speed_1"][1:, None] / exact["rotor_speed_1"] - 1, 0.02),
        "voltage": (flight["est_battery_voltage"][1:, None] - exact["battery_voltage"], 0.1),
    }
    for name, (error, deviation) in errors.items():
        count = len(error)
        assert np.abs(error.std(axis=0) / deviation - 1).max() < 4 / math.sqrt(2 * count), name
        assert np.abs(error.mean(axis=0) / deviation).max() < 4 / math.sqrt(count), name
        assert all(abs(autocorrelation(error, lag)) < 4 / math.sqrt(error.size) for lag in (1, 2, 7)), name
    together = np.hstack([error for error, _ in errors.values()])
    assert np.abs(np.corrcoef(together.T) - np.eye(together.shape[1])).max() < 5 / math.sqrt(len(together))


def test_the_accelerometers_noise_has_the_stream_that_it_had(vehicle):
    sensors = Sensors(accelerometer_noise=(0.05, 0.1, 0.2), gyroscope_noise=0.1)
    flight = flown(vehicle, sensors, 1.0, seed=5)
    drawn = sampled(part_stream(np.random.default_rng(5), "accelerometer"), flight["t"], 3)
    expected = np.array([0, 0, vehicle.gravity]) + np.array([0.05, 0.1, 0.2]) * drawn[1:]
    assert np.abs(flight["force"][1:] - expected).max() < 1e-9


@pytest.mark.parametrize("kind", ["position", "attitude", *slow("velocity")])
def test_a_gauss_markov_error(vehicle, kind):
    """S^2 exp(-tau / T), over many flights that each begin in the stationary distribution."""
    deviation, time = 0.05, 0.2
    sensors = Sensors(**{f"{kind}_drift": deviation, f"{kind}_drift_time": time})
    errors = []
    for seed in range(3):
        flight = flown(vehicle, sensors, 60.0, seed=seed)
        off = flight["told"] - flight["x"]
        errors.append(2 * off[1:, 4:7] if kind == "attitude" else off[1:, POSITION if kind == "position" else VELOCITY])
    independent = 9 * 60.0 / (2 * time)
    assert np.square(errors).mean() / deviation**2 == pytest.approx(1, abs=4 * math.sqrt(2 / independent))
    for lag in (1, 5, 10, 25):
        found = np.mean([autocorrelation(error, lag) for error in errors])
        assert found == pytest.approx(math.exp(-lag * PERIOD / time), abs=4 / math.sqrt(independent)), lag


def test_allan_deviation_of_a_gyroscope(vehicle):
    """White noise sigma^2 / m, a walk K^2 tau / 3 (1 + ..) of its bias, each where it rules."""
    sigma, walk = 0.01, 0.02
    flights = [flown(vehicle, Sensors(gyroscope_noise=sigma, gyroscope_bias_walk=walk), 80.0, seed=s) for s in range(4)]
    errors = np.hstack([(flight["told"] - flight["x"])[1:, RATE] for flight in flights])
    for cluster, close in ((1, 0.03), (3, 0.06), (100, 0.25), (300, 0.45)):
        tau = cluster * PERIOD
        expected = sigma**2 / cluster + walk**2 * tau / 3 * (1 + 1 / (2 * cluster**2))
        assert allan_variance(errors, cluster) == pytest.approx(expected, rel=close), cluster
    biases = np.hstack([flight[f"bias_g_{axis}"][1:, None] for flight in flights for axis in "xyz"])
    assert (errors - biases).std() == pytest.approx(sigma, rel=0.02)
    grown = np.square(np.diff(biases[:: round(1 / PERIOD)], axis=0)).mean()
    assert grown == pytest.approx(walk**2, rel=4 * math.sqrt(2 / (80 * 12)))
    assert np.abs(flights[0]["bias_g_x"][0]) == 0 and DRIFT < PERIOD


def test_a_bias_is_drawn_for_a_flight(vehicle):
    sensors = Sensors(accelerometer_bias_std=0.2, gyroscope_bias_std=0.01)
    flights = [flown(vehicle, sensors, 0.1, seed=seed) for seed in range(40)]
    force = np.array([flight["force"][1:] - [0, 0, vehicle.gravity] for flight in flights])
    rates = np.array([(flight["told"] - flight["x"])[1:, RATE] for flight in flights])
    assert np.ptp(force, axis=1).max() < 1e-9 and np.ptp(rates, axis=1).max() < 1e-12
    assert force[:, 0].std() == pytest.approx(0.2, rel=0.25) and rates[:, 0].std() == pytest.approx(0.01, rel=0.25)
    assert force[3, 0] == pytest.approx([flights[3][f"bias_a_{axis}"][0] for axis in "xyz"], abs=1e-9)


@pytest.mark.parametrize("delay", [0.0003, 0.007, PERIOD, 0.0344])
def test_a_late_state_is_that_of_a_late_estimate(vehicle, delay):
    """Told by other means, see test_world.py."""
    x, u = start(5), commands(vehicle, 12)
    late = flown(vehicle, Sensors(pose_delay=delay, gyroscope_delay=delay), 0, x=x, thrusts=u)
    expected = flown(vehicle, Sensors(), 0, StatedEstimate(delay=delay), x=x, thrusts=u)
    assert np.abs(late["told"] - expected["told"]).max() < 1e-9
    assert late["taken_position"][1:] == pytest.approx(np.maximum(late["t"][1:] - delay, 0), abs=1e-9)
    fresh = flown(vehicle, Sensors(pose_delay=delay, attitude_age="fresh"), 0, x=x, thrusts=u)
    assert np.abs(fresh["told"][1:, 3:7] - fresh["x"][1:, 3:7]).max() < 1e-9
    assert np.abs(fresh["told"][:, VELOCITY] - expected["told"][:, VELOCITY]).max() < 1e-9


def test_an_estimators_delay_and_noise_come_on_top(vehicle):
    x, u = start(5), commands(vehicle, 12)
    both = flown(vehicle, Sensors(pose_delay=0.01), 0, StatedEstimate(delay=0.013), x=x, thrusts=u)
    sum_of_both = flown(vehicle, Sensors(), 0, StatedEstimate(delay=0.023), x=x, thrusts=u)
    assert np.abs(both["told"] - sum_of_both["told"])[:, :10].max() < 1e-9  # the rates are the estimator's alone
    noisy = flown(vehicle, Sensors(position_noise=(0.3,) * 3), 20, StatedEstimate(position_noise=0.4))
    assert (noisy["told"] - noisy["x"])[1:, POSITION].std() == pytest.approx(0.5, rel=0.05)


def test_lags_by_cross_correlation(vehicle):
    """Rotor speeds and accelerations of a shaken vehicle lag behind the true ones by the stated ages."""
    period, ages = 0.004, {"est_rotor_speed_0": 0.0103, "force": 0.0061}
    rng = np.random.default_rng(0)
    shaken = vehicle.hover_thrust * (1 + 0.1 * rng.standard_normal(2000).repeat(2))[:, None].repeat(4, axis=1)
    sensors = Sensors(rotor_speed_delay=ages["est_rotor_speed_0"], accelerometer_delay=ages["force"])
    flight = flown(vehicle, sensors, 0, period=period, thrusts=shaken)
    prompt = flown(vehicle, Sensors(), 0, period=period, thrusts=shaken)
    for name, age in ages.items():
        late, now = (one[name if one is flight else name.replace("est_", "")][100:] for one in (flight, prompt))
        late, now = (one[:, 2] if one.ndim == 2 else one for one in (late, now))
        lags = np.arange(-5, 6)
        now, late = now - now.mean(), late - late.mean()
        score = [np.dot(late[10 + lag : len(late) - 10 + lag], now[10:-10]) for lag in lags]
        best = int(np.argmax(score))
        top = 0.5 * (score[best - 1] - score[best + 1]) / (score[best - 1] - 2 * score[best] + score[best + 1])
        assert (lags[best] + top) * period == pytest.approx(age, abs=2e-4), name


def test_a_reading_waits_for_the_next_one(vehicle):
    """At 30 Hz under a loop of 50 Hz: each is exact at a multiple of 1 / 30 s, and held until the next has come."""
    x = start(2)
    flight = flown(vehicle, Sensors(pose_rate=30.0, pose_delay=0.015), 0, x=x, thrusts=commands(vehicle, 40))
    fine = flown(vehicle, Sensors(), 0, x=x, thrusts=commands(vehicle, 40).repeat(20, axis=0), period=1e-3)
    taken = flight["taken_position"][1:]
    due = np.floor((flight["t"][1:] - 0.015) * 30 + 1e-6).clip(0) / 30
    assert taken == pytest.approx(due, abs=1e-9)
    for axis in (0, 1, 2, 7, 8, 9):
        expected = np.interp(taken, fine["t"], fine["x"][:, axis])
        assert np.abs(flight["told"][1:, axis] - expected).max() < 1e-5


def test_losses_and_overtaking_by_a_list_of_messages(vehicle):
    """The newest that has arrived is given: by an event list in plain Python, from the same draws."""
    delay, jitter, drop, rate = 0.004, 0.07, 0.3, 60.0
    sensors = Sensors(rotor_speed_rate=rate, rotor_speed_delay=delay, rotor_speed_jitter=jitter, rotor_speed_drop=drop)
    flight = flown(vehicle, sensors, 20.0, seed=3)
    from scipy.stats import norm

    drawn = part_stream(np.random.default_rng(3), "rotor_speed way").standard_normal((1200, 2))
    taken = np.arange(1, 1201) / rate
    arrival = taken + delay + jitter * norm.cdf(drawn[:, 0])
    lost = norm.cdf(drawn[:, 1]) < drop
    assert lost.mean() == pytest.approx(drop, abs=0.05)
    arrival[lost] = np.inf
    assert (np.diff(arrival[~lost]) < 0).sum() > 20
    for k in range(1, len(flight["t"])):
        there = np.flatnonzero((arrival <= flight["t"][k] + 1e-9) & (taken <= flight["t"][k] + 1e-9))
        assert flight["taken_rotor_speed"][k] == pytest.approx(taken[there[-1]] if len(there) else 0, abs=1e-9), k


def test_telegrams_of_rotor_speeds():
    """Against the telegram's own integers: the period in us, shifted right until nine bits are left."""
    speeds, pairs = np.linspace(40, 4000, 397), 7
    read = np.array(dshot_speed(ca.DM(speeds), pairs)).ravel()
    for speed, told in zip(speeds, read, strict=True):
        period, exponent = 60e6 / (speed * pairs * 60 / (2 * np.pi)), 0
        mantissa = int(period)
        while mantissa > 511:
            exponent += 1
            mantissa = int(period) >> exponent
        erpm = 60e6 / (mantissa << exponent)
        assert told == pytest.approx(erpm / pairs * 2 * np.pi / 60, rel=1e-12)
        assert 0 <= told / speed - 1 < (1 / 256 if exponent else 1 / mantissa)
    steps = np.unique(np.array(in_steps(ca.DM(speeds), 1.5)).ravel()) / 1.5
    assert np.abs(steps - np.rint(steps)).max() < 1e-9 and len(steps) < len(speeds) * 10 / 1.5


def test_told_speeds_are_quantised(vehicle):
    step = 100 * 2 * np.pi / 60 / 7  # BLHeli_32 tells hundreds of turns of the field a minute, of seven pole pairs
    flight = flown(
        vehicle, Sensors(rotor_speed_step=step, battery_step=0.1), 0, Battery(), thrusts=commands(vehicle, 200)
    )
    told = flight["est_rotor_speed_2"]
    assert np.abs(told[1:] / step - np.rint(told[1:] / step)).max() < 1e-9
    off = told[1:] - flight["rotor_speed_2"][1:]
    assert np.abs(off).max() < step / 2 + 1e-9 and off.std() == pytest.approx(step / math.sqrt(12), rel=0.15)
    volts = flight["est_battery_voltage"][1:] * 10
    assert np.abs(volts - np.rint(volts)).max() < 1e-9


@pytest.mark.parametrize("cutoff", [0.0, 60.0])
def test_vibration_at_the_frequency_of_the_rotors(vehicle, cutoff):
    """In hover all rotors turn at one speed: a line there, as high as the sum of their phases, behind the low pass."""
    vehicle = with_rotors(vehicle)
    amplitude, period = 2.0, 1e-3
    sensors = Sensors(accelerometer_vibration=(amplitude, 0.0, 0.0), accelerometer_cutoff=cutoff)
    world = World(ideal(vehicle), [sensors, LAGGING])
    noise, x, read = world.begin(REST, period, 4.0, np.random.default_rng(2)), REST, []
    for _ in range(4000):
        x, reading = world.advance(x, np.full(4, vehicle.hover_thrust), period, noise)
        read.append(reading[0])
    speed = math.sqrt(vehicle.hover_thrust / vehicle.thrust_coefficient)
    spectrum = np.abs(np.fft.rfft(np.array(read) * np.hanning(len(read)))) / len(read) * 4
    line = int(spectrum.argmax())
    folded = abs((speed / (2 * np.pi) + 500) % 1000 - 500)  # readings of 1 kHz
    assert line / 4.0 == pytest.approx(folded, abs=0.26)
    phases = 2 * np.pi * part_stream(part_stream(np.random.default_rng(2), "sensor"), "angles").random(4)
    passed = 1 / math.hypot(1, speed / (2 * np.pi * cutoff)) if cutoff else 1.0
    power = np.sqrt((spectrum[line - 3 : line + 4] ** 2).sum() / 1.5)
    assert power == pytest.approx(amplitude * passed * abs(np.exp(1j * phases).sum()), rel=0.02)


@pytest.mark.parametrize("ratio", [0.2, 1.0, 3.0])
def test_the_low_passs_attenuation_and_phase(ratio):
    """Of a sine at so many times the cut-off: 1 / sqrt(1 + r^2), atan r late."""
    cutoff, clock = 20.0, Clock(0.01, 40)
    omega, t = 2 * np.pi * cutoff * ratio, clock.step * np.arange(8000)
    out, last, steps = [], 0.0, np.arange(clock.steps + 1)
    for first in range(0, len(t), clock.steps):
        values = ca.MX(ca.DM(np.sin(omega * clock.step * (first + steps))).T)
        out.append(np.array(ca.evalf(History(values, clock).low_passed(ca.MX(last), cutoff).values)).ravel()[1:])
        last = out[-1][-1]
    after, t = np.concatenate(out)[4000:], t[4000:] + clock.step
    phasor = 2 * np.mean(after * np.exp(-1j * omega * t)) if (omega * (t[-1] - t[0]) / (2 * np.pi)) else 0
    assert abs(phasor) == pytest.approx(1 / math.hypot(1, ratio), rel=0.01)
    assert -(np.angle(phasor) + np.pi / 2) == pytest.approx(math.atan(ratio), abs=0.02)


def test_rotors_that_are_not_all_measured_are_told_to_nobody(vehicle):
    flight = flown(vehicle, Sensors(rotor_speed_of=(0, 2)), 0.1)
    assert "est_rotor_speed_2" in flight and "est_rotor_speed_1" not in flight
    assert not hasattr(flight["world"], "rotor_speed") and flight["world"].sensor_spec.rotor_speed is None
    assert hasattr(flown(vehicle, Sensors(rotor_speed_of=(3, 2, 1, 0)), 0.1)["world"], "rotor_speed")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["sensor.rotor_speed_of=[4]", *TURNING], "sensor.rotor_speed_of=.4.: vehicle=torrente has rotors 0 to 3"),
        (["sensor.accelerometer_vibration=[1,0,0]"], "sensor.accelerometer_vibration=.*: no speeds of rot"),
        (["sensor.battery_noise=0.1"], "sensor.battery_..: there is no battery here"),
        (["sensor.pose_rate=8000", "controller.rate=20"], "sensor.pose_rate=8000: 400 readings in a control period"),
        (["sensor.pose_drop=1"], r"sensor.pose_drop=1.0: must be in \[0, 1\)"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(given, message):
    with pytest.raises(UsageError, match=message) as refused:
        fly_one(compose(["trajectory=hover", "trajectory.duration=0.2", "controller=nominal_mpc", *given]))
    assert "\n" not in str(refused.value)


OPTIONS = ("low", "high", "mocap_room", "gnss_quad", "race_dshot", "race_serial", "crazyflie")


@pytest.mark.usefixtures("unmeasured")
@pytest.mark.parametrize("option", OPTIONS)
def test_every_option_flies_with_speeds_of_rotors_and_without(option):
    """Without speeds nothing is given them, and no telemetry is refused."""
    given = ["trajectory=hover", "trajectory.duration=1.5", "controller=nominal_mpc", f"sensor={option}"]
    flights = [fly_one(compose([*given, *more])) for more in ([], TURNING)]
    assert all(flight.outcome == "ok" for flight in flights)
    told = [{name for name in flight.columns if name.startswith("est_rotor")} for flight in flights]
    assert not told[0] and bool(told[1]) == (option in ("low", "high", "race_dshot", "race_serial"))


def spec_of(*overrides):
    config = compose(overrides)
    vehicle = build_vehicle(config.vehicle)
    return sensor_spec_of(build_world(config, vehicle))


def test_the_data_sheet_says_what_is_set_and_no_more():
    exact = spec_of()
    assert exact.accelerometer == Stated() and exact.rotor_speed is None and exact.position == Stated(delay=None)
    sensor_spec = spec_of("sensor=high", "vehicle=sun", "plant=sun", "world=sun_late_30")
    assert sensor_spec.accelerometer == Stated(noise=0.5) and sensor_spec.rotor_speed == Stated(noise=0.02, delay=0.01)
    assert sensor_spec.position == Stated(noise=0.005, delay=None)  # the age of 30 ms is no sensor's
    assert sensor_spec.gyroscope == Stated(noise=0.05)  # given as fresh
    wrong = spec_of("sensor=high", "vehicle=sun", "plant=sun", "world=sun_baseline", "sensor.sheet_factor=3")
    assert wrong.rotor_speed == Stated(noise=pytest.approx(0.06), delay=pytest.approx(0.03))
    late = spec_of("sensor.pose_delay=0.01", "sensor.pose_jitter=0.004", "sensor.pose_rate=100", "estimator.delay=0.02")
    assert late.velocity == Stated(rate=100.0, delay=pytest.approx(0.012)) and late.gyroscope.delay is None
    stated = spec_of("estimator.position_noise=0.03", "sensor.position_noise=[0.04,0.01,0]")
    assert stated.position.noise == pytest.approx(0.05)
    means = spec_of("world=indoor_mocap")  # an IMU's readings are means; as many in a control period as are whole
    for sensor in (means.accelerometer, means.gyroscope):
        assert sensor.span == 1 / 200 and sensor.within(0.02) == 0.005 and sensor.within(1 / 300) == 1 / 300
    assert exact.accelerometer.within(0.02) == 0.0


@dataclass(frozen=True, kw_only=True)
class Looking(Compensation):
    """A compensation that keeps the specifications that it is given, and changes nothing."""

    prefix = "delay."
    seen: ClassVar[list[SensorSpec]] = []

    def put_around(self, controller, context):
        self.seen.append(context.sensor_spec)
        return controller


@needs("remedies", "laws")
def test_a_remedy_is_given_the_data_sheet():
    config = replace(compose(["sensor=high", "controller=geometric"]), delay=Looking())
    vehicle = build_vehicle(config.vehicle)
    plant = build_world(config, vehicle)
    build_controller(config, vehicle, plant, None)
    assert Looking.seen == [plant.sensor_spec] and plant.sensor_spec.velocity == Stated(noise=0.03, delay=None)


def test_records_of_earlier_versions_are_those_of_today():
    assert compose([]).sensor.recorded() == {
        "name": "perfect",
        "accelerometer_bias": [0.0, 0.0, 0.0],
        "accelerometer_noise": [0.0, 0.0, 0.0],
    }
    changed = compose(["sensor.gyroscope_noise=0.1"]).sensor.recorded()
    assert changed["gyroscope_noise"] == 0.1 and len(changed) == 4
    assert compose(["sensor=lei_li"]).world == "clean" and compose(["sensor=low"]).world == "sensor=low"
    assert replace(compose([]).sensor, sheet_factor=2.0).idle
