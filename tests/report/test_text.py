"""Numbers as text: by hand, and read back."""

import math

import pytest

from quadexp.plugins.page.typeset import duration, percent, relative, typeset
from quadexp.report import text
from quadexp.report.text import count, listed, number, speed_text


@pytest.mark.parametrize("value", [0.0, 3e-7, 0.0123, 1.234, 99.96, 1234.5, -0.5, -7e-6])
def test_a_number_read_back_has_three_digits_or_one_decimal(value):
    assert float(number(value)) == pytest.approx(value, rel=6e-3)
    assert number(math.nan) == number(math.inf) == "-"


def test_percentages_have_the_decimals_of_their_interval():
    assert percent(98.6123, 98.58, 98.64) == ("98.61 %", " [98.58, 98.64]")
    assert percent(50.0, 20.0, 80.0) == ("50.0 %", " [20.0, 80.0]")
    texts = [percent(99.9713), percent(95.2, least=0), percent(0.1), percent(math.nan)]
    assert texts == [("99.971 %", ""), ("95 %", ""), ("0.1 %", ""), ("-", "")]
    assert text.with_interval(240.57, 239.91, 241.22) == ("240.6", " [239.9, 241.2]")
    assert text.with_interval(0.8291, 0.7331, 0.9247) == ("0.829", " [0.733, 0.925]")
    assert text.with_interval(12.3) == ("12.3", "") and text.with_interval(5.0, 5.0, 5.0) == ("5.00", " [5.00, 5.00]")


def test_p_values():
    assert [text.p_value(p) for p in (0.0312, 1e-5, 1.0, math.nan)] == ["0.031", "< 0.0001", "1", "-"]
    assert [text.probability(p) for p in (0.0312, 1e-5, math.nan)] == ["p = 0.031", "p < 0.0001", ""]


def test_times_speeds_and_counts():
    assert [duration(t) for t in (40.3e-6, 0.0142, 2.1, 0.25)] == ["40.3 µs", "14.2 ms", "2.10 s", "250 ms"]
    assert duration(0.02, exact=True) == "20 ms" and duration(math.nan) == "-"
    assert [speed_text(v) for v in (8.0, None, math.nan, 0.5)] == ["8 m/s", "", "", "0.5 m/s"]
    assert [count(n, "flight") for n in (0, 1, 2)] == ["0 flights", "1 flight", "2 flights"]
    assert [relative(v) for v in (-99.123, 0.0, math.nan)] == ["-99.1 %", "same", "-"]
    assert [listed(words) for words in ([], ["a"], ["a", "b", "c"])] == ["", "a", "a, b and c"]


def test_the_page_has_minus_signs_and_no_breaks_inside_values_and_changes_nothing_else():
    assert typeset("-1.5 mm [-2.0, -1.0]") == "\u22121.5\u202fmm [\u22122.0,\u00a0\u22121.0]"
    assert typeset("-") == "\u2013" and typeset("98.6 % less (p < 0.0001)") == "98.6\u202f% less (p\u00a0<\u00a00.0001)"
    for plain in ("gain=-1", "2026-01-02", "linear-drag MPC", "4 to 12 seeds", "5 of 20", "a/-1"):
        assert typeset(plain) == plain
