"""Sweeps: done cells stay done, whatever happened in between; one folder holds one sweep."""

import math
import os
import signal
import time
from pathlib import Path

import pytest

from quadexp.errors import UsageError
from quadexp.experiment.identity import flight_record
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_flight, read_table
from quadexp.parts.compose import expand
from quadexp.sweeps import sweep
from quadexp.sweeps.engine import LocalEngine
from quadexp.sweeps.plan import cell_key, flying_order, plan_cells
from quadexp.sweeps.results import select
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.deleted import needs
from tests.processes import processes
from tests.sweeps import cells
from tests.sweeps.quick import start, wait_for

GRID = ["trajectory.speed=4,8", "controller=nominal_mpc,perfect_mpc", "seed=range(3)"]


@pytest.fixture(scope="module")
def grid():
    return expand(GRID)


def fly(grid, out, **options):
    """A sweep of cells that fly nothing, in this process; what processes do is tested apart."""
    return run_sweep(grid, out, SweepRequest(function=cells.quick_cell, isolate=False, **options))


def key_of(config, inputs=()):
    """The key of one cell."""
    return cell_key(flight_record(config), dict(inputs))


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in Path(folder).rglob("*") if path.is_file())


class TestKeys:
    def test_how_a_number_is_written_is_not(self):
        keys = {key_of(expand([f"trajectory.speed={text}"])[0].config) for text in ("8", "8.0", "8e0")}
        assert len(keys) == 1

    def test_cells_that_are_one_flight_are_flown_once(self):
        # nominal_mpc reads no checkpoint, whatever `model` says.
        assert len(plan_cells(expand(["model=a,b", "controller=nominal_mpc"]))) == 1


class TestSweep:
    def test_rows_in_order_and_all_files(self, grid, tmp_path):
        result = fly(grid, tmp_path / "r")
        assert result.flown == 12 and not result.not_flown
        assert [(r["speed"], r["controller"], r["seed"]) for r in result.rows][:4] == [
            (4.0, "nominal_mpc", 0),
            (4.0, "nominal_mpc", 1),
            (4.0, "nominal_mpc", 2),
            (4.0, "perfect_mpc", 0),
        ]
        assert [r["mean_error"] for r in result.rows[:3]] == pytest.approx([0.0, 0.01, 0.02])
        written = files(tmp_path / "r")
        assert len([f for f in written if f.startswith("cells")]) == 12
        tables = {"results.parquet", "results.csv", "table.md", "table.tex", "statistics.parquet", "statistics.csv"}
        assert tables < set(written)
        columns, record = read_table(tmp_path / "r" / "results.parquet", "results")
        assert len(columns["key"]) == 12 and len(record["conditions"]) == 12
        flight = read_flight(CellStore(tmp_path / "r").path(columns["key"][0]))
        assert flight.metadata["row"]["controller"] == "nominal_mpc"

    def test_the_disk_holds_the_cells_before_a_table_says_so(self, grid, tmp_path, monkeypatch):
        """They are flushed together: each by itself would wait for the disk as long as it flies."""
        flushed = []

        def flush(folder):
            flushed.append(
                (folder, len(list(folder.rglob("*.parquet"))), (tmp_path / "r" / "results.parquet").exists())
            )
            os.sync()

        monkeypatch.setattr(sweep, "flush", flush)
        fly(grid, tmp_path / "r")
        assert flushed == [(tmp_path / "r" / "cells", len(grid), False)]
        fly(grid, tmp_path / "r")
        assert len(flushed) == 1

    def test_more_seeds_may_be_added(self, grid, tmp_path):
        fly(grid, tmp_path / "r")
        more = fly(expand([*GRID[:2], "seed=range(4)"]), tmp_path / "r")
        assert more.flown == 4 and len(more.rows) == 16

    def test_another_sweep_is_refused_unless_forced(self, grid, tmp_path):
        fly(grid, tmp_path / "r")
        other = expand(["trajectory.speed=5", "seed=0"])
        with pytest.raises(UsageError, match=r"holds the results of another sweep \(12 of its 12 cells"):
            fly(other, tmp_path / "r")
        assert len(read_table(tmp_path / "r" / "results.parquet", "results")[0]["key"]) == 12
        assert len(fly(other, tmp_path / "r", force=True).rows) == 1

    def test_a_folder_of_other_things_is_refused(self, grid, tmp_path):
        (tmp_path / "thesis.tex").touch()
        with pytest.raises(UsageError, match="is a folder of other things"):
            fly(grid, tmp_path)
        assert files(tmp_path) == ["thesis.tex"]

    def test_two_sweeps_in_one_folder_exclude_each_other(self, grid, tmp_path):
        store = CellStore(tmp_path / "r")
        store.open()
        with store.lock(), pytest.raises(UsageError, match="another sweep is running"):
            fly(grid, tmp_path / "r")

    def test_settings_that_contradict_each_other_in_every_cell_are_said_before_anything_is_flown(self, tmp_path):
        with pytest.raises(UsageError, match="step_time"):
            fly(expand(["trajectory=step", "trajectory.duration=0.4,0.5"]), tmp_path / "r")
        with pytest.raises(UsageError, match="truth: gives no vehicle that can fly"):
            fly(expand(["truth.mass=9,10"]), tmp_path / "r")
        assert files(tmp_path) == []

    def test_a_cell_whose_settings_contradict_each_other_is_marked_and_the_others_are_flown(self, tmp_path):
        """Found while composing (hover has no speed), while planning (a truth that cannot fly), and while its parts are
        built (a part of this test's own)."""
        from quadexp.plugins.archive.verify import verify_results

        asked = ["trajectory=circle,hover", "trajectory.speed=4", "truth.mass=1,9", "seed=0,1"]
        result = run_sweep(expand(asked), tmp_path / "r", SweepRequest(function=cells.contradicting_cell, workers=1))
        found = {(r["trajectory"], r["variant"], r["seed"]): (r["outcome"], r["cause"]) for r in result.rows}
        assert len(found) == 8 and found.pop(("circle", "truth.mass=1", 0)) == ("ok", "")
        assert found.pop(("circle", "truth.mass=1", 1)) == ("invalid", "seed 1 does not go with this")
        assert {outcome for outcome, _ in found.values()} == {"invalid"} and not result.not_flown
        assert all("no such key" in cause for (name, *_), (_, cause) in found.items() if name == "hover")
        assert all("no vehicle that can fly" in cause for (name, *_), (_, cause) in found.items() if name == "circle")
        assert "7 of 8 combinations are invalid and were not flown" in (tmp_path / "r" / "table.md").read_text()
        again = run_sweep(expand(asked), tmp_path / "r", SweepRequest(function=cells.contradicting_cell, workers=1))
        assert [row["outcome"] for row in again.rows] == [row["outcome"] for row in result.rows] and again.flown == 1
        assert [row["outcome"] for row in select(tmp_path / "r", failures=True).rows] == ["invalid"] * 7
        assert not verify_results(tmp_path / "r").wrong

    @needs("papers", "aerodynamics")
    def test_an_invalid_cell_takes_no_part_in_statistics_and_is_marked_in_the_table(self, tmp_path):
        asked = ["controller=nominal_mpc,rls_feedback", "controller.nodes=8,12", "trajectory.speed=2", "seed=0,1"]
        result = fly(expand(asked), tmp_path / "r")
        assert {s.controller for s in result.statistics.rows} == {"nominal_mpc"} and len(result.invalid) == 4
        assert list(result.table.columns) == ["trajectory", "m/s", "nodes", "nominal_mpc", "rls_feedback"]
        rows = result.table.rows
        assert [row[2] for row in rows] == ["", "8", "12"] and [row[4] for row in rows] == ["-", "invalid", "invalid"]

    def test_cells_of_one_controller_are_flown_one_after_the_other(self, grid):
        names = [job.cell.config.controller.name for job in flying_order(list(plan_cells(grid).values()))]
        # One of each first, so that two workers begin by building two controllers and not the same one.
        assert names == ["nominal_mpc", "perfect_mpc", *["nominal_mpc"] * 5, *["perfect_mpc"] * 5]


class TestPoison:
    def test_each_poisoned_cell_is_a_failed_row_and_the_rest_flies(self, tmp_path):
        grid = expand(["seed=range(8)"])
        engine = LocalEngine(2, timeout=15.0, memory=0.6)
        result = run_sweep(grid, tmp_path / "r", SweepRequest(function=cells.poisoned_cell, engine=engine))
        assert [row["outcome"] for row in result.rows] == ["ok", *["failed"] * 5, "ok", "ok"]
        causes = [row["cause"] for row in result.rows]
        assert "died" in causes[1] and causes[2] == "ValueError: this seed does not work" and "longer" in causes[3]
        assert causes[4] == "took more memory than evaluate.memory allows" and "exit code -11" in causes[5]
        assert math.isnan(result.rows[1]["mean_error"])
        assert not [name for name in files(tmp_path) if name.endswith(".tmp")]
        assert len([name for name in files(tmp_path) if "cells/" in name]) == 3
        # The failed ones are tried again next time, and only they.
        again = run_sweep(grid, tmp_path / "r", SweepRequest(function=cells.quick_cell, workers=2))
        assert again.flown == 5 and not again.not_flown


class TestInterrupt:
    @staticmethod
    def group_members(group):
        return [pid for pid, fields in processes() if int(fields[2]) == group and fields[0] != "Z"]

    @pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
    @pytest.mark.parametrize("whole_group", [True, pytest.param(False, marks=pytest.mark.slow)])
    def test_ctrl_c_keeps_what_is_done_and_leaves_nothing_else(self, tmp_path, whole_group):
        process = start(tmp_path, "seed=range(40)")
        wait_for(process, 6)
        os.killpg(process.pid, signal.SIGINT) if whole_group else process.send_signal(signal.SIGINT)
        rest = process.communicate(timeout=600)[0]
        assert process.returncode == 130
        line = rest.strip().splitlines()[-1]
        done = int(line.split()[1])
        assert line.startswith(f"error: {done} of 40 done; run the same command to continue (what is done is kept in ")
        assert done >= 6
        assert len(CellStore(tmp_path / "r").done()) == done
        assert not [name for name in files(tmp_path / "r") if name.endswith((".tmp", ".lock"))]
        deadline = time.time() + 120
        while self.group_members(process.pid) and time.time() < deadline:
            time.sleep(0.05)
        assert self.group_members(process.pid) == [], "orphans"
