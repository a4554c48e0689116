"""How far a low pass is behind what moves, and the one lag of motors that lag unlike up and down."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from quadexp.report.beliefs import behind, lag_of

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
