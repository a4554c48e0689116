"""How a command ends when nobody takes what it prints, or somebody asks it to stop."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from quadexp.log.store import read_flight
from tests.faults.command import FLY, ROOT, START, one_line, run

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


def test_asked_to_end_where_a_library_catches_everything(tmp_path):
    """casadi has a bare `except` in what it imports: an exception that a signal raises there was lost."""
    imported = "import os, signal\ntry: os.kill(os.getpid(), signal.SIGTERM)\nexcept: pass\nSX = 1\n"
    (tmp_path / "casadi.py").write_text(imported)
    code = "from quadexp.cli.terminal import prepare; prepare()\n"
    code += "from quadexp.compile.symbolic import ca; ca.SX; print(1)"
    known = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=known)
    assert "KeyboardInterrupt" in done.stderr and not done.stdout


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
    assert started.returncode == 128 + number and not list(tmp_path.iterdir())


PAUSED = """
import builtins, os, sys, time
importing = builtins.__import__
def slowly(name, *rest):
    if name == {name!r}:
        print("importing", flush=True)
        time.sleep(60)
    return importing(name, *rest)
builtins.__import__ = slowly
sys.argv = ["quadexp", "options"]
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("name", ["quadexp.cli.app", "typer", "quadexp.parts.listing"])
def test_a_command_that_is_asked_to_end_while_it_imports(name, number):
    """From the first module that is imported to the last: in one line, of which a shell sees the signal."""
    command = [sys.executable, "-c", PAUSED.format(name=name) + START]
    known = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    started = subprocess.Popen(command, env=known, **pipes)
    assert started.stdout.readline() == "importing\n"
    started.send_signal(number)
    (line,) = started.communicate(timeout=600)[1].splitlines()
    assert line.startswith("error: interrupted: ") and started.returncode == 128 + number


def test_ctrl_c_in_an_evaluated_text_is_no_other_ending():
    """CPython ends by the signal where the last text that was evaluated was interrupted, whatever the exit code is."""
    lines = [
        "from quadexp.cli import terminal",
        "def interrupt(): raise KeyboardInterrupt",
        "try: eval('interrupt()')",
        "except KeyboardInterrupt: terminal.end(130)",
    ]
    known = {**os.environ, "PYTHONPATH": str(ROOT)}
    assert subprocess.run([sys.executable, "-c", "\n".join(lines)], env=known).returncode == 130


OUT_OF_USE = {"closed stdout": ">&-", "closed stderr": "2>&-", "closed stdin": "<&-", "all closed": "<&- >&- 2>&-"}
OUT_OF_USE |= {"full stderr": "2>/dev/full", "full stdout": ">/dev/full"}


@pytest.mark.skipif(not FULL.exists(), reason="no /dev/full here")
@pytest.mark.parametrize("streams", OUT_OF_USE.values(), ids=OUT_OF_USE)
def test_streams_that_take_nothing(tmp_path, streams):
    """What is written is as it would be; only an output that is lost is an error."""
    words = [*FLY, "--out", str(tmp_path / "a.parquet")]
    shell = f'exec "$0" -c "$1" "${{@:2}}" {streams}'
    known = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = ["bash", "-c", shell, sys.executable, START]
    for asked, code in ((words, 0), (["show", str(tmp_path / "a.parquet")], 0), (["show", "nope"], 2)):
        done = subprocess.run([*command, *asked], capture_output=True, text=True, env=known)
        lost = streams == ">/dev/full" and code == 0
        assert done.returncode == (1 if lost else code), done.stderr
        assert "Traceback" not in done.stderr and (not lost or "the output could not be written" in done.stderr)
    assert read_flight(tmp_path / "a.parquet").outcome == "ok"


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
    assert "Traceback" not in error and started.returncode == 130, error
    assert "run the same command to continue" in error or "nothing was done" in error
    again = run(*words)
    assert again.returncode == 0, again.stderr
    assert len((tmp_path / "r" / "results.csv").read_text().splitlines()) == 3


def test_a_file_that_the_system_refuses(tmp_path):
    """One line that names it, without the name of a class."""
    line = one_line(run("check", tmp_path / ("x" * 300)))
    assert "File name too long" in line and "OSError" not in line
