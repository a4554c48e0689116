"""Frames and reading of a log's attitude: every order and direction of the quaternion, with every world and body frame,
is a candidate of the search that `quadexp check` has too, by the same evidence. What that search finds besides are
corrections. Where the next best candidate is less than search.MARGIN log units behind, the line is a guess that asks
which of both it is.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from quadexp.plugins.check.agreement import agreement
from quadexp.plugins.check.candidates import ANGLES, KEYS, READINGS, Candidate, flow
from quadexp.plugins.check.search import MARGIN, PER_COST, explain
from quadexp.plugins.check.units_by_size import GUESS, SURE
from quadexp.plugins.logs.signal.windows import RELATIONS, Windows, pairs

FRAMES = ("world", "body")
WORLDS = {  # frame of the log's world: what it is, cost
    "ENU": ("z up; which way x points from north cannot be known from the data", 0.0), "NED": ("z down", 0.1),
    "z x y": ("y up", 2.5), "x -z y": ("y down", 2.5), "y z x": ("x up", 2.5), "z -y x": ("x down", 2.5),
}  # fmt: skip
BODIES = ("FLU", "FRD", "z x y", "x z -y", "y z x", "z -y x")
PLAIN = {"order": "wxyz", "direction": "body_to_world"}
SENSORS_APART: tuple[tuple[str, dict[str, str]], ...] = (  # frames that one sensor may have alone
    *product(("acceleration", "rate"), ({"frame": "FLU"}, {"frame": "FRD"})),
    ("acceleration", {"frame": "world"}),
    ("acceleration", {"kind": "coordinate"}),
    ("acceleration", {"frame": "world", "kind": "coordinate"}),
)
FEW = 60  # windows that every frame is tried on
OF_ALL = 40  # conventions of all streams, the likeliest, with which those of single sensors are tried
AGAINST_NAMES = 2.0  # cost of a quaternion whose columns are not what they are called
MISFITS = ("misfit", "inconsistent")  # findings that nothing proposed explains: then no frame is sure

Scored = list[tuple[float, Candidate]]  # evidence (log units), the likeliest first


@dataclass(frozen=True)
class Frames:
    """scored: every convention. mends: corrections besides the best one. misfit: what is left then, or ""."""

    scored: Scored
    mends: list[Candidate]
    misfit: str

    @property
    def best(self) -> Candidate:
        return self.scored[0][1]

    def evidence(self, key: str) -> tuple[str, str]:
        """How sure the best one's `key` is, and by what it is ahead of another."""
        value, best = self.scored[0]
        chosen = best.correction.get(key, PLAIN)
        lead = 2 * MARGIN
        rival: Any = PLAIN
        for other, candidate in self.scored:
            if candidate.correction.get(key, PLAIN) != chosen:
                rival = candidate.correction.get(key, PLAIN)
                lead = value - other
                break
        text = f"log likelihood {lead:.1f} above that of {flow(rival)}"
        if lead < MARGIN:
            text += ": decide between both"
        if key == "world":
            text = f"{WORLDS[str(chosen)][0]}; {text}"
        elif key == "body":
            text = f"where the thrust points along z; {text}"
        return GUESS if lead < MARGIN or self.misfit else SURE, text + self.misfit

    def attitude(self, lines: dict[str, Any]) -> dict[str, Any]:
        """Lines of the attitude with its reading; signs of angles as a scale of their columns, where the frames leave
        roll, pitch and yaw what they are."""
        correction = self.best.correction
        reading = correction.get("attitude", {})
        signs = reading.get("angles")
        aligned = (correction["world"], correction["body"]) in (("ENU", "FLU"), ("NED", "FRD"))
        if not (signs and aligned and signs[2] == 1):
            return lines | reading
        return lines | {"scale": (np.array(signs) * lines.get("scale", 1)).tolist()}


def conventions(columns: int, by_name: bool, with_velocity: bool) -> list[Candidate]:
    """Every order and direction of the attitude in every frame. columns: of the attitude, which are angles or a
    quaternion. by_name: whether their names say which is which."""
    readings: list[tuple[dict[str, Any], float]] = [({}, 0.0)]
    for *_, lines, cost in ANGLES if columns == 3 else READINGS[:3]:
        against_names = AGAINST_NAMES if by_name and "order" in lines else 0.0
        readings.append(({"attitude": lines}, cost + against_names))
    turned: list[tuple[dict[str, Any], int]] = [({}, 0)]
    if with_velocity:
        turned.append(({"velocity": {"frame": "body"}}, 1))
    candidates = []
    for (reading, cost), (world, (_, more)), body, (frame, claim) in product(readings, WORLDS.items(), BODIES, turned):
        correction = {"world": world, "body": body, **reading, **frame}
        candidates.append(Candidate("", "pqvwf", "", correction, cost + more + claim))
    return candidates


def search_frames(log: Windows, candidates: list[Candidate]) -> Frames:
    """The frames in which the streams of a log, in its own frames, agree best."""
    still = not {"p", "v"} & log.streams.keys()  # gravity alone has to explain the accelerometer
    if still:
        log = Windows(log.t, {**log.streams, "v": np.zeros((*log.t.shape, 3))})
    few = log.every(max(1, len(log.t) // FEW))
    scored = _scored(candidates, few)
    apart = [other for _, candidate in scored[:OF_ALL] for other in _with_a_sensor_apart(candidate, log)]
    scored = sorted(scored + _scored(apart, few), key=_score)
    taken, findings = explain(scored[0][1].apply(log))
    mends = [candidate for candidate in taken if candidate.blocks]
    if still:  # nor what is left of it
        mends = [candidate for candidate in mends if "acceleration" not in candidate.correction]
    left = (f"; but {finding.where}: {finding.measured}" for finding in findings if finding.name in MISFITS)
    return Frames(scored, mends, next(left, ""))


def _with_a_sensor_apart(candidate: Candidate, log: Windows) -> list[Candidate]:
    """The same, with one sensor in a frame of its own, or an accelerometer without gravity."""
    present = {KEYS[letter] for letter in log.streams}
    others = []
    for key, lines in SENSORS_APART:
        if key in present and lines.get("frame") != candidate.correction["body"]:
            correction = candidate.correction | {key: lines}
            others.append(replace(candidate, correction=correction, cost=candidate.cost + len(lines)))
    return others


def _scored(candidates: Iterable[Candidate], windows: Windows) -> Scored:
    """Those in which the thrust is along z, with their evidence, the likeliest first."""
    scored = []
    for candidate in candidates:
        value = _evidence(candidate, windows)
        if value is not None:
            scored.append((value, candidate))
    return sorted(scored, key=_score)


def _score(pair: tuple[float, Candidate]) -> float:
    return -pair[0]


def _evidence(candidate: Candidate, windows: Windows) -> float | None:
    """Evidence of a convention (log units), its cost taken off; None where the thrust is not along z in it.

    The drag of a log without accelerometer is the same in every convention: it is no reason to doubt one.
    """
    relations = pairs(candidate.apply(windows))
    thrust = next(pair.expected for pair in relations if pair.name.startswith(("force", "thrust"))).mean(axis=0)
    if np.argmax(np.abs(thrust)) != 2 or thrust[2] < 0:
        return None
    total = -PER_COST * candidate.cost
    for pair in relations:
        total += agreement(pair, min(pair.relation.floor, RELATIONS["force"].floor)).evidence
    return total
