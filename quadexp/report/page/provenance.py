"""The origin of every number, and the commands that make it again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.parts.cells import Grid
from quadexp.report.checked import versions_of
from quadexp.report.frame import flat
from quadexp.report.page.source import Comparison
from quadexp.report.summary import margin_line

LOOKED_AT = 500  # flights whose settings are compared
MOST_VALUES = 12  # of a setting

Record = Mapping[str, Any]


def records(comparison: Comparison) -> list[Record]:
    """Metadata of at most LOOKED_AT flights, spread over all of them."""
    rows = comparison.sampled(LOOKED_AT)
    return [record for row in rows if (record := comparison.flight_record(row)) is not None]


def facts(comparison: Comparison, flights: Sequence[Record]) -> list[tuple[str, str]]:
    """(term, text) of the origin; several of one term."""
    commits = _each(commit_text(flight.get("provenance", {})) for flight in flights)
    models = _each(f"{f['model']}, sha256 {f.get('model_sha256', '')}" for f in flights if f.get("model"))
    created = comparison.record.get("provenance", {}).get("created", "")
    versions = ", ".join(f"{name} {version}" for name, version in versions_of(comparison.rows).items())
    entries = [
        ("Results", f"{len(comparison.rows)} flights, sha256 {comparison.digest}"),
        ("Files", " ".join(filter(None, (f"{comparison.checked.text()}.", *comparison.checked.lines())))),
        ("Seeds", ranges(sorted({int(row["seed"]) for row in comparison.rows}))),
        ("Made", ", commit ".join(filter(None, (created, ", ".join(commits))))),
        ("Machine", "; ".join(machines(flights))),
        *(("Loop", line) for line in margins(flights)),
        *(("Checkpoint", model) for model in models),
        ("Versions", versions),
    ]
    return [(term, text) for term, text in entries if text]


def machines(flights: Iterable[Record]) -> list[str]:
    """Processor and system of each machine."""
    about = (flight.get("provenance", {}) for flight in flights)
    return _each(", ".join(str(record[k]) for k in ("cpu", "platform") if record.get(k)) for record in about)


def margins(flights: Iterable[Record]) -> list[str]:
    """Controller and margins of its loop; several lines for one whose settings vary."""
    lines = ((f.get("controller", ""), margin_line(f.get("margins"))) for f in flights)
    return list(dict.fromkeys(f"{name}: {line}" for name, line in lines if line))


def settings(flights: Sequence[Record]) -> tuple[list[list[str]], list[list[str]]]:
    """Those that differ between flights, with their values in order of appearance, and those that all share."""
    values: dict[str, list[str]] = {}
    for flight in flights:
        for key, value in flat(flight.get("config", {})).items():
            values.setdefault(key, []).append(value if isinstance(value, str) else json.dumps(value))
    varied, common = [], []
    for key, texts in values.items():
        different = list(dict.fromkeys(texts))
        if len(different) == 1 and len(texts) == len(flights):
            common += [[key, texts[0]]] if texts[0] != "null" else []
        else:
            more = ["…"] if len(different) > MOST_VALUES else []
            varied.append([key, ", ".join(different[:MOST_VALUES] + more)])
    return varied, common


def portable(path: Path) -> str:
    """A path for a page that is passed on: absolute ones by their name alone."""
    return path.name if path.is_absolute() else path.as_posix()


def commit_text(provenance: Record) -> str:
    """Such as "0123456789ab with changes"."""
    git = provenance.get("git") or {}
    return f"{git['commit'][:12]}{' with changes' if git.get('dirty') else ''}" if git.get("commit") else ""


def sweep_command(grids: Sequence[Grid], out: str) -> str:
    """The sweep in one line: its one grid, or the experiment of its grids; "" if there is neither."""
    if len(grids) == 1:
        words = []
        for texts in grids[0]:
            key, _, first = texts[0].partition("=")
            words.append(f"{key}={','.join([first, *(text.partition('=')[2] for text in texts[1:])])}")
    else:
        named = {text for grid in grids for texts in grid for text in texts if text.startswith("experiment=")}
        words = sorted(named) if len(named) == 1 else []
    return f"quadexp evaluate --sweep {shlex.join(words)} --out {shlex.quote(out)}" if words else ""


def redo_command(overrides: Sequence[str]) -> str:
    """The command for one flight of a sweep; "" if its overrides are not known."""
    return f"quadexp simulate {shlex.join(overrides)}" if overrides else ""


def ranges(numbers: Sequence[int]) -> str:
    """Such as "0–4, 7"."""
    parts: list[list[int]] = []
    for n in numbers:
        if parts and n == parts[-1][-1] + 1:
            parts[-1].append(n)
        else:
            parts.append([n])
    return ", ".join(f"{p[0]}\u2013{p[-1]}" if len(p) > 1 else str(p[0]) for p in parts)


def _each(texts: Iterable[str]) -> list[str]:
    return sorted(set(texts) - {""})
