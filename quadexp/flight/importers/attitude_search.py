"""Which columns are the attitude, in which order and direction, and in which frames it, gyro and accelerometer stand.

Every hypothesis (four columns, order, direction) gives a rotation R; the gyro is compared with R's own rate, the
accelerometer with R^T (a + g e). The hypothesis that explains both best is taken, by how much better says how sure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from quadexp.flight.importers.evidence import (
    UPS,
    Fit,
    Samples,
    body_rate,
    fit_force,
    fit_turn,
    is_unit,
    matrices,
    quaternion,
)  # fmt: skip
from quadexp.flight.importers.names import numbered_quaternion, unit_of
from quadexp.flight.importers.units import UNITS, axes_matrix
from quadexp.vehicle import GRAVITY

UNLIKELY = 0.5  # a velocity in the body frame has to fit that much better than one in the world
DOUBTFUL = 1.8  # a gap between fits up to which the better one is likely, not sure
LEAST_MOTION = 0.5  # m/s^2 rms: a flight that says by its thrust alone which way is up
Groups = dict[str, list[list[int]]]


@dataclass
class Proposal:
    """value: as it stands in the mapping. confidence: 0 to 1. why: the evidence."""

    value: Any
    confidence: float
    why: str

    @property
    def sureness(self) -> str:
        return "sure" if self.confidence >= 0.85 else "likely" if self.confidence >= 0.6 else "guess"


@dataclass
class Attitude:
    """R: (n, 3, 3), log's body to log's world. fields: attitude, rate, acceleration. taken: columns they use.

    position: three columns whose second derivative explained the accelerometer, where no name said so.
    body_velocity: whether a velocity that nothing else explains is in the body frame.
    """

    R: np.ndarray
    world: Proposal
    body: Proposal
    fields: dict[str, Proposal]
    taken: list[int]
    position: list[int] | None = None
    body_velocity: bool = False


class Thrust(NamedTuple):
    """Without an accelerometer: the thrust points along one axis of the body. misfit: what lies beside it, over the
    acceleration. gap: misfit of the next best choice over this one. in_body: whether the velocity is in the body."""

    up: str
    axis: str
    misfit: float
    gap: float
    in_body: bool


@dataclass
class _Hypothesis:
    columns: list[int]
    order: str
    inverse: bool
    q: np.ndarray
    angles: str = ""
    rate: tuple[list[int], Fit] | None = None
    force: tuple[list[int], Fit, str, float, list[int] | None] | None = None
    thrust: Thrust | None = None
    score: float = 0.0
    named: bool = field(default=False)


def find_attitude(
    names: list[str], s: Samples, usable: list[int], said: Groups, velocities: list[list[int]] | None = None
) -> Attitude | None:
    """The attitude that explains gyro and accelerometer best; None where there is none.

    velocities: by name alone, for the thrust of a log without accelerometer and position.
    """
    hypotheses = _hypotheses(names, s, usable, said)
    if not hypotheses:
        return None
    chosen = [h for h in hypotheses if h.named] or hypotheses
    for h in chosen:
        _weigh(h, s, usable, said, velocities or [])
    ranked = sorted(chosen, key=lambda h: -h.score)
    best = ranked[0]
    same = [h for h in ranked if h.columns == best.columns and (h.order, h.inverse) != (best.order, best.inverse)]
    margin = best.score - (same[0].score if same else 0.0)
    return _proposals(names, s, best, margin)


def _hypotheses(names: list[str], s: Samples, usable: list[int], said: Groups) -> list[_Hypothesis]:
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
                    _Hypothesis(columns, order, inverse, quaternion(s.x[:, columns], order, inverse), named=named)
                )
    if not made:
        made = _angles(names, s, said)
    return made


def _angles(names: list[str], s: Samples, said: Groups) -> list[_Hypothesis]:
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
        made.append(_Hypothesis(columns, "rpy", False, quaternion(q, "wxyz", False), angles=unit, named=True))
    return made


def _weigh(h: _Hypothesis, s: Samples, usable: list[int], said: Groups, velocities: list[list[int]]) -> None:
    """Fit gyro and accelerometer to a hypothesis; its score is the mean of the two, 0 for what is not there."""
    taken = set(h.columns)
    triples = [g for i in range(s.x.shape[1] - 2) if set(g := list(range(i, i + 3))) <= set(usable) - taken]
    R = matrices(h.q)
    _weigh_force(h, R, s, usable, said, triples)
    beside = h.force[0] if h.force else []
    omega = s.smooth(body_rate(h.q, s.t))
    best: tuple[float, list[int], Fit] | None = None
    for rank, columns in enumerate(said.get("rate") or triples):
        if np.ptp(s.x[:, columns], axis=0).min() == 0:
            continue
        fit = fit_turn(s.x[:, columns], omega)
        if set(columns) & set(beside):
            continue
        # An inertial sensor's two halves stand side by side; a rate from a camera's poses need not.
        imu = 0.08 * (bool(beside) and abs(columns[0] - beside[0]) == 3)
        value = fit.score + imu - 0.002 * rank
        if best is None or value > best[0]:
            best = (value, columns, fit)
    if best is not None and best[2].score > 0.5:
        h.rate = (best[1], best[2])
    if h.force is None:
        h.thrust = _thrust_alone(h, R, s, usable, {"velocity": velocities, **said})
    seen = h.force[1].score if h.force else max(0.0, 1 - h.thrust.misfit) if h.thrust else 0.0
    h.score = 0.5 * (h.rate[1].score if h.rate else 0.0) + 0.5 * seen
    fits = [found[1] for found in (h.rate, h.force) if found]
    plain = sum(bool((fit.matrix == np.eye(3)).all()) for fit in fits)
    h.score += 0.01 * plain + 0.01 * (h.order == "wxyz" and h.named) + 0.002 * (not h.inverse) - 1e-4 * h.columns[0]


def _weigh_force(
    h: _Hypothesis, R: np.ndarray, s: Samples, usable: list[int], said: Groups, triples: list[list[int]]
) -> None:
    """The accelerometer that gravity and motion explain best under a hypothesis."""
    taken = set(h.columns)
    found: tuple[float, Any] | None = None
    for motion, columns in _accelerations(s, usable, said, taken):
        for rank, force in enumerate(said.get("acceleration") or triples):
            x = s.x[:, force]
            if np.ptp(x, axis=0).min() == 0 or (columns is not None and set(columns) & set(force)):
                continue
            up, fit, gap = fit_force(R, motion, x)
            value = fit.score - 0.002 * rank
            if found is None or value > found[0]:
                found = (value, (force, fit, up, gap, columns))
    if found is not None and found[1][1].score > 0.9:
        h.force = found[1]


def _thrust_alone(h: _Hypothesis, R: np.ndarray, s: Samples, usable: list[int], said: Groups) -> Thrust | None:
    """Which way is up and along which axis of the body the thrust points, from the motion and the attitude alone."""
    motion, columns = next(_accelerations(s, usable, said, set(h.columns)))
    if columns is None:
        return None
    motions = [(False, motion)]
    if columns in said.get("velocity", []):  # its name does not say whether it is in the world or in the body
        motions.append((True, s.rate_of(np.einsum("nij,nj->ni", R, s.x[:, columns]))))
    made = [found for in_body, a in motions if (found := _best_thrust(R, a, in_body)) is not None]
    if len(made) < len(motions):
        return None
    world, body = made[0], made[-1]
    chosen = body if body.misfit < UNLIKELY * world.misfit else world
    return chosen._replace(gap=min(chosen.gap, DOUBTFUL)) if len(made) > 1 else chosen


def _best_thrust(R: np.ndarray, motion: np.ndarray, in_body: bool) -> Thrust | None:
    """The direction of up under which the thrust keeps to one axis of the body; None where too little moves."""
    size = float(np.sqrt(np.mean(np.sum(motion**2, axis=1))))
    if not LEAST_MOTION < size < 10 * GRAVITY:
        return None
    found = []
    for up, direction in UPS.items():
        force = np.einsum("nji,nj->ni", R, motion + GRAVITY * np.array(direction))
        mean = force.mean(axis=0)
        axis = int(np.argmax(np.abs(mean)))
        beside = force**2
        beside[:, axis] = np.minimum(0.0, np.sign(mean[axis]) * force[:, axis]) ** 2
        misfit = float(np.sqrt(np.mean(beside.sum(axis=1)))) / size
        found.append((misfit, up, ("-" if mean[axis] < 0 else "") + "xyz"[axis]))
    (best, up, name), (second, *_) = sorted(found)[:2]
    return Thrust(up, name, best, second / max(best, 1e-6), in_body)


def _accelerations(s: Samples, usable: list[int], said: Groups, taken: set[int]):
    """Acceleration of the motion in the log's world, from named velocity or position; else none (gravity alone)."""
    for columns in said.get("velocity", [])[:2]:
        yield s.dx[:, columns], columns
        return
    for columns in said.get("position", [])[:2]:
        yield s.smooth(s.rate_of(s.dx[:, columns])), columns
        return
    yield np.zeros((len(s.t), 3)), None


def _frame_word(matrix: np.ndarray) -> str:
    """A signed permutation as `body x -y -z`."""
    return "body " + " ".join(("-" if row.min() < 0 else "") + "xyz"[int(np.argmax(np.abs(row)))] for row in matrix)


BODIES = {"z": "FLU", "-z": "FRD", "y": "z x y", "-y": "x z -y", "x": "y z x", "-x": "z y -x"}
_WORLD = {"z": ("ENU", "z up; which way x points from north cannot be known from the data"),
          "-z": ("NED", "z down"), "y": ("z x y", "y up"), "-y": ("x z -y", "y down"),
          "x": ("y z x", "x up"), "-x": ("z y -x", "x down")}  # fmt: skip


def _proposals(names: list[str], s: Samples, h: _Hypothesis, margin: float) -> Attitude:
    fields: dict[str, Proposal] = {}
    taken = list(h.columns)
    up, body_up, gap = "z", "z", 0.0
    sure, why = 0.4, "not checked"
    if h.force is not None:
        _, _, up, gap, _ = h.force
        body_up = _thrust_axis(s, h)
        sure = 0.95 if gap > 0.1 else 0.4
        why = f"that fits the specific force by {gap:.2f} better than any other"
    elif h.thrust is not None and h.thrust.misfit < 0.7 and h.thrust.gap > 1.3:
        up, body_up = h.thrust.up, h.thrust.axis
        sure = 0.9 if h.thrust.gap > DOUBTFUL else 0.7
        why = (
            f"then {h.thrust.misfit:.0%} of the acceleration lies beside the thrust, {h.thrust.gap:.1f} times otherwise"
        )
    world, word = _WORLD[up]
    frame = Proposal(world, sure, f"{word}; {why}")
    points = f"the thrust points along {body_up} of the attitude's body frame"
    body = Proposal(BODIES[body_up], sure, points if sure > 0.4 or h.force is not None else why)
    entry: dict[str, Any] = {"columns": [names[i] for i in h.columns], "order": h.order}
    if h.angles:
        entry["unit"] = h.angles
    else:
        entry["direction"] = "world_to_body" if h.inverse else "body_to_world"
    evidence = (
        [f"norm 1 within {np.abs(np.linalg.norm(s.x[:, h.columns], axis=1) - 1).max():.2g}"]
        if not h.angles
        else ["named so"]
    )
    evidence += [f"its rate correlates {h.rate[1].score:.3f} with the gyro"] if h.rate else []
    evidence += [f"gravity and motion correlate {h.force[1].score:.3f} with the accelerometer"] if h.force else []
    proved = (h.rate is not None and h.rate[1].score > 0.8) or (h.force is not None and h.force[1].score > 0.97)
    certain = (0.95 if margin > 0.05 else 0.8) if proved else 0.5
    if h.named and not h.angles and proved:
        certain = max(certain, 0.9 if margin > 0.01 else 0.7)
    fields["attitude"] = Proposal(
        entry, certain, "; ".join([*evidence, f"next best order or direction {margin:.2f} worse"])
    )
    if h.rate is not None:
        fields["rate"] = _rate(names, h, s)
        taken += h.rate[0]
    if h.force is not None:
        fields["acceleration"] = _force(names, h, s)
        taken += h.force[0]
    turned = h.thrust is not None and h.thrust.in_body and sure > 0.4
    return Attitude(matrices(h.q), frame, body, fields, taken, body_velocity=turned)


def _rate(names: list[str], h: _Hypothesis, s: Samples) -> Proposal:
    assert h.rate is not None
    columns, fit = h.rate
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


def _force(names: list[str], h: _Hypothesis, s: Samples) -> Proposal:
    assert h.force is not None
    columns, fit, _, _, _ = h.force
    entry, sure, why = force_unit(names, columns, float(np.linalg.norm(s.x[:, columns], axis=1).mean()))
    if not (fit.matrix == np.eye(3)).all():
        entry["frame"] = _relative(fit.matrix, s, h)
    return Proposal(
        {"columns": [names[i] for i in columns], **entry},
        min(sure, 0.95 if fit.score > 0.97 else 0.7),
        f"{why}; fit {fit.score:.3f}",
    )


def _relative(matrix: np.ndarray, s: Samples, h: _Hypothesis) -> str:
    """Axes into FLU of a sensor that stands turned against the attitude's body frame."""
    return _frame_word(axes_matrix("body", BODIES[_thrust_axis(s, h)], "") @ matrix)


def _thrust_axis(s: Samples, h: _Hypothesis) -> str:
    """Along which axis of the attitude's body frame the thrust points."""
    if h.force is None:
        return h.thrust.axis if h.thrust is not None and h.thrust.gap > 1.3 else "z"
    columns, fit, *_ = h.force
    mean = (s.x[:, columns] @ fit.matrix.T).mean(axis=0)
    axis = int(np.argmax(np.abs(mean)))
    return ("-" if mean[axis] < 0 else "") + "xyz"[axis]


def rate_unit(names: Sequence[str], columns: list[int], x: np.ndarray) -> tuple[str, float, str]:
    """Unit of a gyro that nothing can be compared with: the name's, or by its size."""
    written = unit_of(names[columns[0]])[1]
    if written in UNITS["rate"]:
        return str(written), 0.85, "the name says the unit"
    spread = float(np.percentile(np.abs(x - np.median(x, axis=0)), 99))
    unit = "deg/s" if spread > 15 else "rad/s"
    return unit, 0.6 if spread > 60 or spread < 8 else 0.4, f"99 % of its values within {spread:.3g}"


def force_unit(names: Sequence[str], columns: list[int], mean: float) -> tuple[dict[str, Any], float, str]:
    """Unit of an accelerometer from the size of its mean, which in flight is about that of gravity."""
    written = unit_of(names[columns[0]])[1]
    sizes = {"g": 1.0, "m/s^2": 9.81, "cm/s^2": 981.0, "mg": 1000.0}
    counts = {2048.0: "2048 counts a g", 4096.0: "4096 counts a g", 512.0: "512 counts a g", 8192.0: "8192 counts a g"}
    near = min([*sizes.values(), *counts], key=lambda size: abs(np.log(max(mean, 1e-9) / size)))
    clear = abs(np.log(max(mean, 1e-9) / near)) < 0.4
    why = f"its mean length is {mean:.4g}"
    if near in counts and written not in sizes:
        return {"unit": "g", "scale": 1 / near}, 0.75 if clear else 0.4, f"{why}: {counts[near]}"
    if mean < 0.5 and written != "g":
        return {"unit": "m/s^2", "kind": "coordinate"}, 0.4, f"{why}: gravity is not in it"
    unit = next((name for name, size in sizes.items() if size == near), "m/s^2")
    if written in sizes and written != unit:
        return {"unit": written}, 0.4, f"{why}, which would be {unit}; but the name says {written}"
    return {"unit": unit}, 0.95 if clear else 0.4, why
