"""Readings of some time ago, against a straight line, on which linear interpolation is exact."""

import numpy as np
import pytest

from quadexp.control.control_step import run
from quadexp.plugins.remedies.delay_line import DelayLine

PERIOD = 0.01


@pytest.mark.parametrize("age", [0.0, 0.0033, 0.01, 0.024])
def test_a_ramp_is_known_earlier(age):
    values, slope = np.zeros(2), np.array([1.0, -3.0])
    delay_line = DelayLine(2, age, PERIOD, "interpreted")
    delay_line.reset(values)
    calls = delay_line.before(values)
    for k in range(8):
        values[:] = slope * k * PERIOD
        run(calls, k)
        delay_line.memory.commit()
        since = k * PERIOD - age
        if since > 0:
            assert delay_line.output == pytest.approx(slope * since)
            assert (
                abs(delay_line.oldest[0] - since) < PERIOD + 1e-12
                and delay_line.oldest[0] <= delay_line.output[0] + 1e-12
            )
        else:
            assert not delay_line.output.any()
