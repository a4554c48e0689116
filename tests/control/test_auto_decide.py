"""What acts, and when: nothing without evidence, one stiffer grid at a time, an observer that follows what shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from quadexp.control.auto.decide import (
    CERTAIN,
    FIRM,
    GATE,
    GRIDS,
    PATIENT,
    PLAIN,
    PUSHED,
    SURE,
    Acting,
    Decision,
    Senses,
    grids,
)
from quadexp.control.auto.following import (
    FASTEST,
    STRONGEST,
    ForceFollowing,
    SpeedFollowing,
    WindFollowing,
    speeds_tell,
)
from quadexp.control.auto.posterior import Evidence
from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.observers.disturbance import DisturbanceObserver
from quadexp.control.observers.wind import WindObserver
from quadexp.parts.sensor_sheet import SensorSheet, Stated

NO_BIAS = (np.zeros(3), np.ones(3))


def evidence(age=0.0, total=0.0, lag=0.0, *, sd=0.001, late=0.0, slow=0.0):
    return Evidence(np.array([age, total, lag]), np.full(3, sd), late, slow, False, (1.0, 0.1), NO_BIAS, 0)


def test_an_age_acts_once_it_is_sure_for_some_decisions():
    decision, sure = Decision(), evidence(age=0.01, late=SURE + 1)
    acted = [decision.take(sure, Senses(), 3.0).age for _ in range(CERTAIN)]
    assert acted == [*[0.0] * (CERTAIN - 1), 0.01]
    assert Decision().take(evidence(age=0.01, late=SURE - 1), Senses(), 3.0).age == 0.0


def test_an_age_that_is_plain_acts_at_once():
    """By attitude and rates alone, before there is other evidence; and it stays while the evidence does."""
    decision = Decision()
    assert decision.at_once(0.05, PLAIN - 1).age == 0.0
    began = decision.at_once(0.05, PLAIN + 1)
    assert (began.age, began.fresh, began.grid) == (0.05, True, PUSHED)
    assert decision.take(evidence(age=0.05, late=SURE + 1), Senses(), 0.6).age == 0.05
    fresh = evidence(age=0.05, late=PLAIN + 1)._replace(fresh=True)
    assert Decision().take(fresh, Senses(), 0.6).age == 0.05


def test_no_grid_is_softer_than_what_was_asked_for():
    asked = MPCSettings(rate=50.0, nodes=10, position_weight=(200.0, 1.0, 500.0))
    for settings, (*_, weight, _) in zip(grids(asked), GRIDS, strict=True):
        assert settings.position_weight == (200.0, weight, 500.0)


def test_a_position_weighs_as_much_beside_the_other_weights_whatever_these_are():
    """A cost twenty times as large has the same optimum; one other weight that is not larger keeps the position's."""
    asked = MPCSettings(rate=100.0, nodes=20, attitude_weight=(0.0, 5.0, 5.0, 200.0), velocity_weight=(1.0,) * 3)
    asked = replace(asked, rate_weight=(1.0,) * 3, input_weight=433.5)
    for settings, (*_, weight, _) in zip(grids(asked)[1:], GRIDS[1:], strict=True):
        assert settings.position_weight == pytest.approx((20 * weight,) * 3)
    assert grids(asked)[0].position_weight == asked.position_weight  # while nothing is known, as asked
    damped = replace(asked, input_weight=0.03)
    assert [settings.position_weight[0] for settings in grids(damped)] == [weight for *_, weight, _ in GRIDS]


def test_small_changes_of_what_is_known_change_nothing():
    decision = Decision()
    first = decision.take(evidence(total=0.04, lag=0.03, slow=9), Senses(), 3.0)
    assert (first.dead_time, first.lag) == pytest.approx((0.01, 0.03))
    again = decision.take(evidence(total=0.0405, lag=0.031, slow=9), Senses(), 3.2)
    assert (again.dead_time, again.lag) == (first.dead_time, first.lag)
    assert decision.take(evidence(total=0.05, lag=0.031, slow=9), Senses(), 3.4).total == pytest.approx(0.05)


def test_the_grid_gets_stiffer_step_by_step_and_softer_at_once():
    decision, known = Decision(), evidence(sd=0.0005)
    assert [decision.take(known, Senses(), 3.0).grid for _ in range(5)] == [1, 2, 3, 4, 4]
    assert decision.take(evidence(sd=0.005), Senses(), 3.0).grid == 2
    assert decision.take(evidence(total=0.03, sd=0.02), Senses(), 3.0).grid == 0  # late, and nothing acts on it
    assert Decision().take(known, Senses(), 0.5).grid == 1
    noisy = Decision()
    assert max(noisy.take(known, Senses(position=0.005), 3.0).grid for _ in range(6)) == 3


def test_grids_fit_any_rate_and_number_of_nodes():
    for rate, nodes in ((50.0, 10), (100.0, 20), (20.0, 5)):
        fitting = grids(MPCSettings(rate=rate, nodes=nodes, input_hold="deviation"))
        assert len(fitting) == len(GRIDS) and {settings.nodes for settings in fitting} == {nodes}


def test_a_push_acts_from_five_deviations_on_and_for_good():
    decision = Decision()
    assert decision.begin(Senses(away=(GATE - 1, 0, 0)), 1.0).push == (False,) * 3
    assert decision.begin(Senses(away=(3 * GATE - 1, 0, 0)), 3.0) == Acting()  # of a sheet that may be wrong
    began = decision.begin(Senses(away=(GATE + 1, 9, 9)), 1.0)
    assert began.push == (True, False, False)  # thrusts have no time yet
    assert began.grid == PUSHED
    assert decision.take(evidence(), Senses(away=(0, 9, 9)), 3.0).push == (True, True, True)
    assert decision.take(evidence(sd=0.05), Senses(), 4.0).push == (True, True, True)


def test_commands_at_the_rotors_limits_soften_the_grid():
    """Behind a corner to FIRM; where they swing on, one by one to the softest."""
    decision, limited = Decision(), Senses(limited=0.5)
    decision.acting = Acting(grid=4)
    assert [decision.soften(limited).grid for _ in range(7)] == [FIRM] * PATIENT + [1, 0, 0, 0]
    decision.acting = Acting(grid=4)
    assert decision.soften(Senses()).grid == 4 and decision.soften(limited).grid == FIRM


def test_the_bandwidth_by_rotor_speeds_follows_from_the_sheet(vehicle):
    """q / (r sqrt(T)), r of accelerometer, speeds (twice their relative noise in the thrust) and attitude; at most
    FASTEST."""
    vehicle, period = replace(vehicle, thrust_coefficient=1e-6), 0.01
    noise = np.hypot(1.0, 0.02 * vehicle.gravity)  # of four rotors: 2 / sqrt(4)
    sheet = SensorSheet(accelerometer=Stated(1.0), rotor_speed=Stated(0.02, delay=0.01))
    assert speeds_tell(vehicle, sheet)
    K = 1 - np.exp(-STRONGEST / (noise * np.sqrt(period)) * period)
    settings = SpeedFollowing(vehicle, sheet, period).follow(np.zeros(39), Acting(), Acting(), Senses())
    assert settings[1] == pytest.approx(noise**2) and settings[0] == pytest.approx(noise**2 * K**2 / (1 - K))
    exact = SpeedFollowing(vehicle, SensorSheet(rotor_speed=Stated()), period)
    assert exact.follow(np.zeros(39), Acting(), Acting(), Senses())[7] == pytest.approx(1 - np.exp(-FASTEST * period))
    for other in (SensorSheet(), SensorSheet(rotor_speed=Stated(rate=25.0))):
        assert not speeds_tell(vehicle, other)


def test_a_scale_is_known_no_better_than_the_thrusts_and_the_air_it_is_told_by(vehicle):
    """By rotor speeds .08 off where the filter said .01, and forces 5 to 18 deviations; the more, the more thrusts
    swing. By the drag of a vehicle of another mass a fifth of the scale's distance from 1."""
    speeds, state = SpeedFollowing(replace(vehicle, thrust_coefficient=1e-6), SensorSheet(), 0.01), np.zeros(39)
    state[5:30] = np.diag([0.01, 0.01, 0.04, 1e-4, 1e-4]).ravel()
    for swing in (0.0, 5.0):
        speeds.follow(state, Acting(), Acting(), Senses(swing=swing))
        *_, force, _, scale = speeds.deviations(state)
        assert force == pytest.approx(vehicle.mass * np.hypot(0.2, 0.1 * swing))
        assert scale == pytest.approx(np.hypot(0.01, 0.1))
    wind, state = WindFollowing(WindObserver(), 0.02, 0.0, 0.3), np.zeros(29)
    state[3], state[4:20] = 0.25, np.diag([1.0, 1.0, 1.0, 1e-4]).ravel()
    assert wind.deviations(state)[-1] == pytest.approx(np.hypot(0.01, 0.05))


@pytest.mark.parametrize("kind", ["wind", "force"])
def test_the_observer_believes_nothing_that_has_not_shown_itself(kind):
    """And the less of what has, the noisier its readings are."""
    wind = kind == "wind"
    following = (
        WindFollowing(WindObserver(), 0.02, 0.0, 0.3) if wind else ForceFollowing(DisturbanceObserver(), 0.02, 1.0, 0.0)
    )
    state, senses = np.ones(29 if wind else 13), Senses(walk=np.ones(3), reading=np.full(3, 0.05), twist=3.0)
    following.follow(state, Acting(), Acting(), senses)
    believed = [0, 1, 2, 3, 20, 21, 22] if wind else [0, 1, 2]
    assert not state[believed].any() and not state[-3:].any()
    acting = Acting(timed=True, push=(True, True, True))
    state[:] = 1.0
    quiet = following.follow(state, acting, Acting(), senses)
    assert state[believed].all() and state[4 if wind else 6] == (16.0 if wind else 9.0)
    noisy = following.follow(
        state, acting, acting, Senses(walk=np.ones(3), reading=np.full(3, 0.05), attitude=0.02, rate=0.05, twist=3.0)
    )
    gain = 7 if wind else 0
    assert noisy[gain] < quiet[gain] and noisy[-3] < quiet[-3]
    deviations = following.deviations(state)
    assert np.isfinite(deviations[0 if wind else 3]) and np.isnan(deviations[3 if wind else 0])


def test_what_noise_leaves_of_a_force_that_stands_still_is_its_deviation(rng):
    """By a low pass of readings, each with the noise that the observer says its own have."""
    following, state, noise = ForceFollowing(DisturbanceObserver(), 0.01, 2.0, 0.0), np.zeros(13), [0.1, 0.2, 0.4]
    acting = Acting(timed=True, push=(True, True, True))
    following.follow(state, acting, Acting(), Senses(walk=np.ones(3), reading=np.array(noise)))
    *_, x, y, z, lag, _ = following.deviations(state)
    share = -np.expm1(-0.01 / lag)
    found = lfilter([share], [1, share - 1], rng.normal(0, noise, (40000, 3)), axis=0).std(0)
    assert np.array([x, y, z]) == pytest.approx(2.0 * found, rel=0.05)
