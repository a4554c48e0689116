"""Readings of some time ago, against a straight line, on which linear interpolation is exact."""

import numpy as np
import pytest

from quadexp.control.instant import run
from quadexp.plugins.remedies.earlier import Earlier

PERIOD = 0.01


@pytest.mark.parametrize("age", [0.0, 0.0033, 0.01, 0.024])
def test_a_ramp_is_known_earlier(age):
    values, slope = np.zeros(2), np.array([1.0, -3.0])
    earlier = Earlier(2, age, PERIOD, "interpreted")
    earlier.reset(values)
    operations = earlier.before(values)
    for k in range(8):
        values[:] = slope * k * PERIOD
        run(operations, k)
        earlier.memory.commit()
        since = k * PERIOD - age
        if since > 0:
            assert earlier.then == pytest.approx(slope * since)
            assert abs(earlier.oldest[0] - since) < PERIOD + 1e-12 and earlier.oldest[0] <= earlier.then[0] + 1e-12
        else:
            assert not earlier.then.any()
