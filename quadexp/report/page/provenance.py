"""The origin of every number, and the commands that make it again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.parts.cells import Grid
from quadexp.report.flown_by import versions_of
from quadexp.report.frame import flat
from quadexp.report.margin_line import margin_line
from quadexp.report.page.source import Comparison

LOOKED_AT = 500  # flights whose settings are compared


def origin(comparison: Comparison) -> dict[str, Any]:
    """The last section of the page."""
    record = comparison.record
    flights = comparison.sample(LOOKED_AT)
    made_by = record.get("provenance", {})
    return {
        "versions": versions_of(comparison.rows),
        "provenance": made_by,
        "commit": ", ".join(sorted({c for f in flights if (c := _commit(f.get("provenance", {})))})),
        "seeds": _ranges(sorted({int(row["seed"]) for row in comparison.rows})),
        "digest": comparison.digest,
        "flights": len(comparison.rows),
        "backends": sorted({row["backend"] for row in comparison.rows if row["backend"]}),
        "command": sweep_command(comparison.grids, portable(comparison.root)),
        "models": sorted({(f.get("model", ""), f.get("model_sha256", "")) for f in flights if f.get("model")}),
        "margins": _margins(flights),
        "config": common_config(flights),
        "varied": varied(flights),
        "confidence": f"{comparison.confidence:.0%}",
        "machines": sorted({m for f in flights if (m := _machine(f.get("provenance", {})))}),
    }


def portable(path: Path) -> str:
    """A path for a page that is passed on: absolute ones by their name alone."""
    return path.name if path.is_absolute() else path.as_posix()


def _machine(provenance: Mapping[str, Any]) -> str:
    return ", ".join(str(provenance[k]) for k in ("cpu", "platform") if provenance.get(k))


def _commit(provenance: Mapping[str, Any]) -> str:
    git = provenance.get("git") or {}
    return f"{git['commit'][:12]}{' with changes' if git.get('dirty') else ''}" if git.get("commit") else ""


def _margins(flights: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """(controller, margins of its loop); several lines for one whose settings vary."""
    lines = [(f.get("controller", ""), margin_line(f.get("margins"))) for f in flights]
    return list(dict.fromkeys((name, line) for name, line in lines if line))


def _flat(flight: Mapping[str, Any]) -> dict[str, str]:
    """Every setting by its dotted key, as text."""
    settings = flat(flight.get("config", {}))
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in settings.items()}


def common_config(flights: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Settings that all flights share: group -> (key, value)."""
    settings = list(map(_flat, flights))
    groups: dict[str, list[tuple[str, str]]] = {}
    for key, value in (settings[0] if settings else {}).items():
        if value != "null" and all(one.get(key) == value for one in settings):
            group, _, rest = key.partition(".")
            groups.setdefault(group if rest else "all", []).append((rest or group, value))
    return list(groups.items())


def varied(flights: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[str]]]:
    """Settings that differ between flights, with their values in order of appearance."""
    settings = list(map(_flat, flights))
    found = []
    for key in dict.fromkeys(key for one in settings for key in one):
        values = list(dict.fromkeys(one.get(key) for one in settings))
        if len(values) > 1:
            known = [value for value in values if value is not None]
            found.append((key, known[:12] + ["…"] * (len(known) > 12)))
    return found


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
    return f"quadexp evaluate --sweep {' '.join(map(shlex.quote, words))} --out {shlex.quote(out)}" if words else ""


def redo_command(overrides: Sequence[str]) -> str:
    """The command for one flight of a sweep; "" if its overrides are not known."""
    return f"quadexp simulate {' '.join(map(shlex.quote, overrides))}" if overrides else ""


def _ranges(numbers: Sequence[int]) -> str:
    """Such as "0–4, 7"."""
    parts: list[list[int]] = []
    for n in numbers:
        if parts and n == parts[-1][-1] + 1:
            parts[-1].append(n)
        else:
            parts.append([n])
    return ", ".join(f"{p[0]}\u2013{p[-1]}" if len(p) > 1 else str(p[0]) for p in parts)
