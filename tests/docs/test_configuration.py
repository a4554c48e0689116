"""The configuration reference: complete, and what the schemas say today."""

from __future__ import annotations

from pathlib import Path

from tests.docs.configuration import reference

PAGE = Path(__file__).resolve().parents[2] / "docs" / "configuration.md"


def test_the_page_is_made_from_the_schemas_of_today():
    again = "python -m tests.docs.configuration > docs/configuration.md"
    assert PAGE.read_text(encoding="utf-8") == reference(), f"make it anew: {again}"


def test_ranges_and_values_are_on_the_page():
    rows = {line.split("|")[1].strip(): line for line in PAGE.read_text(encoding="utf-8").splitlines() if "|" in line}
    assert "(0, 60] m/s" in rows["`trajectory.speed`"]
    assert "`sgpr`, `subset`, `exact`" in rows["`gp.method`"]
    assert "3 numbers in [0, 100] N s/m" in rows["`plant.linear_drag`"]
