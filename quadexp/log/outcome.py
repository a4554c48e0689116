"""How a flight ended, in one word, which stands in its file and in its row of results.

    ok             flown to its end inside its corridor: it is completed
    left_corridor  flown to its end, but at some instant further from its reference than its corridor reaches
    lost           ended early: beyond trajectory.lost_distance or lost_box, or outside the domain of the plant's model
    solver_failed  ended early: a control step failed
    infeasible     not flown: the vehicle cannot fly the reference
    failed         not flown: its process ended, or raised an error
    invalid        not flown: the settings contradict each other
    damaged        its file cannot be read

A flight that was not flown to its end has no error: what it flew is not the path, so its mean says nothing, and a crash
after one sample would have the least of all.

The corridor is measured in sizes of the vehicle, the largest distance between two of its rotors, because what is a
detour for a vehicle of 0.5 m is a flight elsewhere for one of 92 mm. CORRIDOR is the crash rule of Sun et al. 2022 in
these units, rounded up: 5 m beside the path with a vehicle of 0.28 m are 18 sizes. Where a reference jumps (a step of
the set-point), the corridor is wider by the largest jump.
"""

from __future__ import annotations

import numpy as np

from quadexp.physics.state import norms

CORRIDOR = 20.0  # sizes of the vehicle, in every direction from the reference
COMPLETED = ("ok", "left_corridor")  # flown to the end: their errors are those of the whole path
UNFLOWN = ("infeasible", "failed")  # without a sample
FAILURES = ("left_corridor", "lost", "solver_failed", *UNFLOWN)  # of flights that were asked for
RULE = f"a flight is completed inside its corridor: {CORRIDOR:g} times the distance between its outermost rotors"


def corridor(size: float, t: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> float:
    """Largest distance (m) from the reference with which a flight is completed.

    size: of the vehicle (m). t: (k,) (s). position, velocity: of the reference, (k, 3) (m, m/s).
    """
    moved = np.diff(position, axis=0) - (velocity[1:] + velocity[:-1]) / 2 * np.diff(t)[:, None]
    jump = norms(moved).max(initial=0.0)
    return CORRIDOR * size + float(jump)
