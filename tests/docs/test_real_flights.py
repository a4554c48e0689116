"""The page on real flights, command by command: on the public flights where they are, and on ULogs written here."""

import json
import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from quadexp.cli.app import app
from tests.docs.commands import ROOT, commands
from tests.plugins.logs.importers import logs

PAGE = ROOT / "docs" / "real_flights.md"
DATA = ROOT.parent / "shared" / "data" / "nanobench"
CRAZYFLIE = (0.00472, 0.0454)  # J / (4 m arm) and J_z / (4 m c) of conf/vehicle/crazyflie.yaml
NAMES = ("B2_circle_fast_rep2", "B9_trefoil_fast_rep14", "B3_figure8_fast_rep1")


def run(folder: Path, swap: dict[str, str], extra: dict[str, list[str]]) -> None:
    """Every command of the page, in its order, words replaced by `swap`, more words by command."""
    for words in commands(PAGE):
        words = [swap.get(word, word) for word in words] + extra.get(words[0], [])
        done = CliRunner().invoke(app, words)
        assert done.exit_code == 0, (words, done.stderr or done.output)
        assert "--out" not in words or (folder / words[words.index("--out") + 1]).exists(), words


def least(folder: Path, *, tracked: bool) -> float:
    """Share of nominal's residual that the best model leaves."""
    rows = json.loads((folder / "results/validation/validation.json").read_text())["rows"]
    return min(row["share"] for row in rows if row["thrust_tracked"] == tracked)


@pytest.mark.slow
def test_on_the_public_flights(tmp_path, monkeypatch):
    if not DATA.is_dir():
        pytest.skip("the flights of NanoBench are not beside the repository (../shared/data/nanobench)")
    (tmp_path / "logs").mkdir()
    for name in NAMES:
        os.symlink(DATA / f"{name}.csv", tmp_path / "logs" / f"{name}.csv")
    monkeypatch.chdir(tmp_path)
    run(tmp_path, {}, {})
    assert least(tmp_path, tracked=True) < 0.35
    assert least(tmp_path, tracked=False) < 0.62


def test_on_logs_made_here(tmp_path, monkeypatch):
    """PX4 logs of a flight with known drag (0.4, 0.3, 0.1 1/s) under the names of the page."""
    (tmp_path / "logs").mkdir()
    for seed, name in enumerate(NAMES):
        logs.ulog(tmp_path / "logs" / f"{name}.ulg", logs.truth(duration=20.0, seed=seed, turning=CRAZYFLIE))
    monkeypatch.chdir(tmp_path)
    swap = {f"logs/{name}.csv": f"logs/{name}.ulg" for name in NAMES} | {"px4": "sdf"}  # these logs have rotor speeds
    quick = {
        "fit-gp": ["gp.inducing=5", "gp.max_rows=200", "gp.max_iterations=5", "gp.refit=false", "--no-figures"],
        "identify": ["--no-figures"],
        "validate": ["--no-figures"],
        "evaluate": ["--no-figures"],
    }
    run(
        tmp_path,
        swap | {"trajectory.speed=1,2": "trajectory.speed=1", "trajectory=circle,lemniscate": "trajectory=circle"},
        quick,
    )
    assert least(tmp_path, tracked=False) < 0.2
