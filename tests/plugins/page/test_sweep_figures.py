"""Figures of a sweep: drawn beside the tables, each whole or not at all."""

import shutil

import pytest

from quadexp.log.cell_store import CellStore
from quadexp.parts.compose import expand
from quadexp.plugins.page.sweep_figures import SweepFigures
from quadexp.sweeps.engine import Workers
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.cli.command import run

ASKED = ["controller=nominal_mpc,perfect_mpc", "trajectory.speed=3,4", "trajectory.acceleration=1.5"]
CIRCLE = {"mean_error_against_speed", "path_circle"}


def draw(out, rows, processes=None):
    with SweepFigures(out, processes, "mean_error", 0.95) as figures:
        figures.begin(rows)
        return figures.end(), figures.failed


def drawn(out):
    return {file.name for file in (out / "figures").iterdir()}


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    out = tmp_path_factory.mktemp("figures") / "results"
    rows = run_sweep(expand([*ASKED, "trajectory=circle", "seed=0"]), out, SweepRequest(isolate=False)).rows
    files, failed = draw(out, rows)
    assert not failed and set(files) == {f"figure_{name}" for name in CIRCLE}
    return out, rows


@pytest.fixture
def flown(first, tmp_path):
    """A folder of results with its figures, to be changed."""
    shutil.copytree(first[0], tmp_path / "results")
    return tmp_path / "results", first[1]


def test_processes_draw_the_same_to_the_last_bit(first, tmp_path):
    out, rows = tmp_path / "results", first[1]
    shutil.copytree(first[0] / "cells", out / "cells")
    with Workers(2) as processes:
        files, failed = draw(out, rows, processes)
    assert not failed and len(files) == 2
    assert drawn(out) == drawn(first[0]) == {f"{name}.{form}" for name in CIRCLE for form in ("svg", "png")}
    for name in drawn(out):
        assert (out / "figures" / name).read_bytes() == (first[0] / "figures" / name).read_bytes(), name


@pytest.mark.parametrize("apart", [False, True], ids=["here", "in processes"])
def test_a_figure_that_fails_costs_no_other(flown, apart):
    """And the earlier one goes, which would show other rows."""
    out, rows = flown
    CellStore(out).path(rows[-1]["key"]).unlink()
    with Workers(2) as processes:
        files, failed = draw(out, rows, processes if apart else None)
    assert list(failed) == ["path_circle"] and "no such file" in failed["path_circle"]
    assert set(files) == {"figure_mean_error_against_speed"}
    assert drawn(out) == {f"mean_error_against_speed.{form}" for form in ("svg", "png")}


def test_an_interrupt_leaves_whole_figures_and_the_next_run_draws_the_others(flown):
    out, rows = flown
    shutil.rmtree(out / "figures")
    with (
        pytest.raises(KeyboardInterrupt),
        Workers(2) as processes,
        SweepFigures(out, processes, "mean_error", 0.95) as figures,
    ):
        figures.begin(rows)
        raise KeyboardInterrupt
    for name in drawn(out) if (out / "figures").exists() else ():
        content = (out / "figures" / name).read_bytes()
        assert content.rstrip().endswith(b"</svg>") or b"IEND" in content[-16:], name
    (out / "figures").mkdir(exist_ok=True)
    (out / "figures" / ".quadexp-0123456789abcdef.tmp").write_text("<svg> of a process that was killed")
    assert draw(out, rows)[1] == {}
    assert drawn(out) == {f"{name}.{form}" for name in CIRCLE for form in ("svg", "png")}


def test_the_command_says_what_was_not_drawn_and_its_tables_are_there(tmp_path):
    out = tmp_path / "results"
    asked = ["trajectory=step", "trajectory.duration=0.4", "trajectory.step_time=0.2", "seed=0,1"]
    asked += ["controller.backend=interpreted", "plant.backend=interpreted", "evaluate.workers=1", "--out", out]
    assert run("evaluate", "--sweep", *asked, "--no-figures")[0] == 0
    tables = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    tables.pop("results.parquet")  # says when it was written
    (out / "figures").write_text("a file where the folder should be")
    code, shown, said = run("evaluate", "--sweep", *asked)
    wrong = [line for line in said.splitlines() if line.startswith("error: ")]
    assert code == 1 and f"error: path_step: not drawn: {out / 'figures' / 'path_step.png'}: cannot be written" in said
    assert len(wrong) == 2 and all(line.endswith("; the tables are not affected") for line in wrong)
    assert (
        str(out) in shown and {path.name: path.read_bytes() for path in out.iterdir() if path.name in tables} == tables
    )
