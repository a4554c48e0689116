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

The thrusts are those of the commands, not c_t W^2 of measured rotor speeds: a motor that gives less than it was given
is a matched disturbance too. Where u leaves the limits, allocation.py decides. World ENU, body FLU, SI.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.compile.backend import resolve
from quadexp.compile.symbolic import ca
from quadexp.control.inputs import Circumstances, Inputs
from quadexp.control.layer import NO_BELIEF, Layer, LayerPart
from quadexp.control.wrapped import WrappedController, air_of, parameters_of
from quadexp.errors import UsageError
from quadexp.models.residual import N_OUTPUTS
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import Expression, limited, named_symbols, symbols
from quadexp.physics.rigid_body import features_function
from quadexp.physics.rotation import along_z, rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.laws.allocation import prioritised
from quadexp.plugins.remedies.observers.observer import known_delay

LOGGED = ("l1_force_x", "l1_force_y", "l1_force_z", "l1_torque_x", "l1_torque_y", "l1_torque_z")


def added(vehicle: Vehicle, base: Expression, wrench: Expression) -> Expression:
    """Commands, (n,) (N), that add a wrench [T; tau], (4,), to others, (n,), by priority where that exceeds a limit."""
    u = base + ca.DM(np.linalg.pinv(vehicle.allocation)) @ wrench
    within = ca.logic_and(ca.mmin(u) >= vehicle.thrust_min, ca.mmax(u) <= vehicle.thrust_max)
    return ca.if_else(within, u, prioritised(vehicle, vehicle.allocation @ u))


def _predictor(vehicle: Vehicle, keys: L1, period: float) -> ca.Function:
    """(x, x_last, mean thrusts, z~, s, y, air, air_last) -> z~, s, y; R^T s_F and s_tau; the filtered force across the
    thrust axis, world (3,). air: y of the model at x and x_last."""
    m = vehicle.mass
    J = ca.DM(vehicle.inertia_matrix)
    sizes = {"x": N_STATE, "x_last": N_STATE, "thrust": vehicle.n_rotors, "error": 6, "disturbance": 6, "filtered": 6}
    inputs = named_symbols(ca.SX, sizes | {"air": N_OUTPUTS, "air_last": N_OUTPUTS})
    x, x_last, thrust, error, disturbance, filtered, air, air_last = inputs.values()
    wrench = vehicle.allocation @ thrust

    def known(state: Expression, y: Expression) -> Expression:
        R = rotation_matrix(state[ATTITUDE])
        w = state[RATE]
        linear = R @ (along_z(wrench[0] / m) + y[:3]) + ca.DM([0, 0, -vehicle.gravity])
        torque = wrench[1:] + y[3:] - ca.cross(w, J @ w)
        return ca.vertcat(linear, ca.inv(J) @ torque)

    moved = ca.vertcat(x[VELOCITY] - x_last[VELOCITY], x[RATE] - x_last[RATE])
    poles = np.repeat([keys.velocity_pole, keys.rate_pole], 3)
    decay = np.exp(-poles * period)
    reach = (1 - decay) / poles
    gain = poles * decay / (1 - decay)
    s_F, s_tau = ca.vertsplit(disturbance, 3)
    believed = ca.vertcat(s_F / m, ca.inv(J) @ s_tau)
    error = ca.DM(decay) * error + period / 2 * (known(x, air) + known(x_last, air_last))
    error += ca.DM(reach) * believed - moved
    estimate = -ca.DM(gain) * error
    s_F = m * estimate[:3]
    s_tau = J @ estimate[3:]
    R = rotation_matrix(x[ATTITUDE])
    body = ca.vertcat(R.T @ s_F, s_tau)
    stays = math.exp(-keys.bandwidth * period)
    filtered = stays * filtered + (1 - stays) * body
    force = keys.force_limit * m * vehicle.gravity
    bound = ca.vertcat(force, force, force, keys.torque_limit * ca.DM(np.diag(vehicle.inertia_matrix)))
    filtered = limited(filtered, -bound, bound)
    lateral = R @ ca.vertcat(filtered[:2], 0)
    outputs = [error, ca.vertcat(s_F, s_tau), filtered, body, lateral]
    return ca.Function("l1_predictor", [*inputs.values()], ca.cse(outputs))


@keyed
class L1(LayerPart):
    """L1 adaptive augmentation (Hanover et al. 2022, Wu et al. 2023)."""

    believes = True
    logged = {"body": LOGGED}
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
        False, "give the controller the lateral force, which rotors cannot cancel, through the same low pass"
    )

    def remembers(self, inputs: Inputs) -> dict[str, int]:
        """See LayerPart: z~; s_F and s_tau; y; the last state, and whether there is one."""
        return {"error": 6, "disturbance": 6, "filtered": 6, "last": N_STATE, "begun": 1}

    def start(self, inputs: Inputs, x: np.ndarray, thrust: np.ndarray) -> dict[str, np.ndarray]:
        """See LayerPart."""
        return {"last": x}

    def before(self, vehicle: Vehicle, inputs: Inputs, memory: Any) -> dict[str, Any]:
        """(1), (2) and the low pass of (3). body: R^T s_F and s_tau, (6,), before the low pass."""
        x = inputs.state
        thrust = inputs.mean
        features = features_function(vehicle)
        air = [ca.densify(inputs.model(features(state, thrust))) for state in (x, memory.last)]
        states = [memory.error, memory.disturbance, memory.filtered]
        *now, body, lateral = _predictor(vehicle, self, inputs.period)(x, memory.last, thrust, *states, *air)
        error, disturbance, filtered = (
            ca.if_else(memory.begun, new, old) for new, old in zip(now, states, strict=True)
        )
        results = {"error": error, "disturbance": disturbance, "filtered": filtered, "last": x, "begun": 1}
        results["body"] = memory.begun * body
        if self.unmatched:
            results["belief"] = ca.vertcat(memory.begun * lateral, ca.DM(NO_BELIEF[3:]))
        return results

    def after(self, vehicle: Vehicle, inputs: Inputs, memory: Any, before: Any) -> dict[str, Any]:
        """The sum of (3) within the limits."""
        base, y = symbols(ca.SX, base=vehicle.n_rotors, filtered=6)
        add = ca.Function("l1_add", [base, y], [ca.cse(added(vehicle, base, -y[2:]))])
        return {"command": add(inputs.command, before.filtered)}

    def around(self, controller: Any) -> Layer:
        """See Remedy. UsageError around an observer, around a controller that learns its model in flight, and where the
        controller cannot be given what `unmatched` asks for."""
        if isinstance(controller, WrappedController):
            raise UsageError(
                "adaptive=l1: an observer estimates the same disturbance, and both would compensate it: choose"
                " observer=none or adaptive=none"
            )
        if getattr(controller, "learns", False):
            raise UsageError(
                "adaptive=l1: this controller explains the same error by what it learns in flight, from commands"
                " without what L1 adds. Take one of them"
            )
        if self.unmatched and not hasattr(controller, "believe"):
            raise UsageError(
                "adaptive.unmatched=true: this controller cannot be given a force; adaptive.unmatched=false"
            )
        about = Circumstances(
            controller.control_period,
            known_delay(self.dead_time, controller, "dead_time"),
            known_delay(self.motor_lag, controller, "known_lag"),
            speeds=False,
            compiled=resolve(controller.backend) == "compiled",
        )
        air = air_of(controller)
        return Layer(controller, self, about, None if air.is_zero else air, {"theta": parameters_of(controller)})
