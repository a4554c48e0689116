"""Statistics on disk, computed again only when their result rows change, and the tables made from them.

<results>/statistics.parquet, .csv    every metric, long
<results>/table.md, .tex              one metric: the error table, and in table.md the comparisons
<results>/comparison.tex              one metric: every contestant against the baseline
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError
from quadexp.files.writer import write_text
from quadexp.log.store import read_table, read_text, write_table
from quadexp.report.notes import notes
from quadexp.report.pairing import Row, is_invalid
from quadexp.report.statistics import (
    BASELINE,
    COMPARED,
    CONFIDENCE,
    DESCRIBED,
    Statistic,
    compute_statistics,
    overall,
)
from quadexp.report.table import csv_text
from quadexp.report.tables import ErrorTable, comparison_table, table_of, to_latex, to_markdown
from quadexp.report.winner import Verdict, verdicts

FILE = "statistics.parquet"
VERSION = 4  # of how the numbers are computed; another one makes stored statistics unknown
_KINDS = {field.name: str(field.type) for field in fields(Statistic)}
_DTYPES = {"int": np.int64, "float": float, "str": object}


@dataclass(frozen=True)
class Statistics:
    """rows: per metric and contestant, in each condition and over all. verdicts: per metric, plant and vehicle, the
    least error. notes: on the result rows, see report/notes.py. invalid: those rows
    whose settings contradict each other."""

    rows: list[Statistic]
    verdicts: list[Verdict]
    notes: list[str]
    baseline: str
    confidence: float
    fingerprint: str
    invalid: tuple[Row, ...] = ()

    def of(self, metric: str) -> list[Statistic]:
        return [row for row in self.rows if row.metric == metric and not row.is_overall]

    def record(self, metric: str) -> list[dict[str, Any]]:
        """Of one metric, for JSON."""
        return [asdict(row) for row in self.of(metric)]

    def pooled(self, metric: str) -> list[Statistic]:
        """Of one metric, over all conditions."""
        return [row for row in self.rows if row.metric == metric and row.is_overall]

    def verdicts_of(self, metric: str) -> list[Verdict]:
        return [verdict for verdict in self.verdicts if verdict.metric == metric]


def results_statistics(
    root: str | Path | None, rows: Sequence[Row], *, baseline: str = BASELINE, confidence: float = CONFIDENCE
) -> Statistics:
    """The statistics of result rows: those in the folder `root` if they are of the same rows, else computed."""
    fingerprint = _fingerprint(rows, baseline, confidence)
    invalid = tuple(row for row in rows if is_invalid(row))
    if root is not None:
        try:
            columns, record = read_table(Path(root) / FILE, "statistics", required=list(_KINDS))
        except QuadexpError:
            record = {}
        if record.get("fingerprint") == fingerprint:
            found = [Verdict(**_swapped(entry, None, math.nan)) for entry in record["verdicts"]]
            stored = from_statistics_columns(columns)
            return Statistics(stored, found, notes(rows), baseline, confidence, fingerprint, invalid)
    options: dict[str, Any] = {"baseline": baseline, "confidence": confidence}
    pooled = [entry for metric in COMPARED for entry in overall(rows, metric=metric, **options)]
    found = [one for metric in COMPARED for one in verdicts(rows, metric=metric, confidence=confidence)]
    made = [*compute_statistics(rows, **options), *pooled]
    return Statistics(made, found, notes(rows), baseline, confidence, fingerprint, invalid)


def write_statistics(root: str | Path, statistics: Statistics) -> dict[str, str]:
    """Write both files unless they hold these statistics already; returns name -> path."""
    path, text = Path(root) / FILE, (Path(root) / FILE).with_suffix(".csv")
    csv = statistics_csv(statistics.rows)
    try:
        same = read_table(path, "statistics")[1].get("fingerprint") == statistics.fingerprint
    except QuadexpError:
        same = False
    if not same:
        record = {
            "baseline": statistics.baseline,
            "confidence": statistics.confidence,
            "fingerprint": statistics.fingerprint,
            "verdicts": [_swapped(asdict(entry), math.nan, None) for entry in statistics.verdicts],
        }
        write_table(path, statistics_columns(statistics.rows), record, "statistics")
    if read_text(text) != csv:
        write_text(text, csv)
    return {"statistics": str(path), "statistics_csv": str(text)}


def comparison_texts(statistics: Statistics, metric: str) -> tuple[ErrorTable, dict[str, str]]:
    """The error table of one metric, and name -> content of the text files made of it."""
    compared = statistics.of(metric)
    table = table_of(
        compared, statistics.pooled(metric), statistics.verdicts_of(metric), statistics.notes, statistics.invalid
    )
    files = {"table.md": to_markdown(table), "table.tex": to_latex(table)}
    if (comparison := comparison_table(compared)) is not None:
        files["table.md"] += f"\n{comparison.markdown()}"
        files["comparison.tex"] = comparison.latex()
    return table, files


def write_comparison(root: str | Path, statistics: Statistics, metric: str) -> tuple[ErrorTable, dict[str, str]]:
    """Write the statistics and the tables of one metric; returns the error table and name -> path."""
    root = Path(root)
    table, texts = comparison_texts(statistics, metric)
    names = {"table.md": "markdown", "table.tex": "latex", "comparison.tex": "comparison"}
    files = {names[name]: str(write_text(root / name, text)) for name, text in texts.items()}
    if "comparison.tex" not in texts:
        (root / "comparison.tex").unlink(missing_ok=True)
    return table, files | write_statistics(root, statistics)


def statistics_columns(statistics: Sequence[Statistic]) -> dict[str, np.ndarray]:
    """As columns with settled types, for Parquet."""
    return {
        name: np.array([getattr(row, name) for row in statistics], dtype=_DTYPES[kind]) for name, kind in _KINDS.items()
    }


def from_statistics_columns(columns: Mapping[str, np.ndarray]) -> list[Statistic]:
    lists = [columns[name].tolist() for name in _KINDS]
    return [Statistic(**dict(zip(_KINDS, values, strict=True))) for values in zip(*lists, strict=True)]


def statistics_csv(statistics: Sequence[Statistic]) -> str:
    """Numbers in full precision, nothing for NaN."""
    return csv_text(list(_KINDS), ([getattr(row, name) for name in _KINDS] for row in statistics))


def _fingerprint(rows: Sequence[Row], baseline: str, confidence: float) -> str:
    """sha256 of all that the statistics depend on, 20 hex digits."""
    names = ("plant", "vehicle", "trajectory", "speed", "controller", "model", "variant", "seed", "outcome")
    digest = hashlib.sha256(json.dumps([VERSION, baseline, confidence]).encode())
    for row in rows:
        digest.update(repr([_settled(row.get(name)) for name in (*names, *COMPARED, *DESCRIBED)]).encode())
    return digest.hexdigest()[:20]


def _settled(value: Any) -> Any:
    """One spelling for one value, whether it was just computed or read from a file."""
    if value is None or value == "":
        return ""
    value = value.item() if hasattr(value, "item") else value
    return "" if value != value else value  # NaN


def _swapped(value: Any, old: float | None, new: float | None) -> Any:
    """The same with NaN (here `old` is NaN) or None replaced in all lists and mappings; JSON has no NaN."""
    if isinstance(value, Mapping):
        return {name: _swapped(inner, old, new) for name, inner in value.items()}
    if isinstance(value, list):
        return [_swapped(inner, old, new) for inner in value]
    return new if value is old or (old is not None and value != value) else value
