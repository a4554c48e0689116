"""Cells that other sources have flown: said, asked about, never mixed in silence; and what is said of libraries."""

import json

import pytest

from quadexp import provenance
from quadexp.errors import UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_flight, write_flight
from quadexp.report.checked import flown_by
from quadexp.report.summary import summarise
from quadexp.sweeps.results import select
from quadexp.sweeps.sweep import SweepInterrupted
from tests.cli.command import run
from tests.sweeps.quick import SWEEP, contents, fly


def rewrite(folder, key, **changes):
    """Have a cell say that another program has flown it; a value None: it does not say."""
    path = CellStore(folder).path(key)
    flight = read_flight(path)
    row = {**flight.metadata["row"], **changes}
    flight.metadata["row"] = {name: value for name, value in row.items() if value is not None}
    write_flight(path, flight)


@pytest.fixture
def mixed(folder):
    """Two cells of other sources, one of before there was a hash."""
    keys = [row["key"] for row in select(folder).rows]
    rewrite(folder, keys[0], sources="0123456789ab", program="0.0.9")
    rewrite(folder, keys[1], sources="0123456789ab", program="0.0.9")
    rewrite(folder, keys[3], sources=None, program=None, libraries=None)
    return folder


SAID = "2 by quadexp 0.0.9, sources 0123456789ab; 1 by an earlier version that did not say"


def test_a_sweep_over_them_says_which_and_asks(mixed):
    before = contents(mixed)
    with pytest.raises(UsageError) as error:
        fly(mixed, [*SWEEP, "plant.lift=0"])
    text = str(error.value)
    assert (
        f"3 of its cells were flown by other sources than these (quadexp 0.1.0, sources {provenance.sources()})" in text
    )
    assert SAID in text and "--refly" in text and "--keep-old" in text
    assert contents(mixed) == before, "nothing was touched"


def test_refly_flies_them_and_only_them(mixed):
    before = contents(mixed)
    result = fly(mixed, old="refly")
    assert result.flown == 3
    assert {row["sources"] for row in result.rows} == {provenance.sources()}
    assert f"3 cells of other sources are flown again: {SAID}" in result.notes
    kept = CellStore(mixed).path(result.rows[2]["key"]).relative_to(mixed)
    assert contents(mixed)[kept] == before[kept]
    again = fly(mixed)
    assert again.flown == 0 and not again.notes, "nobody is asked twice"


def test_keep_old_keeps_them_and_says_so_everywhere(mixed):
    kept = contents(mixed)
    result = fly(mixed, [*SWEEP[:2], "seed=0,1,2"], old="keep")
    assert result.flown == 2
    (note,) = result.notes
    assert note.startswith(f"3 cells of other sources are kept: {SAID}")
    after = contents(mixed)
    assert all(after[name] == content for name, content in kept.items() if name.parts[0] == "cells")
    assert "flights of 3 programs stand side by side: 3 by quadexp 0.1.0" in (mixed / "table.md").read_text()
    table = {row["key"]: row["sources"] for row in select(mixed).rows}
    assert sorted(table.values()) == ["", "0123456789ab", "0123456789ab", *[provenance.sources()] * 3]
    assert len(select(mixed, ["sources=0123456789ab"]).rows) == 2 and len(select(mixed, ["sources="]).rows) == 1
    with pytest.raises(UsageError, match="3 of its cells"):
        fly(mixed, [*SWEEP[:2], "seed=0,1,2"])


def test_a_refly_that_was_ended_goes_on(mixed):
    """A table of the run before says of a cell what it was; the cell itself says what it is."""

    def ends(done, total):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(SweepInterrupted):
        fly(mixed, old="refly", progress=ends)
    result = fly(mixed)
    assert 0 < result.flown < 3 and {row["sources"] for row in result.rows} == {provenance.sources()}


def test_show_and_results_print_what_the_cells_carry(mixed, monkeypatch):
    fly(mixed, old="keep")
    monkeypatch.setattr("quadexp.__version__", "77.0")
    monkeypatch.setattr("quadexp.provenance.sources", lambda: "fedcba987654")
    text = "\n".join(summarise(mixed)["lines"])
    assert "flown by    quadexp 0.0.9, sources 0123456789ab: 2 cells" in text
    assert "flown by    an earlier version that did not say: 1 cells" in text and "flown by    quadexp 0.1.0" in text
    assert "77.0" not in text and "fedcba987654" not in text
    code, out, err = run("results", mixed)
    assert code == 0 and "0123456789ab" in out and "flown by    quadexp 0.0.9, sources 0123456789ab: 2 cells" in err
    code, out, _ = run("show", mixed, "--json")
    assert [one["cells"] for one in json.loads(out)["flown_by"]] == [2, 1, 1]


def test_other_libraries_are_said_in_one_line_and_do_not_stop_anything(folder):
    other = provenance.libraries().replace("casadi ", "casadi 1")
    rewrite(folder, select(folder).rows[0]["key"], libraries=other)
    here = provenance.versions()["casadi"]
    result = fly(folder)
    assert result.flown == 0
    (note,) = result.notes
    assert note == f"1 cells were flown with other libraries: 1 with casadi 1{here} (here {here})"
    assert [program["cells"] for program in flown_by(result.rows)] == [3, 1]


class TestCommand:
    COMMAND = ("evaluate", "--sweep", "trajectory=step", "trajectory.duration=0.4", "trajectory.step_time=0.2")
    MORE = ("controller.backend=interpreted", "plant.backend=interpreted", "evaluate.workers=1", "--no-figures")

    def test_exit_code_2_without_either_and_with_both(self, tmp_path):
        out = tmp_path / "r"
        given = (*self.COMMAND, "seed=0,1", *self.MORE, "--out", out)
        assert run(*given)[0] == 0
        key = select(out).rows[0]["key"]
        rewrite(out, key, sources="0123456789ab")
        code, _, err = run(*given)
        assert code == 2 and "1 of its cells were flown by other sources" in err
        code, _, err = run(*given, "--refly", "--keep-old")
        assert code == 2 and "give one of them" in err
        code, printed, err = run(*given, "--keep-old", "--json")
        assert code == 0 and json.loads(printed)["flown"] == 0
        assert json.loads(printed)["notes"] and "note: 1 cells of other sources are kept" in err
        code, printed, err = run(*given, "--refly", "--json")
        assert code == 0 and json.loads(printed)["flown"] == 1
        assert run(*given)[0] == 0
