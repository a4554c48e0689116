"""The pages of calls: they give what they show, and the one on the API names every function there is."""

import doctest
from pathlib import Path

import pytest

import quadexp as qx

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.parametrize(("page", "calls"), [("api.md", 30), ("lei_li.md", 15)])
def test_its_calls_give_what_it_shows(here, page, calls):
    """And leave nothing behind where they are run."""
    (here / "docs").symlink_to(DOCS)
    found = doctest.testfile(str(DOCS / page), module_relative=False, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert found.attempted > calls and found.failed == 0 and list(here.iterdir()) == [here / "docs"]


def test_it_names_what_there_is():
    text = (DOCS / "api.md").read_text(encoding="utf-8")
    assert [name for name in qx.__all__ if not name.startswith("__") and name not in text] == []
