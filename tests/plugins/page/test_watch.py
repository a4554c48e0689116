"""A sweep that is watched: the page grows, loads itself anew while the sweep runs, and stays when it ends."""

import contextlib
import re
import time

import pytest

from quadexp.errors import UsageError
from quadexp.plugins.page.live import Live, clock, page
from quadexp.plugins.page.watch import FILE, Watch
from quadexp.sweeps.sweep import SweepInterrupted
from tests.report.test_tables import row

AGAIN = '<meta http-equiv="refresh"'


@pytest.fixture
def out(tmp_path, monkeypatch):
    monkeypatch.setattr("quadexp.plugins.page.watch.RENEWED", 0.0)
    monkeypatch.setattr("quadexp.plugins.page.watch.SHARE", 1e9)
    (tmp_path / "r" / "cells").mkdir(parents=True)
    return tmp_path / "r"


def fly(watch, *flights):
    for one in flights:
        watch.on_result(one)
        watch.progress(len(watch.live.rows), 4)


def shown(path, text):
    """The page as soon as it shows a text."""
    deadline = time.monotonic() + 60
    while not (path.exists() and text in path.read_text()):
        assert time.monotonic() < deadline, path.exists() and path.read_text()
        time.sleep(0.02)
    return path.read_text()


def test_the_page_grows_and_its_numbers_are_those_of_the_flights(out):
    with Watch(out, "mean_error") as watch:
        watch.progress(0, 4)
        fly(watch, row(seed=0, error=0.2), row(seed=1, error=0.3), row("gp_mpc", error=0.9, outcome="lost"))
        text = shown(watch.path, "3 of 4 flights")
        assert AGAIN in text and 'max="4" value="3"' in text
        columns, flown, line = watch.snapshot().table().columns, *watch.snapshot().table().rows
        assert columns == ["trajectory", "m/s", "nominal_mpc", "gp_mpc"]
        assert flown == ["flown", "", "2 of 2", "0 of 1"]
        assert line[2].startswith("250.0 [") and line[3] == "1 lost"  # (0.2 + 0.3) / 2 m
        fly(watch, row("gp_mpc", seed=1, error=0.004))
        assert watch.snapshot().table().rows[1][2:] == ["300.0 (all 2: 250.0)", "4.00 (1 lost)"]
    left = (out / FILE).read_text()
    assert "4 of 4 flights, finished" in left and AGAIN not in left and "all 2: 250.0" in left


def test_the_page_asks_no_other_machine_and_shows_names_as_text():
    names = ["<script>alert(1)</script>", 'a"b', "gp_mpc+wind"]
    live = Live("<b>", "mean_error", 4, rows=[row(name, error=0.1, trajectory="<i>") for name in names])
    text = page(live, 2.0)
    assert "<script" not in text and "<b>" not in text and "<i>" not in text
    assert not re.findall(r"https?://", text)


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), SweepInterrupted("3 of 4 done; run the same command to continue")]
)
def test_an_end_that_was_not_asked_for_is_said(out, error):
    with contextlib.suppress(type(error)), Watch(out, "mean_error") as watch:
        fly(watch, row())
        raise error
    assert "1 of 4 flights, interrupted" in (out / FILE).read_text()


def test_a_sweep_that_is_refused_leaves_nothing(tmp_path):
    with contextlib.suppress(UsageError), Watch(tmp_path / "r", "mean_error"):
        raise UsageError("no such thing")
    assert not (tmp_path / "r").exists()


def test_times():
    assert [clock(s) for s in (4.6, 65, 3723)] == ["0:00:05", "0:01:05", "1:02:03"]
    live = Live("r", "mean_error", 10, 8.0, 2, rows=[row()] * 6)  # 4 in 8 s, 4 to go
    assert live.progress_text() == "6 of 10 flights, 0:00:08 so far, about 0:00:08 left"
