"""Delays found in flights: of worlds whose delays are stated, and where a flight cannot tell."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from quadexp.cli.app import app
from quadexp.errors import DataError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import fly_one
from quadexp.log.schema import Flight
from quadexp.log.store import write_flight
from quadexp.models.dataset import transitions
from quadexp.parts.compose import compose
from quadexp.plugins.identification.ages import LARGEST_AGE, OVERLAP, SPAN, STEP, Stream, age_of_rates, age_of_state
from quadexp.plugins.identification.delays import Commands, delays_of, identify_delays, overrides, stream_of
from quadexp.plugins.identification.rotor_thrust import fit_timing
from quadexp.plugins.logs.command_lag import CommandLag
from tests.models.late_flights import C, late_flight

NOISY = ["controller=nominal_mpc", "world=everything", "trajectory=lemniscate", "trajectory.speed=6", "seed=3"]


def found(overrides_given):
    config = compose(overrides_given)
    return delays_of(fly_one(config), "a flight", build_vehicle(config.vehicle))


@pytest.mark.parametrize(
    ("age", "latency", "lag", "gyro"),
    [(0.01, 0.01, 0.03, "late"), (0.03, 0.005, 0.05, "fresh"), (0.004, 0.025, 0.02, "late")],
)
def test_delays_of_a_noisy_flight_are_those_of_its_world(age, latency, lag, gyro):
    """With wind, noise, sag and a thrust that is off besides."""
    world = [f"estimator.delay={age}", f"estimator.gyro={gyro}", f"link.latency={latency}"]
    world += [f"actuator.time_constant_up={lag}", f"actuator.time_constant_down={lag}"]
    in_flight = found([*NOISY, *world, "controller.allow_unstable=true"])
    delays = in_flight.delays
    assert delays.age_known and delays.commands_known
    assert delays.age == pytest.approx(age, abs=2e-3)
    assert delays.gyro == pytest.approx(age if gyro == "fresh" else 0.0, abs=2e-3)
    assert delays.dead_time + delays.lag == pytest.approx(latency + lag, abs=5e-3)
    assert delays.lag == pytest.approx(lag, abs=0.35 * lag)
    settings = overrides(in_flight)
    assert f"delay={'strapdown' if gyro == 'fresh' else 'prediction'}" in settings


def test_a_flight_without_delays_asks_for_nothing():
    assert not overrides(found(["controller=nominal_mpc", "trajectory.speed=6", "seed=2"]))


def test_a_quiet_flight_does_not_tell():
    """Nothing changes at hover, so no time can be found in it: that is said, and no number is given."""
    quiet = found(["controller=nominal_mpc", "trajectory=hover", "world=only_late_estimate"])
    assert not quiet.delays.age_known and not quiet.delays.commands_known and not overrides(quiet)


def test_uneven_samples_are_refused():
    flight = late_flight(0.02, 0.03)
    t = flight.t + 1e-3 * np.sin(np.arange(len(flight)))
    with pytest.raises(DataError, match="evenly spaced"):
        stream_of(Flight(flight.columns | {"t": t}, flight.metadata), "a flight")


def test_a_log_without_an_accelerometer_is_refused():
    flight = late_flight(0.02, 0.03)
    columns = {name: values for name, values in flight.columns.items() if not name.startswith("acc_")}
    with pytest.raises(DataError, match="log: column 'acc_x' is missing"):
        stream_of(Flight(columns, flight.metadata), "log")


def test_a_log_tells_by_commands_of_any_unit_and_by_the_speeds_of_its_rotors(tmp_path):
    """Dead time 20 and lag 30 ms; the state is not old, which needs no commands."""
    flight, path = late_flight(0.02, 0.03), tmp_path / "log.parquet"
    speeds = 1000 * np.sqrt(np.maximum(flight["acc_z"], 0.0) / (4 * C))
    fast = {f"rotor_speed_{i}": speeds for i in range(4)}
    for columns, by in (({}, "motor_command and the specific force"), (fast, "the rotor speeds")):
        write_flight(path, Flight(flight.columns | columns, flight.metadata), force=True)
        report = identify_delays([path], None, None)
        record = report["flights"][0]
        assert record["dead_time"] == pytest.approx(0.02, abs=5e-3) and record["lag"] == pytest.approx(0.03, abs=5e-3)
        assert record["age"] == pytest.approx(0.0, abs=2e-3)
        assert any(by in line for line in report["lines"])
        assert sum("rotor 3: dead time" in line for line in report["lines"]) == bool(columns)
    bare = {name: x for name, x in flight.columns.items() if not name.startswith("motor")}
    write_flight(path, Flight(bare, flight.metadata), force=True)
    assert any("none of u, motor_command" in line for line in identify_delays([path], None, None)["lines"])


def test_a_sum_that_is_known_is_set():
    """Dead time and lag each uncertain by 15 ms, their sum by 6: the likeliest parts are set; at a bound none is."""
    intervals = np.array([[0.0, 0.03], [0.03, 0.06], [0.054, 0.066]])
    late = CommandLag(0.015, 0.045, intervals, 50.0)
    assert Commands(late, "").sum_known
    at_bound = late._replace(intervals=intervals + [[0.0, 0.0], [0.0, 0.2], [0.0, 0.2]])
    unsure = late._replace(intervals=np.array([[0.0, 0.03], [0.0, 0.06], [0.02, 0.1]]))
    for unknown in (at_bound, unsure, late._replace(worth=1.0), None):
        assert not Commands(unknown, "").sum_known


def test_a_log_whose_parts_are_unsure_sets_its_sum(tmp_path):
    """No lag of the motors: a log at 100 Hz distinguishes dead time and lag only roughly."""
    flight, path = late_flight(0.02, 0.03), tmp_path / "log.parquet"
    write_flight(path, flight)
    report = identify_delays([path], None, None)
    (record,) = report["flights"]
    settings = dict(text.split("=") for text in record["overrides"])
    assert "set: nothing" not in "".join(report["lines"])
    total = sum(float(settings.get(f"timing.{key}", 0.0)) for key in ("dead_time", "motor_lag"))
    assert total == pytest.approx(0.05, abs=6e-3)


def test_data_set_and_delays_agree():
    """A dead time of 20 ms in a quiet flight, where the accelerometer alone does not tell."""
    config = compose(["controller=nominal_mpc", "trajectory=lemniscate", "trajectory.speed=5", "link=latency",
                      "link.latency=0.02", "controller.allow_unstable=true"])  # fmt: skip
    vehicle, flight = build_vehicle(config.vehicle), fly_one(config)
    delays = delays_of(flight, "a flight", vehicle).delays
    timing = fit_timing([flight], vehicle, [transitions(flight, vehicle)]).timing
    assert delays.dead_time == pytest.approx(timing.delay, abs=1e-3) == pytest.approx(0.02, abs=1e-3)


def test_too_few_samples_are_refused():
    flight = fly_one(compose(["controller=nominal_mpc", "trajectory=hover", "trajectory.duration=1"]))
    with pytest.raises(DataError, match=r"delays cannot be found in 50 samples, 100 are needed"):
        delays_of(flight, "short", build_vehicle(compose([]).vehicle))


def test_the_command_prints_what_to_set(tmp_path):
    path = tmp_path / "a.parquet"
    write_flight(path, fly_one(compose(NOISY)))
    words, picture = ["identify", "--method", "delays", str(path)], tmp_path / "delays.svg"
    said = CliRunner().invoke(app, [*words, "--figure", str(picture)])
    assert said.exit_code == 0 and picture.stat().st_size > 10_000 and picture.with_suffix(".png").exists()
    assert "delay=prediction timing.age=0.0" in said.output and "timing.motor_lag=0.0" in said.output
    record = json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)
    assert record["flights"][0]["age"] == pytest.approx(0.01, abs=2e-3)
    two = CliRunner().invoke(app, [*words, str(path), "--figure", str(picture)])
    assert two.exit_code == 2 and "--figure: draws one flight, 2 are given" in two.output


@pytest.mark.parametrize("age", [0.0, 0.01])
def test_an_age_shows_on_the_axes_that_the_noise_of_the_thrust_is_not_on(age):
    """A tilted vehicle that turns about the vertical, its drag to and fro, with 1.5 m/s^2 of noise on z_body only.

    With one noise for all axes it is lost in that of the thrust."""
    rng, step, period = np.random.default_rng(2), 0.005, 0.02
    t = np.arange(0.0, 12.0, step)
    azimuth = Rotation.from_rotvec(1.6 * t[:, None] * [0, 0, 1])
    attitude = azimuth * Rotation.from_euler("y", 0.4)
    force = np.column_stack([2 * np.sin(3 * t), 2 * np.cos(2 * t), np.full(len(t), 9.81 / np.cos(0.4))])
    acceleration = attitude.apply(force) - [0, 0, 9.81]
    velocity = np.vstack([np.zeros(3), np.cumsum((acceleration[1:] + acceleration[:-1]) / 2 * step, axis=0)])
    rate = np.tile(Rotation.from_euler("y", 0.4).inv().apply([0, 0, 1.6]), (len(t), 1))
    now = np.arange(round(0.2 / step), len(t), round(period / step))
    late = now - round(age / step)
    reading = force[now] + rng.normal(size=(len(now), 3)) * [0.02, 0.02, 1.5]
    found = age_of_state(Stream(t[now], velocity[late], attitude[late], rate[late], reading), 9.81)
    assert found.value == pytest.approx(age, abs=5e-4) and found.error < 1e-3


def test_what_a_shift_leaves_is_that_of_the_samples(rng):
    """Smooth at random; readings linear in between, integrated over each period by quadrature, turned by the attitude
    in its middle: the likelihoods of the ages are those of what then remains on the axes of the body."""
    period = 0.02
    t = period * np.arange(260)

    def waves():
        phases, rates = rng.uniform(0, 6, (5, 3)), rng.uniform(0.5, 9, (5, 3))
        return np.sin(t[:, None, None] * rates + phases).sum(axis=1) / 3

    attitude, force, velocity = Rotation.from_rotvec(0.4 * waves()), [0, 0, 9.8] + 2 * waves(), 4 * waves()
    age = age_of_state(Stream(t, velocity, attitude, waves(), force), 9.81)
    middle = attitude[:-1] * Rotation.from_rotvec((attitude[:-1].inv() * attitude[1:]).as_rotvec() / 2)
    fine = (np.arange(400) + 0.5) / 400 * period
    span, first = round(SPAN / period), round(LARGEST_AGE / period) + 1

    def likelihood(shift):
        steps = np.zeros((len(t), 3))
        for k in range(1, len(t)):
            at = t[k - 1] + fine - shift
            mean = [np.interp(at, t, force[:, i]).mean() for i in range(3)]
            steps[k] = middle[k - 1].apply(mean) * period
        total = np.cumsum(steps, axis=0)
        error = [0, 0, 9.81 * period * span] + velocity[span:] - velocity[:-span] - total[span:] + total[:-span]
        error = attitude[first + span // 2 :][: len(t) - span - first].inv().apply(error[first:])
        return -len(error) / OVERLAP / 2 * np.log(np.var(error, axis=0)).sum()

    for shift in (0.013, 0.02, 0.071):
        found = age.likelihood[round(shift / STEP)] - age.likelihood[0]
        assert found == pytest.approx(likelihood(shift) - likelihood(0.0), rel=1e-6)


def test_rates_that_are_fresh_are_younger_than_the_attitude(rng):
    """By 30 ms, with noise of 0.02 rad/s."""
    t = 0.005 * np.arange(3000)
    waves = np.sin(t[:, None] * [3.0, 4.0, 1.0] + [0.0, 1.0, 2.0])
    attitude = Rotation.from_rotvec(0.5 * waves)
    rate = np.zeros((len(t), 3))
    rate[1:] = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / 0.005
    now = np.arange(10, len(t), 4)
    noisy = rate[now] + 0.02 * rng.standard_normal((len(now), 3))
    still = np.zeros((len(now), 3))
    found = age_of_rates(Stream(t[now], still, attitude[now - 6], noisy, still))
    assert found.value == pytest.approx(0.03, abs=3.5e-3)
