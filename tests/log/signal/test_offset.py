"""Time offsets that are known come back to a millisecond, with an error bar that covers them, or not as certain."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.errors import DataError
from quadexp.log.signal import Stream
from quadexp.log.signal.offset import estimate_offset


def motion(t):
    """Three axes of sums of tones that have no common period."""
    tones = [(0.31, 1.0, 0.1), (0.83, 0.5, 1.0), (1.7, 0.4, 2.0), (4.1, 0.2, 0.5)]
    return np.stack(
        [sum(a * np.sin(2 * np.pi * f * (1 + 0.1 * k) * t + s + k) for f, a, s in tones) for k in range(3)], -1
    )


@pytest.mark.parametrize("offset", [-0.2, -0.05, -0.0037, 0.0, 0.0123, 0.05, 0.31])
def test_known_offsets_to_a_millisecond(offset, rng):
    """Different rates, jittered clock, noise of a quarter of the signal, another gain and mean."""
    t = np.arange(0, 30, 0.01)
    own = np.arange(7110) / 237 + rng.uniform(-1e-3, 1e-3, 7110)
    a = Stream(t, motion(t) + 0.2 * rng.normal(size=(len(t), 3)))
    b = Stream(own, 5 + 2.5 * motion(own - offset) + 0.5 * rng.normal(size=(len(own), 3)))
    found = estimate_offset(a, b)
    assert found.seconds == pytest.approx(offset, abs=1e-3)
    assert abs(found.seconds - offset) < 5 * found.error and found.error < 1e-3
    assert found.certain and found.correlation > 0.9 and found.gain == pytest.approx(2.5, rel=0.1)


def test_error_bars_cover_the_truth(rng):
    t = np.arange(0, 10, 0.01)
    pulls = []
    for _ in range(40):
        a = Stream(t, motion(t) + 0.3 * rng.normal(size=(len(t), 3)))
        b = Stream(t, motion(t - 0.02) + 0.3 * rng.normal(size=(len(t), 3)))
        found = estimate_offset(a, b)
        pulls.append((found.seconds - 0.02) / found.error)
    assert 0.6 < np.std(pulls) < 1.7 and abs(np.mean(pulls)) < 0.7


def test_noise_is_not_certain(rng):
    t = np.arange(0, 20, 0.01)
    found = estimate_offset(Stream(t, rng.normal(size=(2000, 3))), Stream(t, rng.normal(size=(2000, 3))))
    assert not found.certain


def test_a_pure_tone_cannot_tell_its_periods():
    t = np.arange(0, 20, 0.01)
    found = estimate_offset(Stream(t, np.sin(2 * np.pi * 4 * t)), Stream(t, np.sin(2 * np.pi * 4 * (t - 0.02))))
    assert found.rival > 0.97 and not found.certain


def test_gaps_are_left_out():
    t = np.arange(0, 40, 0.01)
    kept = (t < 15) | (t > 18)
    found = estimate_offset(Stream(t[kept], motion(t)[kept]), Stream(t, motion(t - 0.04)))
    assert found.seconds == pytest.approx(0.04, abs=1e-3) and found.certain


def test_nothing_moves():
    t = np.arange(0, 20, 0.01)
    with pytest.raises(DataError, match="does not move"):
        estimate_offset(Stream(t, np.ones(2000)), Stream(t, np.sin(t)))


def test_a_flight_that_turns_in_a_moment_only_is_not_certain(rng):
    """One knock: what is seen once cannot be seen again in another stretch."""
    t = np.arange(0, 30, 0.01)
    knock = np.exp(-(((t - 15) / 0.1) ** 2))
    noise = lambda: 1e-3 * rng.normal(size=len(t))  # noqa: E731
    found = estimate_offset(Stream(t, knock + noise()), Stream(t, np.roll(knock, 3) + noise()))
    assert not found.certain
