"""Time offsets that are known come back to a millisecond, with an error bar that covers them, or not as certain."""

import numpy as np
import pytest

from quadexp.errors import DataError
from quadexp.plugins.logs.signal import Stream
from quadexp.plugins.logs.signal.offset import estimate_offset, find_offsets
from tests.plugins.logs.importers import logs

T = np.arange(0, 30, 0.01)


def motion(t):
    """Three axes of sums of tones that have no common period."""
    tones = [(0.31, 1.0, 0.1), (0.83, 0.5, 1.0), (1.7, 0.4, 2.0), (4.1, 0.2, 0.5)]
    return np.stack(
        [sum(a * np.sin(2 * np.pi * f * (1 + 0.1 * k) * t + s + k) for f, a, s in tones) for k in range(3)], -1
    )


@pytest.mark.parametrize("offset", [-0.2, -0.0037, 0.0, 0.0123, 0.05, 0.31])
def test_known_offsets_to_a_millisecond(offset, rng):
    """Different rates, jittered clock, noise of a quarter of the signal, another gain and mean."""
    own = np.arange(7110) / 237 + rng.uniform(-1e-3, 1e-3, 7110)
    a = Stream(T, motion(T) + 0.2 * rng.normal(size=(len(T), 3)))
    b = Stream(own, 5 + 2.5 * motion(own - offset) + 0.5 * rng.normal(size=(len(own), 3)))
    found = estimate_offset(a, b)
    assert found.seconds == pytest.approx(offset, abs=1e-3)
    assert abs(found.seconds - offset) < 5 * found.error and found.error < 1e-3
    assert found.certain and found.correlation > 0.9


def test_error_bars_cover_the_truth(rng):
    t = T[:1000]
    pulls = []
    for _ in range(40):
        a, b = (Stream(t, motion(t - late) + 0.3 * rng.normal(size=(len(t), 3))) for late in (0.0, 0.02))
        found = estimate_offset(a, b)
        pulls.append((found.seconds - 0.02) / found.error)
    assert 0.6 < np.std(pulls) < 1.7 and abs(np.mean(pulls)) < 0.7


def noise(rng):
    return rng.normal(size=(len(T), 3)), rng.normal(size=(len(T), 3))


def a_tone(rng):
    """It cannot tell its periods."""
    return np.sin(2 * np.pi * 4 * T), np.sin(2 * np.pi * 4 * (T - 0.02))


def a_knock(rng):
    """What is seen once cannot be seen again in another stretch."""
    knock = np.exp(-(((T - 15) / 0.1) ** 2))
    return tuple(x + 1e-3 * rng.normal(size=len(T)) for x in (knock, np.roll(knock, 3)))


@pytest.mark.parametrize("signals", [noise, a_tone, a_knock])
def test_what_cannot_be_told_is_not_certain(signals, rng):
    a, b = signals(rng)
    assert not estimate_offset(Stream(T, a), Stream(T, b)).certain


def test_gaps_are_left_out_and_nothing_moves():
    kept = (T < 12) | (T > 15)
    found = estimate_offset(Stream(T[kept], motion(T)[kept]), Stream(T, motion(T - 0.04)))
    assert found.seconds == pytest.approx(0.04, abs=1e-3) and found.certain
    with pytest.raises(DataError, match="does not move"):
        estimate_offset(Stream(T, np.ones(len(T))), Stream(T, np.sin(T)))


# ------------------------------------------------------------------------------------------------ of a flight's sensors
@pytest.fixture(scope="module")
def truth():
    return logs.truth(40.0, 100.0, seed=1)


@pytest.mark.parametrize("size", [0.0, 1.0])
@pytest.mark.parametrize("delay", [0.0, 0.005, -0.02, 0.05])
def test_known_delays_of_a_flight_with_drag(truth, rng, delay, size):
    """Gyro and accelerometer late; size 1: noise of a hobby IMU and of a filtered motion capture."""
    f = truth

    def late(values, noise):
        moved = np.stack([np.interp(f.t - delay, f.t, column) for column in values.T], axis=1)
        return Stream(f.t, moved + size * rng.normal(0, noise, values.shape))

    velocity = Stream(f.t, f.v + size * rng.normal(0, 0.01, f.v.shape))
    log = {"attitude": Stream(f.t, f.q), "velocity": velocity, "rate": late(f.w, 0.05),
           "acceleration": late(f.acc, 0.5)}  # fmt: skip
    found = find_offsets(log)
    assert found["rate", "attitude"].certain
    for pair, one in found.items():
        if one.certain:
            assert abs(one.seconds - delay) < 4 * one.error + 0.1 * abs(delay) + 5e-4, pair
    assert size or found["acceleration", "velocity"].certain


def test_drift_is_no_motion(rng):
    """Standing still: the attitude drifts, the gyro's bias too; nothing is certain."""
    drift = 1e-3 * np.cumsum(rng.normal(0, 0.1, len(T)))
    q = np.stack([np.cos(drift / 2), 0 * T, 0 * T, np.sin(drift / 2)], axis=1)
    w = rng.normal(0, 2e-3, (len(T), 3)) + 1e-3 * np.sin(0.1 * T)[:, None]
    streams = {"attitude": q, "rate": w, "acceleration": [0, 0, 9.81] + rng.normal(0, 0.05, (len(T), 3))}
    found = find_offsets({name: Stream(T, values) for name, values in streams.items()})
    assert not any(one.certain for one in found.values())
