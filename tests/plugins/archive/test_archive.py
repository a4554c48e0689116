"""`quadexp archive`: what is in it flies again in an empty folder elsewhere, with equal numbers."""

import re
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from quadexp.report.frame import read_results
from quadexp.report.metrics import METRICS
from tests.cli.command import run

BARE = ("controller.backend=interpreted", "plant.backend=interpreted")
COURSE = ("trajectory=step", "trajectory.duration=0.6", "trajectory.step_time=0.2")
TIMES = ("solve_time_median", "solve_time_p99", "solve_time_max")

PART = '''"""Full thrust while the vehicle is below the reference."""
import numpy as np
from gains import GAIN

from quadexp.control.law import Law
from quadexp.physics.state import POSITION


class Mine(Law):
    """Hover thrust, and a share of the height error."""

    def equations(self, vehicle, given, memory):
        error = given.reference[POSITION][2] - given.state[POSITION][2]
        return {"command": np.full(4, 1.0) * vehicle.hover_thrust + GAIN * error}
'''


def commands(text):
    """The commands of a README: its indented lines."""
    return [shlex.split(line) for line in text.splitlines() if line.startswith("    ")]


def called(words, folder):
    """A command as a reader of the README runs it, of this program where it says quadexp."""
    words = [sys.executable, "-m", *words] if words[0] == "quadexp" else words
    return subprocess.run(words, cwd=folder, capture_output=True, text=True)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A sweep with a part of one's own that lies outside of the folder, with a helper and a paper."""
    top = tmp_path_factory.mktemp("archive")
    parts, work = top / "elsewhere" / "parts", top / "work"
    (parts / "controller").mkdir(parents=True)
    work.mkdir()
    (parts / "mine.py").write_text(PART)
    (parts / "gains.py").write_text("GAIN = 4.0\n")
    (parts / "controller" / "mine.yaml").write_text("_target_: mine.Mine\ncite: doe2026\nallow_unstable: true\n")
    (parts / "references.bib").write_text("@misc{doe2026,\n  title = {Up}\n}\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(work)
        own = ("--conf", str(parts), "controller=mine,pid", "seed=0,3", *COURSE, *BARE)
        code, _, err = run("evaluate", "--sweep", *own, "trajectory.target=[0,0,1.5],[0,0,2]", "--out", "r")
        assert code == 0, err
    return work


@pytest.fixture
def packed(flown, tmp_path, monkeypatch):
    monkeypatch.chdir(flown)
    code, said, err = run("archive", "r", "--out", str(tmp_path / "a.zip"))
    assert code == 0 and said.endswith("a.zip\n"), err
    return tmp_path / "a.zip"


def test_the_commands_of_its_readme_fly_it_again_in_an_empty_folder(flown, packed, tmp_path, monkeypatch):
    folder = tmp_path / "empty"
    with zipfile.ZipFile(packed) as archive:
        archive.extractall(folder)
    gone = flown.parent / "elsewhere"
    gone.rename(gone.with_name("moved"))  # nothing of where it was flown is needed
    try:
        check, fly, compare = commands((folder / "README.md").read_text())
        assert (check[0], fly[:3], compare[:2]) == (
            "sha256sum",
            ["quadexp", "evaluate", "--sweep"],
            ["quadexp", "compare"],
        )
        if shutil.which("sha256sum"):
            assert called(check, folder).returncode == 0
        done = called(fly, folder)
        assert done.returncode == 0, done.stderr
        assert "8 of 8 pairs are the same to the last bit" in called(compare, folder).stdout
    finally:
        gone.with_name("moved").rename(gone)
    first, again = (
        sorted(read_results(path)[1], key=lambda row: row["key"]) for path in (flown / "r", folder / "results_again")
    )
    assert len(first) == len(again) == 8
    for name in set(METRICS) - set(TIMES):
        assert [str(row[name]) for row in first] == [str(row[name]) for row in again]
    assert {row["controller"] for row in first} == {"mine", "pid"}


def test_it_holds_parts_tables_versions_and_papers_and_nothing_else(packed):
    with zipfile.ZipFile(packed) as archive:
        names = set(archive.namelist())
        texts = {
            name: archive.read(name).decode() for name in ("citations.bib", "versions.txt", "README.md", "SHA256SUMS")
        }
    own = {f"outside/0_parts/{name}" for name in ("mine.py", "gains.py", "controller/mine.yaml", "references.bib")}
    made = {f"results/{name}" for name in ("results.parquet", "statistics.csv", "table.md", "table.tex")}
    assert own | made | {"rerun/experiment/archived.yaml"} <= names
    assert not [name for name in names if "cells" in name or name.startswith(("/", "..")) or "__pycache__" in name]
    assert "@misc{doe2026" in texts["citations.bib"] and "meier2015" in texts["citations.bib"]
    assert "8 flights: quadexp 0.1.0" in texts["versions.txt"] and re.search("numpy [0-9]", texts["versions.txt"])
    assert "seeds 0, 3" in texts["README.md"]
    assert len(texts["SHA256SUMS"].splitlines()) == len(names) - 1


def test_the_same_results_are_the_same_bytes(flown, packed, tmp_path):
    assert run("archive", "r", "--out", str(tmp_path / "b.zip"))[0] == 0
    assert packed.read_bytes() == (tmp_path / "b.zip").read_bytes()


def test_a_part_that_was_edited_since_is_said_and_nothing_is_written(flown, tmp_path, monkeypatch):
    monkeypatch.chdir(flown)
    file = flown.parent / "elsewhere" / "parts" / "gains.py"
    before = file.read_text()
    try:
        file.write_text("GAIN = 5.0\n")
        code, _, err = run("archive", "r", "--out", str(tmp_path / "c.zip"))
        assert code == 1 and "gains.py: has changed since the sweep read it" in err and err.count("\n") == 1
        file.unlink()
        assert (
            "gains.py: the sweep read this file, and it is gone"
            in run("archive", "r", "--out", str(tmp_path / "c.zip"))[2]
        )
    finally:
        file.write_text(before)
    assert not (tmp_path / "c.zip").exists() and Path("r").is_dir()


def test_a_checkpoint_a_path_and_an_experiment_keep_their_places(tmp_path):
    from quadexp.plugins.archive.archive import Places, experiments

    (tmp_path / "work" / "models" / "gp").mkdir(parents=True)
    (tmp_path / "far").mkdir()
    (tmp_path / "work" / "models" / "gp" / "model.json").write_text("{}")
    (tmp_path / "far" / "wind.csv").write_text("t\n")
    wind = tmp_path / "far" / "wind.csv"
    axes = ["experiment=quick"], [f"model={tmp_path}/work/models/gp"], [f"wind.path={wind}"], ["seed=0", "seed=1"]
    record = {"grids": [list(axes)], "metric": "rmse", "baseline": "pid", "confidence": 0.9}
    (text,) = experiments(record, Places(tmp_path / "work")).values()
    assert '"model": ["models/gp"]' in text and '"wind.path": ["outside/0_far/wind.csv"]' in text
    assert "defaults: [quick, _self_]" in text and '"metric": "rmse"' in text and '"seed": [0, 1]' in text
