"""PX4's topics as a folder of CSVs, one a topic: <prefix>_<topic>_<instance>.csv, as ulog2csv writes them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from quadexp.errors import DataError
from quadexp.log.importers.px4 import TOPICS, read_topics
from quadexp.log.importers.raw import RawLog
from quadexp.log.importers.table import open_table

_NAME = re.compile(rf"(?:.*_)?({'|'.join(sorted(TOPICS, key=len, reverse=True))})_(\d+)")


ABOUT = "folder of CSVs, one a topic, as ulog2csv writes them"


def recognises(path: Path, head: bytes | None) -> int:
    return 2 * (head is None and any(path.glob("*_vehicle_*_0.csv")))


def read(path: Path, named: str) -> RawLog:
    """Streams of a folder of topics. Raises DataError."""
    if any(
        "thrust of rotor" in file.read_text(encoding="utf-8", errors="replace") for file in path.glob("*_about.json")
    ):
        raise DataError(f"{path}: an export of an earlier version of this program: import the flight's Parquet")
    topics: dict[str, list[dict[str, np.ndarray]]] = {}
    notes: list[str] = []
    for file in sorted(path.glob("*.csv")):
        found = _NAME.fullmatch(file.stem)
        if found is None or file.stat().st_size == 0:
            continue
        table = open_table(file)
        if "timestamp" not in table.columns:
            raise DataError(f"{file}: no column 'timestamp' (it has {', '.join(table.columns[:6])}, ...)")
        topics.setdefault(found[1], []).append(table.read(table.columns, notes))
    log = read_topics(path, topics, {})
    log.format = "px4csv"
    log.notes[:0] = notes
    return log
