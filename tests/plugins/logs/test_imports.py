"""Which libraries a command imports: none that it does not need, for some take as long as a flight."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from quadexp.sweeps.server import PRELOAD
from tests.cli.command import run

ROOT = Path(__file__).parents[3]
SCIPY = ("interpolate", "spatial", "stats", "optimize", "signal", "ndimage", "linalg", "special")
HEAVY = (
    "torch", "gpytorch", "pandas", "matplotlib", "hydra", "omegaconf", "pebble", "distributed", "casadi",
    "minsnap_trajectories", *(f"scipy.{name}" for name in SCIPY),
)  # fmt: skip
INTERPRETED = ["controller.backend=interpreted", "plant.backend=interpreted"]
SHORT = ["trajectory=step", "trajectory.duration=0.4", "trajectory.step_time=0.2", *INTERPRETED]


def imported(code):
    """The heavy modules that a process has imported after running some code."""
    last = f"import sys; print('', [name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", f"{code}\n{last}"], capture_output=True, text=True, cwd=ROOT)
    assert "Traceback" not in done.stderr, done.stderr
    return set(ast.literal_eval(done.stderr.splitlines()[-1].strip()))


def by_command(*words):
    """The same of a command, in a process of its own."""
    argv = ["quadexp", *map(str, words)]
    return imported(
        f"import sys; sys.argv = {argv!r}\nfrom quadexp.cli.app import main\ntry: main()\n"
        "except SystemExit as end: assert not end.code, end.code"
    )


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A flight, and with it the compositions that this file asks for are kept."""
    path = tmp_path_factory.mktemp("imports") / "a.parquet"
    assert run("simulate", *SHORT, "--out", path)[0] == 0
    return path


def test_a_flight(flight, tmp_path):
    """The composition is kept by now, so Hydra is not needed."""
    assert by_command("simulate", *SHORT, "--out", tmp_path / "b.parquet") == {"casadi"}


def test_a_command_that_reads(flight):
    assert by_command("show", flight) == set()


def test_a_sweep_and_the_same_again(tmp_path):
    """The process that has it flown and drawn flies and draws nothing itself."""
    asked = ["evaluate", "--sweep", *SHORT, "seed=0,1", "evaluate.workers=1", "--out", tmp_path / "r"]
    run("evaluate", "--sweep", *SHORT, "seed=0", "--no-figures", "--out", tmp_path / "kept")
    assert by_command(*asked) == {"pebble", "scipy.special"}
    assert (tmp_path / "r" / "figures" / "path_step.svg").is_file()
    assert by_command(*asked) == {"pebble", "scipy.special"}


def test_what_workers_import_before_their_first_cell():
    assert imported("\n".join(f"import {name}" for name in PRELOAD)) == {"casadi"}


def test_data_of_a_flight(flight, tmp_path):
    found = by_command("collect", "--flight", flight, "--out", tmp_path / "d.parquet")
    assert found <= {"casadi", "scipy.spatial", "scipy.linalg", "scipy.special", "scipy.optimize", "scipy.interpolate"}
