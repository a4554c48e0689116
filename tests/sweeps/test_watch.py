"""A sweep that is watched: the page grows, is of this machine only, survives a reload, and stays when it ends."""

from __future__ import annotations

import contextlib
import io
import re
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from rich.console import Console

from quadexp.errors import UsageError
from quadexp.report.live import Live, clock, live_table, page
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


@pytest.fixture
def out(tmp_path):
    (tmp_path / "r" / "cells").mkdir(parents=True)
    return tmp_path / "r"


def get(url, **headers):
    """Status and text."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=30) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, ""


def fly(watch, *flights):
    for one in flights:
        watch.landed(one)
        watch.progress(len(watch.live.rows), 4)


def test_the_page_grows_and_its_numbers_are_those_of_the_flights(out):
    with Watch(out, "mean_error") as watch:
        watch.progress(0, 4)
        assert "0 of 4 flights" in get(watch.url)[1]
        fly(watch, row(seed=0, error=0.2), row(seed=1, error=0.3), row("gp_mpc", error=0.9, outcome="lost"))
        status, text = get(watch.url + "part")
        assert status == 200 and "3 of 4 flights" in text and "about" in text
        assert re.search(r'data-label="nominal_mpc".*?<td>2 of 2</td>', text)
        assert re.search(r'data-label="gp_mpc".*?0 of 1 <span class="lost">1 lost</span>', text)
        assert "<td>250.0</td>" in text and "<td>- (1 lost)</td>" in text  # (0.2 + 0.3) / 2 m; nothing ended well
        assert get(watch.url)[1].count(text.splitlines()[0]) == 1  # a page that is loaded again
        fly(watch, row("gp_mpc", seed=1, error=0.004))
        assert "<td>4.0 (1 lost)</td>" in get(watch.url + "part?1")[1].replace("4.00", "4.0")
    left = (out / FILE).read_text()
    assert "4 of 4 flights, finished" in left and "<script" not in left and "250.0" in left
    with pytest.raises(urllib.error.URLError):
        get(watch.url)


def test_settings_that_contradict_each_other_are_no_flight():
    rows = [row(error=0.2), row(seed=1, outcome="lost"), row(seed=2, outcome="invalid")]
    live = Live("r", "mean_error", 3, rows=rows)
    (cells,) = live.lines().values()
    assert live.ended() == {"nominal_mpc": (1, 2)} and cells["nominal_mpc"].text() == "200.0 (1 lost)"


def test_only_who_has_the_address_on_this_machine_gets_an_answer(out):
    with Watch(out, "mean_error") as watch:
        port = watch.url.split(":")[2].split("/")[0]
        base = f"http://127.0.0.1:{port}"
        assert [get(f"{base}{path}")[0] for path in ("/", "/x/", "/x/part", "/favicon.ico")] == [404] * 4
        assert get(f"{watch.url}../../etc/passwd")[0] == get(f"{watch.url}cells")[0] == 404
        assert get(watch.url, Host="evil.example")[0] == 404  # a name that leads here
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(urllib.request.Request(watch.url, method="POST", data=b"x"))
        assert refused.value.code == 501
        assert watch._server.server_address[0] == "127.0.0.1"
        other = Watch(out, "mean_error", int(port))
        with pytest.raises(UsageError, match=rf"--port {port}: is in use; give another one"):
            other.__enter__()


def test_the_page_asks_no_other_machine_and_shows_names_as_text(out):
    names = ["<script>alert(1)</script>", 'a"b', "gp_mpc+wind"]
    live = Live("<b>", "mean_error", 4, rows=[row(name, error=0.1, trajectory="<i>") for name in names])
    text = page(live)
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


def test_thousands_of_flights(out):
    rows = [
        row(f"mpc_{k}", seed=seed, speed=float(v), trajectory=f"path{p}", error=0.1)
        for k in range(5) for v in range(1, 11) for p in range(10) for seed in range(10)
    ]  # fmt: skip
    text = page(Live("big", "mean_error", 5000, rows=rows))
    assert "5000 of 5000 flights" in text and len(text) < 300_000
    assert "40 more lines are not shown" in text and "4 more paths are in the table only" in text


@pytest.mark.parametrize("width", [60, 80, 200])
def test_the_table_on_a_terminal_fits_it(width):
    rows = [row(name, error=0.1) for name in ("nominal_mpc", "linear_drag_mpc", "gp_mpc+wind+strapdown", "perfect_mpc")]
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(live_table(Live("r", "mean_error", 8, 12.0, rows=rows)))
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= width and "100.0" in "".join(lines) and "4 of 8 flights" in "".join(lines)


def test_times():
    assert [clock(s) for s in (4.6, 65, 3723, float("nan"))] == ["5 s", "1:05 min", "1:02:03 h", "?"]
    assert Live("r", "mean_error", 10, 8.0, 2, rows=[row()] * 6).left == pytest.approx(8.0)  # 4 in 8 s, 4 to go


def test_the_command(tmp_path):
    """In a process of its own: the address is said, the page ends with the command, the file stays."""
    words = ("evaluate", "--sweep", "--watch", "--no-figures", *HOVER, "seed=range(4)", "--out", str(tmp_path / "r"))
    started = subprocess.Popen(
        [sys.executable, "-m", "quadexp", *words], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    said = started.stderr.readline()
    url = re.search(r"http://127\.0\.0\.1:\d+/\S+/", said)[0]
    seen = []
    with contextlib.suppress(urllib.error.URLError, ConnectionError):
        while not seen or "finished" not in seen[-1]:
            seen.append(get(url + "part")[1].partition("\n")[0])
            time.sleep(0.05)
    out, err = started.communicate(timeout=300)
    assert started.returncode == 0 and "4 of 4 flights, finished" in seen[-1], (seen, err)
    assert "nominal_mpc" in out and "4 of 4 flights, finished" in (tmp_path / "r" / FILE).read_text()
    assert run_main("results", tmp_path / "r", "--verify").returncode == 0


def test_a_port_in_use_and_a_watch_without_a_sweep_are_one_line(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for words in (("--sweep", "--watch", "--port", port), ("--watch",), ("--sweep", "--port", port)):
            done = run_main("evaluate", *words, *HOVER, "seed=0,1", "--out", tmp_path / "r")
            assert (done.returncode, done.stdout) == (2, "") and done.stderr.count("\n") == 1, done
    assert not (tmp_path / "r").exists()


@pytest.mark.skipif(not (BROWSER and DRIVER), reason="needs chromium and chromedriver on the PATH")
def test_in_a_browser(browser, out):  # noqa: F811
    """It grows by itself, is the same after a reload, fits a phone, and shows the end."""
    metrics = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    state = "document.querySelector('[data-state]').textContent"
    with Watch(out, "mean_error") as watch:
        fly(watch, row(error=0.2))
        browser.get(watch.url)
        wait(browser, f"{state}.startsWith('1 of 4')")
        fly(watch, row("gp_mpc", error=0.02), row("linear_drag_mpc", speed=4.0, error=0.1))
        wait(browser, f"{state}.startsWith('3 of 4')")
        assert browser.execute_script("return document.querySelectorAll('[data-ended] tr').length") == 3
        browser.refresh()
        wait(browser, f"{state}.startsWith('3 of 4')")
        assert browser.execute_script("return document.querySelectorAll('.panels svg .mark').length") == 3
        assert browser.execute_script("return document.documentElement.scrollWidth") <= 390
        fly(watch, row("gp_mpc", speed=4.0, error=0.01))
    wait(browser, f"{state} === '4 of 4 flights, finished'")
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    browser.get((out / FILE).as_uri())
    assert browser.execute_script(f"return {state}") == "4 of 4 flights, finished"
