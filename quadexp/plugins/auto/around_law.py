"""A law in closed form under one setting: it is given the state and the reference of the time at which its command
acts.

    late -> now -> observer of the force, given to the law -> in dead time and lag -> law

A law that cannot be given a force or wind is given the delays only.

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
from quadexp.physics.expression import dense_function, named_symbols
from quadexp.physics.state import N_STATE, POSITION, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.auto.ahead import Ahead, prediction_numbers, sent_commands, span_weights
from quadexp.plugins.auto.auto import Auto
from quadexp.plugins.auto.decide import Decision
from quadexp.plugins.auto.settings import BANK, PATH

DERIVATIVES = 5  # of the path: position .. snap
LONGEST = BANK.largest_dead_time + BANK.largest_lag  # s, that a law is given ahead


class AutoLaw(Auto):
    """A law, which is given the state and the reference of the time at which its command acts."""

    judged = "with the delays found"

    def __init__(self, core: Any, sensor_spec: SensorSpec) -> None:
        vehicle, backend, air = core.vehicle, core.backend, no_residual(core.vehicle)
        world = {"push": np.zeros(6), "wind": np.zeros(3), "scale": np.ones(1)}  # assumed, for the predictions
        commands = sent_commands(vehicle, core.control_period)
        super().__init__(core, sensor_spec, air, world, commands)
        self._ahead = Ahead(vehicle, air, backend, commands, world, LONGEST)
        self._world = BufferedFunction(cached_function(backend, world_of, vehicle), into=world)
        self._later = cached_function(backend, later, vehicle, self.control_period)
        self._believed, self._jumps = Memory("Believed", worked=world), Memory("Sooner", sizes_of([self._later]))
        self._times, self._jump_rows = {"ahead": np.zeros(1), "at": np.zeros(1)}, np.zeros(3)
        spacing = self.control_period / PATH.samples
        longest = LONGEST + max(PATH.looks + 2 * self.control_period, core.node_times[-1])
        self.node_times = spacing * np.arange(math.ceil(longest / spacing) + 2)
        core.rows = self._rows
        form = len(commands.values), self._ahead.parts, spacing, tuple(core.node_times.tolist()), self.believes
        tuned = self._ahead.tuned("ahead") | self._times | {"jump_rows": self._jump_rows}
        self._plans({}, tuned, law_form, *form)

    def _retuned(self, when: np.ndarray | None = None) -> list[Call]:
        """See Auto: what was given the path is of another time."""
        return [*super()._retuned(when), copy(self._jumps.of_next["goes_on"], np.zeros(1), when)]

    def starts(self, x: np.ndarray, thrust: np.ndarray) -> list[tuple[Memory, dict[str, Any]]]:
        """See Auto."""
        return [*super().starts(x, thrust), (self._jumps, {}), (self._believed, {"scale": np.ones(1)})]

    def _planned(self, inputs: InputArrays, now: np.ndarray) -> ControlStep:
        """See Auto."""
        left = {"path_then": np.zeros((DERIVATIVES, 3)), "yaw_then": np.zeros(4)}
        predicted, then = self._ahead.before(now)
        states, thrusts = np.zeros((3, N_STATE)), np.zeros((2, self.vehicle.n_rotors))
        places = {"states": states, "path": inputs.path, "yaw": inputs.yaw, **self._times}
        calls = [*predicted, Call("window", states, self._jump_rows, thrusts)]
        calls.append(call(connected(self._later, places, left, self._jumps)))
        inside = copying.copy(inputs)
        inside.path, inside.yaw = left["path_then"], left["yaw_then"]  # type: ignore[assignment]  # of these shapes
        step = control_step_of(self.wrapped, inside, then)
        if self.believes:
            world, found, believed = self._world.arguments, self._world.results, self._core.believed_numbers
            calls += [copy(world["belief"], believed), copy(world["path"], left["path_then"])]
            calls += [call(self._world), copy(believed[:3], found["force"])]
        return step._replace(calls=[*calls, *step.calls], memory=(*step.memory, self._jumps, self._believed))


def law_form(
    acts: Decision, period: float, count: int, parts: int, spacing: float, nodes: tuple[float, ...], believes: bool
) -> tuple[Any, ...]:
    """See plan_function. count: of commands, parts: of the prediction. spacing: of the reference, which is looked at in
    these nodes (s). believes: whether it may be given a force; in the world of the model alone, predicting further
    would mislead it."""
    dead_time, lag = believes * acts.dead_time, believes * acts.lag
    ahead = dead_time + lag
    first = ca.floor(ahead / spacing + 0.5)
    looks = first + round(PATH.looks / spacing)
    rest = prediction_numbers("ahead", span_weights(count, period), parts, (0, ahead), dead_time, lag)
    rest |= {"ahead": ahead, "at": looks * spacing, "jump_rows": looks + PATH.samples * ca.DM(range(3))}
    return {}, (dead_time, lag), first + ca.DM(np.round(np.array(nodes) / spacing)), rest


def later(vehicle: Vehicle, period: float) -> ca.Function:
    """path (3, 5): position .. snap, yaw (4,): heading, rate, acceleration, drift; ahead (s) -> both then, the path
    with its offset.

    states: of the reference, (3, 13), a period apart, the first at a time `at` from now (s). coming: a jump of the
    velocity that they showed (m/s), and in which time it is (s), 0 for none, (4,). before: what path then was in the
    last step, where it `goes_on`, (3, 5). offset: e, e', c, (3, 3), see the module. These four are remembered.
    """
    shapes = {"path": (3, DERIVATIVES), "yaw": 4, "ahead": 1, "states": (N_STATE, 3), "at": 1}
    kept = {"coming": 4, "before": 3 * DERIVATIVES, "goes_on": 1, "offset": 9}
    inputs = named_symbols(ca.SX, shapes | {NOW + name: size for name, size in kept.items()})
    path, yaw, ahead, states, at, coming, before, goes_on, offset = inputs.values()
    before, offset = ca.reshape(before, 3, DERIVATIVES), ca.reshape(offset, 3, 3)

    def then(rows: list[ca.SX], ahead: Any) -> list[ca.SX]:
        return [
            sum((ahead**j / math.factorial(j) * row for j, row in enumerate(rows[i:])), ca.SX(0))
            for i in range(len(rows))
        ]

    pushed = vehicle.n_rotors * vehicle.thrust_max / vehicle.mass
    most = min(PATH.share * math.sqrt(pushed**2 - vehicle.gravity**2), PATH.steepest * vehicle.gravity)
    least = 2 * most * period

    p, v = ca.horzsplit(states[POSITION, :]), ca.horzsplit(states[VELOCITY, :])
    last, jump = v[1] - v[0], v[2] - v[1] - (v[1] - v[0])
    shows = (ca.norm_2(jump) > least) * (ca.norm_2(v[2] - v[1]) > ca.norm_2(last)) * (coming[3] <= 0)
    since = ca.dot(p[2] - p[1] - period * v[1], jump) / ca.fmax(ca.sumsqr(jump), PATH.ended)
    jump = ca.if_else(shows, jump, coming[:3])
    left = ca.if_else(shows, at + 2 * period - since, coming[3] - period)
    seen = (left > PATH.ended) * (left - ahead < PATH.early * ca.norm_2(jump) / most)

    moved, expected = then(ca.horzsplit(path), ahead), then(ca.horzsplit(before), period)
    moved[0] += seen * (ahead - left) * jump
    moved[1] += seen * jump
    jumps = goes_on * (ca.norm_2(moved[1] - expected[1]) > least)
    e, e_1, c = then(ca.horzsplit(offset), period)
    e, e_1 = e - jumps * (moved[0] - expected[0]), e_1 - jumps * (moved[1] - expected[1])

    far, fast, _ = then([e, e_1, c], 1 / PATH.turns)
    wanted = -ca.fmin(PATH.back / 2, ca.sqrt(2 * PATH.brakes * most / ca.fmax(ca.norm_2(far), PATH.ended))) * far
    u = 2 * PATH.back * (wanted - fast)
    u *= most / ca.fmax(ca.norm_2(u), most)
    jerk = PATH.turns * (u - c)
    after = ca.horzcat(e, e_1, c + period * jerk)
    lasts = ca.sumsqr(after) > PATH.ended**2
    results = {
        "path_then": ca.horzcat(*moved) + lasts * ca.horzcat(after, jerk, ca.SX.zeros(3)),
        "yaw_then": ca.vertcat(*then(ca.vertsplit(yaw[:3]), ahead), yaw[3]),
        f"{NEXT}coming": ca.vertcat(jump, ca.fmax(left, 0)),
        f"{NEXT}before": ca.vec(ca.horzcat(*moved)),
        f"{NEXT}goes_on": 1,
        f"{NEXT}offset": ca.vec(lasts * after),
    }
    return dense_function("later", inputs, results)


def world_of(vehicle: Vehicle) -> ca.Function:
    """What a law is given a force, and the prediction of the world: push (6,), acceleration, world, and angular
    acceleration, body; wind (3,); scale of the thrust.

    belief: (11,). path (3, 5): position .. snap, that the law is given. A force F is given as far as there is thrust
    left beside what the path takes, with b = m (a + g e_z) the largest share s of it, up to 1, for which

        |b - s F| <= TURNING n T_max

    and where the path alone takes more, the share that brings the thrust nearest to that.
    """
    belief, path = ca.SX.sym("belief", N_BELIEF), ca.SX.sym("path", 3, DERIVATIVES)
    force, spin = belief[:3], ca.mtimes(ca.inv(ca.DM(vehicle.inertia_matrix)), belief[3:6])
    taken = vehicle.mass * (path[:, 2] + ca.vertcat(0, 0, vehicle.gravity))
    most = PATH.turning * vehicle.n_rotors * vehicle.thrust_max * belief[9]
    along, square = ca.dot(taken, force), ca.fmax(ca.sumsqr(force), PATH.ended**2)
    share = (along + ca.sqrt(ca.fmax(along**2 + square * (most**2 - ca.sumsqr(taken)), 0))) / square
    told = ca.fmin(ca.fmax(share, 0), 1) * force
    push = ca.vertcat(force / vehicle.mass, spin)
    results = {"push": push, "wind": belief[6:9], "scale": belief[9], "force": told}
    return ca.Function("believed_push", [belief, path], [*results.values()], ["belief", "path"], [*results])
