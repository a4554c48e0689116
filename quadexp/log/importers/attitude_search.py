"""Which columns are the attitude, in which order and direction, and in which frames it, gyro and accelerometer stand.

Every hypothesis (four columns, order, direction) gives a rotation R; the gyro is compared with R's own rate, the
accelerometer with R^T (a + g e). The hypothesis that explains both best is taken, by how much better says how sure.
"""

from __future__ import annotations

import numpy as np

from quadexp.log.importers.attitude_hypothesis import Hypothesis, SensorFit, attitude_hypotheses
from quadexp.log.importers.attitude_proposal import Attitude, attitude_proposal
from quadexp.log.importers.evidence import Samples, body_rate, fit_force, fit_turn, matrices
from quadexp.log.importers.proposal import Groups
from quadexp.log.importers.thrust_search import acceleration_of_motion, thrust_alone


def find_attitude(
    names: list[str], s: Samples, usable: list[int], said: Groups, velocities: list[list[int]] | None = None
) -> Attitude | None:
    """The attitude that explains gyro and accelerometer best; None where there is none.

    velocities: by name alone, for the thrust of a log without accelerometer and position.
    """
    hypotheses = attitude_hypotheses(names, s, usable, said)
    if not hypotheses:
        return None
    chosen = [h for h in hypotheses if h.named] or hypotheses
    for h in chosen:
        _weigh(h, s, usable, said, velocities or [])
    ranked = sorted(chosen, key=lambda h: -h.score)
    best = ranked[0]
    same = [h for h in ranked if h.columns == best.columns and (h.order, h.inverse) != (best.order, best.inverse)]
    margin = best.score - (same[0].score if same else 0.0)
    return attitude_proposal(names, s, best, margin)


def _weigh(h: Hypothesis, s: Samples, usable: list[int], said: Groups, velocities: list[list[int]]) -> None:
    """Fit gyro and accelerometer to a hypothesis; its score is the mean of the two, 0 for what is not there."""
    free = set(usable) - set(h.columns)
    triples = [g for i in range(s.x.shape[1] - 2) if set(g := list(range(i, i + 3))) <= free]
    R = matrices(h.q)
    h.force = _best_force(R, s, said, triples)
    h.rate = _best_rate(h, s, said.get("rate") or triples)
    if h.force is None:
        h.thrust = thrust_alone(R, s, {"velocity": velocities, **said})
    seen = h.force.fit.score if h.force else max(0.0, 1 - h.thrust.misfit) if h.thrust else 0.0
    h.score = 0.5 * (h.rate.fit.score if h.rate else 0.0) + 0.5 * seen
    plain = sum(bool((found.fit.matrix == np.eye(3)).all()) for found in (h.rate, h.force) if found)
    h.score += 0.01 * plain + 0.01 * (h.order == "wxyz" and h.named) + 0.002 * (not h.inverse) - 1e-4 * h.columns[0]


def _best_rate(h: Hypothesis, s: Samples, candidates: list[list[int]]) -> SensorFit | None:
    """The gyro that the attitude's own rate explains best; None where none does."""
    beside = h.force.columns if h.force else []
    omega = s.smooth(body_rate(h.q, s.t))
    best: tuple[float, SensorFit] | None = None
    for rank, columns in enumerate(candidates):
        if np.ptp(s.x[:, columns], axis=0).min() == 0 or set(columns) & set(beside):
            continue
        fit = fit_turn(s.x[:, columns], omega)
        # An inertial sensor's two halves stand side by side; a rate from a camera's poses need not.
        imu = 0.08 * (bool(beside) and abs(columns[0] - beside[0]) == 3)
        value = fit.score + imu - 0.002 * rank
        if best is None or value > best[0]:
            best = (value, SensorFit(columns, fit))
    return best[1] if best is not None and best[1].fit.score > 0.5 else None


def _best_force(R: np.ndarray, s: Samples, said: Groups, triples: list[list[int]]) -> SensorFit | None:
    """The accelerometer that gravity and motion explain best under R, (n, 3, 3); None where they explain none."""
    best: tuple[float, SensorFit] | None = None
    motion, moving = acceleration_of_motion(s, said)
    for rank, columns in enumerate(said.get("acceleration") or triples):
        x = s.x[:, columns]
        if np.ptp(x, axis=0).min() == 0 or set(moving or ()) & set(columns):
            continue
        up, fit, gap = fit_force(R, motion, x)
        value = fit.score - 0.002 * rank
        if best is None or value > best[0]:
            best = (value, SensorFit(columns, fit, up, gap))
    return best[1] if best is not None and best[1].fit.score > 0.9 else None
