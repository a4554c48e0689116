"""The held-out scores of a checkpoint: how well each predictor does on flights that no fit has seen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from quadexp.errors import QuadexpError
from quadexp.models.checkpoint import load_report
from quadexp.report.table import Table
from quadexp.report.text import number

UNITS = {"a": "m/s^2", "t": "N m"}  # by the first letter of an output


def held_out_rows(checkpoint: str | Path) -> list[dict[str, Any]]:
    """A record for each output and predictor: rmse and its unit, and what else the report of the fit says; [] where the
    checkpoint has no report, or one of another kind."""
    try:
        rows = load_report(Path(checkpoint)).get("rows", [])
        return [{**row, "unit": UNITS[row["output"][0]], "rmse": float(row["rmse"])} for row in rows]
    except (QuadexpError, ValueError, TypeError, KeyError, AttributeError):  # a model does not need its report
        return []


def held_out_table(rows: list[dict[str, Any]]) -> Table | None:
    """Outputs down, predictors across; None without scores."""
    if not rows:
        return None
    predictors = list(dict.fromkeys(row["predictor"] for row in rows))
    outputs = list(dict.fromkeys((row["output"], row["unit"]) for row in rows))
    found = {(row["output"], row["predictor"]): row["rmse"] for row in rows}
    lines = [
        [f"{output} ({unit})", *(number(found[output, p]) if (output, p) in found else "-" for p in predictors)]
        for output, unit in outputs
    ]
    return Table(["RMSE on held-out flights", *predictors], lines)
