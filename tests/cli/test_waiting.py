"""What a command says on a terminal while it takes long, and that nothing of it stays."""

import re

import pytest

from quadexp.log.store import write_flight
from tests.faults.test_hostile_files import on_a_terminal
from tests.log.flights import straight_flight

LINE = re.compile(r"\r([^\r\n\x1b]*)\x1b\[K")


@pytest.fixture
def flights(tmp_path):
    for name in "abc":
        write_flight(tmp_path / f"{name}.parquet", straight_flight(400))
    return [tmp_path / f"{name}.parquet" for name in "abc"]


def test_a_line_says_which_file_and_since_when(flights):
    said = LINE.findall(text := on_a_terminal("check", *flights, patience=0.05))
    assert any(re.fullmatch(r"check: .*[abc]\.parquet \(\d+ s\)", line) for line in said), text
    assert said[-1] == "", "it is taken away"
    left = LINE.sub("", text)
    assert "check: " not in left and "parquet" in left


def test_in_time_nothing_is_said(flights):
    assert LINE.findall(on_a_terminal("check", *flights, patience=60.0)) == []
