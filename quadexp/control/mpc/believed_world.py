"""Planning in the world that an observer believes in (control.belief): what a control step does before the plan.

    estimate      an observer's update (control.observers), where the controller has one; otherwise the belief is given
    disturbance   F / m and J^-1 tau are parameters of the prediction model
    wind          the plan is made in a frame that moves with the air: v - w, p - o, and p*(t) - o - w t over the
                  horizon, with o' = w. In a constant wind the equations of motion there are those of still air, so that
                  nothing changes in the model. Where the wind is believed to be another, the last solution is moved.
    thrust scale  the inputs of the plan are the thrusts that are delivered, s u, within s times the limits
    targets       attitudes and thrusts of the reference are made anew (control.mpc.targets), where that is asked for

All of it is one function a control step. What it remembers until the next one is one array.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.base import N_BELIEF, no_belief
from quadexp.control.built import built
from quadexp.control.delivered import Delays, delivered_thrust
from quadexp.control.instant import YES, Operation, Told, call, copy, move
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.targets import held_targets
from quadexp.models.residual import Residual
from quadexp.names import named
from quadexp.physics.expression import named_function, named_symbols
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

ROUNDING = 1e-15  # of a limit: a delivered thrust at it gives a command within the rotor's, however it is rounded
MOVED = 0.5  # m/s: with a smaller change of the wind the last solution is a good guess as it is


@dataclass(frozen=True)
class Estimator:
    """An observer for a BelievedWorld: its update with settings (control.observers.observer), and what it is told of
    the commands' delays."""

    update: ca.Function
    settings: np.ndarray
    delays: Delays


class BelievedWorld:
    """From the world to the plan's frame and back.

    mpc: made with disturbed=True. node_times: of the reference, from the measurement on, (k,) (s). targets: whether
    they are made anew. air: the model that references are made with; None: without.
    estimator: finds the belief; without one, it is `told`, (11,). numbers: what is believed since the last step, (11,).
    thrust: an array with what the rotors deliver, (n,) (N), where somebody else knows it. seen: an array with the state
    (13,) at the time of the readings, where that is not now. rows: of the horizon that it is told, an array with those
    that are the MPC's; None: all.
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
        self._mpc, settings, self._estimator = mpc, mpc.settings, estimator
        self.thrust: np.ndarray | None = None
        self.seen: np.ndarray | None = None
        self.rows: np.ndarray | None = None
        model = None
        self._air_scale = mpc.parameters.ravel()[-1:] if mpc.residual.unscaled is not None else None
        if air is not None and targets:
            model = (air.unscaled or air).form(mpc.backend == "compiled")
        mpc.set_disturbance(np.zeros(6))  # refuses a model without one
        pending = None if estimator is None else estimator.delays.pending
        solution = mpc.prediction[0]
        form = {"targets": targets, "parameters": mpc.parameters.size, "width": solution.shape[1], "delays": pending}
        sizes = settings.nodes, settings.samples
        observe = estimator and estimator.update
        function = built(mpc.backend, enter_function, mpc.vehicle, model, observe, *sizes, **form)
        assert mpc.disturbance is not None
        low, high = mpc.limits
        into = {"disturbance": mpc.disturbance, "low": low, "high": high}
        self._in_place = mpc.reference[0].shape[1] == N_STATE  # no thrusts among the states
        into |= named(("X_in", "U_in"), mpc.reference) if self._in_place else {}
        self._enter = BufferedFunction(function, {"theta": mpc.parameters, "X": solution}, into)
        self._given, self._left = self._enter.arguments, self._enter.results
        given = self._given
        given["times"][...], given["period"][...] = node_times, settings.control_period
        self._memory, self.numbers = given["memory"], self._left["found"]
        given["since"][...] = settings.dead_time + settings.node_times
        self._coefficient = mpc.vehicle.thrust_coefficient
        self._sent = given.get("sent", np.zeros(mpc.vehicle.n_rotors))
        if estimator is not None:
            given["settings"].ravel()[:], given["delays"][...] = estimator.settings, estimator.delays.numbers
            self._layout = Layout(mpc.vehicle, settings.nodes, observe, pending)
        self.reset(None)

    @property
    def told(self) -> np.ndarray:
        """The belief for the next step, (11,), where no estimator finds it."""
        return self._given["belief"]

    def retime(self, node_times: np.ndarray) -> None:
        """Use other times of the reference, (k,) (s) from the measurement on, from the next step on."""
        settings = self._mpc.settings
        self._given["times"][...], self._given["since"][...] = node_times, settings.dead_time + settings.node_times

    def reset(self, begin: np.ndarray | None) -> None:
        """Begin a flight in the world of the model, after the MPC did. begin: first state of the estimator."""
        self._mpc.set_disturbance(np.zeros(6))
        self._memory[...], self.numbers[...] = 0.0, np.hstack([*no_belief()])
        if self._estimator is None:
            self.told[...] = self.numbers
        if self._air_scale is not None:
            self._air_scale[:] = 1.0
        self._mpc.set_thrust_scale(1.0)
        if self._estimator is None or begin is None:
            return
        given, thrust = self._enter.arguments, self._mpc.prediction[1][0]
        given["known"][...], given["sent"][...], given["measured"][...] = 0.0, thrust, 0.0
        parts = self._layout.slices
        self._memory[parts["commands"]] = np.tile(thrust, self._estimator.delays.pending)
        self._memory[parts["thrust"]], self._memory[parts["estimate"]] = thrust, begin

    @property
    def estimate(self) -> np.ndarray:
        """The state of the estimator, which may be changed between two steps."""
        return self._memory[self._layout.slices["estimate"]]

    @property
    def settings(self) -> np.ndarray:
        """The numbers of the estimator's update, likewise."""
        return self._given["settings"]

    def before(self, told: Told, state: np.ndarray) -> tuple[list[Operation], np.ndarray]:
        """What stands before the plan: it leaves the reference in the plan's frame where the MPC reads it, and the
        state (13,) in the array that is returned; the MPC is told of the rest."""
        given, left, (X, U) = self._given, self._left, self._mpc.reference
        operations = [copy(given["x"], state), Operation("window", given["X_ref"], self.rows, given["U_ref"])]
        if self._estimator is not None:
            operations += [copy(given["known"][:1], told.read), copy(given["reading"], told.force)]
            operations.append(copy(given["seen"], state if self.seen is None else self.seen))
            if self.thrust is not None:
                operations += [copy(given["known"][1:], YES), copy(given["measured"], self.thrust)]
            elif self._coefficient is not None:
                operations.append(copy(given["known"][1:], told.turning))
            if self._coefficient is not None:
                measured = Operation("square", given["measured"], told.speed, factor=self._coefficient)
                operations.append(measured._replace(when=told.turning))
        operations += [call(self._enter), Operation("finite", source=left["squares"])]
        operations.append(move(self._mpc.prediction[0], left["X_moved"], left["moved"]))
        operations.append(move(self._memory, left["memory_next"]))
        if self._air_scale is not None:
            operations.append(move(self._air_scale, self.numbers[10:]))
        if not self._in_place:
            operations += [copy(X[:, :N_STATE], left["X_in"]), copy(U, left["U_in"])]
        return operations, left["x_in"]

    def after(self, thrust: np.ndarray) -> tuple[list[Operation], np.ndarray]:
        """The command that delivers a planned thrust, (n,) (N), and the array that has it then."""
        return [Operation("divide", self._sent, thrust, self.numbers[9:10])], self._sent

    @property
    def finite(self) -> bool:
        """Whether what `before` left is."""
        return math.isfinite(self._left["squares"].item())


class Layout:
    """Places in the memory, by name: the frame's origin, the wind, `air` of control.mpc.targets at the nodes; with an
    estimator what commands gave, and its state."""

    def __init__(self, vehicle: Vehicle, nodes: int, update: ca.Function | None, pending: int | None) -> None:
        n = vehicle.n_rotors
        sizes = {"origin": 3, "wind": 3, "air": 6 * (nodes + 1)}
        if update is not None and pending is not None:
            sizes |= {
                "commands": n * pending,
                "thrust": n,
                "before": n + 1,
                "flown": 1,
                "estimate": update.size1_in("s"),
            }
        ends = [*accumulate(sizes.values())]
        self.size = ends[-1]
        self.slices = {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


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
    delays: int | None = None,
) -> ca.Function:
    """What a BelievedWorld computes before the plan, for N = nodes with s = samples of the reference in each;
    update: of an estimator, which knows of `delays` pending commands.

    Inputs: x (13,); X_ref (13, s N + 1), U_ref (n, s N); times (s N + 1,) of the reference from now, period (s);
    X (width, N + 1), the last solution, and times `since` of its nodes from now (N + 1,) (s);
    memory, see Layout; belief (11,), or with an estimator: reading (3,), measured (n,), thrusts by rotor speeds (N),
    known (2,), whether these two are, seen (13,), the state then, sent (n,), the last command (N), settings, delays
    (see Delays); theta (p,), where the model or the estimator has parameters.
    Outputs: x_in, X_in, U_in: the same in the plan's frame; disturbance (6,); low, high (n,), limits of delivered
    thrusts (N); found (11,), the belief; X_moved: the last
    solution in a frame that is the faster by the change of the wind from now on, and `moved`, whether that is large;
    squares: the sum of those of x_in, X_in and U_in; memory_next.
    """
    n, rows, layout = vehicle.n_rotors, samples * nodes + 1, Layout(vehicle, nodes, update, delays)
    shapes = {"x": N_STATE, "X_ref": (N_STATE, rows), "U_ref": (n, rows - 1), "times": rows}
    shapes |= {"period": 1, "memory": layout.size, "X": (width, nodes + 1), "since": nodes + 1}
    if update is None:
        shapes |= {"belief": N_BELIEF}
    else:
        shapes |= {"reading": 3, "measured": n, "known": 2, "seen": N_STATE, "sent": n}
        shapes |= {"settings": update.size_in("settings"), "delays": 6}
    shapes |= {"theta": parameters} if update is not None or model is not None else {}
    a = named_symbols(ca.MX, shapes)
    kept = {name: a["memory"][place] for name, place in layout.slices.items()}
    left: dict[str, Any] = {}
    found = a.get("belief")
    if update is not None and delays is not None:
        found, left = _estimated(a, kept, update)
    force, torque, wind, scale, air_scale = ca.vertsplit(found, [0, 3, 6, 9, 10, 11])
    spin = ca.inv(ca.DM(vehicle.inertia_matrix)) @ torque
    disturbance = ca.vertcat(force / vehicle.mass, spin)
    origin = kept["origin"] + a["period"] * kept["wind"]

    times, X_ref, U_in, air = a["times"], a["X_ref"], a["U_ref"], kept["air"]
    attitude, rate = X_ref[ATTITUDE, :], X_ref[RATE, :]
    if targets:
        at, inputs = range(0, rows, samples), ca.horzsplit(a["U_ref"])
        states, ticks = [X_ref[:, i] for i in at], [times[i] for i in at]
        known = [inputs[min(i, rows - 2)] for i in at]
        theta = a["theta"][: model.size1_in(1)] if model is not None else None
        believed = (model, theta, disturbance, wind, air_scale, vehicle)
        moved, changes, forces = held_targets(states, known, ca.vertsplit(air, 6), ticks, *believed)
        air = ca.vertcat(*forces)
        steps = [(c, d - c) for c, d in zip(changes, changes[1:], strict=False)]  # between nodes: from one to the next
        U_in = U_in + ca.horzcat(*(c + d * (i / samples) for c, d in steps for i in range(samples)))
        within = [moved[i // samples] for i in range(rows)]  # between nodes nothing weighs states
        attitude, rate = ca.horzcat(*(m[:4] for m in within)), ca.horzcat(*(m[4:] for m in within))
    position = X_ref[POSITION, :] - ca.repmat(origin, 1, rows) - wind @ times.T
    X_in = ca.vertcat(position, attitude, X_ref[VELOCITY, :] - ca.repmat(wind, 1, rows), rate)
    x, change = a["x"], wind - kept["wind"]
    x_in = ca.vertcat(x[POSITION] - origin, x[ATTITUDE], x[VELOCITY] - wind, x[RATE])
    memory = {"origin": origin, "wind": wind, "air": air} | left
    results = {"x_in": x_in, "X_in": X_in, "U_in": U_in, "disturbance": disturbance, "found": found}
    low, high = (1 + ROUNDING) * vehicle.thrust_min, (1 - ROUNDING) * vehicle.thrust_max
    results |= {"low": scale * low * ca.DM.ones(n), "high": scale * high * ca.DM.ones(n)}
    squares = ca.sumsqr(x_in) + ca.sumsqr(X_in) + ca.sumsqr(U_in)
    moving = ca.vertcat(change @ (a["since"] - a["period"]).T, ca.DM.zeros(4, nodes + 1))
    moving = ca.vertcat(moving, ca.repmat(change, 1, nodes + 1), ca.DM.zeros(width - VELOCITY.stop, nodes + 1))
    results |= {"X_moved": a["X"] - moving, "moved": ca.norm_2(change) > MOVED, "squares": squares}
    results |= {"memory_next": ca.vertcat(*(memory[name] for name in layout.slices))}
    return named_function("believed_world", a, results)


def _estimated(a: dict[str, ca.MX], kept: dict[str, ca.MX], update: ca.Function) -> tuple[ca.MX, dict[str, ca.MX]]:
    """The belief (11,) by an estimator, and what is to be remembered of commands and estimates."""
    read, turning = a["known"][0], a["known"][1]
    now, mean, left = delivered_thrust(kept, a["sent"], a["delays"], a["measured"], turning)
    given = [kept["estimate"], a["seen"], a["reading"], read, now, mean, a["theta"], a["settings"]]
    estimate, belief = update(*given)
    nothing, flown = ca.DM([0.0] * (N_BELIEF - 2) + [1.0, 1.0]), ca.fmax(kept["flown"], read)
    left |= {"estimate": ca.if_else(flown, estimate, kept["estimate"]), "flown": ca.DM.ones(1)}
    return ca.if_else(flown, belief, nothing), left
