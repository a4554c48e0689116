"""Disturbance observer: the force, world axes, and the torque, body axes, that the controller's model does not know.

    y = R (f - T e_z / m - a_air(z))        f: accelerometer, T: delivered thrust, a_air: the model of the air

is the unknown force over the mass, and noise. A scalar Kalman filter on each axis, for a force that walks at random,

    P- = P + q,   K = P- / (P- + r),   a^ += K (y - a^),   P = (1 - K) P-

begins with a large P and ends at the gain of a first-order low pass: with K = 1 - exp(-b T), b the bandwidth and T the
control period, q = r K^2 / (1 - K). A white noise of variance r then gives a^ the variance r K / (2 - K).

Without an accelerometer (observer.source=velocity) from the velocity, which is not differentiated:

    v^- = v^ + T [R (T e_z / m + a_air) + g + a^],   v^ = v^- + (1 - z^2) (v - v^-),   a^ += (1 - z)^2 / T (v - v^-)

with both poles of the error at z = exp(-b T). The torque: plugins.remedies.observers.filters.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.inputs import Circumstances
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.part import Compensation, ControllerPart
from quadexp.control.wrapped import innermost
from quadexp.errors import UsageError
from quadexp.models.build_context import BuildContext
from quadexp.models.residual import Residual
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import named_function
from quadexp.physics.rigid_body import body_features
from quadexp.physics.rotation import along_z, rotation_matrix
from quadexp.physics.state import ATTITUDE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.remedies.observers.filters import (
    APART,
    N_SCALED,
    N_SCALED_STATE,
    N_TORQUE_SETTINGS,
    N_TORQUE_STATE,
    scaled_force_update,
    torque_settings,
    torque_update,
)
from quadexp.plugins.remedies.observers.observer import ObserverPart, arguments, believer

N_FORCE_STATE = 7  # a^, v^, P
N_FORCE_SETTINGS = 8  # numbers of `settings`


def disturbance_function(
    vehicle: Vehicle, residual: Residual, about: Circumstances, *, velocity: bool = False, scaled: bool = False
) -> ca.Function:
    """The update of plugins.remedies.observers.observer; s = [a^ (3,), v^ (3,), P, w^ (3,), J^-1 tau^ (3,)]; with
    scales, see plugins.remedies.observers.filters, [a, k, c, P (5, 5), e^ (3,), w^, J^-1 tau^]."""
    model = (residual.unscaled or residual).form(about.compiled)
    period = about.period
    first = N_SCALED_STATE if scaled else N_FORCE_STATE
    a = arguments(vehicle, first + N_TORQUE_STATE, len(residual.theta), N_FORCE_SETTINGS + N_TORQUE_SETTINGS)
    x = a["x"]
    s = a["s"]
    settings = a["settings"]
    R = rotation_matrix(x[ATTITUDE])
    thrust = ca.sum1(a["thrust"]) / vehicle.mass
    y, slope = model(body_features(x, a["thrust"]), a["theta"][: model.size1_in(1)])
    y = ca.densify(y)
    force = s[:3]
    estimate = s[3:6]
    P = s[6]
    scale = ca.MX(1)
    air = ca.MX(1)
    q, r, for_v, for_a, limit, scale_walk, air_walk, for_rest = ca.vertsplit(settings[:N_FORCE_SETTINGS])
    known = along_z(thrust) + y[:3]
    if scaled:
        by_scale = along_z(thrust) + ca.densify(slope)[:3, 6:] @ a["thrust"]
        unexplained = R @ (a["reading"] - known)
        turned = R @ by_scale
        drag = R @ y[:3]
        walks = ca.vertcat(q, scale_walk, air_walk)
        scaled_state, P, rest = scaled_force_update(s[:first], unexplained, turned, drag, walks, r, for_rest, a["read"])
        force = scaled_state[:3] + rest
        scale = 1 + scaled_state[3]
        air = 1 + scaled_state[4]
    elif velocity:
        mean = along_z(ca.sum1(a["mean"]) / vehicle.mass) + y[:3]
        predicted = estimate + period * (R @ mean + along_z(-vehicle.gravity) + force)
        error = x[VELOCITY] - predicted
        force = force + for_a * error
        estimate = predicted + for_v * error
    else:
        P = P + q
        gain = a["read"] * P / (P + r)
        unexplained = R @ (a["reading"] - known)
        force = force + gain * (unexplained - force)
        P = (1 - gain) * P
    size = ca.sqrt(ca.sumsqr(force) + 1e-30)
    force = force * ca.fmin(1, limit / size)
    rates, torque = torque_update(
        s[first:], x[RATE], scale * a["mean"], air * y[3:], settings[N_FORCE_SETTINGS:], vehicle, period
    )
    belief = ca.vertcat(vehicle.mass * force, torque, ca.MX.zeros(3), scale, air)
    state = ca.vertcat(scaled_state, P, rest) if scaled else ca.vertcat(force, estimate, P)
    return named_function("disturbance_observer", a, {"s_next": ca.vertcat(state, rates), "belief": belief})


@keyed
class DisturbanceObserver(ObserverPart):
    """Force and torque beyond the model."""

    source: Literal["accelerometer", "velocity"] = key(
        "accelerometer", "source of the force: the accelerometer, or the velocity if there is none"
    )
    force_bandwidth: float = key(25.0, "bandwidth of the estimated force", "(0, 1000]", "rad/s", tuned="1..100:log")
    force_noise: float = key(
        0.1,
        "standard deviation of the accelerometer from the model; its ratio to initial counts",
        "(0, 1000]",
        "m/s^2",
        when="source=accelerometer",
    )
    force_initial: float = key(
        3.0,
        "standard deviation of the force over the mass when a flight begins",
        "[0, 1000]",
        "m/s^2",
        when="source=accelerometer",
    )
    force_limit: float = key(15.0, "largest estimated force over the mass", "(0, 1000]", "m/s^2")
    scale_walk: float = key(
        0.0, "random walk of the thrust scale: its standard deviation after a second; 0: not estimated", "[0, 1]"
    )
    scale_initial: float = key(
        0.3, "standard deviation of the thrust scale when a flight begins", "[0, 1]", when="scale_walk"
    )
    air_walk: float = key(0.0, "likewise of the scale of the air's force; 0: not estimated", "[0, 10]")
    air_initial: float = key(
        1.0, "standard deviation of the air's scale when a flight begins", "[0, 10]", when="air_walk"
    )

    def scales_air(self, context: BuildContext) -> bool:
        """See Remedy."""
        return self.air_walk > 0

    def around(self, controller: Any) -> Any:
        """See Remedy."""
        wrapped = believer(controller, self.name)
        for name in ("scale_walk", "air_walk"):
            if self.source == "velocity" and getattr(self, name) > 0:
                raise UsageError(f"observer.{name}: a scale is found from the accelerometer, not with source=velocity")
        core = innermost(wrapped)
        if self.air_walk > 0 and isinstance(core, PredictiveController) and core.mpc.residual.unscaled is None:
            raise UsageError("observer.air_walk: the MPC was made without a scale of its model of the air (air.scaled)")
        return self.put(controller)

    @property
    def scaled(self) -> bool:
        """Whether it finds a scale of the thrust or of the air."""
        return self.scale_walk > 0 or self.air_walk > 0

    def update(self, vehicle: Vehicle, air: Residual, about: Circumstances) -> ca.Function:
        """See ObserverPart."""
        velocity = self.source == "velocity"
        return disturbance_function(vehicle, air, about, velocity=velocity, scaled=self.scaled)

    def settings(self, period: float) -> np.ndarray:
        """See ObserverPart: [q, r, gain on v^, gain on a^ from v, limit, variances that the scales of thrust and air
        gain in a step, gain of what the filter of the scales leaves] and those of the torque."""
        z = float(np.exp(-self.force_bandwidth * period))
        r = self.force_noise**2
        apart = min(self.force_bandwidth, APART) if self.scaled else self.force_bandwidth
        K = 1 - float(np.exp(-apart * period))
        force = [r * K**2 / (1 - K), r, 1 - z * z, (1 - z) ** 2 / period, self.force_limit]
        force += [self.scale_walk**2 * period, self.air_walk**2 * period]
        force += [1 - z if apart < self.force_bandwidth else 0.0]
        return np.array(force + torque_settings(self.torque_bandwidth, self.torque_limit, period))

    def begin(self, x: np.ndarray) -> np.ndarray:
        """See ObserverPart."""
        if self.scaled:
            known = self.scale_initial if self.scale_walk else 0.0
            air = self.air_initial if self.air_walk else 0.0
            P = np.diag([self.force_initial**2] * 3 + [known**2, air**2])
            return np.concatenate([np.zeros(N_SCALED), P.ravel(), np.zeros(3), x[RATE], np.zeros(3)])
        return np.concatenate([np.zeros(3), x[VELOCITY], [self.force_initial**2], x[RATE], np.zeros(3)])

    def check(self, vehicle: Vehicle, plant: Any, controller: ControllerPart, others: tuple[Compensation, ...]) -> None:
        """See Remedy. A scale of the thrust or of the air is the ratio of two forces at one time. Where motors lag, the
        thrusts of that time are known from rotor speeds, or from a lag and a dead time that are given."""
        lag = getattr(plant, "loop_lag", 0.0)
        stated = [getattr(part, name, None) for part in (self, controller) for name in ("motor_lag", "dead_time")]
        if vehicle.thrust_coefficient is not None or not lag or any(stated):
            return
        for name in ("scale_walk", "air_walk"):
            if getattr(self, name) > 0:
                raise UsageError(
                    f"observer.{name}: a scale is found from rotor speeds, which need vehicle.thrust_coefficient, and"
                    f" vehicle={vehicle.name} has none; its motors lag by {1e3 * lag:.0f} ms here: give the"
                    f" coefficient, or observer.motor_lag and observer.dead_time, or observer.{name}=0"
                )
