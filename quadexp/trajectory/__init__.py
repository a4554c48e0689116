"""Trajectories (flat outputs in time) and the state and input references that follow from them."""

from quadexp.trajectory.base import FlatOutput, Trajectory
from quadexp.trajectory.circle import Circle
from quadexp.trajectory.feasibility import Infeasibility, check_feasible
from quadexp.trajectory.flatness import Reference, flat_reference
from quadexp.trajectory.from_file import FileTrajectory
from quadexp.trajectory.hover import Hover
from quadexp.trajectory.lemniscate import Lemniscate
from quadexp.trajectory.random_polynomial import RandomPolynomial
from quadexp.trajectory.rotor_drag import rotor_drag_reference
from quadexp.trajectory.step import Step

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
