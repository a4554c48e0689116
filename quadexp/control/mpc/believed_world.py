"""Planning in the world that an observer believes in (control.belief).

    disturbance   F / m and J^-1 tau are parameters of the prediction model
    wind          the plan is made in the frame that moves with the air from now on: v - w, p*(t) - w t. In a constant
                  wind the equations of motion there are those of still air, so that nothing changes in the model.
    thrust scale  the inputs of the plan are the thrusts that are delivered, s u, within s times the limits
    targets       attitudes and thrusts of the reference are made anew (control.mpc.targets), where that is asked for

The last solution is kept in the air's frame: when the wind is believed to be another, or a control period has passed,
it is moved into the new one. All of it is one function a control step.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from quadexp.air.base import Residual
from quadexp.compile.backend import BufferedFunction, realise
from quadexp.control.base import Window
from quadexp.control.belief import no_belief
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.targets import held_targets
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle


class BelievedWorld:
    """From the world to the plan's frame and back.

    mpc: made with disturbed=True. node_times: of the reference, from the measurement on, (k,) (s). targets: whether
    they are made anew. air: the model that references are made with; None: without.
    belief: the one to enter with; set it before each step.
    """

    def __init__(
        self, mpc: ModelPredictiveController, node_times: np.ndarray, *, targets: bool, air: Residual | None
    ) -> None:
        self._mpc, settings = mpc, mpc.settings
        sizes = (settings.nodes, settings.samples, mpc.prediction[0].shape[1])
        function = _function(mpc.vehicle, air, mpc.backend, *sizes, targets)
        self._enter = BufferedFunction(function, {"X": mpc.prediction[0], "theta": mpc.parameters})
        given = self._enter.arguments
        given["times"][...], given["period"][...] = node_times, settings.control_period
        self._belief, self._wind, self._air = given["belief"], given["last_wind"], given["air"]
        self._scale = 1.0
        self.reset()

    def retime(self, node_times: np.ndarray) -> None:
        """Use other times of the reference, (k,) (s) from the measurement on, from the next step on."""
        self._enter.arguments["times"][...] = node_times

    def reset(self) -> None:
        """Begin a flight in the world of the model."""
        self.belief = no_belief()
        self._wind[...] = self._air[...] = 0.0
        self._mpc.set_disturbance(np.zeros(6))
        self._rescale(1.0)

    def enter(self, x: np.ndarray, window: Window) -> tuple[np.ndarray, Window]:
        """State (13,) and window in the plan's frame; the MPC is told of the rest."""
        given, left, told = self._enter.arguments, self._enter.results, self._belief
        told[:3], told[3:6], told[6:], scale = self.belief
        given["x"][...], given["X_ref"][...], given["U_ref"][...] = x, window.state, window.input
        self._enter()
        self._mpc.set_disturbance(left["disturbance"])
        self._mpc.prediction[0][...] = left["X_moved"]
        self._wind[...], self._air[...] = told[6:], left["air_next"]
        self._rescale(scale)
        return left["x_in"].copy(), window._replace(state=left["X_in"], input=left["U_in"])

    def _rescale(self, scale: float) -> None:
        if scale != self._scale:
            self._mpc.set_thrust_scale(scale)
            self._scale = scale

    def commanded(self, thrust: np.ndarray) -> np.ndarray:
        """The command, (n,) (N), that delivers a planned thrust."""
        if self._scale == 1.0:
            return thrust
        vehicle = self._mpc.vehicle
        return np.clip(thrust / self._scale, vehicle.thrust_min, vehicle.thrust_max)


_built: dict[tuple[Any, ...], ca.Function] = {}


def _function(
    vehicle: Vehicle, air: Residual | None, backend: str, nodes: int, samples: int, states: int, targets: bool
) -> ca.Function:
    """`enter_function` on a resolved back end; built once per process and structure."""
    model = None
    if air is not None and targets:
        model = air.to_compile if backend == "compiled" and air.to_compile is not None else air.function
    key = (vehicle.fingerprint, model and model.serialize(), backend, nodes, samples, states, targets)
    if key not in _built:
        function = enter_function(vehicle, model, nodes, samples, states, targets=targets)
        _built[key] = realise(function, backend)
    return _built[key]


def enter_function(
    vehicle: Vehicle, model: ca.Function | None, nodes: int, samples: int, states: int, *, targets: bool
) -> ca.Function:
    """What `BelievedWorld.enter` computes, for N = nodes with s = samples of the reference in each.

    Inputs: x (13,); X_ref (13, s N + 1), U_ref (n, s N); belief (9,): force, torque, wind; last_wind (3,);
    X (m, N + 1), m = states, the last solution; times (s N + 1,) of the reference from now, period (s); air (3, N + 1),
    left by the last call; theta (p,), where the references contain a model of the air and targets are made anew.
    Outputs: x_in, X_in, U_in, X_moved: the same in the plan's frame; disturbance (6,); air_next.
    """
    n, rows = vehicle.n_rotors, samples * nodes + 1
    shapes = {"x": (N_STATE, 1), "X_ref": (N_STATE, rows), "U_ref": (n, rows - 1), "belief": (9, 1)}
    shapes |= {"last_wind": (3, 1), "X": (states, nodes + 1), "times": (rows, 1), "period": (1, 1)}
    shapes |= {"air": (3, nodes + 1)} | ({"theta": (model.size1_in(1), 1)} if model is not None else {})
    a = {name: ca.MX.sym(name, *shape) for name, shape in shapes.items()}
    force, torque, wind = ca.vertsplit(a["belief"], 3)
    spin = ca.mtimes(ca.inv(ca.DM(vehicle.inertia_matrix)), torque)
    disturbance = ca.vertcat(force / vehicle.mass, spin)
    times, X_ref, U_in, air = a["times"], a["X_ref"], a["U_ref"], a["air"]
    attitude, rate = X_ref[ATTITUDE, :], X_ref[RATE, :]
    if targets:
        at, inputs = range(0, rows, samples), ca.horzsplit(a["U_ref"])
        known = [inputs[min(i, rows - 2)] for i in at]
        model_of = (model, a.get("theta"), disturbance, wind, vehicle)
        states_at, ticks = [X_ref[:, i] for i in at], [times[i] for i in at]
        moved, changes, forces = held_targets(states_at, known, ca.horzsplit(air), ticks, *model_of)
        air = ca.horzcat(*forces)
        if samples == 1:
            U_in = U_in + ca.horzcat(*changes[:-1])
        else:  # between nodes the changes go from one to the next
            steps = [(c, d - c) for c, d in zip(changes, changes[1:], strict=False)]
            U_in = U_in + ca.horzcat(*(c + d * (i / samples) for c, d in steps for i in range(samples)))
        within = [moved[i // samples] for i in range(rows)]  # between nodes nothing weighs states
        attitude, rate = ca.horzcat(*(m[:4] for m in within)), ca.horzcat(*(m[4:] for m in within))
    X_in = ca.vertcat(
        X_ref[POSITION, :] - ca.mtimes(wind, times.T), attitude, X_ref[VELOCITY, :] - ca.repmat(wind, 1, rows), rate
    )
    x, X = a["x"], a["X"]
    x_in = ca.vertcat(x[:7], x[VELOCITY] - wind, x[RATE])
    # The last solution's frame met the world one control period ago, the new one does so now.
    change, since = wind - a["last_wind"], times[::samples]
    position = X[POSITION, :] + ca.repmat(a["period"] * wind, 1, nodes + 1) - ca.mtimes(change, since.T)
    velocity = X[VELOCITY, :] - ca.repmat(change, 1, nodes + 1)
    X_moved = ca.vertcat(position, X[ATTITUDE, :], velocity, X[VELOCITY.stop :, :])
    results = {"x_in": x_in, "X_in": X_in, "U_in": U_in, "X_moved": X_moved}
    results |= {"disturbance": disturbance, "air_next": air}
    return ca.Function("believed_world", [*a.values()], [*results.values()], [*a], [*results])
