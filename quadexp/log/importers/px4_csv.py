"""PX4's topics as a folder of CSVs, one a topic: <prefix>_<topic>_<instance>.csv, as ulog2csv writes them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.log.importers.px4 import TOPICS, read_topics
from quadexp.log.importers.raw import Crop, RawLog
from quadexp.log.importers.table import open_table
from quadexp.log.store import first_line

_NAME = re.compile(rf"(?:.*_)?({'|'.join(sorted(TOPICS, key=len, reverse=True))})_(\d+)")


def read_px4_csv(path: Path) -> RawLog:
    """Streams of a folder of topics; a folder that `quadexp export` wrote is not cropped. Raises DataError."""
    topics: dict[str, list[dict[str, np.ndarray]]] = {}
    notes: list[str] = []
    for file in sorted(path.glob("*.csv")):
        found = _NAME.fullmatch(file.stem)
        if found is None or file.stat().st_size == 0:
            continue
        table = open_table(file, "text")
        if "timestamp" not in table.columns:
            raise DataError(f"{file}: no column 'timestamp' (it has {', '.join(table.columns[:6])}, ...)")
        topics.setdefault(found[1], []).append(table.read(table.columns, notes))
    record = _about(path)
    log = read_topics(path, topics, {}, exported=record is not None)
    log.format = "px4csv"
    log.notes[:0] = notes
    if record is not None:
        log.crop = Crop("none")
        log.about["record"] = {key: record[key] for key in ("name", "seed", "config") if key in record}
    return log


def _about(path: Path) -> dict[str, Any] | None:
    """The record of a flight that this program exported."""
    for file in path.glob("*_about.json"):
        try:
            about = json.loads(file.read_text(encoding="utf-8"))
        except (ValueError, OSError, RecursionError) as error:
            raise DataError(f"{file}: damaged ({first_line(error)})") from None
        if "thrust of rotor" in str(about.get("units", {}).get("actuator_outputs", "")):
            return dict(about.get("record", {}))
    return None
