"""Wind observer: an extended Kalman filter of the wind, in world axes, from the drag that it causes.

    w' = noise,  k' = noise        f = (1 + k) T e_z / m + a_air(R'(v - w), ..) + noise            f: accelerometer

    H = [-da/dv R',  T e_z / m + da/du u],   S = H P- H' + N
    K = P- H' S^-1,   [w, k] += K (f - f^),   P = (1 - K H) P-

da/dv is the model's own Jacobian, so what is called wind is whatever air velocity makes the model explain the reading.
k, the error of the thrust scale, is estimated where observer.scale_walk is not 0. What both leave of the reading goes
through a low pass of observer.force_bandwidth into a force of the world, as by the disturbance observer; the filter
knows nothing of it. P of the wind is not let beyond its initial value where a hovering vehicle feels no drag.

Around an airspeed with a drag slope c = |da/dv| the filter is, on one axis, a low pass of bandwidth b = c q / r, q the
walk (m/s in a root of a second) and r the noise (m/s^2 in a root of a hertz: sigma sqrt(T)). A vehicle with little drag
is a poor anemometer: where b is below observer.least_bandwidth the controller is refused, and observer=disturbance does
what can be done.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.inputs import Circumstances
from quadexp.control.wrapped import air_of, innermost, parameters_of
from quadexp.errors import UsageError
from quadexp.models.residual import Residual
from quadexp.parts.settings import Triple, key, keyed
from quadexp.physics.expression import limited, named_function
from quadexp.physics.rotation import along_z, rotation_matrix
from quadexp.physics.state import ATTITUDE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.remedies.observers.filters import (
    N_TORQUE_SETTINGS,
    N_TORQUE_STATE,
    inverse,
    torque_settings,
    torque_update,
)
from quadexp.plugins.remedies.observers.observer import ObserverPart, arguments, believer

N_AIR = 4  # wind (3,), thrust scale - 1
N_FORCE = 3  # over the mass
N_WIND_SETTINGS = 8  # numbers of `settings`
TYPICAL_AIRSPEED = 5.0  # m/s, at which the drag slope is taken


def wind_bandwidth(
    vehicle: Vehicle, residual: Residual, theta: np.ndarray, config: WindObserver, period: float
) -> float:
    """Bandwidth of the estimated wind on the worse horizontal body axis (rad/s), where it hovers in a breeze."""
    slopes = []
    for axis in (0, 1):
        each = []
        for airspeed in (-TYPICAL_AIRSPEED, TYPICAL_AIRSPEED):
            z = np.zeros(6 + vehicle.n_rotors)
            z[axis] = airspeed
            z[6:] = vehicle.hover_thrust
            _, slope = residual.function(z, theta)
            each.append(abs(float(slope[axis, axis])))
        slopes.append(np.mean(each) / (config.noise[axis] * np.sqrt(period)))
    return float(config.wind_walk * min(slopes))


def wind_function(vehicle: Vehicle, residual: Residual, about: Circumstances) -> ca.Function:
    """The update of plugins.remedies.observers.observer; s = [wind (3,), k, P (4, 4), F / m (3,), w^ (3,), J^-1 tau^
    (3,)]."""
    model = residual.form(about.compiled)
    period = about.period
    first = N_AIR + N_AIR**2 + N_FORCE
    a = arguments(vehicle, first + N_TORQUE_STATE, model.size1_in(1), N_WIND_SETTINGS + N_TORQUE_SETTINGS)
    x = a["x"]
    s = a["s"]
    settings = a["settings"]
    R = rotation_matrix(x[ATTITUDE])
    thrust = ca.sum1(a["thrust"]) / vehicle.mass
    air = s[:N_AIR]
    P = ca.reshape(s[N_AIR : first - N_FORCE], N_AIR, N_AIR)
    force = s[first - N_FORCE : first]
    wind_walk, scale_walk, *noise, largest, limit, gain = ca.vertsplit(settings[:N_WIND_SETTINGS])

    scale = 1 + air[3]
    z = ca.vertcat(R.T @ (x[VELOCITY] - air[:3]), x[RATE], scale * a["thrust"])
    y, slope = model(z, a["theta"])
    y = ca.densify(y)
    slope = ca.densify(slope)
    by_scale = along_z(thrust) + slope[:3, 6:] @ a["thrust"]
    H = ca.horzcat(-(slope[:3, :3] @ R.T), by_scale)
    P = P + ca.diag(ca.vertcat(wind_walk, wind_walk, wind_walk, scale_walk))
    error = a["reading"] - y[:3] - along_z(scale * thrust)
    N = ca.diag(ca.vertcat(*noise))
    S = H @ P @ H.T + N
    K = a["read"] * (P @ H.T @ inverse(S))
    change = K @ error
    air = air + change
    unexplained = R @ (error - H @ change)
    force = force + a["read"] * gain * (unexplained - force)
    reduction = ca.DM.eye(N_AIR) - K @ H
    P = reduction @ P @ reduction.T + K @ N @ K.T  # Joseph's form
    shrink = ca.fmin(1, ca.sqrt(3 * largest / ca.trace(P[:3, :3])))
    by = ca.diag(ca.vertcat(shrink, shrink, shrink, 1))
    P = by @ P @ by
    size = ca.sqrt(ca.sumsqr(air[:3]) + 1e-30)
    wind = air[:3] * ca.fmin(1, limit / size)
    air = ca.vertcat(wind, limited(air[3], -0.5, 1.0))

    mean = (1 + air[3]) * a["mean"]
    of_torque = settings[N_WIND_SETTINGS:]
    rates, torque = torque_update(s[first:], x[RATE], mean, y[3:], of_torque, vehicle, period)
    belief = ca.vertcat(vehicle.mass * force, torque, air[:3], 1 + air[3], 1)
    s_next = ca.vertcat(air, ca.vec(P), force, rates)
    return named_function("wind_observer", a, {"s_next": s_next, "belief": belief})


@keyed
class WindObserver(ObserverPart):
    """Wind from the drag that it causes."""

    noise: Triple = key(
        (0.1, 0.1, 3.0),
        "standard deviation of the accelerometer from the model; large on z: thrust is uncertain",
        "(0, 1000]",
        "m/s^2",
    )
    force_bandwidth: float = key(
        25.0, "bandwidth of the force that the wind leaves unexplained; 0: none", "[0, 1000]", "rad/s"
    )
    wind_walk: float = key(
        1.5, "random walk of the wind: its standard deviation after a second", "[0, 100]", "m/s", tuned="0.1..20:log"
    )
    wind_initial: float = key(
        4.0, "standard deviation of the wind when a flight begins, and the largest later", "(0, 100]", "m/s"
    )
    wind_limit: float = key(25.0, "largest estimated wind", "(0, 100]", "m/s")
    scale_walk: float = key(
        0.005, "random walk of the thrust scale: its standard deviation after a second; 0: not estimated", "[0, 1]"
    )
    scale_initial: float = key(
        0.05, "standard deviation of the thrust scale when a flight begins", "[0, 1]", when="scale_walk"
    )
    least_bandwidth: float = key(
        1.0, "of the wind estimate; a controller whose drag gives less is refused", "[0, 1000]", "rad/s"
    )

    def around(self, controller: Any) -> Any:
        """See Remedy; UsageError where the model has too little drag to measure a wind."""
        wrapped = believer(controller, self.name)
        core = innermost(wrapped)
        residual = air_of(core)
        period = wrapped.control_period
        bandwidth = wind_bandwidth(wrapped.vehicle, residual, parameters_of(core), self, period)
        if bandwidth < self.least_bandwidth:
            raise UsageError(
                f"observer={self.name}: this controller knows too little drag of vehicle={wrapped.vehicle.name} to"
                f" measure the wind (bandwidth {bandwidth:.2g} rad/s at {TYPICAL_AIRSPEED:g} m/s,"
                f" observer.least_bandwidth is {self.least_bandwidth:g}); take observer=disturbance"
            )
        return self.put(controller)

    def update(self, vehicle: Vehicle, air: Residual, about: Circumstances) -> ca.Function:
        """See ObserverPart."""
        return wind_function(vehicle, air, about)

    def settings(self, period: float) -> np.ndarray:
        """See ObserverPart: variances of a step's walks and of readings, limits, gain of the force; those of the
        torque."""
        walks = [self.wind_walk**2 * period, self.scale_walk**2 * period]
        limits = [self.wind_initial**2, self.wind_limit, 1 - float(np.exp(-self.force_bandwidth * period))]
        noise = [sigma**2 for sigma in self.noise]
        return np.array(walks + noise + limits + torque_settings(self.torque_bandwidth, self.torque_limit, period))

    def begin(self, x: np.ndarray) -> np.ndarray:
        """See ObserverPart."""
        P = np.diag([self.wind_initial**2] * 3 + [self.scale_initial**2 if self.scale_walk else 0.0])
        return np.concatenate([np.zeros(N_AIR), P.ravel(), np.zeros(N_FORCE), x[RATE], np.zeros(3)])
