"""How a command ends when nobody takes what it prints, or somebody asks it to stop."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.faults.command import ROOT, START, one_line, run

FULL = Path("/dev/full")
LONG = (
    "simulate", "trajectory=hover", "trajectory.duration=600", "controller=nominal_mpc", "plant=ideal",
    "controller.backend=interpreted", "plant.backend=interpreted",
)  # fmt: skip


def start(*words, stdout=subprocess.PIPE, **environment):
    known = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    known.pop("PYTHONUNBUFFERED", None)  # what is printed then waits until the command ends
    return subprocess.Popen(
        [sys.executable, "-c", START, *map(str, words)],
        stdout=stdout, stderr=subprocess.PIPE, text=True, env=known, start_new_session=True,
    )  # fmt: skip


@pytest.mark.parametrize("words", [("--version",), ("--help",), ("show", "--help")])
def test_a_reader_that_has_left(words):
    """`quadexp ... | head`: no word, and no success either."""
    reading, writing = os.pipe()
    os.close(reading)
    started = start(*words, stdout=writing)
    os.close(writing)
    assert started.communicate(timeout=600)[1] == "" and started.returncode == 1


@pytest.mark.skipif(not FULL.exists(), reason="no /dev/full here")
@pytest.mark.parametrize("words", [("--version",), ("show", "--help")])
def test_output_that_cannot_be_written(words):
    with FULL.open("w") as full:
        started = start(*words, stdout=full)
    (line,) = started.communicate(timeout=600)[1].splitlines()
    assert line.startswith("error: ") and "No space left on device" in line and started.returncode == 1


def test_a_terminal_of_few_letters():
    """A page of results is not lost for a thin blank, and a path that is no text comes out as it went in."""
    code = "from quadexp.cli.terminal import prepare; prepare(); print('14.1 µs, 5\\u202f%, ± 1, 飛', '/a/\\udcfc')"
    known = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=known)
    assert done.stdout == b"14.1 us, 5 %, +- 1, ? /a/\xfc\n", done.stderr


def wait_for(sign, started):
    deadline = time.monotonic() + 90
    while not sign() and started.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_flight_that_is_asked_to_end(tmp_path, number):
    """SIGTERM, of a batch system for one, ends a command as Ctrl-C does: in one line, with nothing half-written."""
    started = start(*LONG, "--out", tmp_path / "a.parquet")
    maps = Path(f"/proc/{started.pid}/maps")
    wait_for(lambda: "libcasadi" in maps.read_text(), started)
    started.send_signal(number)
    error = started.communicate(timeout=600)[1]
    said = "error: interrupted: no file is left half written: run the same command again"
    assert error.splitlines()[-1] == said and "Traceback" not in error
    assert started.returncode == 1 and not list(tmp_path.iterdir())


def test_a_sweep_that_is_interrupted_while_its_processes_start(tmp_path):
    """The terminal sends Ctrl-C to all of them; one line comes of it, and the same command goes on."""
    words = (
        "evaluate", "--sweep", "--no-figures", "trajectory=hover", "trajectory.duration=0.4", "seed=0,1",
        "controller=nominal_mpc", "plant=ideal", "controller.backend=interpreted", "plant.backend=interpreted",
        "--out", tmp_path / "r",
    )  # fmt: skip
    started = start(*words)
    wait_for((tmp_path / "r" / "cells" / ".lock").exists, started)
    time.sleep(0.1)
    os.killpg(started.pid, signal.SIGINT)
    error = started.communicate(timeout=600)[1]
    assert "Traceback" not in error and started.returncode == 1, error
    assert "run the same command to continue" in error or "interrupted before anything was done" in error
    again = run(*words)
    assert again.returncode == 0, again.stderr
    assert len((tmp_path / "r" / "results.csv").read_text().splitlines()) == 3


def test_a_file_that_the_system_refuses(tmp_path):
    """One line that names it, without the name of a class."""
    line = one_line(run("check", tmp_path / ("x" * 300)))
    assert "File name too long" in line and "OSError" not in line
