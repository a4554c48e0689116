"""`quadexp new` writes a part whose test passes at once, and which flies."""

import os
import subprocess
import sys
from pathlib import Path

from quadexp.cli.extend import TEMPLATES
from quadexp.log.store import read_metadata
from tests.cli.command import run

NAMES = {
    "vehicle": "racer",
    "trajectory": "loop_up",
    "plant": "soft_arms",
    "model": "flapping",
    "controller": "Pid2",
    "remedy": "level",
}


def test_their_tests_pass_and_they_fly(here):
    """Each in a folder of its own; the tests of all in one run of pytest."""
    assert set(NAMES) == set(TEMPLATES)
    tests, fits, flights = [], [], {}
    for part, name in NAMES.items():
        code, out, errors = run("new", part, name, "--to", part)
        assert code == 0, errors
        files, _, rest = out.partition("\n\n")
        assert sorted(files.splitlines()) == sorted(str(path) for path in Path(part).rglob("*.*"))
        for path in Path(part).rglob("*.*"):
            assert TEMPLATES[part].example not in path.read_text() and name in path.read_text()
        _, tested, *fitted, flights[part] = (line.split() for line in rest.splitlines())
        fits += fitted
        assert tested[:3] == ["python", "-m", "pytest"] and flights[part][0] == "quadexp"
        tests += tested[3:]
    interpreted = {**os.environ, "CC": "none"}  # compiling takes longer than all of their flights
    command = [sys.executable, "-m", "pytest", *tests, "-q"]
    done = subprocess.run(command, capture_output=True, text=True, env=interpreted)
    assert done.returncode == 0, done.stdout + done.stderr
    assert run("collect", "collect.duration=20", "--out", "data/residuals.parquet")[0] == 0
    for words in fits:
        assert run(*words[1:])[0] == 0
    for part, flown in flights.items():
        quick = ["trajectory=hover", "trajectory.duration=0.5"] if part != "trajectory" else ["trajectory.turns=0.5"]
        quick += [f"{group}.backend=interpreted" for group in ("controller", "plant") if group != part]
        code, _, errors = run(*flown[1:], *quick)
        assert code == 0, errors
        record = read_metadata(flown[-1], "flight")
        option = flown[4].partition("=")[2]
        assert record["outcome"] == "ok" and record["config"][flown[4].partition("=")[0]]["name"] == option


def test_nothing_is_overwritten_and_nothing_written_half(here):
    assert run("new", "plant", "mine", "--to", "parts")[0] == 0
    (here / "parts" / "test_mine.py").write_text("my own")
    before = {path: path.read_bytes() for path in here.rglob("*.*")}
    for _ in range(2):
        code, _, errors = run("new", "plant", "mine", "--to", "parts")
        assert code == 2 and "exists already: choose another name" in errors and errors.count("\n") == 1
        assert {path: path.read_bytes() for path in here.rglob("*.*")} == before
        (here / "parts" / "mine.py").unlink(missing_ok=True)
        before = {path: path.read_bytes() for path in here.rglob("*.*")}
    (here / "file").write_text("")
    code, _, errors = run("new", "plant", "other", "--to", "file")
    assert code == 2 and "file" in errors and errors.count("\n") == 1


def test_two_parts_share_a_folder(here):
    """With names that contain those of the examples."""
    names = {"vehicle": "hexacopter2", "trajectory": "HelixUp", "plant": "my_motor_lag", "residual": "xcubic_drag"}
    for part, name in names.items():
        assert run("new", part, name, "--to", "my parts")[0] == 0
    assert "class HelixUpTrajectory(TrajectoryPart):" in Path("my parts/HelixUp.py").read_text()
    assert "note: new residual: is `new model` now" in run("new", "residual", "more_air", "--to", "my parts")[2]
    flown = ("collect.duration=20", "collect.speed_max=8", "vehicle=hexacopter2")
    assert run("collect", *flown, "--conf", "my parts", "--out", "d.parquet")[0] == 0
    fitted = run("fit", "xcubic_drag", "d.parquet", "vehicle=hexacopter2", "--conf", "my parts")
    assert fitted[0] == 0, fitted[2]
    code, _, errors = run(
        "simulate", "--conf", "my parts", "vehicle=hexacopter2", "plant=my_motor_lag", "controller=xcubic_drag_mpc",
        "trajectory=HelixUp", "trajectory.turns=1", "--out", "a.parquet",
    )  # fmt: skip
    assert code == 0, errors
    assert "'my parts/test_more.py'" in run("new", "vehicle", "more", "--to", "my parts")[1]
