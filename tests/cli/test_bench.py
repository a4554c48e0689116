"""`quadexp bench` as a user meets it: wrong requests are one line, before anything is flown."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest

from quadexp.cli.fly import _controllers
from tests.bench.rows import board
from tests.cli.command import run


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trajectory=circle"], "what is flown is the protocol's"),
        (["--only"], "nobody takes part"),
        (["--controller", "nominal_mcp"], "no such controller; did you mean nominal_mpc"),
        (["--add", "nothing.parquet"], "no such file (made by `quadexp bench`)"),
        (["--conf", "nowhere"], "no such folder"),
    ],
)
def test_wrong_requests_are_one_line(here, words, message):
    code, out, err = run("bench", *words)
    assert code == 2 and out == "" and err.startswith("error: ") and err.count("\n") == 1 and message in err, err


def test_rows_that_are_there_are_ranked_without_a_flight(here):
    from quadexp.bench.board import write_board
    from quadexp.bench.protocol import read_protocol

    errors = {"nominal_mpc": lambda t, s: 0.2, "other": lambda t, s: 0.1}
    rows = board(errors, protocol_sha256=read_protocol().sha256)
    write_board("mine.parquet", rows, {})
    code, out, err = run("bench", "--only", "--add", "mine.parquet", "--out", "b", "--markdown", "b.md", "--json")
    found = json.loads(out)
    assert code == 0, err
    assert [line["entry"] for line in found["boards"]["small"]] == ["other", "nominal_mpc"]
    assert "| 1 | other |" in (here / "b.md").read_text()
    assert run("show", "b/leaderboard.parquet")[0] == 0


def test_controllers_are_completed():
    assert _controllers(SimpleNamespace(params={"conf": None}), "gp_") == ["gp_mpc", "gp_mpc_tuned"]
