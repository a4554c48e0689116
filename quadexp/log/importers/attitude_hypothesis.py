"""What the attitude may be: four columns of norm one in either order and direction, or roll, pitch and yaw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quadexp.log.importers.evidence import Fit, Samples, is_unit, quaternion
from quadexp.log.importers.names import numbered_quaternion, unit_of
from quadexp.log.importers.proposal import Groups
from quadexp.log.importers.thrust_search import Thrust


class SensorFit(NamedTuple):
    """columns: of the gyro or the accelerometer. up: the world's axis that points up, gap: by how much it fits better
    than any other; of an accelerometer."""

    columns: list[int]
    fit: Fit
    up: str = "z"
    gap: float = 0.0


@dataclass
class Hypothesis:
    """q: (n, 4), body to world, as `columns` read in `order` say, `inverse`d or not. angles: unit of roll, pitch, yaw,
    "" for a quaternion. rate, force, thrust: what was found to fit. named: whether the columns' names say so."""

    columns: list[int]
    order: str
    inverse: bool
    q: np.ndarray
    angles: str = ""
    rate: SensorFit | None = None
    force: SensorFit | None = None
    thrust: Thrust | None = None
    score: float = 0.0
    named: bool = False


def attitude_hypotheses(names: list[str], s: Samples, usable: list[int], said: Groups) -> list[Hypothesis]:
    """Every reading of four columns of norm one, those named so if there are any; else of named roll, pitch and yaw."""
    made = []
    known = [g for g in said.get("attitude", []) if is_unit(s.x[:, g])]
    free = set(usable)
    adjacent = [g for i in range(len(names) - 3) if set(g := list(range(i, i + 4))) <= free and is_unit(s.x[:, g])]
    for columns in known or adjacent:
        named = columns in known
        orders = ("wxyz",) if named and not numbered_quaternion(names, columns) else ("wxyz", "xyzw")
        for order in orders:
            for inverse in (False, True):
                made.append(
                    Hypothesis(columns, order, inverse, quaternion(s.x[:, columns], order, inverse), named=named)
                )
    if not made:
        made = _angles(names, s, said)
    return made


def _angles(names: list[str], s: Samples, said: Groups) -> list[Hypothesis]:
    """Roll, pitch and yaw, where no four columns are a quaternion; signs as of FLU or FRD."""
    from scipy.spatial.transform import Rotation

    made = []
    for columns in said.get("euler", []):
        written = unit_of(names[columns[0]])[1]
        largest = float(np.abs(s.x[:, columns]).max())
        unit = written if written in ("rad", "deg") else "deg" if largest > 6.4 else "rad"
        angles = s.x[:, columns] * (np.pi / 180 if unit == "deg" else 1.0)
        if np.abs(np.diff(angles[:, 2])).max() > 1.0 or largest == 0:
            continue  # smoothing has spoilt a yaw that wraps
        q = Rotation.from_euler("ZYX", angles[:, ::-1]).as_quat(scalar_first=True)
        made.append(Hypothesis(columns, "rpy", False, quaternion(q, "wxyz", False), angles=unit, named=True))
    return made
