"""A law in closed form under one setting: it is given the state and the reference of the time at which its command
acts.

    late -> now -> observer of the force, given to the law -> in dead time and lag -> law

A law that cannot be given a force or wind is given the delays only. The state is predicted with the likeliest force,
with evidence for it or without: else a law with a gain k on the velocity would be off 1 + k T times as far under a
steady force, T the time that is predicted over, as behind any Smith predictor (1957).

Where the velocity of the path jumps, a law would ask for more than the vehicle has, tilt it beyond the horizontal and
fall. So what is given goes over to the path behind the jump already before it, with an offset e that makes both ends
meet and dies out as fast as the vehicle accelerates, a = min(SHARE sqrt((T_max / m)^2 - g^2), STEEPEST g):

    e'' = c,  c' = TURNS (u - c),    u = 2 BACK (-min(BACK / 2, sqrt(2 BRAKES a / |e|)) e - e'),  |u| <= a

with e and e' of the time 1 / TURNS ahead in u, as thrust turns. A path without jumps is given as it is.
"""

from __future__ import annotations

import copy as copying
import math
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.memory import NEXT, NOW, Memory, connected, sizes_of
from quadexp.compile.symbolic import ca
from quadexp.control.base import N_BELIEF
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, ControlStep, InputArrays, call, control_step_of, copy
from quadexp.models.residual import no_residual
from quadexp.parts.sensor_spec import SensorSpec
from quadexp.physics.expression import dense_function, limited, named_function, named_symbols
from quadexp.physics.state import N_STATE, POSITION, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.auto.ahead import Ahead, prediction_numbers, span_weights
from quadexp.plugins.auto.auto import Auto
from quadexp.plugins.auto.decide import Decision, level_acceleration
from quadexp.plugins.auto.settings import BANK, PATH

DERIVATIVES = 5  # of the path: position .. snap
LONGEST = BANK.largest_dead_time + BANK.largest_lag  # s, that a law is given ahead


class AutoLaw(Auto):
    """A law, which is given the state and the reference of the time at which its command acts."""

    settles = "with the delays found"

    def __init__(self, core: Any, sensor_spec: SensorSpec) -> None:
        vehicle, backend = core.vehicle, core.backend
        air = no_residual(vehicle)
        super().__init__(core, sensor_spec, air, air.theta)
        period = self.control_period
        self._ahead = Ahead(vehicle, air, backend, self._commands, self._world, LONGEST)
        self._assume = BufferedFunction(cached_function(backend, world_of, vehicle), into=self._world)
        self._later = cached_function(backend, later, vehicle, period)
        self._jumps = Memory("Sooner", sizes_of([self._later]))
        self._times = {"ahead": np.zeros(1), "at": np.zeros(1)}
        self._jump_rows = np.zeros(3)
        spacing = period / PATH.samples
        longest = LONGEST + max(PATH.looks + 2 * period, core.node_times[-1])
        self.node_times = spacing * np.arange(math.ceil(longest / spacing) + 2)
        core.rows = self._rows
        tuned = self._ahead.tuned("ahead") | self._times | {"jump_rows": self._jump_rows}
        nodes = tuple(core.node_times.tolist())
        count, parts = len(self._commands.values), self._ahead.parts
        self._plans({}, tuned, law_form, count, parts, spacing, nodes, self.believes)

    def _retuned(self, when: np.ndarray | None = None) -> list[Call]:
        """See Auto: what was given the path is of another time."""
        goes_on = self._jumps.of_next["goes_on"]
        return [*super()._retuned(when), copy(goes_on, np.zeros(1), when)]

    def starts(self, x: np.ndarray, thrust: np.ndarray) -> list[tuple[Memory, dict[str, Any]]]:
        """See Auto."""
        return [*super().starts(x, thrust), (self._jumps, {})]

    def _planned(self, inputs: InputArrays, now: np.ndarray) -> ControlStep:
        """See Auto."""
        calls, then = self._ahead.before(now)
        states = np.zeros((3, N_STATE))
        thrusts = np.zeros((2, self.vehicle.n_rotors))
        calls.append(Call("window", states, self._jump_rows, thrusts))
        inside = copying.copy(inputs)
        inside.path = np.zeros((DERIVATIVES, 3))
        inside.yaw = np.zeros(4)
        places = {"states": states, "path": inputs.path, "yaw": inputs.yaw, **self._times}
        left = {"path_then": inside.path, "yaw_then": inside.yaw}
        calls.append(call(connected(self._later, places, left, self._jumps)))
        step = control_step_of(self.wrapped, inside, then)
        if self.believes:
            belief, path, likely = self._assume.arguments.values()
            believed = self.wrapped.believed_numbers
            calls += [copy(belief, believed), copy(path, inside.path)]
            calls += [copy(likely, self._filter.likely), call(self._assume)]
            calls.append(copy(believed[:3], self._assume.results["force"]))
        calls += step.calls
        return step._replace(calls=calls, memory=(*step.memory, self._jumps))


def law_form(
    acts: Decision, period: float, count: int, parts: int, spacing: float, nodes: tuple[float, ...], believes: bool
) -> tuple[Any, ...]:
    """See plan_function. count: of commands, parts: of the prediction. spacing: of the reference, which is looked at in
    these nodes (s). believes: whether it may be given a force; in the world of the model alone, predicting further
    would mislead it."""
    dead_time = believes * acts.dead_time
    lag = believes * acts.lag
    ahead = dead_time + lag
    first = ca.floor(ahead / spacing + 0.5)
    looks = first + round(PATH.looks / spacing)
    weights = span_weights(count, period)
    rest = prediction_numbers("ahead", weights, parts, (0, ahead), dead_time, lag)
    rest["ahead"] = ahead
    rest["at"] = looks * spacing
    rest["jump_rows"] = looks + PATH.samples * ca.DM(range(3))
    rows = first + ca.DM(np.round(np.array(nodes) / spacing))
    return {}, (dead_time, lag), rows, rest


def derivatives_after(rows: list[ca.SX], ahead: Any) -> list[ca.SX]:
    """A quantity and its derivatives, a time `ahead` (s) later: Taylor's series, to the last derivative."""
    later_rows = []
    for i in range(len(rows)):
        row = ca.SX(0)
        for j, derivative in enumerate(rows[i:]):
            row = row + ahead**j / math.factorial(j) * derivative
        later_rows.append(row)
    return later_rows


def later(vehicle: Vehicle, period: float) -> ca.Function:
    """path (3, 5): position .. snap, yaw (4,): heading, rate, acceleration, drift; ahead (s) -> both then, the path
    with its offset.

    states: of the reference, (3, 13), a period apart, the first at a time `at` from now (s). coming: a jump of the
    velocity that they showed (m/s), and in which time it is (s), 0 for none, (4,). before: what path then was in the
    last step, where it `goes_on`, (3, 5). offset: e, e', c, (3, 3), see the module. These four are remembered.
    """
    shapes: dict[str, Any] = {"path": (3, DERIVATIVES), "yaw": 4, "ahead": 1, "states": (N_STATE, 3), "at": 1}
    kept = {"coming": 4, "before": 3 * DERIVATIVES, "goes_on": 1, "offset": 9}
    shapes |= {NOW + name: size for name, size in kept.items()}
    inputs = named_symbols(ca.SX, shapes)
    path, yaw, ahead, states, at, coming, before, goes_on, offset = inputs.values()
    before = ca.reshape(before, 3, DERIVATIVES)
    offset = ca.reshape(offset, 3, 3)

    most = min(PATH.share * level_acceleration(vehicle), PATH.steepest * vehicle.gravity)
    least = 2 * most * period

    # a jump between two states, beyond what the velocity changes by anyway; where in the period it is, by the positions
    p = ca.horzsplit(states[POSITION, :])
    v = ca.horzsplit(states[VELOCITY, :])
    last = v[1] - v[0]
    change = v[2] - v[1]
    jump = change - last
    is_jump = (ca.norm_2(jump) > least) * (ca.norm_2(change) > ca.norm_2(last))
    shows = is_jump * (coming[3] <= 0)
    moved_more = p[2] - p[1] - period * v[1]
    since = ca.dot(moved_more, jump) / ca.fmax(ca.sumsqr(jump), PATH.ended)
    jump = ca.if_else(shows, jump, coming[:3])
    left = ca.if_else(shows, at + 2 * period - since, coming[3] - period)
    early = PATH.early * ca.norm_2(jump) / most
    seen = (left > PATH.ended) * (left - ahead < early)

    # the path behind the jump, and the offset from it that makes both ends meet
    moved = derivatives_after(ca.horzsplit(path), ahead)
    moved[0] += seen * (ahead - left) * jump
    moved[1] += seen * jump
    expected = derivatives_after(ca.horzsplit(before), period)
    jumps = goes_on * (ca.norm_2(moved[1] - expected[1]) > least)
    e, e_1, c = derivatives_after(ca.horzsplit(offset), period)
    e = e - jumps * (moved[0] - expected[0])
    e_1 = e_1 - jumps * (moved[1] - expected[1])

    # which dies out
    far, fast, _ = derivatives_after([e, e_1, c], 1 / PATH.turns)
    distance = ca.fmax(ca.norm_2(far), PATH.ended)
    back = ca.sqrt(2 * PATH.brakes * most / distance)
    wanted = -ca.fmin(PATH.back / 2, back) * far
    u = 2 * PATH.back * (wanted - fast)
    u *= most / ca.fmax(ca.norm_2(u), most)
    jerk = PATH.turns * (u - c)
    after = ca.horzcat(e, e_1, c + period * jerk)
    lasts = ca.sumsqr(after) > PATH.ended**2
    path_then = ca.horzcat(*moved)
    yaw_then = derivatives_after(ca.vertsplit(yaw[:3]), ahead)
    results = {
        "path_then": path_then + lasts * ca.horzcat(after, jerk, ca.SX.zeros(3)),
        "yaw_then": ca.vertcat(*yaw_then, yaw[3]),
        f"{NEXT}coming": ca.vertcat(jump, ca.fmax(left, 0)),
        f"{NEXT}before": ca.vec(path_then),
        f"{NEXT}goes_on": 1,
        f"{NEXT}offset": ca.vec(lasts * after),
    }
    return dense_function("later", inputs, results)


def world_of(vehicle: Vehicle) -> ca.Function:
    """What a law is given a force, and the prediction of the world: push (6,), acceleration, world, and angular
    acceleration, body; wind (3,); scale of the thrust.

    belief: (11,). path (3, 5): position .. snap, that the law is given. likely: see DisturbanceFilter. A force F is
    given as far as there is thrust left beside what the path takes, with b = m (a + g e_z) the largest share s of it,
    up to 1, for which

        |b - s F| <= TURNING n T_max

    and where the path alone takes more, the share that brings the thrust nearest to that.
    """
    belief = ca.SX.sym("belief", N_BELIEF)
    path = ca.SX.sym("path", 3, DERIVATIVES)
    likely = ca.SX.sym("likely", 3)
    force, torque, wind, scale, _ = ca.vertsplit(belief, [0, 3, 6, 9, 10, N_BELIEF])
    spin = ca.inv(ca.DM(vehicle.inertia_matrix)) @ torque
    specific = path[:, 2] + ca.vertcat(0, 0, vehicle.gravity)
    taken = vehicle.mass * specific
    most = PATH.turning * vehicle.n_rotors * vehicle.thrust_max * scale
    along = ca.dot(taken, force)
    square = ca.fmax(ca.sumsqr(force), PATH.ended**2)
    room = along**2 + square * (most**2 - ca.sumsqr(taken))
    root = ca.sqrt(ca.fmax(room, 0))
    share = limited((along + root) / square, 0, 1)
    push = ca.vertcat(likely, spin)
    results = {"push": push, "wind": wind, "scale": scale, "force": share * force}
    return named_function("believed_push", {"belief": belief, "path": path, "likely": likely}, results)
