"""`quadexp results`: what lies in a folder, and what may go."""

import json
import os
import shutil

import pytest

from quadexp.errors import QuadexpError, UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_metadata, read_table, write_table
from quadexp.parts.compose import expand
from quadexp.sweeps.results import prune, select
from quadexp.sweeps.sweep import SweepInterrupted, SweepRequest, run_sweep
from tests.cli.command import run
from tests.sweeps.cells import quick_cell
from tests.sweeps.quick import kill, start, wait_for
from tests.sweeps.test_sweep import GRID, fly


@pytest.fixture(scope="module")
def once(tmp_path_factory):
    out = tmp_path_factory.mktemp("once") / "r"
    fly(expand(GRID), out)
    return out


@pytest.fixture
def flown(once, tmp_path):
    """A copy of the results."""
    return shutil.copytree(once, tmp_path / "r")


class TestList:
    def test_everything_in_the_order_of_the_sweep(self, flown):
        rows = select(flown).rows
        assert [(r["speed"], r["controller"], r["seed"]) for r in rows][2:4] == [
            (4.0, "nominal_mpc", 2),
            (4.0, "perfect_mpc", 0),
        ]
        assert all(row["wanted"] for row in rows)

    @pytest.mark.parametrize(
        ("filters", "count"),
        [(["seed=1"], 4), (["seed=0,2", "speed=8"], 4), (["controller=perf*"], 6), (["controller=x"], 0)],
    )
    def test_filters_must_all_hold(self, flown, filters, count):
        assert len(select(flown, filters).rows) == count

    @pytest.mark.parametrize("wrong", [{"filters": ["sped=4"]}, {"sort": "sped"}])
    def test_a_column_that_is_none(self, flown, wrong):
        with pytest.raises(UsageError, match="sped: no such column; did you mean speed"):
            select(flown, **wrong)

    def test_cells_of_an_earlier_sweep_are_listed_as_not_wanted(self, flown):
        fly(expand(["seed=9"]), flown, force=True)
        rows = select(flown).rows
        assert len(rows) == 13 and sum(row["wanted"] for row in rows) == 1
        assert len(select(flown, ["wanted=true"]).rows) == 1

    def test_a_damaged_cell_is_listed(self, flown):
        key = select(flown).rows[0]["key"]
        CellStore(flown).path(key).write_bytes(b"no")
        (flown / "results.parquet").unlink()
        (row,) = select(flown, failures=True).rows
        assert row["key"] == key and "not a Parquet file" in row["cause"]


KEYS = ["controller.nodes=10,20,30", "plant.step=0.001,0.002", "wind.velocity=[1,0,0],[0.5,2,0]"]
SETTINGS = [(n, s, w) for n in (10, 20, 30) for s in (0.001, 0.002) for w in ("[1,0,0]", "[0.5,2,0]")]


@pytest.fixture(params=["of the last sweep", "of an earlier one", "of one that did not end", "with a wrong table"])
def varied(request, tmp_path):
    """Twelve cells that differ in settings only."""
    out = tmp_path / "r"
    fly(expand(["wind=constant", *KEYS]), out)
    if request.param == "of an earlier one":
        fly(expand(["seed=9"]), out, force=True)
    if request.param == "of one that did not end":
        (out / "results.parquet").unlink()
    if request.param == "with a wrong table":
        columns, record = read_table(out / "results.parquet", "results")
        columns["variant"][:] = columns["variant"][0]
        write_table(out / "results.parquet", columns, record, "results")
    return out


NAMES = ("controller.nodes", "plant.step", "wind.velocity")
FILTERS = [
    (["wind.velocity=[1,0,0]", "plant.step=0.002"], lambda n, s, w: w == "[1,0,0]" and s == 0.002),
    (["wind.velocity=[1.0, 0, 0.0],[9,9,9]"], lambda n, s, w: w == "[1,0,0]"),
]


class TestSettings:
    @pytest.mark.parametrize(("filters", "holds"), FILTERS)
    def test_what_goes_is_chosen_by_its_own_settings(self, varied, filters, holds):
        prune(varied, filters, remove=True)
        store = CellStore(varied)
        records = [read_metadata(store.path(key)) for key in store.done()]
        configs = [record["config"] for record in records if record["seed"] == 0]
        left = [tuple(_value(config, name) for name in NAMES) for config in configs]
        assert sorted(left) == sorted(setting for setting in SETTINGS if not holds(*setting))


def _value(config, name):
    group, _, key = name.partition(".")
    return (
        json.dumps(config[group][key]).replace(".0", "").replace(" ", "") if key == "velocity" else config[group][key]
    )


class TestPrune:
    def test_what_the_last_sweep_did_not_ask_for(self, flown):
        fly(expand(["seed=9"]), flown, force=True)
        said = prune(flown)
        assert len(said.keys) == 12 and said.size > 0 and not said.removed
        assert len(CellStore(flown).done()) == 13, "nothing goes without being given"
        assert prune(flown, remove=True).removed
        assert len(CellStore(flown).done()) == 1 == len(select(flown).rows)
        assert fly(expand(["seed=9"]), flown).flown == 0

    def test_what_is_named_goes_from_the_table_too(self, flown):
        assert len(prune(flown, ["controller=perfect_mpc"], remove=True).keys) == 6
        assert {row["controller"] for row in select(flown).rows} == {"nominal_mpc"}
        smaller = expand(["trajectory.speed=4,8", "controller=nominal_mpc", "seed=range(3)"])
        assert fly(smaller, flown).flown == 0, "the smaller sweep is not another one"
        assert fly(expand(GRID), flown).flown == 6

    def test_without_a_table_nobody_knows_what_is_wanted(self, flown):
        (flown / "results.parquet").unlink()
        with pytest.raises(UsageError, match="name the others by KEY=VALUE"):
            prune(flown, remove=True)


def interrupted(out, overrides, flights, error=KeyboardInterrupt, **options):
    """A sweep that ends so after some flights; keys of what is then there."""
    left = iter(range(flights))

    def cell(*task):
        if next(left, None) is None:
            raise error
        return quick_cell(*task)

    with pytest.raises((QuadexpError, KeyboardInterrupt, OSError)) as ended:
        run_sweep(expand(overrides), out, SweepRequest(function=cell, isolate=False, **options))
    if error is KeyboardInterrupt:
        assert ended.type is SweepInterrupted and "what is done is kept" in str(ended.value)
    return CellStore(out).done()


LARGER = [*GRID[:2], "seed=range(6)"]
OTHER = ["controller=perfect_mpc", "controller.nodes=5,10", "seed=range(3)"]


class TestPruneKeeps:
    """What a sweep that has not ended reported as kept."""

    @pytest.mark.parametrize("error", [KeyboardInterrupt, OSError("the disk has gone")])
    def test_an_enlargement_that_was_interrupted(self, flown, error):
        from quadexp.plugins.archive.verify import verify_results

        there = interrupted(flown, LARGER, 5, error)
        assert len(there) == 17 and prune(flown, remove=True).keys == []
        assert sum(row["wanted"] for row in select(flown).rows) == 17
        assert fly(expand(LARGER), flown).flown == 24 - 17
        assert prune(flown).keys == [] and len(CellStore(flown).done()) == 24
        assert not verify_results(flown).wrong

    def test_one_that_was_killed(self, tmp_path):
        out = tmp_path / "r"
        fly(expand(["seed=range(2)"]), out)
        process = start(tmp_path, "seed=range(24)")
        wait_for(process, 6)
        kill(process)
        there = CellStore(out).done()
        assert 6 <= len(there) < 24 and prune(out, remove=True).keys == []
        assert there <= CellStore(out).done()  # its processes may have ended a flight meanwhile

    def test_two_sweeps_of_which_the_other_ended(self, tmp_path):
        out = tmp_path / "r"
        first = interrupted(out, GRID, 5)
        fly(expand(OTHER), out)
        fly(expand(["seed=9"]), out, force=True)
        gone = prune(out, remove=True)
        assert len(gone.keys) == 6 and len(first) == 5 and first < CellStore(out).done()
        assert {row["controller"] for row in gone.frame.rows} == {"perfect_mpc"}
        assert fly(expand(GRID), out, force=True).rows and {*prune(out).keys} & first == set()

    def test_both_of_two_that_were_interrupted(self, tmp_path):
        out = tmp_path / "r"
        interrupted(out, GRID, 5)
        there = interrupted(out, OTHER, 2)
        fly(expand(["seed=9"]), out)
        assert prune(out).keys == [] and len(there) == 7

    def test_a_sweep_of_which_nothing_was_flown_leaves_nothing(self, tmp_path):
        assert interrupted(tmp_path / "r", GRID, 0) == set() and not (tmp_path / "r").exists()

    @pytest.mark.parametrize("content", ["", '["ab12', "7", "\x00"])
    def test_where_the_list_cannot_be_read_everything(self, flown, content):
        interrupted(flown, LARGER, 5)
        (flown / "cells" / "asked.json").write_text(content)
        code, _, err = run("results", flown, "--prune", "--yes")
        assert code == 2 and "cannot be read: name the others by KEY=VALUE" in err and err.count("\n") == 1
        fly(expand(["seed=9"]), flown, force=True)
        with pytest.raises(UsageError, match="cannot be read"):
            prune(flown, remove=True)
        assert all(row["wanted"] for row in select(flown).rows) and len(CellStore(flown).done()) == 18
        assert len(prune(flown, ["seed=0"], remove=True).keys) == 4

    def test_no_link_is_followed(self, flown, tmp_path):
        (tmp_path / "mine").write_text("[]")
        (flown / "cells" / "asked.json").symlink_to(tmp_path / "mine")
        interrupted(flown, LARGER, 5)
        assert (tmp_path / "mine").read_text() == "[]" and prune(flown).keys == []


def test_a_finished_sweep_in_a_folder_that_takes_no_files(flown, monkeypatch):
    """On a disk that can only be read: the table is shown, and what is there stays. More cannot be flown."""
    written = {path: path.read_bytes() for path in flown.rglob("*") if path.is_file()}
    monkeypatch.setattr("os.access", lambda path, mode: mode != os.W_OK)
    result = fly(expand(GRID), flown)
    assert len(result.rows) == 12 and result.flown == 0 and result.table.rows
    assert "cannot be written: tables and figures in it are as they were" in " ".join(result.notes)
    assert {path: path.read_bytes() for path in flown.rglob("*") if path.is_file()} == written


class TestCommand:
    def test_what_goes_is_listed_before(self, flown):
        fly(expand(["seed=9"]), flown, force=True)
        _, out, _ = run("results", flown, "--prune")
        assert "12 cells" in out and all(key in out for key in prune(flown).keys)

    def test_prune(self, flown):
        code, out, _ = run("results", str(flown), "seed=1", "--prune")
        assert code == 0 and out.startswith("4 cells") and "--yes" in out
        code, out, _ = run("results", str(flown), "seed=1", "--prune", "--yes", "--json")
        assert json.loads(out)["removed"] is True and len(CellStore(flown).done()) == 8
