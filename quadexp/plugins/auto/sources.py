"""What a disturbance is found from: which sensors there are, how well they are known, and what the model tells."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quadexp.parts.sensor_spec import SensorSpec, Stated
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.auto.settings import DISTURBANCE, INTERVAL, SPEEDS

WIND, SCALE, FORCE, AIR, N_ESTIMATE = slice(0, 3), 3, slice(4, 7), 7, 8


class Sources(NamedTuple):
    """What a disturbance is found from. has_drag: whether the model's drag tells a wind; by_speeds: whether rotor
    speeds tell the thrusts. random_walk, initial: deviations of each number of the estimate, a root of a second, and as
    a flight begins. reading: least noise of the accelerometer (m/s^2). thrust: noise of the model along the thrust, as
    a share of it. wind_offset, wind_untimed, force_offset: what a wind is off by for a slow error of sensors, and
    upward for thrusts of an unknown time (m/s), and what an acceleration is (m/s^2)."""

    has_drag: bool
    by_speeds: bool
    random_walk: tuple[float, ...]
    initial: tuple[float, ...]
    reading: float
    thrust: float
    wind_offset: float
    wind_untimed: float
    force_offset: float


def speeds_tell(vehicle: Vehicle, sensor_spec: SensorSpec) -> bool:
    """Whether the speeds of all rotors are given, often enough, and what thrusts they are."""
    speeds = sensor_spec.rotor_speed
    if speeds is None or vehicle.thrust_coefficient is None:
        return False
    return not 0 < speeds.rate < SPEEDS.least_rate


def sources(vehicle: Vehicle, sensor_spec: SensorSpec, slope: float, *, by_speeds: bool) -> Sources:
    """slope: acceleration by wind where the vehicle hovers in a breeze (1/s); 0: no drag tells a wind."""
    s = DISTURBANCE
    random_walk, initial = np.zeros((2, N_ESTIMATE))
    random_walk[FORCE] = s.force_walk
    random_walk[SCALE] = s.scale_walk
    initial[FORCE] = s.force_initial
    initial[SCALE] = s.scale_initial
    if by_speeds:
        random_walk[FORCE] = SPEEDS.force_walk
        random_walk[AIR] = SPEEDS.air_walk
        initial[SCALE] = SPEEDS.scale_initial
        initial[AIR] = SPEEDS.air_initial
    elif slope:
        random_walk[WIND] = s.wind_walk
        random_walk[FORCE] = s.force_walk_beside_wind
        initial[WIND] = s.wind_initial
        initial[FORCE] = s.force_initial_beside_wind

    accelerometer = sensor_spec.accelerometer or Stated()
    attitude = sensor_spec.attitude or Stated()
    rotor_speed = sensor_spec.rotor_speed or Stated()
    reading = max(accelerometer.noise, s.reading_noise)
    offset = math.hypot(accelerometer.drift, vehicle.gravity * attitude.drift)
    return Sources(
        has_drag=slope > 0,
        by_speeds=by_speeds,
        random_walk=tuple(random_walk),
        initial=tuple(initial),
        reading=math.hypot(reading, s.tilt_to_acceleration * attitude.noise),
        thrust=2 * rotor_speed.noise / math.sqrt(vehicle.n_rotors) if by_speeds else s.thrust_noise,
        wind_offset=math.hypot(offset / slope, INTERVAL.least_wind) if slope else 0.0,
        wind_untimed=INTERVAL.untimed_noise / slope if slope else 0.0,
        force_offset=offset,
    )
