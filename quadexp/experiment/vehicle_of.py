"""The vehicle that several files have in common, or one by its name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from quadexp.errors import UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.parts.options import Folders
from quadexp.physics.vehicle import Vehicle


def vehicle_named(name: str, conf: Folders) -> Vehicle:
    """A vehicle of the configuration, or of the folder `conf`; raises UsageError for an unknown name."""
    from quadexp.parts.compose import compose

    return build_vehicle(compose([f"vehicle={name}"], conf).vehicle)


def refuse_repeated(command: str, paths: Sequence[Path], said: str = "{path} is given twice") -> None:
    """UsageError where a path is there twice, in these words."""
    if twice := next((path for path in paths if paths.count(path) > 1), None):
        raise UsageError(f"{command}: {said.format(path=twice)}")
