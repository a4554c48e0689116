"""One flight under two names: made from the same file, or of the same samples, whatever is cut off or left out of them.

Two flights of one trajectory look alike; the noise of their sensors does not. So what is compared is the samples of the
motion, time aside, to the last digit. Of a simulation, flights of other configurations are no duplicates.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from quadexp.log.schema import Flight
from quadexp.plugins.check.samples import row_numbers
from quadexp.plugins.logs.finding import Finding
from quadexp.plugins.logs.signal.windows import streams_of

LEAST = 40  # different samples
SHARE = 0.3  # of the samples of the shorter one


class _Flown(NamedTuple):
    """streams: letters of windows. samples: their numbers, each once. source, config: what it was made from."""

    streams: tuple[str, ...]
    samples: np.ndarray
    source: str
    config: str


def check_duplicates(flights: Mapping[str, Flight]) -> dict[str, list[Finding]]:
    """Findings by flight; of two that are alike the later one in the order given is the duplicate."""
    findings: dict[str, list[Finding]] = {}
    seen: dict[str, _Flown] = {}
    for name, flight in flights.items():
        flown = _flown(flight)
        for other, earlier in seen.items():
            same = _same(flown, earlier)
            if same:
                where = f"all samples, {flight.t[0]:.2f}..{flight.t[-1]:.2f} s" if len(flight) else "all samples"
                advice = f"leave it out, or keep it on the same side of a split as {other}"
                findings[name] = [Finding("duplicate", "blocking", where, f"{same} {other}", f"{SHARE:.0%}", advice)]
                break
        else:
            seen[name] = flown
    return findings


def _flown(flight: Flight) -> _Flown:
    streams = streams_of(flight)
    record = flight.metadata
    columns = [column for values in streams.values() for column in values.T]
    samples = np.unique(row_numbers(columns)) if columns else np.empty(0, np.uint64)
    config = "" if record.get("recorded") else str(record.get("provenance", {}).get("config_hash", ""))
    return _Flown(tuple(streams), samples, str((record.get("source") or {}).get("sha256", "")), config)


def _same(a: _Flown, b: _Flown) -> str:
    """How two flights are the same, or ""."""
    if a.source and a.source == b.source:
        return "made from the same file, to the last byte, as"
    fewest = min(len(a.samples), len(b.samples))
    if a.streams != b.streams or fewest < LEAST or (a.config and b.config and a.config != b.config):
        return ""
    share = len(np.intersect1d(a.samples, b.samples, assume_unique=True)) / fewest
    if share <= SHARE:
        return ""
    return f"{share:.0%} of the samples are, to the last digit, those of"
