"""L1 adaptive augmentation (Hanover, Foehn, Sun, Kaufmann, Scaramuzza 2022; Wu et al. 2023) of any controller.

A predictor of velocity and body rate knows the controller's model and the thrusts that its commands, as clipped, give
through the motors' known lag. What it misses is taken for a disturbance; the part that rotors can cancel, force along
the thrust axis and torque, is subtracted from the controller's command through a low pass. s: disturbance, world force
s_F (N) and body torque s_tau (N m); z~: prediction minus measurement; T the control period; a_v, a_w: poles.

    v~_k = e^{-a_v T} v~_{k-1} + T (f_v + g) + (1 - e^{-a_v T})/a_v s_F/m - (v_k - v_{k-1})                         (1)
    w~_k = e^{-a_w T} w~_{k-1} + T f_w + (1 - e^{-a_w T})/a_w J^-1 s_tau - (w_k - w_{k-1})
    s_F <- -m c(a_v) v~_k,    s_tau <- -J c(a_w) w~_k,    c(a) = a e^{-a T}/(1 - e^{-a T})                          (2)
    y_k = e^{-w_co T} y_{k-1} + (1 - e^{-w_co T}) [R^T s_F; s_tau],    u = u_b - G^+ [y_z; y_tau]                   (3)

f_v = R (T e_z/m + a_air), f_w = J^-1 (tau + tau_air - w x J w): means of their values at both ends of the period, with
the mean of the delivered thrusts over it. This is the exact hold of the continuous law: whatever the pole, s_k is
a T/(e^{a T} - 1) times the mean disturbance of the last period (dead beat), so that w_co alone shapes the response.

The thrusts are those of the commands, not c_t W^2 of measured rotor speeds: a motor that gives less than it was told is
a matched disturbance too. Where u leaves the limits, allocation.py decides. World ENU, body FLU, SI.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction, realise_together, resolve
from quadexp.compile.symbolic import ca
from quadexp.control.allocation import prioritised
from quadexp.control.base import Controller, Window, no_belief
from quadexp.control.instant import YES, Instant, Operation, Told, believing, call, copy, instant_of, move
from quadexp.control.mpc.online_mpc import AdaptingController, IdentifyingController
from quadexp.control.observers.observer import air_of, known_delay, parameters_of
from quadexp.control.part import Remedy
from quadexp.control.wrapped import WrappedController, thrust_at_start
from quadexp.errors import UsageError
from quadexp.models.residual import N_OUTPUTS, Residual
from quadexp.names import named
from quadexp.parts.settings import Settings, key, keyed, part
from quadexp.physics.expression import Expression, limited, named_function, named_symbols, symbols
from quadexp.physics.rigid_body import features_function
from quadexp.physics.rotation import along_z, rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

ERROR, DISTURBANCE, FILTERED = slice(0, 6), slice(6, 12), slice(12, 18)  # of the memory: z~; s_F, s_tau; y
LOGGED = ("l1_force_x", "l1_force_y", "l1_force_z", "l1_torque_x", "l1_torque_y", "l1_torque_z")


@keyed
class L1Keys(Settings):
    """Predictor, low pass and limits of L1 adaptive augmentation; see quadexp/control/l1.py."""

    prefix = "adaptive."

    velocity_pole: float = key(
        1.0, "a_v: decay of the predicted velocity's error", "(0, 1000]", "1/s", tuned="0.3..30:log"
    )
    rate_pole: float = key(
        1.0, "a_w: decay of the predicted body rate's error", "(0, 1000]", "1/s", tuned="0.3..30:log"
    )
    bandwidth: float = key(
        10.0, "w_co; with motors that lag by tau at most a third of 1/tau", "(0, 1000]", "rad/s", tuned="1..60:log"
    )
    force_limit: float = key(1.0, "largest thrust that is added or taken away", "[0, 10]", "of the weight")
    torque_limit: float = key(
        50.0, "largest angular acceleration that is added about each body axis", "[0, 1e4]", "rad/s^2"
    )
    motor_lag: float | None = key(
        None, "time constant of the rotors in the predictor; null: what the controller knows", "[0, 0.5]", "s"
    )
    dead_time: float | None = key(
        None, "delay of the commands in the predictor; null: what the controller knows", "[0, 0.5]", "s"
    )
    unmatched: bool = key(
        False, "tell the controller the lateral force, which rotors cannot cancel, through the same low pass"
    )


class L1Controller(WrappedController):
    """L1 around a controller, with its model of the air. lag, dead_time: of its commands (s)."""

    def __init__(self, inner: Controller, keys: L1Keys, lag: float = 0.0, dead_time: float = 0.0) -> None:
        super().__init__(inner)
        self.keys, vehicle, period, air = keys, self.vehicle, self.control_period, air_of(inner)
        known = None if air.is_zero else air
        functions = l1_functions(vehicle, keys, period, known, lag, compiled=resolve(self.backend) == "compiled")
        estimate, add = realise_together(functions, self.backend)
        shared = {} if known is None else {"theta": parameters_of(inner)}
        self._estimate, self._add = BufferedFunction(estimate, shared), BufferedFunction(add)
        steps = math.ceil(dead_time / period - 1e-9)
        self._old = steps - dead_time / period  # share of a period in which the older of two commands acts
        self._sent = np.zeros((steps + 1, vehicle.n_rotors))  # commands, the latest last
        self._begun = np.zeros(1)

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        start = thrust_at_start(window, self.vehicle)
        self._sent[...] = start
        arguments = [array for name, array in self._estimate.arguments.items() if name != "theta"]
        for array in (*arguments, *self._estimate.results.values()):
            array[...] = 0.0
        self._estimate.results["rotors_next"][...] = start
        self._begun[0] = 0.0

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        belief = np.hstack([*no_belief()])
        believe = believing(self.inner, belief) if self.keys.unmatched else []
        inner = instant_of(self.inner, told, state)
        given, found, add, begun = self._estimate.arguments, self._estimate.results, self._add.arguments, self._begun
        operations = [copy(given["x"], state), move(given["memory"], found["memory_next"], begun)]
        operations.append(move(given["rotors"], found["rotors_next"], begun))
        if len(self._sent) == 1:
            operations.append(copy(given["acting"], self._sent[0]))
        else:
            operations.append(Operation("mix", given["acting"], self._sent[1], self._sent[0], factor=self._old))
        operations += [move(array, array) for array in found.values()]  # what the call leaves is remembered too
        operations += [call(self._estimate, begun), move(given["x_last"], state), move(begun, YES)]
        operations += [copy(belief[:3], found["lateral"]), *believe, *inner.operations]
        operations.append(copy(add["base"], inner.command))
        operations.append(copy(add["filtered"], found["memory_next"][FILTERED]))
        u, flat = self._add.results["u"], self._sent.reshape(-1)
        operations += [call(self._add), copy(flat[: -len(u)], flat[len(u) :]), copy(self._sent[-1], u)]
        return inner._replace(operations=operations, command=u, logged=(*inner.logged, found["body"]))

    def log(self) -> dict[str, float]:
        """See Controller.log; the estimated force along body axes (N) and torque (N m), before the low pass."""
        return self.inner.log() | named(LOGGED, self._estimate.results["body"].tolist())


def l1_functions(
    vehicle: Vehicle, keys: L1Keys, period: float, residual: Residual | None, lag: float, *, compiled: bool
) -> tuple[ca.Function, ca.Function]:
    """Equations (1), (2) and the low pass of (3); and the sum of (3) within the limits.

    First: x, x_last (13,), acting: mean command over the last period (n,), rotors: thrusts at its start (n,), memory
    (18,), theta -> memory_next, rotors_next, body: R^T s_F and s_tau (6,), lateral: the filtered force across the
    thrust axis, world (3,). Second: base (n,), filtered: y (6,) -> u (n,).
    """
    n = vehicle.n_rotors
    sizes = {"x": N_STATE, "x_last": N_STATE, "acting": n, "rotors": n, "memory": 18}
    inputs = named_symbols(ca.MX, sizes)
    decay = math.exp(-period / lag) if lag else 0.0
    rotors_next = inputs["acting"] + decay * (inputs["rotors"] - inputs["acting"])
    mean = inputs["acting"] + lag / period * (1 - decay) * (inputs["rotors"] - inputs["acting"])
    air = [ca.DM.zeros(N_OUTPUTS)] * 2
    if residual is not None:
        model = residual.form(compiled)
        inputs["theta"] = ca.MX.sym("theta", model.size1_in(1))
        features = features_function(vehicle)
        air = [model(features(inputs[name], mean), inputs["theta"])[0] for name in ("x", "x_last")]
    predictor = _predictor(vehicle, keys, period)
    results = predictor(inputs["x"], inputs["x_last"], mean, inputs["memory"], *map(ca.densify, air))
    outputs = named(("memory_next", "body", "lateral"), results) | {"rotors_next": rotors_next}
    estimate = named_function("l1_estimate", inputs, outputs)
    base, y = symbols(ca.SX, base=n, filtered=6)
    u = added(vehicle, base, -y[2:])
    return estimate, ca.Function("l1_add", [base, y], [ca.cse(u)], ["base", "filtered"], ["u"])


def added(vehicle: Vehicle, base: Expression, wrench: Expression) -> Expression:
    """Commands, (n,) (N), that add a wrench [T; tau], (4,), to others, (n,), by priority where that exceeds a limit."""
    u = base + ca.DM(np.linalg.pinv(vehicle.allocation)) @ wrench
    within = ca.logic_and(ca.mmin(u) >= vehicle.thrust_min, ca.mmax(u) <= vehicle.thrust_max)
    return ca.if_else(within, u, prioritised(vehicle, vehicle.allocation @ u))


def _predictor(vehicle: Vehicle, keys: L1Keys, period: float) -> ca.Function:
    """(x, x_last, thrusts, memory, air, air_last) -> memory_next, body, lateral; see l1_functions."""
    m, J = vehicle.mass, ca.DM(vehicle.inertia_matrix)
    x, x_last, thrust, memory, air, air_last = symbols(
        ca.SX, x=N_STATE, x_last=N_STATE, thrust=vehicle.n_rotors, memory=18, air=N_OUTPUTS, air_last=N_OUTPUTS
    )
    wrench = vehicle.allocation @ thrust

    def known(state: Expression, y: Expression) -> Expression:
        R, w = rotation_matrix(state[ATTITUDE]), state[RATE]
        linear = R @ (along_z(wrench[0] / m) + y[:3]) + ca.DM([0, 0, -vehicle.gravity])
        return ca.vertcat(linear, ca.inv(J) @ (wrench[1:] + y[3:] - ca.cross(w, J @ w)))

    moved = ca.vertcat(x[VELOCITY] - x_last[VELOCITY], x[RATE] - x_last[RATE])
    poles = np.repeat([keys.velocity_pole, keys.rate_pole], 3)
    decay = np.exp(-poles * period)
    reach, gain = (1 - decay) / poles, poles * decay / (1 - decay)
    s_F, s_tau = ca.vertsplit(memory[DISTURBANCE], 3)
    believed = ca.vertcat(s_F / m, ca.inv(J) @ s_tau)
    error = ca.DM(decay) * memory[ERROR] + period / 2 * (known(x, air) + known(x_last, air_last))
    error += ca.DM(reach) * believed - moved
    estimate = -ca.DM(gain) * error
    s_F, s_tau = m * estimate[:3], J @ estimate[3:]
    R = rotation_matrix(x[ATTITUDE])
    body = ca.vertcat(R.T @ s_F, s_tau)
    stays = math.exp(-keys.bandwidth * period)
    filtered = stays * memory[FILTERED] + (1 - stays) * body
    force = keys.force_limit * m * vehicle.gravity
    bound = ca.vertcat(force, force, force, keys.torque_limit * ca.DM(np.diag(vehicle.inertia_matrix)))
    filtered = limited(filtered, -bound, bound)
    lateral = R @ ca.vertcat(filtered[:2], 0)
    outputs = [ca.vertcat(error, s_F, s_tau, filtered), body, lateral]
    return ca.Function("l1_predictor", [x, x_last, thrust, memory, air, air_last], ca.cse(outputs))


@keyed
class L1(L1Keys, Remedy):
    """L1 adaptive augmentation (Hanover et al. 2022, Wu et al. 2023)."""

    believes = True

    def around(self, controller: Any) -> L1Controller:
        """See Remedy. UsageError around an observer, around a controller that learns its model in flight, and where the
        controller cannot be told what `unmatched` asks for."""
        if isinstance(controller, WrappedController):
            raise UsageError(
                "adaptive=l1: an observer estimates the same disturbance, and both would compensate it: choose"
                " observer=none or adaptive=none"
            )
        if isinstance(controller, (IdentifyingController, AdaptingController)):
            raise UsageError(
                "adaptive=l1: this controller explains the same error by what it learns in flight, from commands"
                " without what L1 adds. Take one of them"
            )
        if self.unmatched and not hasattr(controller, "believe"):
            raise UsageError(
                "adaptive.unmatched=true: this controller cannot be told of a force; adaptive.unmatched=false"
            )
        lag = known_delay(self.motor_lag, controller, "known_lag")
        return L1Controller(controller, part(L1Keys, self), lag, known_delay(self.dead_time, controller, "dead_time"))
