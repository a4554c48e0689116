"""Accelerometers that stop for a while, and quantities at the end of what is looked for."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.wider_draws import missing_readings
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.plugins.auto.beliefs import beliefs_table
from quadexp.report.metrics import position_error


def flown(*words):
    return fly_one(compose([*words, "controller.allow_unstable=true"]))


def test_gaps_in_readings_tell_nothing_of_an_age():
    """Half a second missing every two: the straight line across a gap counted as readings, and no age was found: 60 mm,
    as without."""
    late = ["controller=perfect_mpc", "trajectory.speed=6", "estimator=late", "estimator.delay=0.02", "seed=85"]
    with missing_readings(0, when=lambda t: t % 2 < 0.5):
        flight = flown(*late, "remedies=auto")
    assert position_error(flight).mean() < 0.01
    assert flight["auto_acts_age"][-1] == pytest.approx(0.02, abs=0.001)


@pytest.mark.parametrize("words", [("geometric", "trajectory=lemniscate"), ("dfbc", "trajectory=circle")])
def test_a_force_is_forgotten_once_no_reading_shows_it(words):
    """After 8 s there is no accelerometer: held, the drag of one heading acted on all others, 2.2 and 1.5 times as far
    off as without."""
    controller, path = words
    given = [f"controller={controller}", path, "trajectory.speed=6", "seed=93"]
    none = flown(*given)
    with missing_readings(0, when=lambda t: t > 8):
        auto = flown(*given, "remedies=auto")
    assert position_error(auto).mean() < 0.8 * position_error(none).mean()


def test_rotor_speeds_alone_are_no_evidence_of_a_force():
    """Without any reading of the accelerometer a force was said to act, and a stiffer horizon flew: lost, in a world of
    wind and delays, or 5 times as far off as without."""
    words = ["controller=perfect_mpc", "vehicle=hummingbird", "world=only_motor_lag", "trajectory.speed=4", "seed=7"]
    with missing_readings(0, when=lambda t: True):
        flight = flown(*words, "remedies=auto")
    assert np.ptp(flight["rotor_speed_0"]) > 0  # they are there
    assert not flight["auto_acts_lateral"].any() and not flight["auto_grid"].any()


@pytest.mark.parametrize("age", [0.05, 0.03])
def test_an_age_in_a_quiet_hover_is_in_its_interval(age):
    """Of exact sensors: an assumed noise of the velocity hid how readings scatter between two instants, and ages were
    9 ms low in all of ten flights, their intervals 5 ms to either side."""
    late = ["controller=perfect_mpc", "trajectory=hover", "trajectory.duration=15", "seed=3", "remedies=auto"]
    flight = flown(*late, "estimator=late", f"estimator.delay={age}")
    assert flight["auto_age_low"][-1] < age < flight["auto_age_high"][-1] < flight["auto_age_low"][-1] + 0.015
    assert flight["auto_age"][-1] == pytest.approx(age, abs=0.006)


@pytest.mark.parametrize(
    ("words", "delay"), [(("perfect_mpc", "speed=3", "106"), 0.12), (("geometric", "speed=5", "54"), 0.09)]
)
def test_a_dead_time_beyond_what_is_looked_for_opens_all_intervals(words, delay):
    """Said was 80 (75 to 85) ms of dead time and lag, and an age of 40 (37 to 43) that is 0."""
    controller, speed, seed = words
    link = ["link=latency", f"link.latency={delay}", "trajectory=circle", f"trajectory.{speed}", f"seed={seed}"]
    flight = flown(f"controller={controller}", *link, "remedies=auto")
    assert np.isinf([flight[f"auto_{name}_high"][-1] for name in ("age", "delay", "lag")]).all()
    assert flight["auto_age_low"][-1] == 0 and flight["auto_delay_low"][-1] < delay
    assert (flight["auto_grid"][-20:] == 0).all()
    shown = {row[0]: row for row in beliefs_table(flight).rows}
    assert shown["dead time and lag of commands"][3].startswith("at least")
    assert float(shown["dead time and lag of commands"][2]) > 70  # ms; it was printed as 0


def test_noise_of_the_position_flies_on_the_softest_horizon():
    """Once it is measured: stiffer ones follow 30 mm of noise, 1.5 times as far off as without."""
    noisy = ["controller=perfect_mpc", "world=only_noisy_estimate", "estimator.position_noise=0.03", "trajectory=hover"]
    flights = {name: flown(*noisy, "trajectory.duration=8", "seed=76", f"remedies={name}") for name in ("none", "auto")}
    errors = {name: position_error(flight)[flight["t"] > 2].mean() for name, flight in flights.items()}
    assert errors["auto"] < 1.1 * errors["none"] and flights["auto"]["auto_grid"][-1] == 0
