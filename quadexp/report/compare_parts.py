"""What files are compared by: settings as dotted keys, figures by name, flights by what they have in common."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.report.held_out import held_out_rows
from quadexp.report.pairing import condition_of, contestant_of
from quadexp.report.summary import MODEL_FILE

Row = Mapping[str, Any]
Key = tuple[Any, ...]  # condition, contestant, seed

FIGURES = {  # of a flight, with the factor and unit in which they are printed
    "mean_error": (1e3, "mm"),
    "rmse": (1e3, "mm"),
    "max_error": (1e3, "mm"),
    "attitude_rmse": (180 / math.pi, "deg"),
    "saturated_share": (100.0, "%"),
    "peak_speed": (1.0, "m/s"),
    "duration": (1.0, "s"),
    "solve_time_median": (1e6, "us"),
    "solve_time_p99": (1e6, "us"),
}


def flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Nested mappings as dotted keys."""
    if not isinstance(value, Mapping):
        return {prefix[:-1]: value}
    return {key: item for name, inner in value.items() for key, item in flat(inner, f"{prefix}{name}.").items()}


def record_of(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """What decides a flight: its configuration, the content of its checkpoint, and the versions that flew it."""
    git = (metadata.get("provenance") or {}).get("git") or {}
    return {
        **(metadata.get("config") or {}),
        "model_sha256": (metadata.get("model_sha256") or "")[:12],
        "versions": {
            **(metadata.get("versions") or {}),
            "sources": metadata.get("sources") or "",
            "commit": (git.get("commit") or "")[:10],
        },
        "backend": metadata.get("backend", ""),
    }


def checkpoint_record(summary: Mapping[str, Any]) -> dict[str, Any]:
    """What decides a checkpoint: its data, its settings, the features of its outputs."""
    names = ("kind", "vehicle", "dataset", "settings", "versions")
    features = {name: {"features": output["features"]} for name, output in summary["outputs"].items()}
    return {**{name: summary[name] for name in names}, "outputs": features}


def parameters(path: Path, summary: Mapping[str, Any]) -> dict[str, float]:
    """The numbers of a checkpoint by name; held-out errors from its report, if there is one."""
    folder = path.parent if path.name == MODEL_FILE else path
    values = {
        f"held-out RMSE of {row['output']} by {row['predictor']} ({row['unit']})": row["rmse"]
        for row in held_out_rows(folder)
        if row["predictor"] != "zero"
    }
    values |= {f"drag_{axis} (1/s)": value for axis, value in zip("xyz", summary["drag"], strict=True)}
    for output, one in summary["outputs"].items():
        values[f"{output} signal"], values[f"{output} noise"] = one["signal_std"], one["noise_std"]
        scales = zip(one["features"], one["lengthscale"], strict=True)
        values |= {f"{output} length of {feature}": scale for feature, scale in scales}
    return values


def matched(*tables: Sequence[Row]) -> list[dict[Key, Row]]:
    """Rows by condition, contestant and seed; with the checkpoint only where it distinguishes contestants."""
    contestants = ((side, who) for side, rows in enumerate(tables) for who in set(map(contestant_of, rows)))
    models = Counter((side, controller, variant) for side, (controller, _, variant) in contestants)
    several = {who[1:] for who, n in models.items() if n > 1}
    made: list[dict[Key, Row]] = []
    for rows in tables:
        made.append({})
        for row in rows:
            controller, model, variant = contestant_of(row)
            contestant = controller, model if (controller, variant) in several else "", variant
            made[-1][condition_of(row), contestant, row["seed"]] = row
    return made
