"""Where every number comes from, and the commands that make it again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.config.cells import Grid
from quadexp.report.flown_by import versions_of
from quadexp.report.margin_line import margin_line
from quadexp.report.page.source import Comparison

LOOKED_AT = 500  # flights whose settings are compared


def origin(comparison: Comparison) -> dict[str, Any]:
    """What stands at the foot of the page."""
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
        "models": _models(flights),
        "margins": _margins(flights),
        "config": common_config(flights),
        "varied": varied(flights),
        "confidence": f"{comparison.confidence:.0%}",
        "machines": sorted({m for f in flights if (m := _machine(f.get("provenance", {})))}),
    }


def portable(path: Path) -> str:
    """A path as it may stand in a page that travels: absolute ones by their name alone."""
    return path.name if path.is_absolute() else path.as_posix()


def _machine(provenance: Mapping[str, Any]) -> str:
    return ", ".join(str(provenance[k]) for k in ("cpu", "platform") if provenance.get(k))


def _commit(provenance: Mapping[str, Any]) -> str:
    git = provenance.get("git") or {}
    return f"{git['commit'][:12]}{' with changes' if git.get('dirty') else ''}" if git.get("commit") else ""


def _models(flights: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """(path, sha256) of every checkpoint that flew."""
    found = {(f.get("model", ""), f.get("model_sha256", "")) for f in flights if f.get("model")}
    return sorted(found)


def _margins(flights: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """(controller, what its loop stands); several lines for one whose settings vary."""
    lines = [(f.get("controller", ""), margin_line(f.get("margins"))) for f in flights]
    return list(dict.fromkeys((name, line) for name, line in lines if line))


def _flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Every value by its dotted key, as text."""
    flat: dict[str, str] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value if isinstance(value, str) else json.dumps(value)
    return flat


def common_config(flights: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Settings that all flights share: group -> (key, value)."""
    flats = [_flat(f.get("config", {})) for f in flights]
    groups: dict[str, list[tuple[str, str]]] = {}
    for key, value in (flats[0] if flats else {}).items():
        if value != "null" and all(flat.get(key) == value for flat in flats):
            group, _, rest = key.partition(".")
            groups.setdefault(group if rest else "all", []).append((rest or group, value))
    return list(groups.items())


def varied(flights: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[str]]]:
    """Settings that differ between flights, with their values in order of appearance."""
    flats = [_flat(f.get("config", {})) for f in flights]
    found = []
    for key in dict.fromkeys(key for flat in flats for key in flat):
        values = list(dict.fromkeys(flat[key] for flat in flats if key in flat))
        if len(values) > 1 or any(key not in flat for flat in flats):
            found.append((key, values[:12] + ["…"] * (len(values) > 12)))
    return found


def sweep_command(grids: Sequence[Grid], out: str) -> str:
    """The sweep in one line: its one grid, or the experiment that its grids come from; "" where neither is."""
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
    """One flight of a sweep again, by itself; "" where what was asked for is not known."""
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
