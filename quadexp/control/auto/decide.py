"""When which part acts, from the evidence: nothing is corrected that has not shown itself.

    age             from SURE in log odds on, CERTAIN times in a row, and LEAST_AGE
    dead time, lag  from LIKELY in log odds on; the total is the likeliest one
    stiffness       of the grid and weights (GRIDS): PUSHED once a push or a plain age shows itself, then by what may be
                    unknown of the timing,
                        unknown = sd(d + l) + |d + l - what is acted on| + sd(a) / 2
                    one grid at a time towards the stiffer, at once towards the softer
                    where commands stand at the rotors' limits, as behind a corner, FIRM at most, or they would swing
                    between these; where they still do after PATIENT decisions, one softer each time
    push            each of lateral, vertical and torque, once it is GATE deviations away from zero; the lateral
                    one from the first reading on

Where the timing of commands is not known to SURELY_TIMED, thrusts are not compared with readings: it would look like a
force.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from quadexp.control.auto.bank import AGE, DEAD_TIME, LAG
from quadexp.control.auto.posterior import Evidence
from quadexp.control.mpc.settings import MPCSettings

SURE, CERTAIN, LEAST_AGE = 4.0, 3, 0.001  # log odds, decisions, s
PLAIN = 8.0  # log odds of an age by attitude and rates that acts at once
LIKELY = 2.0  # log odds
GATE = 5.0  # deviations
SURELY_TIMED = 0.005  # s
SOFTEST_LATE = 0.04  # s, of a total that is not acted on: from there on the softest grid
CHANGED = 0.0005, 0.0015, 0.004  # s, of age, total and lag: smaller changes are not worth one
LEAST_LAG = 0.003  # s
LARGE_NOISE = 0.002  # m, of the told position: then at most the second stiffest grid
# first node (s), horizon (s), position weight beside the usual ones; and up to which unknown time (s). The margins of a
# nominal MPC at 50 Hz in hover are 67, 40, 35, 29, 13 ms; of controller=sun_mpc at 100 Hz 51, 50, 46, 41, 28 ms.
GRIDS = (
    (0.0, 1.0, 10.0, np.inf), (0.06, 0.8, 40.0, np.inf), (0.06, 0.8, 100.0, 0.008), (0.04, 0.8, 50.0, 0.005),
    (0.02, 0.8, 200.0, 0.0025),
)  # fmt: skip
HEAVIEST = 1e3  # of what a position weight is raised by
PUSHED = 1  # least grid once there is a push or such an age: the softest one would let their error stand for a second
PATIENT = 3  # decisions with commands at their limits: a corner takes fewer
FIRM, LIMITED = 2, 0.2  # a grid, and from which share of commands at a limit on none is stiffer
STIFF_TOTAL = 0.015  # s, largest dead time and lag under the stiffest grid


def grids(settings: MPCSettings) -> list[MPCSettings]:
    """Settings of each of GRIDS, the softest first, for the nodes and control period of an MPC.

    Where all its other weights are k times the usual ones or more, so is that of the position: a cost that is scaled
    has the same optimum. Not in the softest grid, while nothing is known.
    """
    of_grids, usual, k = [], MPCSettings(), HEAVIEST
    for name in ("attitude_weight", "velocity_weight", "rate_weight", "input_weight"):
        given, least = (np.atleast_1d(getattr(one, name)) for one in (settings, usual))
        k = min(k, float((given[least > 0] / least[least > 0]).min()))
    for first, horizon, weight, _ in GRIDS:
        first = max(first, settings.control_period) if first else 0.0
        longer = max(horizon, settings.nodes * max(first, settings.control_period))
        weight *= max(k, 1.0) if first else 1.0
        x, y, z = (max(weight, asked) for asked in settings.position_weight)
        of_grids.append(replace(settings, first_node=first, horizon=longer, position_weight=(x, y, z)))
    return of_grids


@dataclass(frozen=True)
class Senses:
    """What is measured beside the delays, see senses.py. away: deviations of the lateral push, the vertical one and the
    torque from zero. walk: of the push, (3,) (m/s^2 in a root of a second). reading: deviation of a reading from the
    model, (3,) (m/s^2). position (m), attitude (rad), rate (rad/s): of the told state. twist: walk of the torque
    (rad/s^2 in a root of a second). velocity: that is told, (3,) (m/s). swing: deviation of the last thrusts over
    the mass (m/s^2). limited: share of the last commands that are at a limit."""

    away: tuple[float, float, float] = (0.0, 0.0, 0.0)
    walk: np.ndarray = field(default_factory=lambda: np.zeros(3))
    reading: np.ndarray = field(default_factory=lambda: np.zeros(3))
    position: float = 0.0
    attitude: float = 0.0
    rate: float = 0.0
    twist: float = 0.0
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    swing: float = 0.0
    limited: float = 0.0


@dataclass(frozen=True)
class Acting:
    """What is acted on. age, dead_time, lag (s). fresh: the told rates are of now. grid: which of GRIDS. timed: the
    commands' timing is known. push: lateral, vertical, torque."""

    age: float = 0.0
    dead_time: float = 0.0
    lag: float = 0.0
    fresh: bool = False
    grid: int = 0
    timed: bool = False
    push: tuple[bool, bool, bool] = (False, False, False)

    @property
    def total(self) -> float:
        """Dead time and lag (s)."""
        return self.dead_time + self.lag


def found_at(age: float, dead_time: float, lag: float) -> Acting:
    """What is acted on once these delays (s) are known, as far as they are looked for, in the stiffest grid."""
    age, dead_time, lag = min(age, AGE), min(dead_time, DEAD_TIME), min(lag, LAG)
    stiffest = len(GRIDS) - 1 if dead_time + lag < STIFF_TOTAL else len(GRIDS) - 2
    return Acting(age, dead_time, lag, grid=stiffest, timed=True)


class Decision:
    """What is acted on now, and why it may change; `reset` begins a flight. softly: at most grid 1 until then (s)."""

    def __init__(self, softly: float = 0.0) -> None:
        self._softly = softly
        self.reset()

    def reset(self) -> None:
        """Nothing is acted on."""
        self.acting, self._certain, self._limited = Acting(), 0, 0

    def at_once(self, age: float, late: float) -> Acting:
        """What to act on where nothing is known but an age by attitude and rates (s), and its log odds."""
        if late > PLAIN and age > LEAST_AGE and not self.acting.age:
            grid = max(self.acting.grid, PUSHED)
            self.acting, self._certain = replace(self.acting, age=age, fresh=True, grid=grid), CERTAIN
        return self.acting

    def soften(self, senses: Senses) -> Acting:
        """What to act on meanwhile, without further evidence."""
        self._limited = self._limited + 1 if senses.limited > LIMITED else 0
        softer = FIRM if self._limited <= PATIENT else self.acting.grid - 1
        if self._limited and self.acting.grid > max(softer, 0):
            self.acting = replace(self.acting, grid=softer)
        return self.acting

    def begin(self, senses: Senses, doubt: float) -> Acting:
        """What to act on where nothing is known of the delays yet. doubt: factor by which deviations may be larger."""
        if senses.away[0] > doubt * GATE and not self.acting.push[0]:
            self.acting = replace(self.acting, push=(True, False, False), grid=PUSHED)
        return self.acting

    def shown(self, senses: Senses) -> Acting:
        """What to act on with what pushes, without further evidence of delays: at any time of a flight."""
        before, (lateral, vertical, torque) = self.acting, (away > GATE for away in senses.away)
        timed, shown = before.timed, before.push
        push = lateral or shown[0], (timed and vertical) or shown[1], (timed and torque) or shown[2]
        self.acting = replace(before, push=push)
        return self.acting

    def take(self, evidence: Evidence, senses: Senses, time: float) -> Acting:
        """What to act on with this evidence. time: of the flight (s)."""
        before = self.acting
        age, total, lag = evidence.mean
        sd_age, sd_total, _ = evidence.deviation
        at_once = CERTAIN if evidence.fresh and evidence.late > PLAIN else 1
        self._certain = self._certain + at_once if evidence.late > SURE else 0
        age = float(age) if self._certain >= CERTAIN and age > LEAST_AGE else 0.0
        acts = evidence.slow > LIKELY
        dead_time, lag = (float(max(total - lag, 0.0)), float(min(lag, total))) if acts else (0.0, 0.0)
        changes = age - before.age, dead_time + lag - before.total, lag - before.lag
        if all(abs(change) < least for change, least in zip(changes, CHANGED, strict=True)):
            age, dead_time, lag = before.age, before.dead_time, before.lag
        unknown = float(sd_total + abs(total - dead_time - lag) + sd_age / 2)
        timed = unknown < SURELY_TIMED
        far = total + 2 * sd_total - dead_time - lag > SOFTEST_LATE and time > 0.8
        grid = max(i for i, (*_, most) in enumerate(GRIDS) if unknown < most)
        grid = min(grid, 3 if dead_time + lag >= STIFF_TOTAL or senses.position > LARGE_NOISE else 4)
        grid = grid if grid > 1 and time >= self._softly else int(not far)
        grid = min(grid, before.grid + (not self._limited))
        self.acting = Acting(age, dead_time, lag, evidence.fresh, grid, timed, before.push)
        return self.shown(senses)
