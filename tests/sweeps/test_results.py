"""`quadexp results`: what lies in a folder, and what may go."""

import json
import shutil

import pytest

from quadexp.errors import UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_metadata, read_table, write_table
from quadexp.parts.compose import expand
from quadexp.sweeps.results import prune, select
from tests.cli.command import run
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
        assert len(CellStore(flown).done()) == 13, "nothing goes without being told"
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


class TestCommand:
    def test_prune(self, flown):
        code, out, _ = run("results", str(flown), "seed=1", "--prune")
        assert code == 0 and out.startswith("4 cells") and "--yes" in out
        code, out, _ = run("results", str(flown), "seed=1", "--prune", "--yes", "--json")
        assert json.loads(out)["removed"] is True and len(CellStore(flown).done()) == 8
