"""What pyproject.toml promises: its lowest versions are those that are tested, and types reach the user."""

import importlib.util
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def version(text):
    """The numbers of a version, without zeros at its end: 3.8.0 is 3.8."""
    numbers = [int(number) for number in text.split(".")]
    while numbers[-1] == 0:
        numbers.pop()
    return numbers


def test_the_lowest_versions_are_those_that_are_tested():
    bounds = (re.match(r"([\w-]+)>=([\d.]+)", text) for text in PROJECT["dependencies"])
    lowest = {bound[1]: version(bound[2]) for bound in bounds}
    lines = (ROOT / "constraints-lowest.txt").read_text().splitlines()
    tested = dict(line.split("==") for line in lines if not line.startswith("#"))
    assert lowest == {name: version(text) for name, text in tested.items()}


def test_this_python_is_one_that_is_allowed():
    low, high = re.fullmatch(r">=3\.(\d+),<3\.(\d+)", PROJECT["requires-python"]).groups()
    assert int(low) <= sys.version_info.minor < int(high) == 15


USER = """
import quadexp as qx
reveal_type(qx.simulate)
reveal_type(qx.simulate("trajectory=hover"))
"""


def test_types_reach_the_user(tmp_path):
    """As of an installed package: a copy beside which there is nothing else."""
    if importlib.util.find_spec("mypy") is None:
        pytest.skip("mypy is not installed")
    assert (ROOT / "quadexp" / "py.typed").is_file()
    (tmp_path / "quadexp").symlink_to(ROOT / "quadexp")
    (tmp_path / "user.py").write_text(USER)
    skipped = "[mypy]\nfollow_imports = silent\n[mypy-casadi,torch.*,gpytorch.*]\nfollow_imports = skip\n"
    (tmp_path / "mypy.ini").write_text(skipped + "follow_imports_for_stubs = true\n")  # stubs of CasADi cannot be read
    command = [sys.executable, "-m", "mypy", "--no-incremental", "user.py"]
    known = {**os.environ, "MYPYPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=known)
    function, flight = (line for line in done.stdout.splitlines() if "Revealed type" in line)
    assert '"def (' in function and flight.endswith('"quadexp.frames.Flight"'), done.stdout + done.stderr
