"""What makes two flights the same: the part of a configuration that decides a flight, and hashes of it."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from quadexp.config.schema import Config
from quadexp.config.settings import record

FLIGHT_GROUPS = (
    "vehicle",
    "plant",
    "sensor",
    "trajectory",
    "controller",
)  # what decides one flight, with model and seed


def canonical(value: Any) -> str:
    """JSON with one spelling for one value, for hashing."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(value: Any) -> str:
    """sha256 of the canonical JSON, 20 hex digits."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()[:20]


def flight_record(config: Config) -> dict[str, Any]:
    """The part of a configuration that decides one flight, as a plain dictionary."""
    nodes = {group: record(getattr(config, group)) for group in FLIGHT_GROUPS}
    return {**nodes, "model": config.model, "seed": config.seed}


def flight_entropy(config: Config) -> int:
    """Seed of the noise of one flight: from trajectory, plant, vehicle and seed, NOT from controller or model.

    Flights that differ in what the controller knows meet the same noise, so comparisons are paired. What cannot change
    a flight (names, where a file lies, the back end, what a flight may ask for and when it is over) takes no part.
    """
    nodes = flight_record(config)
    aside = {"name", "backend", "allow_infeasible", "lost_distance", "path"}
    parts = [
        {k: v for k, v in nodes[group].items() if k not in aside and v is not None}
        for group in ("vehicle", "plant", "trajectory")
    ]
    return int(digest(["noise", *parts, config.seed]), 16)
