"""`quadexp compare` and the statistics of `quadexp evaluate`, as a user meets them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.cli.test_cli import QUICK, quadexp, run

SWEEP = ("--sweep", *QUICK, "controller=nominal_mpc,perfect_mpc", "seed=range(3)", "--no-figures")


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flown")
    done = quadexp("evaluate", *SWEEP, "--out", "r", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "r"


@pytest.fixture
def results(here, flown):
    shutil.copytree(flown, here / "r")
    return here


class TestCompare:
    def test_two_flights(self, here):
        run("simulate", *QUICK, "--out", "a.parquet")
        run("simulate", *QUICK, "plant.lift=0.1", "--out", "b.parquet")
        code, out, _ = run("compare", "a.parquet", "b.parquet")
        assert code == 0 and "configuration  1 setting differs" in out and "plant.lift  0  0.1" in out
        assert len(out.splitlines()) < 30
        record = json.loads(run("compare", "a.parquet", "b.parquet", "--json")[1])
        assert record["configuration"] == {"plant.lift": [0.0, 0.1]} and "lines" not in record
        assert record["metrics"]["rmse"]["difference"] != 0

    def test_two_results(self, results):
        assert run("evaluate", *SWEEP, "plant.lift=0.05", "--out", "heavy")[0] == 0
        code, out, _ = run("compare", "r", "heavy")
        assert code == 0 and "plant.lift  0  0.05" in out and "6 ok" in out
        record = json.loads(run("compare", "r", "heavy", "--json")[1])
        assert record["pairs"] == 6 and [one["pairs"] for one in record["metrics"]] == [3, 3]

    @pytest.mark.parametrize(
        ("arguments", "code", "said"),
        [
            (("nowhere", "r"), 2, "nowhere: no such file or folder"),
            (("r", "r/statistics.parquet"), 2, "holds statistics; flights, results and checkpoints can be compared"),
            (("r", "cell"), 2, "cannot compare results (r) with a flight"),
            (("r", "r/table.md"), 2, "not a Parquet file"),
        ],
    )
    def test_what_cannot_be_compared_is_one_line(self, results, arguments, code, said):
        cell = str(next(Path("r/cells").glob("*/*.parquet")))
        found, out, err = run("compare", *(cell if word == "cell" else word for word in arguments))
        assert (found, out) == (code, "") and said in err and err.count("\n") == 1


class TestStatistics:
    def test_baseline_and_confidence_change_no_cell(self, results):
        cells = sorted(Path("r/cells").rglob("*.parquet"))
        more = ("evaluate.baseline=perfect_mpc", "evaluate.confidence=0.5", "evaluate.metric=rmse")
        code, out, _ = run("evaluate", *SWEEP, *more, "--out", "r")
        assert code == 0 and "[50 % interval:" in out and "RMSE (mm)" in out and "than perfect_mpc" in out
        assert sorted(Path("r/cells").rglob("*.parquet")) == cells
        assert "than perfect_mpc" in run("show", "r")[1]
