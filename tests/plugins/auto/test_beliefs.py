"""How far a low pass is behind what moves, and the one lag of motors that lag unlike up and down."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.plugins.auto.beliefs import behind, beliefs, force_variance, lag_of, truths
from quadexp.plugins.auto.settings import INTERVAL

STEP = 0.0005  # s


def test_a_low_pass_is_behind_a_ramp_by_what_it_moved_in_its_time_constant():
    t, lag, slope = np.arange(0, 2, STEP), 0.05, 3.0
    share = -np.expm1(-STEP / lag)
    value = lfilter([share], [1, share - 1], slope * t)
    moved = behind(t, value, np.full(len(t), lag))
    assert moved[t > 1] == pytest.approx((slope * t - value)[t > 1], rel=0.02)
    assert moved[-1] == pytest.approx(slope * lag, rel=1e-6)
    wave = lfilter([share], [1, share - 1], np.sin(8 * t))  # which stands still twice in a turn
    there = behind(t, wave, np.full(len(t), lag))[t > 1]
    assert 0.2 * 8 * lag < there.min() and there.max() < 8 * lag
    assert not behind(t, np.ones(len(t)), np.full(len(t), lag)).any()


@pytest.mark.parametrize(("sd", "known"), [(0.0, 0.004), (0.003, 0.007), (0.004, 0.0)])
def test_thrusts_that_are_expected_too_late_look_like_a_force(sd, known):
    """A climb whose thrust grows by 5 N/s, upright, of which rms(sd, known) is not acted on."""
    t, lag, ones = np.arange(0, 2, STEP), 0.05, np.ones(round(2 / STEP))
    share, off = -np.expm1(-STEP / lag), np.hypot(sd, known)
    force = lfilter([share], [1, share - 1], 5.0 * t - 5.0 * np.maximum(t - off, 0.0))  # which is none
    columns = {"observer_force_z": force, "auto_force_lag": lag * ones, "auto_thrust_scale_sd": np.nan * ones}
    columns |= {"auto_delay": (0.01 + known) * ones}
    columns |= {
        f"auto_delay_{end}": columns["auto_delay"] + sign * INTERVAL.band * sd
        for end, sign in (("low", -1), ("high", 1))
    }
    columns |= {"auto_acts_dead_time": 0.01 * ones, "auto_acts_lag": 0.0 * ones}
    state = np.tile([0, 0, 0, 1.0, *np.zeros(9)], (len(t), 1))
    flight = SimpleNamespace(t=t, columns=columns, state=state, input=np.tile(5.0 * t[:, None] / 4, 4))
    assert np.sqrt(force_variance(flight, "observer_force_z")[-1]) == pytest.approx(force[-1], rel=0.01)
    by_speeds = SimpleNamespace(**vars(flight) | {"columns": columns | {"observer_air_scale": 1 + 0.1 * t}})
    assert force_variance(by_speeds, "observer_force_z")[-1] == pytest.approx(0.0, abs=1e-9)
    still = SimpleNamespace(t=t, columns=columns | {"auto_delay_high": np.inf * ones}, state=state)
    still.input = np.ones((len(t), 4))  # a delay of at least some time, which thrusts that stand do not show
    assert np.isfinite(force_variance(still, "observer_force_z")).all()


@pytest.mark.parametrize(("up", "down"), [(0.0125, 0.025), (0.03, 0.03), (0.02, 0.01)])
@pytest.mark.parametrize("held", [20, 40])
def test_motors_that_lag_unlike_up_and_down_have_the_lag_that_fits_them_best(rng, up, down, held):
    command = np.repeat(1 + 0.1 * rng.standard_normal(2000), held)
    ways, root, thrust = [-np.expm1(-STEP / way) for way in (up, down)], 1.0, []
    for wanted in np.sqrt(command):  # the rotors' speed lags
        root += ways[int(wanted < root)] * (wanted - root)
        thrust.append(root**2)
    went = np.array(thrust) - np.mean(thrust)

    def left(lag):
        share = -np.expm1(-STEP / lag)
        model = lfilter([share], [1, share - 1], command - command.mean())
        return np.square(went - (model @ went) / (model @ model) * model).sum()

    best = minimize_scalar(left, bounds=(0.003, 0.1), method="bounded").x
    assert lag_of(up, down) == pytest.approx(best, rel=0.03)


@pytest.mark.parametrize(
    ("world", "scale"),
    [
        (["truth.thrust_coefficient=0.85"], 0.85),
        (["truth.mass=0.8", "world=only_motor_lag", "link=latency"], 1.25),
        (["truth.mass=0.8", "world=only_motor_lag", "vehicle=hummingbird"], 1.25),
    ],
)
def test_the_true_scale_is_that_of_the_world_in_corners_too(world, scale):
    """Thrusts are compared with the commands that they follow."""
    path = ["trajectory=rectangle", "trajectory.start=reference", "trajectory.duration=6", "trajectory.speed=4"]
    flight = fly_one(compose([*world, *path, "controller=nominal_mpc", "controller.allow_unstable=true"]))
    assert truths(flight)["observer_thrust_scale"][flight.t > 1] == pytest.approx(scale, rel=1e-6)


def test_what_a_world_draws_or_carries_has_no_true_scale():
    for world in (["world=everything"], ["vehicle=lei_li", "plant=blade_element_payload"]):
        flight = fly_one(compose([*world, "controller=nominal_mpc", "trajectory.duration=1", "trajectory=hover"]))
        assert np.isnan(truths(flight)["observer_thrust_scale"]).all()


def test_a_flight_of_one_sample_has_no_beliefs():
    interpreted = "controller.backend=interpreted", "plant.backend=interpreted"
    hover = "controller=perfect_mpc", "trajectory=hover", "trajectory.duration=0.01", "remedies=auto"
    flight = fly_one(compose([*hover, *interpreted]))
    assert len(flight) == 1 and not beliefs(flight)
