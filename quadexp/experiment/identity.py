"""Identity of a flight: the part of a configuration that determines it, and hashes of that part."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from quadexp.parts.schema import WORLD, Config, remedies
from quadexp.parts.settings import declared
from quadexp.physics.vehicle import FORMER_NAMES

# Groups that determine one flight, together with the world, the remedies, model and seed.
FLIGHT_GROUPS = ("vehicle", "plant", "sensor", "trajectory", "controller")


def canonical(value: Any) -> str:
    """Canonical JSON, for hashing."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(value: Any) -> str:
    """sha256 of the canonical JSON, 20 hex digits."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()[:20]


def flight_record(config: Config) -> dict[str, Any]:
    """The part of a configuration that determines one flight, as a dictionary; parts of the world and remedies
    that do nothing are left out."""
    nodes = {group: getattr(config, group).recorded() for group in FLIGHT_GROUPS}
    world = {group: getattr(config, group) for group in WORLD if group not in nodes}
    nodes |= {group: part.recorded() for group, part in world.items() if not part.idle}
    nodes |= {group: part.recorded() for group, part in remedies(config).items()}
    return {**nodes, "model": config.model, "seed": config.seed}


def flight_entropy(config: Config) -> int:
    """Seed of the noise of one flight: from trajectory, plant, vehicle and seed, NOT from controller or model.

    Flights of different controllers have the same noise, so comparisons are paired. Keys that do not decide noise say
    so where they are declared (`noise=False`). The parts of the world are none of it: each has a stream of its own,
    which is the same whatever the others do.
    """
    nodes = flight_record(config)
    parts = []
    for group in ("vehicle", "plant", "trajectory"):
        keys = declared(type(getattr(config, group)))
        deciding = {k: v for k, v in nodes[group].items() if v is not None and (k not in keys or keys[k].setting.noise)}
        parts.append({FORMER_NAMES.get(k, k): v for k, v in deciding.items()})
    return int(digest(["noise", *parts, config.seed]), 16)
