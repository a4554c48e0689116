"""A sweep that is watched: the page grows, loads itself anew while the sweep runs, and stays when it ends."""

from __future__ import annotations

import contextlib
import io
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from quadexp.errors import UsageError
from quadexp.report.live import Live, clock, page
from quadexp.sweeps.sweep import SweepInterrupted
from quadexp.sweeps.watch import FILE, Watch
from tests.cli.command import run_main
from tests.report.test_html_browser import BROWSER, DRIVER, browser, wait  # noqa: F401
from tests.report.test_tables import row

ROOT = Path(__file__).resolve().parents[2]
HOVER = (
    "trajectory=hover", "trajectory.duration=0.3", "plant=ideal", "controller.backend=interpreted",
    "plant.backend=interpreted",
)  # fmt: skip
AGAIN = '<meta http-equiv="refresh"'


@pytest.fixture
def out(tmp_path, monkeypatch):
    monkeypatch.setattr("quadexp.sweeps.watch.RENEWED", 0.0)
    monkeypatch.setattr("quadexp.sweeps.watch.SHARE", 1e9)
    (tmp_path / "r" / "cells").mkdir(parents=True)
    return tmp_path / "r"


def fly(watch, *flights):
    for one in flights:
        watch.landed(one)
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
        columns, flown, line = watch.shot().table().columns, *watch.shot().table().rows
        assert columns == ["trajectory", "m/s", "nominal_mpc", "gp_mpc"]
        assert flown == ["flown", "", "2 of 2", "0 of 1"]
        assert line[2].startswith("250.0 [") and line[3] == "1 lost"  # (0.2 + 0.3) / 2 m
        fly(watch, row("gp_mpc", seed=1, error=0.004))
        assert watch.shot().table().rows[1][2:] == ["300.0 (own 250.0 of 2)", "4.00 (1 lost)"]
    left = (out / FILE).read_text()
    assert "4 of 4 flights, finished" in left and AGAIN not in left and "own 250.0 of 2" in left


def test_settings_that_contradict_each_other_are_no_flight():
    rows = [row(error=0.2), row(seed=1, outcome="lost"), row(seed=2, outcome="invalid")]
    flown, line = Live("r", "mean_error", 3, rows=rows).table().rows
    assert (flown[2], line[2]) == ("1 of 2", "200.0 (1 lost)")


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


@pytest.mark.parametrize("width", [60, 80, 200])
def test_the_table_on_a_terminal_fits_it(width):
    rows = [row(name, error=0.1) for name in ("nominal_mpc", "linear_drag_mpc", "gp_mpc+wind+strapdown", "perfect_mpc")]
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(Live("r", "mean_error", 8, 12.0, rows=rows).table().rich())
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= width and "100.0" in "".join(lines) and "4 of 8 flights" in " ".join(lines)


def test_times():
    assert [clock(s) for s in (4.6, 65, 3723)] == ["5 s", "1:05 min", "1:02:03 h"]
    live = Live("r", "mean_error", 10, 8.0, 2, rows=[row()] * 6)  # 4 in 8 s, 4 to go
    assert live.progress_text() == "6 of 10 flights, 8 s so far, about 8 s left"


def test_the_command(tmp_path):
    """In a process of its own: the path is said, and the file shows the end."""
    words = ("evaluate", "--sweep", "--watch", "--no-figures", *HOVER, "seed=range(4)", "--out", str(tmp_path / "r"))
    done = subprocess.run([sys.executable, "-m", "quadexp", *words], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0 and str(tmp_path / "r" / FILE) in done.stderr.splitlines()[0], done
    assert "nominal_mpc" in done.stdout and "4 of 4 flights, finished" in (tmp_path / "r" / FILE).read_text()
    assert run_main("results", tmp_path / "r", "--verify").returncode == 0


def test_a_port_and_a_watch_without_a_sweep_are_one_line(tmp_path):
    for words in (("--sweep", "--watch", "--port", "8000"), ("--watch",)):
        done = run_main("evaluate", *words, *HOVER, "seed=0,1", "--out", tmp_path / "r")
        assert (done.returncode, done.stdout) == (2, "") and done.stderr.count("\n") == 1, done
    assert not (tmp_path / "r").exists()


@pytest.mark.skipif(not (BROWSER and DRIVER), reason="needs chromium and chromedriver on the PATH")
def test_in_a_browser(browser, out):  # noqa: F811
    """It grows by itself, fits a phone, and shows the end."""
    metrics = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    state = "document.querySelector('[data-state]').textContent"
    with Watch(out, "mean_error") as watch:
        fly(watch, row(error=0.2))
        shown(watch.path, "1 of 4")
        browser.get(watch.path.as_uri())
        wait(browser, f"{state}.startsWith('1 of 4')")
        fly(watch, row("gp_mpc", error=0.02), row("linear_drag_mpc", speed=4.0, error=0.1))
        wait(browser, f"{state}.startsWith('3 of 4')")
        assert browser.execute_script("return document.documentElement.scrollWidth") <= 390
        fly(watch, row("gp_mpc", speed=4.0, error=0.01))
    wait(browser, f"{state} === '4 of 4 flights, finished'")
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
