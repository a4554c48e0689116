"""What stands in the way of a search is said before its first flight, and nothing of somebody else is removed."""

import pytest

from quadexp.errors import UsageError
from quadexp.plugins.bench.board import check_markdown
from quadexp.plugins.tune.call import tune
from quadexp.plugins.tune.settings import Tune

CELL = ["controller=pid", "plant=ideal", "trajectory=hover", "trajectory.duration=0.2"]
ASKED = {"vary": ("controller.position_proportional=0.5..2",), "seeds": 1, "flights": 2}


def refused(out, match, *, conf=None, force=False, **asked):
    """A search that does not fly; the files of the folder stay as they are."""

    def never(*cell):
        raise AssertionError("a cell was flown")

    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(UsageError, match=match):
        tune(CELL, Tune(**ASKED, **asked), out=out, conf=conf, force=force, function=never, isolate=False, figure=False)
    after = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert after == before


def test_the_name_of_an_option_that_ships(tmp_path):
    refused(tmp_path / "t", "--name pid_tuned: is an option already", name="pid_tuned")
    assert not (tmp_path / "t").exists()


def test_the_name_of_an_own_option(tmp_path):
    (tmp_path / "c/controller").mkdir(parents=True)
    (tmp_path / "c/controller/mine.yaml").write_text("defaults: [pid, _self_]\n")
    refused(tmp_path / "t", "--name mine: is an option already", name="mine", conf=tmp_path / "c")
    refused(tmp_path / "c", "mine.yaml: was not written by", name="mine", conf=tmp_path / "c")
    refused(tmp_path / "c", "mine.yaml: was not written by", name="mine", force=True)


def test_a_folder_of_other_things_keeps_them(tmp_path):
    (tmp_path / "search.json").write_text("mine")
    refused(tmp_path, "is a folder of other things", force=True)


def test_a_file_where_the_folder_of_the_option_would_be(tmp_path):
    (tmp_path / "cells").mkdir()
    (tmp_path / "controller").write_text("")
    refused(tmp_path, "pid_tuned.yaml: cannot be written there")


def test_a_history_that_cannot_be_written(tmp_path):
    (tmp_path / "cells").mkdir()
    (tmp_path / "history.parquet").mkdir()
    refused(tmp_path, "history.parquet: is a folder")


def test_a_markdown_file_without_marks(tmp_path):
    (tmp_path / "a.md").write_text("# Mine\n")
    with pytest.raises(UsageError, match=r"a.md: has no marks to write between"):
        check_markdown(tmp_path / "a.md")
    assert check_markdown(tmp_path / "b.md") is None
    with pytest.raises(UsageError, match="is a folder"):
        check_markdown(tmp_path)
