"""Ground phases and derivatives."""

import numpy as np
import pytest

from quadexp.errors import DataError
from quadexp.plugins.logs.importers.ground import crop
from quadexp.plugins.logs.signal import derivative, increasing

T = np.arange(0, 20, 0.01)
CROP = {"clearance": 0.5, "margin": 1.5}
HEIGHT = np.interp(T, [0, 2, 4, 16, 18, 20], [0.05, 0.05, 1.0, 1.0, 0.05, 0.05])


def test_crop_takes_the_margin_off_both_sides():
    kept = crop(T, HEIGHT, **CROP)
    up = 2 + 2 * 0.45 / 0.95  # when the climb passes 0.5 m
    assert T[kept][0] == pytest.approx(up + 1.5, abs=0.02)
    assert T[kept][-1] == pytest.approx(18 - 2 * 0.45 / 0.95 - 1.5, abs=0.02)
    assert np.diff(np.flatnonzero(kept)).max() == 1


def changed(value, rows):
    height = HEIGHT.copy()
    height[rows] = value
    return height


def test_a_short_dropout_does_not_cut_the_flight_and_a_landing_does():
    assert (crop(T, changed(0.0, slice(1000, 1010)), **CROP) == crop(T, HEIGHT, **CROP)).all()
    kept = crop(T, changed(0.05, slice(900, 1100)), **CROP)
    assert not kept[760:1240].any() and kept[700] and kept[1300]


def test_a_log_in_the_air_is_kept_and_one_on_the_ground_has_no_flight():
    assert crop(T, 1 + 0.1 * np.sin(T), **CROP).all()
    assert not crop(T, 0.05 + 0 * T, **CROP).any()


def test_derivative_of_tones_and_its_bandwidth():
    for frequency, least, most in ((0.5, 0.999, 1.001), (1.0, 0.99, 1.01)):
        found = derivative(T, np.sin(2 * np.pi * frequency * T))
        expected = 2 * np.pi * frequency * np.cos(2 * np.pi * frequency * T)
        gain = np.sum(found.values * expected) / np.sum(expected**2)
        assert least < gain < most
    at = found.bandwidth
    wave = derivative(T, np.sin(2 * np.pi * at * T)).values
    expected = 2 * np.pi * at * np.cos(2 * np.pi * at * T)
    inner = slice(50, -50)
    assert np.sum(wave[inner] * expected[inner]) / np.sum(expected[inner] ** 2) == pytest.approx(0.707, abs=0.01)


def test_derivative_does_not_reach_across_segments():
    jump = np.where(T < 10, T, T + 100)
    found = derivative(T, jump, segment=(T >= 10).astype(int))
    np.testing.assert_allclose(found.values, 1, atol=1e-9)


def test_derivative_refuses_a_clock_that_is_not_uniform():
    t = T.copy()
    t[700:] += 0.004
    with pytest.raises(DataError, match="row 699"):
        derivative(t, T)


def test_increasing_leaves_out_what_goes_back():
    assert increasing(np.array([0, 1, 1, 0.5, 2, np.nan, 3])).tolist() == [True, True, False, False, True, False, True]
