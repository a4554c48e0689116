"""Rows of results: their columns, as CSV and as columns for Parquet."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quadexp.report.metrics import errors_none
from quadexp.report.table import csv_text

# Columns of a result row, in the order they are written.
ROW_COLUMNS = (
    "plant", "vehicle", "trajectory", "speed", "controller", "model", "variant", "seed", "rmse", "mean_error",
    "max_error", "attitude_rmse", "heading_rmse", "solve_time_median", "solve_time_p99", "solve_time_max",
    "saturated_share", "peak_speed", "duration", "unconverged_count", "reference_residual", "outside_data", "outcome",
    "backend", "cause", "program", "sources", "libraries", "key",
)  # fmt: skip
TEXT_COLUMNS = (
    "plant", "vehicle", "trajectory", "controller", "model", "variant", "outcome", "backend", "cause",
    "program", "sources", "libraries", "key",
)  # fmt: skip
INTEGER_COLUMNS = ("seed", "unconverged_count")
NAN = math.nan


def to_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Result rows as CSV, numbers in full precision."""
    return csv_text(ROW_COLUMNS, ([row.get(name) for name in ROW_COLUMNS] for row in rows))


def to_columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Result rows as columns of fixed types, for Parquet."""
    columns: dict[str, Any] = {}
    for name in ROW_COLUMNS:
        kind: Any = object if name in TEXT_COLUMNS else np.int64 if name in INTEGER_COLUMNS else float
        empty = {object: "", np.int64: 0, float: NAN}[kind]
        values = [empty if (value := row.get(name)) is None else value for row in rows]
        columns[name] = np.array([str(v) for v in values] if kind is object else values, dtype=kind)
    return columns


def from_columns(columns: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Result rows from the columns of a results file; a flight that was lost has no errors, whatever wrote it."""
    lists = [column.tolist() for column in columns.values()]
    rows = (dict(zip(columns, values, strict=True)) for values in zip(*lists, strict=True))
    return [row | errors_none(row["outcome"]) for row in rows]
