"""The statistics of a sweep on disk, and the tables made from them.

<results>/statistics.parquet, .csv    every metric, long
<results>/table.md, .tex              one metric: the error table, and in table.md the comparisons
<results>/comparison.tex              one metric: every contestant against the baseline
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError
from quadexp.files.writer import write_text
from quadexp.log.store import read_table, read_text, write_table
from quadexp.report.pairing import Row
from quadexp.report.statistics import BASELINE, COMPARED, CONFIDENCE, Statistic, compute_statistics, overall
from quadexp.report.table import csv_text
from quadexp.report.tables import ErrorTable, comparison_table, error_table

FILE = "statistics.parquet"
NAMES = {
    "table.md": "markdown",
    "table.tex": "latex",
    "comparison.tex": "comparison",
    "statistics.csv": "statistics_csv",
}
_KINDS = {field.name: {"int": np.int64, "float": float, "str": object}[str(field.type)] for field in fields(Statistic)}


@dataclass(frozen=True)
class Statistics:
    """rows: per metric and contestant, in each condition and over all. flights: the result rows they are of."""

    rows: list[Statistic]
    flights: Sequence[Row]
    baseline: str
    confidence: float

    def of(self, metric: str) -> list[Statistic]:
        return [row for row in self.rows if row.metric == metric and not row.is_overall]

    def record(self, metric: str) -> list[dict[str, Any]]:
        """Of one metric, for JSON."""
        return [asdict(row) for row in self.of(metric)]

    @cached_property
    def csv(self) -> str:
        return statistics_csv(self.rows)

    @cached_property
    def fingerprint(self) -> str:
        """20 hex digits of all numbers."""
        return hashlib.sha256(self.csv.encode()).hexdigest()[:20]


def results_statistics(rows: Sequence[Row], *, baseline: str = BASELINE, confidence: float = CONFIDENCE) -> Statistics:
    """The statistics of result rows: of each metric, line by line and over all conditions."""
    options: dict[str, Any] = {"baseline": baseline, "confidence": confidence}
    pooled = [entry for metric in COMPARED for entry in overall(rows, metric=metric, **options)]
    return Statistics([*compute_statistics(rows, **options), *pooled], rows, baseline, confidence)


def comparison_texts(statistics: Statistics, metric: str) -> tuple[ErrorTable, dict[str, str]]:
    """The error table of one metric, and name -> content of the text files made of the statistics."""
    table = error_table(statistics.flights, metric, baseline=statistics.baseline, confidence=statistics.confidence)
    files = {"table.md": table.markdown(), "table.tex": table.latex(), "statistics.csv": statistics.csv}
    if (comparison := comparison_table(statistics.of(metric))) is not None:
        files["table.md"] += f"\n{comparison.markdown()}"
        files["comparison.tex"] = comparison.latex()
    return table, files


def write_comparison(root: Path, statistics: Statistics, texts: Mapping[str, str]) -> dict[str, str]:
    """Write the statistics and the texts of `comparison_texts`, unless they are there; returns name -> path."""
    for name, text in texts.items():
        if read_text(root / name) != text:
            write_text(root / name, text)
    if "comparison.tex" not in texts:
        (root / "comparison.tex").unlink(missing_ok=True)
    record = {name: getattr(statistics, name) for name in ("baseline", "confidence", "fingerprint")}
    try:
        there = read_table(root / FILE, "statistics")[1].get("fingerprint") == statistics.fingerprint
    except QuadexpError:
        there = False
    if not there:
        columns = {
            name: np.array([getattr(row, name) for row in statistics.rows], kind) for name, kind in _KINDS.items()
        }
        write_table(root / FILE, columns, record, "statistics")
    return {NAMES[name]: str(root / name) for name in texts} | {"statistics": str(root / FILE)}


def statistics_csv(statistics: Sequence[Statistic]) -> str:
    """Numbers in full precision, nothing for NaN."""
    return csv_text(list(_KINDS), ([getattr(row, name) for name in _KINDS] for row in statistics))
