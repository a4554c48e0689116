"""From posterior and disturbance to what is acted on: one pure function of declared memory, called at every instant.

age               posterior mean, where the Bayes factor against none is very strong
dead time, lag    posterior mean, where it is positive
stiffness         by the timing uncertainty  sigma = sd(D) + |D - acted| + max(sd(a), |a - acted| / 2) / 2, one grid at
                  a time towards the stiffer; the stiffest where also the total is short and the estimated position
                  has no noise. The softest, the controller's own, where age or total may be any larger one than those
                  that are looked for, where they and the period are long, where rotors saturate, where the path asks
                  for more acceleration than the vehicle has, and as long as there are few readings.

A look at the evidence begins a search for the posterior where one is due: the coarse grid in the next instant, finer
ones in those after it, each where the last one ended, until one's mode is not on its edge. As a flight begins, all are
in one instant: each further one that passes until an age of 50 ms acts costs 10 to 30 mm at 10 m/s.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from quadexp.compile.memory import NEXT, NOW
from quadexp.compile.symbolic import ca
from quadexp.control.mpc.settings import MPCSettings
from quadexp.names import named
from quadexp.physics.expression import Expression, dense_function, limited, named_symbols, split
from quadexp.physics.state import N_STATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.auto.posterior import FOUND
from quadexp.plugins.auto.settings import BANK, DECISION, DISTURBANCE, INTERVAL

LARGEST_DELAYS = BANK.largest_age, BANK.largest_dead_time, BANK.largest_lag  # s
UNKNOWN = -1.0  # of what a decision has crossed: neither
BELIEFS = 10  # age, delay, lag, their lower and their upper ends; by how much rates are newer; behind them what acts
OF_SEARCH = sum(FOUND.values())
KEPT = {
    "searching": 1,
    "passes": 1,
    "wait": 1,
    "saturates": 1,
    "next": 1,
    "crossed": 3,
    "known": 1,
    "searches": 1,
    "rounds": 1,
    "found": OF_SEARCH,
    "odds": 2,
    "at_end": 4,
    "decision": 6,
    "unsure": 1,
    "late": 1,
    "apart": 1,
    "beliefs": BELIEFS + 4,
}


class Decision(NamedTuple):
    """What is acted on. age, dead_time, lag, timing (s): timing is the uncertainty of the commands' delay. newer: by
    how much the rates are newer than the pose (s). grid: of DECISION.grids, from 1 on; 0: the controller's own."""

    age: Expression
    dead_time: Expression
    lag: Expression
    newer: Expression
    grid: Expression
    timing: Expression

    @property
    def total(self) -> Expression:
        """Dead time and lag (s)."""
        return self.dead_time + self.lag


NOTHING = Decision(0.0, 0.0, 0.0, 0.0, 0.0, DISTURBANCE.unknown_timing)  # before there is evidence


class Statistics(NamedTuple):
    """What is measured beside the delays. busy: whether noise speaks against the stiffest grid. acts: whether a
    disturbance is assumed. enough: whether there are enough readings, of little enough noise, rotors that are not
    saturated, and a path that the vehicle can follow, for any but the softest grid."""

    busy: Expression = 0.0
    acts: Expression = 0.0
    enough: Expression = 1.0


def decided(
    known: Expression, found: Mapping[str, Expression], last: Decision, statistics: Statistics, period: float
) -> Decision:
    """What to act on from now on. found: mean and deviation, (3,), newer, odds, (2,), at_end, (4,), of a posterior;
    known: whether there is one. period: of control (s)."""
    s = DECISION
    mean_age, total, lag = ca.vertsplit(found["mean"])
    odds_of_age, odds_of_total = ca.vertsplit(found["odds"])

    # delays that there is evidence for; small changes of what is known change nothing
    needed = s.age_odds * (1 + s.between / ca.fmax(mean_age, s.least_age))
    is_late = ca.logic_and(odds_of_age > needed, mean_age > s.least_age)
    age = ca.if_else(is_late, mean_age, 0)
    acted = ca.if_else(odds_of_total > s.total_odds, total, 0)
    lag = ca.fmin(lag, acted)
    wanted = ca.vertcat(age, acted, lag, ca.fmin(found["newer"], age))
    before = ca.vertcat(last.age, last.total, last.lag, last.newer)
    small = ca.mmax(ca.fabs(wanted - before)[:2]) < s.least_change
    age, acted, lag, newer = ca.vertsplit(ca.if_else(small, before, wanted))

    # stiffness
    age_deviation, total_deviation, _ = ca.vertsplit(found["deviation"])
    late = ca.fmax(age_deviation, ca.fabs(mean_age - age) / 2)  # also an age that does not act yet
    timing = total_deviation + ca.fabs(total - acted) + late / 2
    uncertain = timing + s.inexact * (age + acted)
    stiff = (uncertain < s.stiff_timing) * (acted < s.stiff_total) * (1 - statistics.busy)
    may_be_later = ca.mmax(found["at_end"][[0, 1, 3]]) > 0
    soft = ca.logic_or(may_be_later, age + acted + period >= s.soft_sum)
    stiffness = 1 + (uncertain < s.middle_timing) + stiff
    grid = ca.if_else(soft, 0, ca.fmin(stiffness, last.grid + 1))
    # without evidence the softest grid would let the error stand for a second
    grid = ca.if_else(known, grid, ca.fmax(last.grid, statistics.acts))
    grid *= statistics.enough
    found_now = ca.vertcat(age, acted - lag, lag, newer, grid, timing)
    unchanged = ca.vertcat(*last[:4], grid, last.timing)
    return Decision(*ca.vertsplit(ca.if_else(known, found_now, unchanged)))


def intervals(found: Mapping[str, Expression], beside: Expression) -> tuple[Expression, Expression]:
    """Ends of 95 % intervals of age, total and lag, (3,) each: quantiles of the posterior, and half a band `beside`.

    Age and total are mostly known by their sum, to half a step of the finer grid. So that there is none of one, at the
    edge of what can be, and all of both is the other, lies within, unless the Bayes factor excludes it.
    """
    mean = found["mean"]
    both = mean[0] + mean[1] + BANK.age_step / BANK.fine / 2
    ageless, prompt = ca.vertsplit(found["odds"] < INTERVAL.none_odds)
    least = found["lower"] * (1 - ca.vertcat(ageless, prompt, prompt))
    most = ca.fmax(found["upper"], both * ca.vertcat(prompt, ageless, 0))
    lower = mean - ca.hypot(mean - least, beside)
    upper = mean + ca.hypot(most - mean, beside)
    return ca.fmax(lower, 0), upper


def known(age: float, dead_time: float, lag: float, period: float) -> Decision:
    """What is acted on once these delays (s) are known, as far as they are looked for, in the stiffest grid."""
    grid = len(DECISION.grids) - (dead_time + lag >= DECISION.stiff_total)
    delays = age, dead_time, lag
    found = tuple(map(min, delays, LARGEST_DELAYS))
    if found != delays or sum(delays) + period >= DECISION.soft_sum:
        grid = 0
    age, dead_time, lag = found
    return Decision(age, dead_time, lag, 0.0, grid, 0.0)


def start_of(begin: Decision) -> dict[str, Any]:
    """What is remembered of decisions as a flight begins, but for zeros."""
    beliefs = np.zeros(KEPT["beliefs"])
    beliefs[3:9] = np.nan  # of ends of intervals
    return {
        "next": DECISION.begins,
        "crossed": np.full(KEPT["crossed"], UNKNOWN),
        "decision": np.array(begin),
        "late": DISTURBANCE.unknown_timing,
        "beliefs": beliefs,
    }


def level_acceleration(vehicle: Vehicle) -> float:
    """The largest one at a constant height (m/s^2)."""
    thrust = vehicle.n_rotors * vehicle.thrust_max / vehicle.mass
    return math.sqrt(thrust**2 - vehicle.gravity**2)


def decision_function(
    vehicle: Vehicle, period: float, bank_period: float, commands: int, apart: float, *, unsaid: bool
) -> ca.Function:
    """Memory after an instant, see KEPT, and whether a decision is another one than the last, or its grid is.

    count, weights, noise, x: of the bank. path: state of the reference a time `ahead`. commands: the last ones (N).
    acts: of the disturbance. odds, at_end: of the coarse grid; moved and FOUND of the finer one. apart: by which age
    and delays cannot be distinguished (s). unsaid: whether nobody says how old rates are beside the pose.
    """
    s = DECISION
    shapes = {"x": N_STATE, "path": N_STATE, "count": 1, "weights": 3, "noise": 3, "commands": commands, "acts": 3}
    shapes |= {"odds": 2, "at_end": 4, "moved": 1} | FOUND
    shapes |= {NOW + name: size for name, size in KEPT.items()}
    a = named_symbols(ca.SX, shapes)
    kept = {name: a[NOW + name] for name in KEPT}
    searching, looks = kept["searching"], kept["wait"] <= 0
    last = Decision(*ca.vertsplit(kept["decision"]))
    elapsed = ca.fmax(a["count"] * bank_period - BANK.settling, 0)
    rounding = s.rounding * period
    soon = elapsed + rounding < s.early
    often = max(1, round(s.soonest / period))
    seldom = max(1, round(s.checks / period))

    # a look at what is measured
    low, high = vehicle.thrust_min, vehicle.thrust_max
    n = vehicle.n_rotors
    held = (a["commands"][n:] + a["commands"][:-n]) / 2  # two in a row are at a limit: noise brings them there once
    saturated = ca.sum1(ca.fabs(held - (low + high) / 2) > s.at_limit * (high - low) / 2) / (commands - n)
    share = looks * ca.if_else(soon, s.soonest, s.checks) / s.corners_memory
    saturates = kept["saturates"] + share * (saturated - kept["saturates"])
    position = ca.sqrt(ca.fmax(a["noise"][1], 0))
    readings = (a["count"] >= s.few_readings) * (position < s.soft_noise)
    asked = ca.norm_2(a["path"][VELOCITY] - a["x"][VELOCITY]) / s.ahead
    enough = readings * (saturates < s.saturates) * (asked < s.steep * level_acceleration(vehicle))
    statistics = Statistics(busy=position > s.large_noise, acts=enough * (ca.mmax(a["acts"]) > 0), enough=enough)
    crossed = ca.vertcat(statistics.busy, statistics.acts, enough)
    has_crossed = ca.mmax(ca.fabs(crossed - kept["crossed"])) > 0

    # the search goes on, or ends
    refined = kept["rounds"] > 0
    passes = kept["passes"] + kept["rounds"]
    done = refined * ca.logic_or(ca.logic_not(a["moved"]), passes >= BANK.passes)
    due = elapsed + period - rounding >= kept["next"]  # the search is in the next instant
    due = ca.logic_and(due, a["weights"][1] > 0)
    due = looks * due * ca.logic_or(ca.logic_not(searching), done)
    now = ca.logic_or(due, searching * ca.logic_not(done))
    found = ca.vertcat(*(a[name] for name in FOUND))
    found = ca.if_else(done, found, kept["found"])
    of = named(FOUND, split(found, FOUND.values()))
    for name in ("odds", "at_end"):
        of[name] = ca.if_else(refined, a[name], kept[name])

    # the decision
    is_known = ca.fmax(kept["known"], done)
    decides = ca.logic_or(done, looks * ca.logic_not(searching) * has_crossed)
    decision = ca.vertcat(*decided(is_known, of, last, statistics, period))
    decision = ca.if_else(decides, decision, kept["decision"])
    differs = ca.fabs(decision - kept["decision"]) > 0
    acts = Decision(*ca.vertsplit(decision))
    crossed = ca.if_else(ca.mmax(differs) > 0, UNKNOWN, crossed)  # the next one goes on from this one

    # intervals, and beside them what the model of all hypotheses leaves out
    age, _, lag = ca.vertsplit(of["mean"])
    untold = ca.hypot(unsaid * age / INTERVAL.band, INTERVAL.unlike * lag)
    unsure = ca.if_else(done, ca.hypot(apart, untold), kept["unsure"])
    late = ca.fabs(age - acts.age)  # age that does not act
    beside = INTERVAL.band * ca.hypot(INTERVAL.inexact * of["mean"], unsure)
    lower, upper = intervals(of, beside)
    beyond = ca.mmax(of["at_end"]) > 0  # then any of them may be larger, and what is not at its end is not known
    lower *= ca.logic_or(1 - beyond, of["at_end"][:3])
    beliefs = ca.vertcat(of["mean"], lower, ca.if_else(beyond, math.inf, upper), of["newer"])
    beliefs = ca.if_else(done, beliefs, kept["beliefs"][:BELIEFS])
    predicted_over = s.inexact * (acts.age + acts.total)
    pause = limited(s.pace * elapsed, s.soonest, s.latest)
    left = {
        "searching": now,
        "passes": ca.if_else(due, 0, passes),
        "wait": ca.if_else(looks, ca.if_else(soon, often, seldom), kept["wait"]) - 1,
        "saturates": saturates,
        "next": ca.if_else(due, elapsed + pause, kept["next"]),
        "crossed": ca.if_else(decides, crossed, kept["crossed"]),
        "known": is_known,
        "searches": due,
        "rounds": now * ca.if_else(soon, BANK.passes, ca.logic_not(due)),
        "found": found,
        "odds": of["odds"],
        "at_end": of["at_end"],
        "decision": decision,
        "unsure": unsure,
        "late": ca.if_else(ca.logic_and(is_known, readings), late, kept["late"]),
        "apart": ca.hypot(unsure, ca.hypot(late * is_known, predicted_over)),
        "beliefs": ca.vertcat(beliefs, decision[:3], acts.grid),
    }
    results = {NEXT + name: left[name] for name in KEPT}
    results |= {"retunes": ca.mmax(differs[:5]) > 0, "regrids": differs[4]}
    return dense_function("decision", a, results)


def grids(settings: MPCSettings) -> list[MPCSettings]:
    """Settings of each grid, the softest first, for the nodes and control period of an MPC.

    Where all its other weights are k times the usual ones or more, so are those of position and commands: a cost that
    is scaled has the same optimum.
    """
    factors = []
    for name in ("attitude_weight", "velocity_weight", "rate_weight", "input_weight"):
        asked = np.atleast_1d(getattr(settings, name))
        usual = np.atleast_1d(getattr(MPCSettings(), name))
        weighed = usual > 0
        factors.append(float((asked[weighed] / usual[weighed]).min()))
    factor = max(min(factors), 1.0)
    of_grids = [settings]
    for grid in DECISION.grids:
        first = max(grid.first_node, settings.control_period)
        horizon = max(grid.horizon, settings.nodes * first)
        x, y, z = (max(grid.position_weight * factor, asked) for asked in settings.position_weight)
        input_weight = max(grid.input_weight * factor, settings.input_weight)
        timed = replace(settings, first_node=first, horizon=horizon)
        of_grids.append(replace(timed, position_weight=(x, y, z), input_weight=input_weight))
    return of_grids
