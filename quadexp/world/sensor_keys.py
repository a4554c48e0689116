"""The keys of sensors: what can be set of each reading; what they mean in equations: sensors.py."""

from __future__ import annotations

from typing import Literal

from quadexp.parts.settings import Setting, Settings, Triple, key, keyed

ZERO = (0.0, 0.0, 0.0)
RATES = "[0, 8000]"
AGES = "[0, 0.5]"
RATE_HZ = Setting("readings a second; 0: one at every control instant", RATES, "Hz")
AGE = Setting("age at which a reading is given", AGES, "s")
JITTER = Setting("largest additional delay, uniform from reading to reading", AGES, "s")
DROP = Setting("share of the readings that are lost", "[0, 1)")
CUTOFF = Setting("cut-off of the low pass before the readings; 0: none", "[0, 10000]", "Hz")
BIAS_STD = "standard deviation of the bias that is drawn for a flight, each axis"
DRIFT_STD = "standard deviation of the correlated error, each axis"
DRIFT_TIME = Setting("correlation time of that error", "(0, 1e6]", "s")


@keyed
class SensorKeys(Settings):
    """One key a quality of a reading; all readings are exact by default."""

    prefix = "sensor."

    accelerometer_bias: Triple = key(ZERO, "constant error of the specific force", "[-100, 100]", "m/s^2")
    accelerometer_noise: Triple = key(
        ZERO, "standard deviation of the white noise on the specific force", "[0, 100]", "m/s^2"
    )
    accelerometer_bias_std: float = key(0.0, BIAS_STD, "[0, 10]", "m/s^2")
    accelerometer_bias_walk: float = key(0.0, "random walk of the bias", "[0, 10]", "m/s^3/sqrt(Hz)")
    accelerometer_rate: float = key(0.0, RATE_HZ)
    accelerometer_delay: float = key(0.0, AGE)
    accelerometer_cutoff: float = key(0.0, CUTOFF)
    accelerometer_vibration: Triple = key(
        ZERO, "amplitude at the frequency of each rotor in hover, as a rotor's unbalance makes it", "[0, 1000]", "m/s^2"
    )
    gyroscope_noise: float = key(0.0, "standard deviation of the white noise, each axis", "[0, 10]", "rad/s")
    gyroscope_bias_std: float = key(0.0, BIAS_STD, "[0, 1]", "rad/s")
    gyroscope_bias_walk: float = key(0.0, "random walk of the bias", "[0, 1]", "rad/s^2/sqrt(Hz)")
    gyroscope_rate: float = key(0.0, RATE_HZ)
    gyroscope_delay: float = key(0.0, AGE)
    gyroscope_cutoff: float = key(0.0, CUTOFF)
    rotor_speed_noise: float = key(
        0.0, "standard deviation of the white noise over the speed, where rotors have speeds; likewise below", "[0, 1]"
    )
    rotor_speed_rate: float = key(0.0, RATE_HZ)
    rotor_speed_delay: float = key(0.0, AGE)
    rotor_speed_jitter: float = key(0.0, JITTER)
    rotor_speed_drop: float = key(0.0, DROP)
    rotor_speed_step: float = key(0.0, "resolution of a telegram; 0: exact", "[0, 1000]", "rad/s")
    rotor_speed_pole_pairs: int = key(
        0, "of the motors, whose period is given in telegrams of bidirectional DShot; 0: in none", "[0, 50]"
    )
    rotor_speed_of: tuple[int, ...] | None = key(
        None, "rotors that are measured, from 0; null: all; controllers are given speeds where all are", "[0, 99]"
    )
    position_noise: Triple = key(ZERO, "standard deviation of the white noise, world", "[0, 100]", "m")
    position_drift: float = key(0.0, DRIFT_STD, "[0, 100]", "m")
    position_drift_time: float = key(30.0, DRIFT_TIME)
    velocity_noise: float = key(0.0, "standard deviation of the white noise, each axis", "[0, 100]", "m/s")
    velocity_drift: float = key(0.0, DRIFT_STD, "[0, 100]", "m/s")
    velocity_drift_time: float = key(1.0, DRIFT_TIME)
    attitude_noise: float = key(0.0, "standard deviation of the white noise, about each body axis", "[0, 1]", "rad")
    attitude_drift: float = key(0.0, DRIFT_STD, "[0, 1]", "rad")
    attitude_drift_time: float = key(10.0, DRIFT_TIME)
    attitude_age: Literal["pose", "fresh"] = key(
        "pose", "age of the given attitude: that of position and velocity, or none, as of a filter on board"
    )
    pose_rate: float = key(0.0, RATE_HZ)
    pose_delay: float = key(0.0, AGE)
    pose_jitter: float = key(0.0, JITTER)
    pose_drop: float = key(0.0, DROP)
    battery_noise: float = key(0.0, "standard deviation of the white noise on the voltage", "[0, 10]", "V")
    battery_step: float = key(0.0, "resolution of the given voltage; 0: exact", "[0, 1]", "V")
    sheet_factor: float = key(
        1.0, "factor from the true noise, drift and delay of the sensors to the stated ones", "[0.01, 100]"
    )
