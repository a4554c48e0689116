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

from quadexp.compile.backend import BufferedFunction, realise
from quadexp.compile.symbolic import ca
from quadexp.control.base import Measurement, Window
from quadexp.control.belief import N_BELIEF, Belief, no_belief
from quadexp.control.delivered import Delays, delivered_by_commands
from quadexp.control.instant import Operation, Told, call, copy, move
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.targets import held_targets
from quadexp.models.residual import Residual
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
    estimator: finds the belief in `enter`; without one, set `belief` before. thrust: what the rotors deliver, (n,) (N),
    where somebody else knows it; set it before each `enter`.
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
        self._mpc, settings, self._estimator, self._scale = mpc, mpc.settings, estimator, 1.0
        self.finite = False  # whether what `enter` left is
        self.thrust: np.ndarray | None = None
        model = None
        self._air_scale = mpc.parameters.ravel()[-1:] if mpc.residual.unscaled is not None else None
        if air is not None and targets:
            air = air.unscaled or air
            model = air.to_compile if mpc.backend == "compiled" and air.to_compile is not None else air.function
        mpc.set_disturbance(np.zeros(6))  # refuses a model without one
        sizes = (settings.nodes, settings.samples)
        function = _function(mpc.vehicle, model, estimator, mpc.backend, *sizes, targets, mpc.parameters.size)
        assert mpc.disturbance is not None
        step, _ = mpc.functions
        into = {"disturbance": mpc.disturbance, "low": step.arguments["u_min"], "high": step.arguments["u_max"]}
        in_place = mpc.reference[0].shape[1] == N_STATE  # no thrusts among the states
        into |= dict(zip(("X_in", "U_in"), mpc.reference, strict=True)) if in_place else {}
        self._enter = BufferedFunction(function, {"theta": mpc.parameters}, into)
        self._given = given = self._enter.arguments
        left = self._enter.results
        given["times"][...], given["period"][...] = node_times, settings.control_period
        self._x, self._X_ref, self._U_ref, self._memory = (given[name] for name in ("x", "X_ref", "U_ref", "memory"))
        self._x_in, self._X_in, self._U_in = left["x_in"], left["X_in"], left["U_in"]
        if in_place:
            self._X_in, self._U_in = mpc.reference
        self._next, self._found, self._change = left["memory_next"], left["found"], left["change"]
        self._since = (settings.dead_time + settings.node_times)[:, None]
        self._coefficient = mpc.vehicle.thrust_coefficient
        self._told = [given.get(name, np.empty(0)) for name in ("known", "reading", "measured", "sent")]
        if estimator is not None:
            given["settings"].ravel()[:], given["delays"][...] = estimator.settings, estimator.delays.numbers
            self._layout = Layout(mpc.vehicle, settings.nodes, estimator)
        self.reset(None)

    def retime(self, node_times: np.ndarray) -> None:
        """Use other times of the reference, (k,) (s) from the measurement on, from the next step on."""
        settings = self._mpc.settings
        self._given["times"][...], self._since = node_times, (settings.dead_time + settings.node_times)[:, None]

    def reset(self, begin: np.ndarray | None) -> None:
        """Begin a flight in the world of the model, after the MPC did. begin: first state of the estimator."""
        self.belief = no_belief()
        self._mpc.set_disturbance(np.zeros(6))
        self._memory[...] = self._found[...] = 0.0
        self._found[-2:] = 1.0
        if self._air_scale is not None:
            self._air_scale[:] = 1.0
        self._mpc.set_thrust_scale(1.0)
        self._scale = 1.0
        if self._estimator is None or begin is None:
            return
        given, thrust = self._enter.arguments, self._mpc.prediction[1][0]
        given["known"][...], given["sent"][...], given["measured"][...] = 0.0, thrust, 0.0
        parts = self._layout.slices
        self._memory[parts["commands"]] = np.tile(thrust, self._estimator.delays.pending)
        self._memory[parts["thrust"]], self._memory[parts["estimate"]] = thrust, begin

    def estimate_by(self, settings: np.ndarray, state: np.ndarray) -> None:
        """Other settings of the estimator's update, and its state, from the next step on."""
        self._given["settings"].ravel()[:] = settings
        self._memory[self._layout.slices["estimate"]] = state

    @property
    def estimates(self) -> bool:
        """Whether an estimator finds the belief, and this program's own arrays what it needs."""
        return self._estimator is not None and self.thrust is None

    @property
    def in_place(self) -> bool:
        """Whether `enter` leaves the reference where the MPC's step reads it."""
        return self._X_in is self._mpc.reference[0]

    @property
    def found(self) -> Belief:
        """What the estimator believes since the last step."""
        b = self._found
        return Belief(b[0:3], b[3:6], b[6:9], float(b[9]), float(b[10]))

    @property
    def numbers(self) -> np.ndarray:
        """What is believed, (10,), as `enter` left it: force, torque, wind, thrust scale; the same array always."""
        return self._found

    def enter(self, measurement: Measurement, window: Window) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """State (13,) and the window's states and inputs in the plan's frame; the MPC is told of the rest.

        The arrays are overwritten by the next call.
        """
        self._x[...], self._X_ref[...], self._U_ref[...] = measurement.state, window.state, window.input
        if self._estimator is None:
            told = self._given["belief"]
            told[:3], told[3:6], told[6:9], told[9], told[10] = self.belief
        else:
            _, _, reading, speed = measurement
            known, read, measured, _ = self._told
            if reading is None:
                known[0] = 0.0
            else:
                known[0], read[...] = 1.0, reading
            if self._coefficient is not None:
                known[1] = speed is not None
                if speed is not None:
                    measured[...] = self._coefficient * speed**2
            if self.thrust is not None and (speed is None or self._coefficient is None):
                known[1], measured[...] = 1.0, self.thrust
        self._enter()
        self._mpc.prepared = False  # the disturbance is another
        self._memory[...] = self._next
        self._scale, self.finite = self._found.item(9), math.isfinite(self._change.item(4))
        if self._air_scale is not None:
            self._air_scale[:] = self._found[10:]
        if self._change.item(3) > MOVED:
            self._move(self._change[:3])
        return self._x_in, self._X_in, self._U_in

    def before(self, told: Told) -> tuple[list[Operation], np.ndarray]:
        """`enter` for C, with an estimator; and the array that has the state in the plan's frame then."""
        known, read, measured, _ = self._told
        known[:] = 1.0, told.speed is not None and self._coefficient is not None
        operations = [copy(self._x, told.state), Operation("window", self._X_ref, other=self._U_ref)]
        operations.append(copy(read, told.force))
        if told.speed is not None and self._coefficient is not None:
            operations.append(Operation("square", measured, told.speed, factor=self._coefficient))
        operations += [call(self._enter), Operation("finite", source=self._change)]
        operations += [Operation("below", source=self._change[3:4], factor=MOVED), move(self._memory, self._next)]
        if self._air_scale is not None:
            operations.append(move(self._air_scale, self._found[10:]))
        return operations, self._x_in

    def after(self, thrust: np.ndarray) -> tuple[list[Operation], np.ndarray]:
        """`leave` for C, and the array that has the command then."""
        sent = self._told[3]
        return [Operation("divide", sent, thrust, self._found[9:10])], sent

    def go_on(self, k: int, record: Any) -> None:
        """Go on after operations in C."""
        self._mpc.prepared, self._scale = False, self._found.item(9)

    def leave(self, thrust: np.ndarray) -> np.ndarray:
        """The command, (n,) (N), that delivers a planned thrust."""
        if self._scale != 1.0:
            thrust = thrust / self._scale
        if self._estimator is not None:
            self._told[3][...] = thrust
        return thrust

    def _move(self, change: np.ndarray) -> None:
        """Bring the last solution into a frame that is the faster by `change` (m/s) from now on."""
        X = self._mpc.prediction[0]
        X[:, VELOCITY] -= change
        X[:, POSITION] -= change * (self._since - self._mpc.settings.control_period)


class Layout:
    """Places in the memory, by name: the frame's origin, the wind, `air` of control.mpc.targets at the nodes; with an
    estimator what commands gave, and its state."""

    def __init__(self, vehicle: Vehicle, nodes: int, estimator: Estimator | None) -> None:
        n = vehicle.n_rotors
        sizes = {"origin": 3, "wind": 3, "air": 6 * (nodes + 1)}
        if estimator is not None:
            sizes |= {"commands": n * estimator.delays.pending, "thrust": n, "before": n + 1}
            sizes |= {"estimate": estimator.update.size1_in("s")}
        ends = [*accumulate(sizes.values())]
        self.size = ends[-1]
        self.slices = {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


_built: dict[tuple[Any, ...], ca.Function] = {}


def _function(
    vehicle: Vehicle,
    model: ca.Function | None,
    estimator: Estimator | None,
    backend: str,
    nodes: int,
    samples: int,
    targets: bool,
    parameters: int,
) -> ca.Function:
    """`enter_function` on a resolved back end; built once per process and structure."""
    observed = estimator and (estimator.update.serialize(), estimator.delays.pending)
    key = (vehicle.fingerprint, model and model.serialize(), observed, backend, nodes, samples, targets, parameters)
    if key not in _built:
        function = enter_function(vehicle, model, estimator, nodes, samples, targets=targets, parameters=parameters)
        _built[key] = realise(function, backend)
    return _built[key]


def enter_function(
    vehicle: Vehicle,
    model: ca.Function | None,
    estimator: Estimator | None,
    nodes: int,
    samples: int,
    *,
    targets: bool,
    parameters: int,
) -> ca.Function:
    """What `BelievedWorld.enter` computes, for N = nodes with s = samples of the reference in each.

    Inputs: x (13,); X_ref (13, s N + 1), U_ref (n, s N); times (s N + 1,) of the reference from now, period (s);
    memory, see Layout; belief (11,), or with an estimator: reading (3,), measured (n,), thrusts by rotor speeds (N),
    known (2,), whether these two are, sent (n,), the last command (N), settings, delays (see Delays); theta (p,), where
    the model or the estimator has parameters.
    Outputs: x_in, X_in, U_in: the same in the plan's frame; disturbance (6,); low, high (n,), limits of delivered
    thrusts (N); found (11,), the belief; change (5,): of
    the wind, its size (m/s), and the sum of the squares of x_in, X_in and U_in; memory_next.
    """
    n, rows, layout = vehicle.n_rotors, samples * nodes + 1, Layout(vehicle, nodes, estimator)
    shapes = {"x": (N_STATE, 1), "X_ref": (N_STATE, rows), "U_ref": (n, rows - 1), "times": (rows, 1)}
    shapes |= {"period": (1, 1), "memory": (layout.size, 1)}
    if estimator is None:
        shapes |= {"belief": (N_BELIEF, 1)}
    else:
        update = estimator.update
        shapes |= {"reading": (3, 1), "measured": (n, 1), "known": (2, 1), "sent": (n, 1)}
        shapes |= {"settings": update.size_in("settings"), "delays": (len(estimator.delays.numbers), 1)}
    shapes |= {"theta": (parameters, 1)} if estimator is not None or model is not None else {}
    a = {name: ca.MX.sym(name, *shape) for name, shape in shapes.items()}
    kept = {name: a["memory"][place] for name, place in layout.slices.items()}
    left: dict[str, Any] = {}
    found = a.get("belief")
    if estimator is not None:
        found, left = _estimated(a, kept, estimator, n)
    force, torque, wind, scale, air_scale = ca.vertsplit(found, [0, 3, 6, 9, 10, 11])
    spin = ca.mtimes(ca.inv(ca.DM(vehicle.inertia_matrix)), torque)
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
    position = X_ref[POSITION, :] - ca.repmat(origin, 1, rows) - ca.mtimes(wind, times.T)
    X_in = ca.vertcat(position, attitude, X_ref[VELOCITY, :] - ca.repmat(wind, 1, rows), rate)
    x, change = a["x"], wind - kept["wind"]
    x_in = ca.vertcat(x[POSITION] - origin, x[ATTITUDE], x[VELOCITY] - wind, x[RATE])
    memory = {"origin": origin, "wind": wind, "air": air} | left
    results = {"x_in": x_in, "X_in": X_in, "U_in": U_in, "disturbance": disturbance, "found": found}
    low, high = (1 + ROUNDING) * vehicle.thrust_min, (1 - ROUNDING) * vehicle.thrust_max
    results |= {"low": scale * low * ca.DM.ones(n), "high": scale * high * ca.DM.ones(n)}
    squares = ca.sumsqr(x_in) + ca.sumsqr(X_in) + ca.sumsqr(U_in)
    results |= {"change": ca.vertcat(change, ca.norm_2(change), squares)}
    results |= {"memory_next": ca.vertcat(*(memory[name] for name in layout.slices))}
    return ca.Function("believed_world", [*a.values()], [*results.values()], [*a], [*results])


def _estimated(
    a: dict[str, ca.MX], kept: dict[str, ca.MX], estimator: Estimator, n: int
) -> tuple[ca.MX, dict[str, ca.MX]]:
    """The belief (11,) by an estimator, and what is to be remembered of commands and estimates."""
    read, turning = a["known"][0], a["known"][1]
    commands, thrust, mean = delivered_by_commands(
        ca.reshape(kept["commands"], n, estimator.delays.pending), kept["thrust"], a["sent"], a["delays"]
    )
    before, had = kept["before"][:n], kept["before"][n]
    lags = a["delays"][-1]
    now = turning * a["measured"] + (1 - turning) * thrust
    share = turning * had * lags / 2  # of the thrusts a period ago
    mean = turning * (share * before + (1 - share) * a["measured"]) + (1 - turning) * mean
    given = [kept["estimate"], a["x"], a["reading"], now, mean, a["theta"], a["settings"]]
    estimate, belief = estimator.update(*given)
    nothing = ca.DM([0.0] * (N_BELIEF - 2) + [1.0, 1.0])
    left = {"commands": ca.vec(commands), "thrust": thrust, "before": ca.vertcat(a["measured"], turning)}
    left |= {"estimate": ca.if_else(read, estimate, kept["estimate"])}  # without a reading, `reading` is an old one
    return ca.if_else(read, belief, nothing), left
