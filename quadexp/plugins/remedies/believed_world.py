"""Planning in the world that an observer assumes (control.belief): what a control step does before the plan.

    estimate      an observer's update (plugins.remedies.observers), where the controller has one; otherwise the
    belief is given disturbance   F / m and J^-1 tau are parameters of the prediction model
    wind          the plan is made in a frame that moves with the air: v - w, p - o, and p*(t) - o - w t over the
                  horizon, with o' = w. In a constant wind the equations of motion there are those of still air, so that
                  nothing changes in the model. Where the wind is assumed to be another, the last solution is moved.
    thrust scale  the inputs of the plan are the thrusts that are delivered, s u, within s times the limits
    targets       attitudes and thrusts of the reference are made anew (targets.py), where that is asked for

All of it is one function a control step. What it remembers until the next one is one array.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from quadexp.compile.memory import NEXT, NOW, Memory, connected
from quadexp.compile.symbolic import ca
from quadexp.control.base import N_BELIEF, no_belief
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, InputArrays, call, copy
from quadexp.control.delivered import Delays, delivered_thrust, kept_sizes
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.models.residual import Residual
from quadexp.names import named
from quadexp.physics.expression import named_function, named_symbols
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.remedies.targets import held_targets

ROUNDING = 1e-15  # of a limit: a delivered thrust at it gives a command within the rotor's, however it is rounded
MOVED = 0.5  # m/s: with a smaller change of the wind the last solution is a good guess as it is


@dataclass(frozen=True)
class Estimator:
    """An observer for a BelievedWorld: its update with settings (plugins.remedies.observers.observer), and what it is
    given the commands' delays."""

    update: ca.Function
    settings: np.ndarray
    delays: Delays


class BelievedWorld:
    """From the world to the plan's frame and back.

    mpc: made with disturbed=True. node_times: of the reference, from the measurement on, (k,) (s). targets: whether
    they are made anew. air: the model that references are made with; None: without.
    estimator: finds the belief; without one, it is `given`, (11,). numbers: what is assumed since the last step, (11,).
    rows: of the horizon that it is given, an array with those that are the MPC's; None: all. memory: what it remembers.
    """

    def __init__(
        self,
        mpc: ModelPredictiveController,
        node_times: np.ndarray,
        *,
        targets: bool,
        air: Residual | None,
        estimator: Estimator | None = None,
    ) -> None:
        self._mpc = mpc
        settings = mpc.settings
        self._estimator = estimator
        vehicle = mpc.vehicle
        self.rows: np.ndarray | None = None
        model = None
        self._air_scale = mpc.parameters.ravel()[-1:] if mpc.residual.unscaled is not None else None
        if air is not None and targets:
            model = (air.unscaled or air).form(mpc.backend == "compiled")
        mpc.set_disturbance(np.zeros(6))  # refuses a model without one
        solution = mpc.prediction[0]
        n = vehicle.n_rotors
        update = None if estimator is None else estimator.update
        sizes = memory_sizes(vehicle, settings.nodes, estimator)
        self._function = cached_function(
            mpc.backend,
            enter_function,
            vehicle,
            model,
            update,
            settings.nodes,
            settings.samples,
            kept=tuple(sizes.items()),
            targets=targets,
            parameters=mpc.parameters.size,
            width=solution.shape[1],
        )
        self.memory = Memory("BelievedWorld", sizes)
        self.numbers = np.zeros(N_BELIEF)
        self.stated = np.zeros(N_BELIEF)
        self._sent = np.zeros(n)
        samples = settings.samples * settings.nodes + 1
        self._horizon = np.zeros((samples, N_STATE)), np.zeros((samples - 1, n))
        last = mpc.memory.of_now["X"].reshape(solution.shape)
        self._places = {"theta": mpc.parameters, "X": last, "belief": self.stated, "times": np.array(node_times)}
        self._places |= named(("X_ref", "U_ref"), self._horizon)
        self._places["period"] = np.full(1, settings.control_period)
        self._places["since"] = settings.dead_time + settings.node_times
        if estimator is not None:
            self._places["settings"] = estimator.settings
            self._places["delays"] = estimator.delays.numbers
        assert mpc.disturbance is not None
        low, high = mpc.limits
        result_places = {"disturbance": mpc.disturbance, "low": low, "high": high, "found": self.numbers}
        result_places["x_in"] = np.zeros(N_STATE)
        result_places["X_moved"] = solution
        result_places["squares"] = np.zeros(1)
        self._in_place = mpc.reference[0].shape[1] == N_STATE  # no thrusts among the states
        wide = tuple(np.zeros_like(array) for array in self._horizon)
        self._left = result_places | named(("X_in", "U_in"), mpc.reference if self._in_place else wide)
        self.reset(None)

    @property
    def times(self) -> dict[str, np.ndarray]:
        """Arrays of the times of the reference, (k,), and of the nodes, (N + 1,), from the measurement on (s); they may
        change from one step to the next."""
        return {name: self._places[name] for name in ("times", "since")}

    def reset(self, begin: np.ndarray | None) -> None:
        """Begin a flight in the world of the model, after the MPC did. begin: first state of the estimator."""
        self._mpc.set_disturbance(np.zeros(6))
        self.numbers[...] = self.stated[...] = np.hstack([*no_belief()])
        if self._air_scale is not None:
            self._air_scale[:] = 1.0
        self._mpc.set_thrust_scale(1.0)
        self.memory.begin({} if begin is None else self.start(begin, self._mpc.prediction[1][0]))

    def start(self, begin: np.ndarray, thrust: np.ndarray) -> dict[str, np.ndarray]:
        """What is remembered then, of the estimator and its thrusts, (n,) (N); both may be symbols."""
        if self._estimator is None:
            return {}
        commands = np.tile(thrust, self._estimator.delays.pending)
        return {"commands": commands, "thrust": thrust, "sent": thrust, "estimate": begin}

    def before(self, inputs: InputArrays, state: np.ndarray) -> tuple[list[Call], np.ndarray]:
        """What stands before the plan: it leaves the reference in the plan's frame where the MPC reads it, and the
        state (13,) in the array that is returned; the MPC is given the rest."""
        result_places = self._left
        X, U = self._mpc.reference
        X_ref, U_ref = self._horizon
        places = dict(self._places)
        places["x"] = state
        places["reading"] = inputs.specific_force
        places["fresh"] = inputs.fresh
        places["speed"] = inputs.rotor_speed
        calls = [Call("window", X_ref, self.rows, U_ref)]
        calls.append(call(connected(self._function, places, result_places, self.memory)))
        calls.append(Call("finite", source=result_places["squares"]))
        if self._air_scale is not None:
            calls.append(copy(self._air_scale, self.numbers[10:]))
        if not self._in_place:
            states = zip(X, result_places["X_in"], strict=True)  # by rows: of rotors that lag there are thrusts behind
            calls += [copy(row[:N_STATE], state) for row, state in states]
            calls.append(copy(U, result_places["U_in"]))
        return calls, result_places["x_in"]

    def after(self, thrust: np.ndarray) -> tuple[list[Call], np.ndarray]:
        """The command that delivers a planned thrust, (n,) (N), and the array that has it then."""
        calls = [Call("divide", self._sent, thrust, self.numbers[9:10])]
        if self._estimator is not None:
            calls.append(copy(self.memory.of_next["sent"], self._sent))
        return calls, self._sent

    @property
    def finite(self) -> bool:
        """Whether what `before` left is."""
        return math.isfinite(self._left["squares"].item())


def memory_sizes(vehicle: Vehicle, nodes: int, estimator: Estimator | None) -> dict[str, int]:
    """What a BelievedWorld remembers: the frame's origin, the wind, `air` of targets.py at the nodes; with an
    estimator what commands gave, and its state."""
    sizes = {"origin": 3, "wind": 3, "air": 6 * (nodes + 1)}
    if estimator is not None:
        sizes |= kept_sizes(vehicle.n_rotors, estimator.delays)
        sizes["flown"] = 1
        sizes["estimate"] = estimator.update.size1_in("s")
    return sizes


def enter_function(
    vehicle: Vehicle,
    model: ca.Function | None,
    update: ca.Function | None,
    nodes: int,
    samples: int,
    *,
    targets: bool,
    parameters: int,
    width: int,
    kept: tuple[tuple[str, int], ...],
) -> ca.Function:
    """What a BelievedWorld computes before the plan, for N = nodes with s = samples of the reference in each;
    update: of an estimator. kept: see memory_sizes.

    Inputs: x (13,); X_ref (13, s N + 1), U_ref (n, s N); times (s N + 1,) of the reference from now, period (s);
    X (width, N + 1), the last solution, and times `since` of its nodes from now (N + 1,) (s);
    the memory; belief (11,), or with an estimator: reading (3,), speed (n,), of the rotors, fresh (2,), whether these
    two are of now, settings, delays (see Delays); theta (p,), where the model or the estimator has parameters.
    Outputs: x_in, X_in, U_in: the same in the plan's frame; disturbance (6,); low, high (n,), limits of delivered
    thrusts (N); found (11,), the belief; X_moved: the last
    solution, in a frame that is the faster by the change of the wind from now on where that is large;
    squares: the sum of those of x_in, X_in and U_in; the memory's next values.
    """
    n = vehicle.n_rotors
    rows = samples * nodes + 1
    shapes = {"x": N_STATE, "X_ref": (N_STATE, rows), "U_ref": (n, rows - 1), "times": rows}
    shapes["period"] = 1
    shapes["X"] = (width, nodes + 1)
    shapes["since"] = nodes + 1
    if update is None:
        shapes["belief"] = N_BELIEF
    else:
        shapes["reading"] = 3
        shapes["speed"] = n
        shapes["fresh"] = 2
        shapes["settings"] = update.size_in("settings")
        shapes["delays"] = 6
    if update is not None or model is not None:
        shapes["theta"] = parameters
    remembered = named_symbols(ca.MX, dict(kept))
    a = named_symbols(ca.MX, shapes) | {NOW + name: value for name, value in remembered.items()}
    next_values: dict[str, Any] = {}
    belief = a.get("belief")
    if update is not None:
        belief, next_values = _estimated(vehicle, a, remembered, update)
    force, torque, wind, scale, air_scale = ca.vertsplit(belief, [0, 3, 6, 9, 10, 11])
    spin = ca.inv(ca.DM(vehicle.inertia_matrix)) @ torque
    disturbance = ca.vertcat(force / vehicle.mass, spin)
    origin = remembered["origin"] + a["period"] * remembered["wind"]

    times = a["times"]
    X_ref = a["X_ref"]
    U_in = a["U_ref"]
    air = remembered["air"]
    attitude = X_ref[ATTITUDE, :]
    rate = X_ref[RATE, :]
    if targets:
        at = range(0, rows, samples)
        inputs = ca.horzsplit(a["U_ref"])
        states = [X_ref[:, i] for i in at]
        ticks = [times[i] for i in at]
        known = [inputs[min(i, rows - 2)] for i in at]
        theta = a["theta"][: model.size1_in(1)] if model is not None else None
        believed = (model, theta, disturbance, wind, air_scale, vehicle)
        moved, changes, forces = held_targets(states, known, ca.vertsplit(air, 6), ticks, *believed)
        air = ca.vertcat(*forces)
        added = []
        for change, following in pairwise(changes):  # linear between nodes
            for i in range(samples):
                added.append(change + (following - change) * (i / samples))
        U_in = U_in + ca.horzcat(*added)
        within = [moved[i // samples] for i in range(rows)]  # between nodes nothing weighs states
        attitude = ca.horzcat(*(m[:4] for m in within))
        rate = ca.horzcat(*(m[4:] for m in within))
    position = X_ref[POSITION, :] - ca.repmat(origin, 1, rows) - wind @ times.T
    X_in = ca.vertcat(position, attitude, X_ref[VELOCITY, :] - ca.repmat(wind, 1, rows), rate)
    x = a["x"]
    change = wind - remembered["wind"]
    x_in = ca.vertcat(x[POSITION] - origin, x[ATTITUDE], x[VELOCITY] - wind, x[RATE])
    next_values["origin"] = origin
    next_values["wind"] = wind
    next_values["air"] = air
    results = {"x_in": x_in, "X_in": X_in, "U_in": U_in, "disturbance": disturbance, "found": belief}
    low = (1 + ROUNDING) * vehicle.thrust_min
    high = (1 - ROUNDING) * vehicle.thrust_max
    results["low"] = scale * low * ca.DM.ones(n)
    results["high"] = scale * high * ca.DM.ones(n)
    moving = ca.vertcat(change @ (a["since"] - a["period"]).T, ca.DM.zeros(4, nodes + 1))
    moving = ca.vertcat(moving, ca.repmat(change, 1, nodes + 1), ca.DM.zeros(width - VELOCITY.stop, nodes + 1))
    results["X_moved"] = ca.if_else(ca.norm_2(change) > MOVED, a["X"] - moving, a["X"])
    results["squares"] = ca.sumsqr(x_in) + ca.sumsqr(X_in) + ca.sumsqr(U_in)
    results |= {NEXT + name: value for name, value in next_values.items()}
    return named_function("believed_world", a, results)


def _estimated(
    vehicle: Vehicle, a: dict[str, ca.MX], kept: dict[str, ca.MX], update: ca.Function
) -> tuple[ca.MX, dict[str, ca.MX]]:
    """The belief (11,) by an estimator, and what is to be remembered of commands and estimates."""
    read, turning = ca.vertsplit(a["fresh"])
    coefficient = vehicle.thrust_coefficient
    speeds = [] if coefficient is None else [coefficient * a["speed"] ** 2, turning]
    now, mean, next_values = delivered_thrust(kept, kept["sent"], a["delays"], *speeds)
    estimate, belief = update(kept["estimate"], a["x"], a["reading"], read, now, mean, a["theta"], a["settings"])
    nothing = ca.DM([0.0] * (N_BELIEF - 2) + [1.0, 1.0])
    flown = ca.fmax(kept["flown"], read)
    next_values["estimate"] = ca.if_else(flown, estimate, kept["estimate"])
    next_values["flown"] = ca.DM.ones(1)
    return ca.if_else(flown, belief, nothing), next_values
