"""The mapping's lines for an attitude, its gyro and its accelerometer, in words: frames, order, direction, units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.log.importers.attitude_hypothesis import Hypothesis, SensorFit
from quadexp.log.importers.evidence import Samples, matrices
from quadexp.log.importers.names import unit_of
from quadexp.log.importers.proposal import Proposal
from quadexp.log.importers.sensor_units import force_unit
from quadexp.log.importers.thrust_search import DOUBTFUL
from quadexp.log.importers.units import axes_matrix

BODIES = {"z": "FLU", "-z": "FRD", "y": "z x y", "-y": "x z -y", "x": "y z x", "-x": "z y -x"}
_WORLD = {"z": ("ENU", "z up; which way x points from north cannot be known from the data"),
          "-z": ("NED", "z down"), "y": ("z x y", "y up"), "-y": ("x z -y", "y down"),
          "x": ("y z x", "x up"), "-x": ("z y -x", "x down")}  # fmt: skip


@dataclass
class Attitude:
    """R: (n, 3, 3), log's body to log's world. fields: attitude, rate, acceleration. taken: columns they use.

    body_velocity: whether a velocity that nothing else explains is in the body frame.
    """

    R: np.ndarray
    world: Proposal
    body: Proposal
    fields: dict[str, Proposal]
    taken: list[int]
    body_velocity: bool = False


def _frame_word(matrix: np.ndarray) -> str:
    """A signed permutation as `body x -y -z`."""
    return "body " + " ".join(("-" if row.min() < 0 else "") + "xyz"[int(np.argmax(np.abs(row)))] for row in matrix)


def attitude_proposal(names: list[str], s: Samples, h: Hypothesis, margin: float) -> Attitude:
    """What the mapping says of a hypothesis.

    margin: by how much its score is above that of the same columns read in another order or direction.
    """
    world, body, sure = _frames(s, h)
    fields, taken = {"attitude": _attitude(names, s, h, margin)}, list(h.columns)
    if h.rate is not None:
        fields["rate"] = _rate(names, h.rate, s, h)
        taken += h.rate.columns
    if h.force is not None:
        fields["acceleration"] = _force(names, h.force, s, h)
        taken += h.force.columns
    turned = h.thrust is not None and h.thrust.in_body and sure > 0.4
    return Attitude(matrices(h.q), world, body, fields, taken, body_velocity=turned)


def _frames(s: Samples, h: Hypothesis) -> tuple[Proposal, Proposal, float]:
    """World and body frame, and how sure they are."""
    up, body_up = "z", "z"
    sure, why = 0.4, "not checked"
    if h.force is not None:
        up, body_up = h.force.up, _thrust_axis(s, h)
        sure = 0.95 if h.force.gap > 0.1 else 0.4
        why = f"that fits the specific force by {h.force.gap:.2f} better than any other"
    elif h.thrust is not None and h.thrust.misfit < 0.7 and h.thrust.gap > 1.3:
        up, body_up = h.thrust.up, h.thrust.axis
        sure = 0.9 if h.thrust.gap > DOUBTFUL else 0.7
        why = (
            f"then {h.thrust.misfit:.0%} of the acceleration lies beside the thrust, {h.thrust.gap:.1f} times otherwise"
        )
    world, word = _WORLD[up]
    points = f"the thrust points along {body_up} of the attitude's body frame"
    body = Proposal(BODIES[body_up], sure, points if sure > 0.4 or h.force is not None else why)
    return Proposal(world, sure, f"{word}; {why}"), body, sure


def _attitude(names: list[str], s: Samples, h: Hypothesis, margin: float) -> Proposal:
    entry: dict[str, Any] = {"columns": [names[i] for i in h.columns], "order": h.order}
    if h.angles:
        entry["unit"] = h.angles
        evidence = ["named so"]
    else:
        entry["direction"] = "world_to_body" if h.inverse else "body_to_world"
        evidence = [f"norm 1 within {np.abs(np.linalg.norm(s.x[:, h.columns], axis=1) - 1).max():.2g}"]
    evidence += [f"its rate correlates {h.rate.fit.score:.3f} with the gyro"] if h.rate else []
    evidence += [f"gravity and motion correlate {h.force.fit.score:.3f} with the accelerometer"] if h.force else []
    proved = (h.rate is not None and h.rate.fit.score > 0.8) or (h.force is not None and h.force.fit.score > 0.97)
    certain = (0.95 if margin > 0.05 else 0.8) if proved else 0.5
    if h.named and not h.angles and proved:
        certain = max(certain, 0.9 if margin > 0.01 else 0.7)
    return Proposal(entry, certain, "; ".join([*evidence, f"next best order or direction {margin:.2f} worse"]))


def _rate(names: list[str], found: SensorFit, s: Samples, h: Hypothesis) -> Proposal:
    columns, fit = found.columns, found.fit
    factor = fit.scale / max(fit.score**2, 1e-6)  # freed of what noise in the gyro takes off the slope
    ratio = {"rad/s": 1.0, "deg/s": np.pi / 180, "mrad/s": 1e-3, "mdeg/s": np.pi / 180e3}
    written = unit_of(names[columns[0]])[1]
    unit = min(ratio, key=lambda name: abs(np.log(max(factor, 1e-9) / ratio[name])))
    clear = abs(np.log(max(factor, 1e-9) / ratio[unit])) < 0.7
    entry: dict[str, Any] = {"columns": [names[i] for i in columns], "unit": unit}
    if not (fit.matrix == np.eye(3)).all():
        entry["frame"] = _relative(fit.matrix, s, h)
    sure = (0.95 if fit.score > 0.8 else 0.75) if clear else 0.4
    why = f"correlation {fit.score:.3f} with the attitude's rate, slope {fit.scale:.3g} rad/s per unit"
    if written in ratio and written != unit:
        sure, why = 0.4, f"{why}; but the name says {written}"
    return Proposal(entry, sure, why)


def _force(names: list[str], found: SensorFit, s: Samples, h: Hypothesis) -> Proposal:
    columns, fit = found.columns, found.fit
    entry, sure, why = force_unit(names, columns, float(np.linalg.norm(s.x[:, columns], axis=1).mean()))
    if not (fit.matrix == np.eye(3)).all():
        entry["frame"] = _relative(fit.matrix, s, h)
    return Proposal(
        {"columns": [names[i] for i in columns], **entry},
        min(sure, 0.95 if fit.score > 0.97 else 0.7),
        f"{why}; fit {fit.score:.3f}",
    )


def _relative(matrix: np.ndarray, s: Samples, h: Hypothesis) -> str:
    """Axes into FLU of a sensor that stands turned against the attitude's body frame."""
    return _frame_word(axes_matrix("body", BODIES[_thrust_axis(s, h)], "") @ matrix)


def _thrust_axis(s: Samples, h: Hypothesis) -> str:
    """Along which axis of the attitude's body frame the thrust points."""
    if h.force is None:
        return h.thrust.axis if h.thrust is not None and h.thrust.gap > 1.3 else "z"
    mean = (s.x[:, h.force.columns] @ h.force.fit.matrix.T).mean(axis=0)
    axis = int(np.argmax(np.abs(mean)))
    return ("-" if mean[axis] < 0 else "") + "xyz"[axis]
