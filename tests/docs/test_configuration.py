"""The page of all keys that `make docs` makes: what the parts say today."""

import runpy
from pathlib import Path

from tests.deleted import needs


@needs()
def test_ranges_and_values_are_on_the_page():
    module = Path(__file__).resolve().parents[2] / "docs" / "site" / "configuration.py"
    page = runpy.run_path(str(module))["reference"]()
    rows = {line.split("|")[1].strip(): line for line in page.splitlines() if "|" in line}
    assert "(0, 60] m/s" in rows["`trajectory.speed`"]
    assert "`sgpr`, `subset`" in rows["`model.method`"]
    assert "3 numbers in [0, 100] N s/m" in rows["`plant.linear_drag`"]
