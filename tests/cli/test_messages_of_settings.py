"""What people write instead of a setting is answered with the setting."""

from __future__ import annotations

import pytest

from tests.cli.command import run_main


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--seed", "3"], "a setting is given without dashes: seed=VALUE"),
        (["--wind", "gust"], "a setting is given without dashes: wind=VALUE"),
        (["wind.speed=4"], "wind=none has no settings"),
        (["remedy=wind"], "did you mean remedies?"),
        (["--out", "x.csv"], "write x.parquet, then quadexp export x.parquet"),
    ],
)
def test_the_line_says_what_to_write(words, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run_main("simulate", *words)
    assert done.returncode == 2 and said in done.stderr and done.stderr.count("\n") == 1
    assert not [*tmp_path.iterdir()]
