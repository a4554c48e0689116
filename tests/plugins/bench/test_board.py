"""Leaderboards as files: what may be ranked together, and what is written."""

import pytest

from quadexp.errors import UsageError
from quadexp.log.store import write_table
from quadexp.plugins.bench.board import (
    BEGIN,
    END,
    board_table,
    error_table,
    joined,
    markdown,
    read_board,
    update_markdown,
    write_board,
)
from quadexp.plugins.bench.protocol import SHORT, read_protocol
from tests.docs.commands import ROOT
from tests.plugins.bench.rows import board

ERRORS = {"nominal_mpc": lambda task, seed: 0.2, "other": lambda task, seed: 0.1 if seed else None}
ROWS = board(ERRORS)


def test_rows_come_back(tmp_path):
    path = write_board(tmp_path / "b.parquet", ROWS, {})
    back = read_board(path)
    assert str([{name: one[name] for name in ROWS[0]} for one in back]) == str(ROWS)  # NaN is the same here
    write_table(tmp_path / "c.parquet", {"t": [0.0]}, {}, "flight")
    with pytest.raises(Exception, match="is a flight, a leaderboard is needed here"):
        read_board(tmp_path / "c.parquet")


def test_another_entry_joins():
    found = joined(ROWS, board({"third": lambda t, s: 0.3, "other": lambda t, s: 0.9}), "b.parquet")
    assert [row for row in found if row["entry"] == "other"] == [row for row in ROWS if row["entry"] == "other"]
    assert {row["entry"] for row in found} == {"nominal_mpc", "other", "third"}


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (
            {"protocol_sha256": "bb" * 32},
            "is of protocol bbbbbbbbbbbb, not aaaaaaaaaaaa: results of different protocols",
        ),
        ({"size": "full"}, "is of size full, not quick: results of different sizes are not ranked together"),
        ({"seeds": range(2)}, "have not flown the same cells"),
        ({"tasks": ["circle"]}, "have not flown the same cells"),
    ],
)
def test_what_is_not_alike_is_not_ranked_together(more, message):
    with pytest.raises(UsageError, match=message):
        joined(ROWS, board({"third": lambda t, s: 0.3}, **more), "b.parquet")


def test_tables_say_who_lost_and_which_settings():
    table = board_table(ROWS, metric="mean_error", baseline="nominal_mpc")
    assert [row[:4] for row in table.rows] == [
        ["1", "other", "as shipped", "4 of 6"],
        ["= 2", "nominal_mpc", "as shipped", "6 of 6"],
    ]
    assert [row[5] for row in table.rows] == ["1.00 (4)", "1.59"]  # of the surviving flights, which says how many
    assert table.notes == ["3 seeds cannot show p < 0.05: at least 6 are needed; no two are significantly different"]
    errors = error_table(ROWS, metric="mean_error", by=("task",))
    assert list(errors.columns) == ["task", "nominal_mpc", "other"]
    assert errors.rows[0] == ["circle", "200.0", "100.0 (1 lost)"]


def test_markdown_is_written_between_its_marks(tmp_path):
    text = markdown(ROWS, metric="mean_error", baseline="nominal_mpc", what={"small": "a hover"})
    path = tmp_path / "b.md"
    path.write_text(f"# Title\n\nbefore\n\n{BEGIN}\nformer text\n{END}\n\nafter\n")
    once = update_markdown(path, text).read_text()
    assert once.startswith("# Title\n\nbefore\n") and once.endswith("after\n") and "former text" not in once
    assert update_markdown(path, text).read_text() == once and "| 1 | other |" in once
    (tmp_path / "c.md").write_text("# no marks\n")
    with pytest.raises(UsageError, match="has no marks to write between"):
        update_markdown(tmp_path / "c.md", text)


def test_the_page_of_the_documentation_is_of_the_rows_beside_it():
    """docs/leaderboard.md is made from docs/leaderboard.parquet, and says by which protocol it was flown."""
    rows, protocol = read_board(ROOT / "docs" / "leaderboard.parquet"), read_protocol()
    what = {family.name: family.what for family in protocol.families.values()}
    text = markdown(rows, metric=protocol.metric, baseline=protocol.baseline, what=what)
    assert f"Protocol v{rows[0]['protocol']} ({rows[0]['protocol_sha256'][:SHORT]})" in text
    assert text in (ROOT / "docs" / "leaderboard.md").read_text(encoding="utf-8")
