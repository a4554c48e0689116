"""Settings of inertial and aiding sensors, and of the estimator that joins them.

The defaults are those of docs/estimation.md, which names the source of each.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from quadexp.config.settings import Setting, Settings, Triple
from quadexp.config.world import WorldPartConfig

RATE = "[0.1, 8000]"
SHARE = Setting("share of the fixes that are lost", "[0, 0.99]")
OUTAGE = Setting("mean length of an outage; 0: every fix is lost or not by itself", "[0, 3600]", "s")


@dataclass(frozen=True, kw_only=True)
class ImuKeys(Settings):
    """An accelerometer and a gyroscope; see quadexp/world/imu.py."""

    prefix: ClassVar[str] = "sensor."

    imu_rate: Annotated[
        float, Setting("readings a second; the next whole number of them in a control period", RATE, "Hz")
    ] = 200.0
    accelerometer_noise_density: Annotated[
        float, Setting("white noise of the specific force", "[0, 10]", "m/s^2/sqrt(Hz)")
    ] = 2e-3
    gyroscope_noise_density: Annotated[float, Setting("white noise of the rates", "[0, 10]", "rad/s/sqrt(Hz)")] = (
        1.6968e-4
    )
    accelerometer_bias_std: Annotated[
        float, Setting("standard deviation of the bias that is drawn for a flight, each axis", "[0, 10]", "m/s^2")
    ] = 0.05
    gyroscope_bias_std: Annotated[
        float, Setting("standard deviation of the bias that is drawn for a flight, each axis", "[0, 1]", "rad/s")
    ] = 0.005
    accelerometer_bias_walk: Annotated[float, Setting("random walk of the bias", "[0, 10]", "m/s^3/sqrt(Hz)")] = 3e-3
    gyroscope_bias_walk: Annotated[float, Setting("random walk of the bias", "[0, 1]", "rad/s^2/sqrt(Hz)")] = 1.9393e-5


@dataclass(frozen=True, kw_only=True)
class MotionCaptureKeys(Settings):
    """Position and attitude from cameras; see quadexp/world/motion_capture.py."""

    prefix: ClassVar[str] = "sensor."

    pose_rate: Annotated[float, Setting("poses a second, at most imu_rate", RATE, "Hz")] = 100.0
    pose_delay: Annotated[float, Setting("between the exposure and the pose at hand", "[0, 1]", "s")] = 0.01
    pose_position_noise: Annotated[float, Setting("standard deviation of the position, each axis", "(0, 10]", "m")] = (
        1e-3
    )
    pose_attitude_noise: Annotated[
        float, Setting("standard deviation of the attitude, about each body axis", "(0, 1]", "rad")
    ] = 5e-3
    pose_dropout: Annotated[float, SHARE] = 0.01
    pose_outage: Annotated[float, OUTAGE] = 0.05


@dataclass(frozen=True, kw_only=True)
class GnssKeys(Settings):
    """Position and velocity from satellites; see quadexp/world/gnss.py."""

    prefix: ClassVar[str] = "sensor."

    gnss_rate: Annotated[float, Setting("fixes a second, at most imu_rate", RATE, "Hz")] = 10.0
    gnss_delay: Annotated[float, Setting("between the fix's time and the fix at hand", "[0, 2]", "s")] = 0.1
    gnss_position_noise: Annotated[
        Triple, Setting("standard deviation of the position, east, north, up; white", "(0, 100]", "m")
    ] = (0.0085, 0.0085, 0.015)
    gnss_velocity_noise: Annotated[
        Triple, Setting("standard deviation of the velocity, east, north, up; white", "(0, 100]", "m/s")
    ] = (0.05, 0.05, 0.05)
    gnss_dropout: Annotated[float, SHARE] = 0.01
    gnss_outage: Annotated[float, OUTAGE] = 0.5


@dataclass(frozen=True, kw_only=True)
class HeadingKeys(Settings):
    """North from a magnetometer; see quadexp/world/heading.py."""

    prefix: ClassVar[str] = "sensor."

    heading_rate: Annotated[float, Setting("readings a second, at most imu_rate", RATE, "Hz")] = 50.0
    heading_delay: Annotated[float, Setting("between the reading's time and the reading at hand", "[0, 1]", "s")] = 0.0
    heading_noise: Annotated[float, Setting("standard deviation of the heading; white", "(0, 3]", "rad")] = 0.035


@dataclass(frozen=True, kw_only=True)
class EskfKeys(Settings):
    """The error-state Kalman filter; see quadexp/world/eskf.py. Its noise is that of the sensors, times factors."""

    prefix: ClassVar[str] = "estimator."

    process_factor: Annotated[
        float, Setting("factor on the standard deviations of the IMU's noise that the filter believes", "(0, 1000]")
    ] = 1.0
    measurement_factor: Annotated[
        float, Setting("factor on the standard deviations of the aids' noise that the filter believes", "(0, 1000]")
    ] = 1.0
    warm_up: Annotated[
        float, Setting("how long the vehicle has stood, with the filter running, when a flight begins", "[0, 600]", "s")
    ] = 10.0


@dataclass(frozen=True, kw_only=True)
class ImuMocapConfig(MotionCaptureKeys, ImuKeys, WorldPartConfig):
    """An IMU and motion capture; see quadexp/world/inertial.py."""

    effect = "quadexp.world.inertial:ImuMocap"


@dataclass(frozen=True, kw_only=True)
class ImuGnssConfig(GnssKeys, HeadingKeys, ImuKeys, WorldPartConfig):
    """An IMU, satellite navigation and a magnetometer; see quadexp/world/inertial.py."""

    effect = "quadexp.world.inertial:ImuGnss"


@dataclass(frozen=True, kw_only=True)
class EskfConfig(EskfKeys, WorldPartConfig):
    """The error-state Kalman filter; see quadexp/world/navigation.py."""

    effect = "quadexp.world.navigation:Navigation"
