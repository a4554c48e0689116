"""Trajectories (flat outputs in time) and the state and input references that follow from them."""

import importlib
from typing import Any

from quadexp.reference.base import FlatOutput, Trajectory
from quadexp.reference.circle import Circle
from quadexp.reference.feasibility import Infeasibility, check_feasible
from quadexp.reference.flatness import Reference, flat_reference
from quadexp.reference.hover import Hover
from quadexp.reference.lemniscate import Lemniscate
from quadexp.reference.step import Step

__all__ = [
    "Circle",
    "FileTrajectory",
    "FlatOutput",
    "Hover",
    "Infeasibility",
    "Lemniscate",
    "RandomPolynomial",
    "Reference",
    "Step",
    "Trajectory",
    "check_feasible",
    "flat_reference",
    "rotor_drag_reference",
]

# Imported when they are asked for: scipy.interpolate and scipy.spatial take a quarter of a second.
_LATER = {"FileTrajectory": "from_file", "RandomPolynomial": "random_polynomial", "rotor_drag_reference": "rotor_drag"}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_LATER[name]}"), name)
