"""The key of a cell: the hash of everything that decides its flight. It is the name of the cell's file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from quadexp.experiment.identity import digest

SCHEMA = 1  # version of what a cell is; with a higher number every older cell is unknown


def cell_key(record: Mapping[str, Any], inputs: Mapping[str, str]) -> str:
    """Key of one flight: sha256 of what decides it, 20 hex digits.

    record: of the flight, see identity.flight_record. inputs: content hash of every file that it reads
    (checkpoint, trajectory file, the user's own sources).
    """
    return digest([SCHEMA, "evaluate", condition(record), sorted(inputs.items())])


def condition(record: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a flight's record that was asked for: without the places where a checkpoint was looked for."""
    return {**record, "controller": {k: v for k, v in record["controller"].items() if k != "models"}}
