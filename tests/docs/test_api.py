"""The page on the Python API: its calls give what it shows, and it names every function there is."""

from __future__ import annotations

import doctest
from pathlib import Path

import quadexp as qx

PAGE = Path(__file__).resolve().parents[2] / "docs" / "api.md"


def test_its_calls_give_what_it_shows(tmp_path, monkeypatch):
    """And leave nothing behind where they are run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").symlink_to(PAGE.parent)
    found = doctest.testfile(str(PAGE), module_relative=False, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert found.attempted > 30 and found.failed == 0 and list(tmp_path.iterdir()) == [tmp_path / "docs"]


def test_it_names_what_there_is():
    text = PAGE.read_text(encoding="utf-8")
    assert [name for name in qx.__all__ if not name.startswith("__") and name not in text] == []
