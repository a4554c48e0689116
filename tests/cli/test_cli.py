"""The command line as a user meets it: what it prints, where, and with which exit code."""

import contextlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from quadexp.log.store import read_flight, read_table, write_flight, write_table
from tests.cli.command import run, run_main
from tests.deleted import needs
from tests.log.flights import straight_flight

ROOT = Path(__file__).resolve().parents[2]
QUICK = ("trajectory=hover", "trajectory.duration=0.5", "controller.backend=interpreted", "plant.backend=interpreted")


def quadexp(*arguments, cwd):
    """The entry point in this process, in another folder."""
    with contextlib.chdir(cwd):
        return run_main(*arguments)


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in Path(folder).rglob("*"))


class TestHelp:
    def test_nothing_heavy_is_imported_for_it(self, tmp_path):
        code = (
            "import sys; sys.argv = ['quadexp', '--help']\nfrom quadexp.cli.app import main\n"
            "try:\n    main()\nexcept SystemExit: pass\n"
            "heavy = ('torch', 'casadi', 'pandas', 'hydra', 'numpy', 'pyarrow', 'matplotlib', 'scipy', 'rich')\n"
            "print([name for name in heavy if name in sys.modules], file=sys.stderr)"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
        assert done.stderr.strip() == "[]" and "simulate" in done.stdout

    @pytest.mark.parametrize(
        "words", ["results {DIR} [KEY=VALUE]...", "compare {FILE} {FILE}...", "animate {FILE}...", "import {LOG}..."]
    )
    def test_it_says_which_words_may_be_several(self, words):
        name, rest = words.split(" ", 1)
        assert run(name, "--help")[1].startswith(f"Usage: quadexp {name} [OPTIONS] {rest}\n")

    def test_an_example_stands_in_every_help_as_it_is_typed(self):
        """Those of fit-gp, fit-nn and fit-drag began with the mark of a paragraph."""
        listed = [line.split()[0] for line in run("--help")[1].splitlines() if re.match("  [a-z]", line)]
        texts = {name: run(name, "--help")[1] for name in listed if name != "quadexp"}
        assert len(texts) > 10 and not [name for name, text in texts.items() if "\\b" in text or "\b" in text]

    def test_version(self):
        assert run("--version")[1].startswith("quadexp ")


class TestSimulate:
    def test_it_writes_the_flight_and_says_which_model_flew(self, here):
        code, out, _ = run("simulate", *QUICK, "--out", "runs/a.parquet")
        assert code == 0
        lines = out.splitlines()
        assert lines[0].startswith("nominal_mpc (residual: none) flew hover on simplified, seed 0")
        assert "outcome     ok" in lines and lines[-1] == "runs/a.parquet"
        flight = read_flight("runs/a.parquet")
        assert flight.metadata["config"]["controller"]["name"] == "nominal_mpc"
        assert flight.metadata["versions"]["quadexp"] and flight.metadata["provenance"]["created"]
        assert len(flight) == 26  # 0.5 s at 50 Hz, both ends

    def test_the_place_it_writes_to_unless_told(self, here):
        assert run("simulate", *QUICK)[0] == 0
        assert run("simulate", *QUICK, "seed=3")[0] == 0
        assert files(here) == ["runs", "runs/nominal_mpc_hover.parquet", "runs/nominal_mpc_hover_seed3.parquet"]

    def test_an_existing_file_is_refused_before_the_flight(self, here, monkeypatch):
        Path("a.parquet").write_text("precious")
        monkeypatch.setattr("quadexp.experiment.evaluate.fly_one", lambda *_: pytest.fail("it flew"))
        code, out, err = run("simulate", *QUICK, "--out", "a.parquet")
        assert (code, out) == (2, "") and "a.parquet: exists already; pass --force" in err
        assert Path("a.parquet").read_text() == "precious"
        monkeypatch.undo()


class TestMistakes:
    @pytest.mark.parametrize("out", ["/proc/quadexp/a.parquet", "file/a.parquet"])
    def test_a_place_that_cannot_be_written(self, here, out):
        Path("file").touch()
        for words in (["simulate", *QUICK], ["collect", "collect.duration=5"]):
            code, _, err = run(*words, "--out", out)
            assert code == 2 and "cannot be written there" in err and err.count("\n") == 1
        code, _, err = run("evaluate", *QUICK, "--out", out)
        assert code == 2 and "cannot be written" in err
        assert files(here) == ["file"]

    def test_the_unexpected_is_one_line_too(self, here, monkeypatch):
        def fails(*_):
            raise RuntimeError("the sky\nis falling")

        monkeypatch.setattr("quadexp.experiment.evaluate.fly_one", fails)
        code, _, err = run("simulate", *QUICK)
        assert code == 1
        assert err == "error: RuntimeError: the sky is falling (QUADEXP_DEBUG=1 shows where)\n"

    def test_debug_shows_where(self, here):
        """By `python -m quadexp`, in a process of its own."""
        command = [sys.executable, "-m", "quadexp", "--debug", "simulate", "trajectory.sped=8"]
        done = subprocess.run(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
        assert done.returncode == 2 and "Traceback" in done.stderr


class TestEvaluate:
    SWEEP = ("--sweep", *QUICK, "controller=nominal_mpc,perfect_mpc", "seed=range(2)")

    def test_one_cell(self, here):
        code, out, _ = run("evaluate", *QUICK, "--out", "r")
        assert code == 0 and "nominal_mpc" in out and out.splitlines()[-1] == "r"
        assert len(read_table("r/results.parquet", "results")[0]["key"]) == 1 and not Path("r/figures").exists()

    @needs("page")
    def test_a_sweep_and_its_table(self, here):
        done = quadexp("evaluate", *self.SWEEP, "--out", "r", cwd=here)
        assert done.returncode == 0, done.stderr
        assert "perfect_mpc" in done.stdout and done.stdout.splitlines()[-1] == "r"
        assert "flights: 100 % (4 of 4)" in done.stderr
        columns, record = read_table("r/results.parquet", "results")
        assert set(columns["outcome"]) == {"ok"} and len(columns["key"]) == 4
        # Paired: the two controllers met the same noise; without drag to know, hovering is nearly the same flight.
        assert columns["seed"].tolist() == [0, 1, 0, 1]
        assert {p.name for p in Path("r/figures").iterdir()} == {
            f"{name}.{form}" for name in ("path_hover", "mean_error_against_controller") for form in ("svg", "png")
        }
        again = quadexp("evaluate", *self.SWEEP, "--out", "r", "--json", cwd=here)
        record = json.loads(again.stdout)
        assert record["flown"] == 0 and len(record["rows"]) == 4
        assert [row["rmse"] for row in record["rows"]] == columns["rmse"].tolist()
        cells = sorted(Path("r/cells").rglob("*.parquet"))
        more = ("evaluate.baseline=perfect_mpc", "evaluate.confidence=0.5", "evaluate.metric=rmse", "--no-figures")
        assert quadexp("evaluate", *self.SWEEP, *more, "--out", "r", cwd=here).returncode == 0
        statistics = read_table("r/statistics.parquet", "statistics")[1]
        assert (statistics["baseline"], statistics["confidence"]) == ("perfect_mpc", 0.5)
        assert sorted(Path("r/cells").rglob("*.parquet")) == cells

    def test_a_cell_that_cannot_be_flown_is_a_row_and_the_rest_is_flown(self, here):
        arguments = ["trajectory=circle", "trajectory.speed=2,30", "controller.backend=interpreted"]
        done = quadexp("evaluate", "--sweep", *arguments, "--no-figures", "--out", "r", cwd=here)
        assert done.returncode == 1
        assert done.stderr.splitlines()[-1].startswith(
            "error: 1 of 2 cells were not flown; the first: circle cannot be"
        )
        assert "1 infeasible" in done.stdout and not Path("r/figures").exists()
        columns, _ = read_table("r/results.parquet", "results")
        assert columns["outcome"].tolist() == ["ok", "infeasible"] and np.isnan(columns["rmse"][1])
        assert Path("r/results.csv").exists() and Path("r/table.tex").exists()


class TestLearning:
    """collect -> fit-drag and fit-gp -> simulate, as small as it goes."""

    @pytest.fixture(scope="class")
    def chain(self, tmp_path_factory):
        folder = tmp_path_factory.mktemp("chain")
        done = [
            quadexp("collect", "collect.duration=24", "--save-flights", "flights", "--json", cwd=folder),
            quadexp("fit-drag", "data/residuals.parquet", "--json", cwd=folder),
            quadexp("fit-gp", "data/residuals.parquet", "gp.inducing=8", "gp.max_rows=300", "--no-figures", cwd=folder),
        ]
        for process in done:
            assert process.returncode == 0, process.stderr
        return folder, done

    def test_the_data_set(self, chain):
        folder, done = chain
        report = json.loads(done[0].stdout)
        columns, record = read_table(folder / "data/residuals.parquet", "residuals", finite=True)
        assert (
            report["rows"] == len(columns["t"]) > 1100 and report["duration"] >= 23.9
        )  # rows without the commands before them are left out
        assert record["config"]["collect"]["mode"] == "random" and record["seed"] == 0
        assert len(list((folder / "flights").glob("*.parquet"))) == report["flights"] == len(record["flights"])
        assert len(set(columns["flight"].tolist())) == report["flights"] > 1

    def test_recorded_flights_make_the_same_rows(self, chain):
        folder, _ = chain
        flights = [part for path in sorted((folder / "flights").glob("*")) for part in ("--flight", path)]
        done = quadexp("collect", *flights, "--out", "recorded.parquet", cwd=folder)
        assert done.returncode == 0, done.stderr
        flown, _ = read_table(folder / "data/residuals.parquet", "residuals")
        recorded, record = read_table(folder / "recorded.parquet", "residuals")
        np.testing.assert_array_equal(flown["a_x"], recorded["a_x"])
        assert record["flights"][0]["name"].endswith("flight_000.parquet")

    def test_both_checkpoints_fly(self, chain, monkeypatch):
        folder, done = chain
        assert "on 1 held-out flights" in done[2].stdout or "held-out flights" in done[2].stdout
        monkeypatch.chdir(folder)
        for controller, source in (("linear_drag_mpc", "models/drag"), ("gp_mpc", "models/gp")):
            code, out, err = run("simulate", *QUICK, f"controller={controller}", "--out", f"{controller}.parquet")
            assert code == 0, err
            assert f"from {source})" in out.splitlines()[0]
        # linear_drag_mpc reads the drag of a GP checkpoint too.
        code, out, _ = run("simulate", *QUICK, "controller=linear_drag_mpc", "model=models/gp", "--out", "c.parquet")
        assert code == 0 and "(residual: linear_drag from models/gp)" in out

    def test_a_drag_checkpoint_is_no_gaussian_process(self, chain, monkeypatch):
        monkeypatch.chdir(chain[0])
        code, _, err = run("simulate", *QUICK, "controller=gp_mpc", "model=models/drag", "--out", "no.parquet")
        assert (
            code == 2
            and "models/drag: holds linear_drag, not gaussian_process, which quadexp fit gaussian_process" in err
        )

    def test_one_flight_cannot_be_split(self, chain, monkeypatch):
        monkeypatch.chdir(chain[0])
        flight = min(Path("flights").iterdir())
        assert run("collect", "--flight", flight, "--out", "one.parquet")[0] == 0
        for command in ("fit-drag", "fit-gp"):
            code, _, err = run(command, "one.parquet", "--out", "one")
            assert code == 1 and "one flight" in err and err.count("\n") == 1 and not Path("one").exists()
        assert run("fit-drag", "one.parquet", "drag.holdout=0", "--out", "one")[0] == 0


@pytest.mark.parametrize(
    ("change", "words", "message"),
    [
        (
            lambda columns: columns.pop("w_x"),
            ("fit-gp", "gp.holdout=0", "gp.features.a_x=[v_x,w_x]"),
            "column 'w_x' is missing",
        ),
        (lambda columns: columns.update({k: v[:0] for k, v in columns.items()}), ("fit-gp",), "has no rows"),
        (lambda columns: columns["a_y"].__setitem__(7, np.nan), ("fit-drag",), "column 'a_y' is nan at row 7"),
    ],
)
def test_a_data_set_that_is_none(here, change, words, message):
    write_flight("a.parquet", straight_flight(40))
    assert run("collect", "--flight", "a.parquet", "--out", "d.parquet")[0] == 0
    columns, record = read_table("d.parquet", "residuals")
    change(columns)
    write_table("wrong.parquet", columns, record, "residuals")
    code, _, err = run(words[0], "wrong.parquet", *words[1:], "--out", "m")
    assert code == 1 and message in err and not Path("m").exists()


def test_a_command_that_had_too_little_memory_ends_at_once():
    """What a library would do when Python ends could crash, after the line was said."""
    code = (
        "import atexit; from quadexp.cli import terminal\n"
        "terminal.prepare(); atexit.register(print, 'at the end')\n"
        "try:\n"
        "    with terminal.guarded('fly'): raise {}\n"
        "except Exception as error: terminal.end(error.exit_code)"
    )
    for error, end in (
        ("MemoryError", ""),
        ("ImportError('libarrow.so: failed to map segment from shared object')", ""),
        ("ValueError('x')", "at the end\n"),
    ):
        done = subprocess.run([sys.executable, "-c", code.format(error)], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (1, end), done.stderr
        assert done.stderr.count("\n") == 1 and ("not enough memory" in done.stderr) == (not end)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["a.parquet", "--margins", "--beliefs"], "show: --beliefs and --margins: one at a time"),
        (["a.parquet", "--out", "a.png"], "show: --out a.png: is for --beliefs"),
        (["a.parquet", "seed=1"], "show: seed=1: is for --margins"),
    ],
)
@needs("margins", "auto")
def test_show_answers_one_question_at_a_time(words, said):
    code, _, error = run("show", *words)
    assert code == 2 and said in error
