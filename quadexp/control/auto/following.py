"""An observer with gains by what its readings are worth, which believes nothing that has not shown itself.

The wind where the model of the air has a drag that tells it, the force otherwise. Bandwidth of a low pass that follows
a walk q (m/s^2 in a root of a second) from readings of noise r (m/s^2), one a period T: q / (r sqrt(T)).

Deviations, for the bands: a^ is short of a force a by e, e+ = (1 - K) (e + da) - K n, under a gain K. Noise n of
variance r makes K r / (2 - K) of its variance. The rest is how far a low pass is behind a force that moves, whatever
moves it: in steady motion by what a^ itself moved in 1 / bandwidth, which report/beliefs.py adds for each instant.
Beside it what readings are off all along by their data sheet. Of a wind that of the filter, these offsets as a wind,
and an airspeed times the thrust scale's distance from 1: by a wrong mass the drag is off as much, and the scale by OFF
of that distance. Where no such scale is found, thrusts may be off by UNTIMED, which looks like a wind on z. By rotor
speeds a scale is found where thrust changes faster than the force is followed, there readings are behind low passes and
thrusts lag: it is off by SCALE, and a force by that of the swing.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.control.auto.bank import SHEET
from quadexp.control.auto.decide import Acting, Senses
from quadexp.control.auto.posterior import SCALE
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.observers.disturbance import DisturbanceObserver, disturbance_settings
from quadexp.control.observers.filters import N_SCALED
from quadexp.control.observers.observer import air_of, parameters_of
from quadexp.control.observers.wind import N_AIR, WindObserver, wind_bandwidth, wind_settings
from quadexp.parts.sensor_sheet import SensorSheet
from quadexp.parts.settings import changed
from quadexp.physics.vehicle import Vehicle

LIFT = 12.0  # m/s^2, by which an error of the attitude (rad) becomes one of the acceleration
TWIST = 0.035  # rad/s^2 in a root of a second, for each rad/s of bandwidth of the torque
STRONG = 0.5  # m/s^2 in a root of a second: a push that is followed with the observer's own settings
UPWARD = 1.0  # m/s, deviation of the wind upward as it begins: over ground a mean wind is level
OFF = 0.2  # of the thrust scale's distance from 1
UNTIMED = 3.0  # m/s^2, noise of the z axis where the time of the thrusts is not known
SWING = 10.0  # m/s^2: where thrusts swing by more, a scale of theirs would look like a force that jumps with them
SLOW = 3.0  # rad/s, of a force then
LEAST_NOISE = 0.02  # m/s^2, of a reading of the accelerometer
# Where rotor speeds are told: readings of them in a second, the largest bandwidth of the force (rad/s), its walk (m/s^2
# in a root of a second), and the largest one over the mass (m/s^2)
LEAST_RATE, FASTEST, STRONGEST, MOST_FORCE = 100.0, 100.0, 1.5, 50.0
# m/s, N, s that the force is behind, 1
DEVIATIONS = (*(f"{of}_{axis}_sd" for of in ("wind", "force") for axis in "xyz"), "force_lag", "thrust_scale_sd")
UNKNOWN = np.full(len(DEVIATIONS), np.nan)


class WindFollowing:
    """Of the wind, and of the force that it leaves."""

    def __init__(self, config: WindObserver, period: float, offset: float, slope: float) -> None:
        """offset: of readings (m/s^2). slope: acceleration by wind, where it hovers in a breeze (1/s)."""
        self.config, self._period, self._offset, self._slope = config, period, offset / slope, slope
        self._velocity = np.zeros(3)
        self.around = config.around
        first = N_AIR + N_AIR**2
        self._wind, self._scale, self._force, self._torque = slice(0, 3), 3, slice(first, first + 3), slice(-3, None)
        self._scaled = False

    def follow(self, estimate: np.ndarray, acting: Acting, before: Acting, senses: Senses) -> np.ndarray:
        """Settings of the update; estimate: its state, which is changed where something shows itself or does not."""
        config, (lateral, vertical, torque) = self.config, acting.push
        self._velocity = senses.velocity
        tilt = LIFT * senses.attitude
        noise = (math.hypot(max(config.noise[0], float(senses.reading[:2].max())), tilt),) * 2
        walk = min(1.0, float(senses.walk[:2].max()) / STRONG)
        by_noise = float(senses.walk[2]) / (max(float(senses.reading[2]), 1e-3) * math.sqrt(self._period))
        config = changed(
            config,
            noise=(*noise, max(config.noise[2], UNTIMED)),
            wind_walk=config.wind_walk * walk,
            wind_initial=config.wind_initial if lateral else 1e-3,
            scale_walk=config.scale_walk if vertical and acting.timed else 0.0,
            force_bandwidth=min(config.force_bandwidth / (1 + 15 * tilt), by_noise) * (vertical and acting.timed),
            torque_bandwidth=torque_bandwidth(config.torque_bandwidth, acting, senses),
        )
        diagonal = N_AIR + (N_AIR + 1) * np.arange(N_AIR)
        if not (lateral and before.push[0]):  # as it begins; the first reading would else be taken for a wind
            level = config.wind_initial
            estimate[diagonal[:3]] = np.square([level, level, min(level, UPWARD)])
        scaled = vertical and acting.timed
        if not scaled:
            estimate[diagonal[3]] = estimate[self._scale] = 0.0
        elif not self._scaled:
            estimate[diagonal[3]] = config.scale_initial**2
        self._scaled = scaled
        estimate[self._wind] *= lateral
        estimate[self._force] *= vertical
        estimate[self._torque] *= torque
        return wind_settings(config, self._period)

    def deviations(self, estimate: np.ndarray) -> np.ndarray:
        """Standard deviations, in the order of DEVIATIONS; NaN of what is not estimated."""
        variances = estimate[N_AIR + (N_AIR + 1) * np.arange(N_AIR)]
        known = np.sqrt(np.where(variances > 1e-6, variances, np.nan))
        by_drag = estimate[self._scale] * np.linalg.norm(self._velocity - estimate[self._wind])
        by_thrust = np.array([0.0, 0.0, 0.0 if self._scaled else UNTIMED / self._slope])
        scale = math.hypot(known[3], OFF * estimate[self._scale])
        wind = np.hypot(known[:3], by_thrust + math.hypot(self._offset, by_drag))
        return np.array([*wind, *UNKNOWN[:4], scale])


class SpeedFollowing:
    """Of force, torque and the scales of thrust and air, where rotor speeds tell the thrusts, so that no time of
    commands has to be known. Believed from the first reading on, as far as its noise lets it."""

    def __init__(self, vehicle: Vehicle, sheet: SensorSheet, period: float) -> None:
        accelerometer, speeds, attitude = (
            0.0 if sensor is None else sensor.noise
            for sensor in (sheet.accelerometer, sheet.rotor_speed, sheet.attitude)
        )
        thrust = 2 * speeds * vehicle.gravity / math.sqrt(vehicle.n_rotors)
        noise = math.hypot(max(accelerometer, LEAST_NOISE), thrust, LIFT * attitude)
        config = DisturbanceObserver(
            force_bandwidth=min(FASTEST, STRONGEST / (noise * math.sqrt(period))),
            force_noise=max(noise, DisturbanceObserver.force_noise),
            force_limit=MOST_FORCE,
            thrust_noise=2 * speeds / math.sqrt(vehicle.n_rotors),
            scale_walk=0.005,
            air_walk=0.01,
        )
        self.around, self._mass, self._swing = config.around, vehicle.mass, 0.0
        self._lag = 1 / config.force_bandwidth
        self._config, self._period, self._stated = config, period, max(accelerometer, LEAST_NOISE)

    def follow(self, estimate: np.ndarray, acting: Acting, before: Acting, senses: Senses) -> np.ndarray:
        """See WindFollowing. A sheet whose accelerometer is noisier than it says is not believed in the rest."""
        self._swing, config = senses.swing, self._config
        doubt = min(max(float(senses.reading[:2].mean()) / self._stated, 1.0), SHEET)
        config = changed(
            config,
            force_bandwidth=config.force_bandwidth / doubt,
            force_noise=config.force_noise * doubt,
            thrust_noise=min(config.thrust_noise * doubt, 1.0),
        )
        self._lag = 1 / config.force_bandwidth
        return disturbance_settings(config, self._period)

    def deviations(self, estimate: np.ndarray) -> np.ndarray:
        """See WindFollowing."""
        variances = np.maximum(estimate[N_SCALED : N_SCALED + N_SCALED**2 : N_SCALED + 1], 0.0)
        force = self._mass * math.hypot(math.sqrt(variances[:3].max()), SCALE * self._swing)
        scale = math.hypot(math.sqrt(variances[3]), SCALE)
        return np.array([*UNKNOWN[:3], force, force, force, self._lag, scale])


def speeds_tell(vehicle: Vehicle, sheet: SensorSheet) -> bool:
    """Whether the speeds of all rotors are told, often enough, and what thrusts they are."""
    speeds = sheet.rotor_speed
    return speeds is not None and vehicle.thrust_coefficient is not None and not 0 < speeds.rate < LEAST_RATE


class ForceFollowing:
    """Of the force alone. mass: kg. offset: of readings (m/s^2)."""

    def __init__(self, config: DisturbanceObserver, period: float, mass: float, offset: float) -> None:
        self.config, self._period, self._mass, self._offset = config, period, mass, offset
        self._deviations = UNKNOWN
        self.around = config.around

    def follow(self, estimate: np.ndarray, acting: Acting, before: Acting, senses: Senses) -> np.ndarray:
        """See WindFollowing."""
        config, (lateral, vertical, torque) = self.config, acting.push
        shown, first = lateral or vertical, not (before.push[0] or before.push[1])
        by_noise = float((senses.walk / np.maximum(senses.reading, 1e-3)).max()) / math.sqrt(self._period)
        most = config.force_bandwidth / (1 + 15 * LIFT * senses.attitude + max(senses.swing - SWING, 0.0) / SWING)
        bandwidth = min(most, max(by_noise, 1e-3))
        config = changed(
            config,
            force_bandwidth=bandwidth if acting.timed else min(bandwidth, SLOW),
            torque_bandwidth=torque_bandwidth(config.torque_bandwidth, acting, senses),
        )
        passed = math.sqrt(math.tanh(config.force_bandwidth * self._period / 2))  # of white noise, sqrt(K / (2 - K))
        noise = passed * np.hypot(senses.reading, LIFT * senses.attitude)
        force = self._mass * np.hypot(noise, self._offset)
        self._deviations = np.array([*UNKNOWN[:3], *force, 1 / config.force_bandwidth, np.nan])
        if shown and first:
            estimate[6] = config.force_initial**2
        estimate[:3] *= shown
        estimate[-3:] *= torque
        settings = disturbance_settings(config, self._period)
        if not shown:
            settings[0] = settings[2] = settings[3] = 0.0
            estimate[6] = 0.0
        return settings

    def deviations(self, estimate: np.ndarray) -> np.ndarray:
        """See WindFollowing."""
        return self._deviations if estimate[6] > 0 else UNKNOWN


def torque_bandwidth(most: float, acting: Acting, senses: Senses) -> float:
    """Of the torque (rad/s): by its walk, and less the noisier the rates are."""
    if not (acting.timed and acting.push[2]):
        return 0.0
    return min(most, senses.twist / TWIST) / (1 + 40 * senses.rate * (senses.rate > 0.001))


def following(core: Any, sheet: SensorSheet) -> WindFollowing | SpeedFollowing | ForceFollowing:
    """The observer for a controller."""
    if isinstance(core, PredictiveController) and speeds_tell(core.vehicle, sheet):
        return SpeedFollowing(core.vehicle, sheet, core.control_period)
    drift = (0.0 if sensor is None else sensor.drift for sensor in (sheet.accelerometer, sheet.attitude))
    by_reading, by_attitude = drift
    offset = math.hypot(by_reading, LIFT * by_attitude)
    wind = WindObserver(targets=False)  # of next to no weight beside that of the position
    period = core.control_period
    bandwidth = wind_bandwidth(core.vehicle, air_of(core), parameters_of(core), wind, period)
    if isinstance(core, PredictiveController) and bandwidth >= wind.least_bandwidth:
        slope = bandwidth * wind.noise[0] * math.sqrt(period) / wind.wind_walk
        return WindFollowing(wind, period, offset, slope)
    tilted = math.hypot(by_reading, core.vehicle.gravity * by_attitude)
    return ForceFollowing(DisturbanceObserver(targets=False), period, core.vehicle.mass, tilted)
