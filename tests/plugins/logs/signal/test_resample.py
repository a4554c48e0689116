"""Resampling: frequency response, no aliasing, gaps kept, quaternions on the sphere, held signals, samples kept."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.plugins.logs.signal import Stream
from quadexp.plugins.logs.signal.resample import interpolate, resample


def tone(frequency, rate, duration=10.0, jitter=0.0, rng=None):
    t = np.arange(int(duration * rate)) / rate
    if jitter:
        t = t + rng.uniform(-jitter, jitter, len(t)) / rate
    return Stream(t, np.sin(2 * np.pi * frequency * t))


def amplitude(out, frequency):
    """Amplitude and phase of the tone left in a resampled stream, its ends aside."""
    inner = slice(len(out.t) // 5, -len(out.t) // 5)
    phase = 2 * np.pi * frequency * out.t[inner]
    basis = np.stack([np.sin(phase), np.cos(phase)], axis=-1)
    (a, b), *_ = np.linalg.lstsq(basis, out.values["x"][inner, 0], rcond=None)
    return np.hypot(a, b), np.arctan2(b, a)


@pytest.mark.parametrize("frequency", [1.0, 10.0, 20.0, 38.0])
def test_pass_band_is_flat_and_without_phase(frequency):
    gain, phase = amplitude(resample({"x": tone(frequency, 1000)}, 100), frequency)
    assert gain == pytest.approx(1, abs=5e-3) and abs(phase) < 1e-3


@pytest.mark.parametrize("rate", [1000.0, 977.0, 250.0])
@pytest.mark.parametrize("frequency", [55.0, 70.0, 95.0, 110.0])
def test_a_tone_above_nyquist_leaves_nothing(rate, frequency):
    out = resample({"x": tone(frequency, rate)}, 100)
    inner = out.values["x"][50:-50]
    assert np.abs(inner).max() < (6e-3 if rate > 500 else 0.05)  # plain picking of samples would leave 1
    assert np.abs(out.values["x"]).max() < 1  # at the ends half the filter lies on the continuation


@pytest.mark.parametrize(("frequency", "source", "jitter"), [(5.0, 400, 0.3), (1.0, 50, 0.0)])
def test_irregular_and_slower_clocks(frequency, source, jitter, rng):
    out = resample({"x": tone(frequency, source, jitter=jitter, rng=rng), "y": tone(1.0, 200)}, 100)
    gain, phase = amplitude(out, frequency)
    assert gain == pytest.approx(1, abs=5e-3) and abs(phase) < 2e-3


def test_samples_on_the_clock_are_taken_to_the_last_bit(rng):
    t = 100.0 + np.arange(500) * 0.01
    values, q = rng.normal(size=(500, 3)), rng.normal(size=(500, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    out = resample({"x": Stream(t, values), "q": Stream(t, q)}, 100)
    assert (out.values["x"] == values).all() and len(out.t) == 500
    np.testing.assert_array_equal(np.abs(out.values["q"]), np.abs(q))


@pytest.mark.parametrize("lost", [np.nan, None])
def test_gaps_start_a_new_segment_and_are_not_bridged(lost):
    """Rows that are not there, or not finite; a few that are lost are bridged."""
    a = tone(1.0, 200)
    bad = ((a.t >= 3.0) & (a.t <= 4.0)) | ((a.t >= 7.0) & (a.t < 7.015))
    x = Stream(a.t, np.where(bad, lost, a.values)) if lost is not None else Stream(a.t[~bad], a.values[~bad])
    out = resample({"x": x, "y": a}, 100)
    assert set(out.segment) == {0, 1} and np.isfinite(out.values["x"]).all()
    assert not ((out.t > 3.0) & (out.t < 4.0)).any()
    assert out.t[out.segment == 1][0] == pytest.approx(4.0, abs=0.011)
    inside = np.diff(out.segment) == 0
    np.testing.assert_allclose(np.diff(out.t)[inside], 0.01, atol=1e-12)


@pytest.mark.parametrize("source", [10.0, 1000.0])
def test_lines_are_kept_to_the_ends(source):
    """Of a battery at 10 Hz beside a 100 Hz log, which is not all gaps, and of what is filtered."""
    t = np.arange(0, 10, 1 / source)
    out = resample({"x": tone(1.0, 100), "line": Stream(t, 4 - 0.01 * t)}, 100)
    assert set(out.segment) == {0} and out.t[-1] == pytest.approx(9.99, abs=0.1)
    np.testing.assert_allclose(out.values["line"][:, 0], 4 - 0.01 * out.t, atol=1e-9)


def test_held_signals_keep_their_steps():
    command = Stream(np.arange(0, 10, 0.1), np.arange(100.0))
    out = resample({"x": tone(1.0, 100), "u": command}, 100, held=("u",))
    np.testing.assert_array_equal(out.values["u"][:, 0], np.floor(out.t * 10 + 1e-6))


@pytest.mark.parametrize("source", [40.0, 333.0, 1000.0])
def test_quaternions_through_sign_flips(source, rng):
    """A steady turn: slerp is exact, however the log chose its signs."""
    t = np.arange(0, 6, 1 / source)
    rate = np.array([0.7, -1.1, 1.9])
    q = np.roll(Rotation.from_rotvec(t[:, None] * rate).as_quat(), 1, axis=1)
    q *= rng.choice([-1, 1], len(t))[:, None]
    out = resample({"q": Stream(t, q)}, 100)
    found = out.values["q"]
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
    assert (np.sum(found[1:] * found[:-1], axis=1) > 0).all()
    error = Rotation.from_quat(np.roll(found, -1, axis=1)).inv() * Rotation.from_rotvec(out.t[:, None] * rate)
    inner = slice(10, -10)
    assert error[inner].magnitude().max() < (1e-9 if source <= 100 else 2e-3)


def test_what_cannot_be_is_named():
    a, t = tone(1.0, 100), np.arange(10) / 10
    with pytest.raises(DataError, match="no time in common"):
        resample({"a": a, "b": Stream(a.t + 20, a.values)}, 100)
    t[5] = 0.1
    with pytest.raises(DataError, match="row 4"):
        resample({"a": Stream(t, t)}, 10)


def test_a_quaternion_that_is_none_is_left_out():
    """Of norm zero or NaN: a log is refused for it by its check, not by the interpolation of another fault."""
    t, angle = np.arange(5.0), 0.2 * np.arange(5.0)
    turned = Rotation.from_rotvec(angle[:, None] * [0, 0, 1]).as_quat(scalar_first=True)
    at, whole = np.array([1.5, 2.0, 3.7]), turned.copy()
    turned[2], turned[3] = 0.0, np.nan
    np.testing.assert_allclose(
        interpolate(t, turned, at, sphere=True), interpolate(t, whole, at, sphere=True), atol=1e-12
    )
    assert np.isnan(interpolate(t, np.zeros((5, 4)), at, sphere=True)).all()


def test_the_new_clock_is_that_of_commands_as_fast(rng):
    """Motion begins 4 ms after a command: on its own clock every command would be 4 ms older than it says."""
    t = np.arange(500) / 100
    command, motion = rng.normal(size=(500, 1)), np.sin(t)[:, None]
    found = resample({"p": (t + 0.004, motion), "motor_command": (t, command)}, 100.0, held=("motor_command",))
    np.testing.assert_allclose(found.t, t[1:], atol=1e-12)
    assert np.array_equal(found.values["motor_command"], command[1:])
