"""Dead time and lag of recorded commands: the truth inside the intervals, and the drag of a fit unbiased by them."""

import numpy as np
import pytest

from quadexp.models.regression import half_width
from quadexp.plugins.identification.thrust_curve import CurveSettings, fit_thrust_samples
from quadexp.plugins.logs.command_lag import find_lag, lagged
from quadexp.plugins.logs.samples import gather, gather_to_fit
from tests.models.late_flights import C, late_flight
from tests.slow import slow

SQUARED = CurveSettings(powers=(2,))


def test_lag_is_the_step_response():
    step = np.repeat([0.0, 1.0], [10, 40])[:, None]
    response = lagged(step, 0.01, 0.02, 0.05)[:, 0]
    since = np.maximum(0.01 * (np.arange(50) - 10) - 0.02, 0.0)
    assert response == pytest.approx(1 - np.exp(-since / 0.05), abs=0.03)
    assert lagged(step, 0.01, 0.0, 0.0) == pytest.approx(step)


TIMES = ((0.01, 0.03), (0.0, 0.04), (0.02, 0.0), (0.03, 0.06))  # s
CASES = [(dead_time, lag, seed) for dead_time, lag in TIMES for seed in (0, 1)]
FEW = [(0.0, 0.04, 0), (0.02, 0.0, 1), (0.03, 0.06, 0)]  # a lag alone, a dead time alone, and both at their largest


@pytest.mark.parametrize(("dead_time", "lag", "seed"), [*FEW, *slow(*(case for case in CASES if case not in FEW))])
def test_late_commands_bias_no_drag(dead_time, lag, seed):
    flight = late_flight(dead_time, lag, seed=seed)
    samples = gather([flight], "motor_command")
    late = find_lag(samples.time, samples.segment, samples.signal, samples.force[:, 2], samples.velocity, samples.held)
    for truth, (low, high) in zip((dead_time, lag, dead_time + lag), late.intervals, strict=True):
        assert low - 1e-6 <= truth <= high + 1e-6
    at_once, _ = fit_thrust_samples(samples, SQUARED)
    curve, _ = fit_thrust_samples(gather_to_fit([flight]), SQUARED)
    assert at_once.drag_z < -0.2  # what is wrong without it
    assert abs(curve.drag_z) < min(0.02, half_width(curve.drag_z_error, curve.freedom))
    assert curve.residual_std == pytest.approx(0.1, abs=0.01)
    assert curve.coefficients[0] == pytest.approx(C, rel=2e-3)


def test_nothing_is_found_where_commands_act_at_once():
    flight = late_flight(0.0, 0.0)
    samples = gather([flight], "motor_command")
    force = 4 * C * samples.signal[:, 0] ** 2
    late = find_lag(samples.time, samples.segment, samples.signal, force, samples.velocity, samples.held)
    assert not late.late and late.dead_time == late.lag == 0.0
