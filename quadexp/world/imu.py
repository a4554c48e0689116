"""An inertial measurement unit: mean specific force and mean rates since the last reading.

    w_m = Log(q_0* o q_1) / h + b_g + s_g / sqrt(h) n                                     body, rad/s
    a_m = R(q_0 o Exp(Log(q_0* o q_1) / 2))' ((v_1 - v_0) / h - g) + b_a + s_a / sqrt(h) n    body, m/s^2
    b(t + h) = b(t) + s_b sqrt(h) n                                                       random walk of each bias

over the interval h from (q_0, v_0) to (q_1, v_1), n standard normal. These are the coning and sculling corrected
angle and velocity increments that a flight stack's driver forms from readings at several kHz, over h and in the axes
of the middle of the interval; they contain whatever accelerated the vehicle. s are densities: white noise of density s
has the standard deviation s / sqrt(h) in a mean over h. The model of noise is that of IEEE Std 952 and of Kalibr.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.parts.part import Part
from quadexp.parts.settings import key
from quadexp.physics.expression import Expression
from quadexp.physics.rotation import conjugate, exponential, logarithm, product, rotation_matrix
from quadexp.physics.state import ATTITUDE, VELOCITY
from quadexp.world.aid import RATE

N_READING = 6  # [a_m, w_m]
N_BIAS = 6  # [b_a, b_g]
N_NOISE = N_READING + N_BIAS
N_DENSITIES = 4
FORCE, TURN = slice(0, 3), slice(3, 6)


@dataclass(frozen=True, kw_only=True)
class ImuKeys(Part):
    """An accelerometer and a gyroscope; see quadexp/world/imu.py."""

    prefix: ClassVar[str] = "sensor."

    imu_rate: float = key(200.0, "readings a second; the next whole number of them in a control period", RATE, "Hz")
    accelerometer_noise_density: float = key(2e-3, "white noise of the specific force", "[0, 10]", "m/s^2/sqrt(Hz)")
    gyroscope_noise_density: float = key(1.6968e-4, "white noise of the rates", "[0, 10]", "rad/s/sqrt(Hz)")
    accelerometer_bias_std: float = key(
        0.05, "standard deviation of the bias that is drawn for a flight, each axis", "[0, 10]", "m/s^2"
    )
    gyroscope_bias_std: float = key(
        0.005, "standard deviation of the bias that is drawn for a flight, each axis", "[0, 1]", "rad/s"
    )
    accelerometer_bias_walk: float = key(3e-3, "random walk of the bias", "[0, 10]", "m/s^3/sqrt(Hz)")
    gyroscope_bias_walk: float = key(1.9393e-5, "random walk of the bias", "[0, 1]", "rad/s^2/sqrt(Hz)")


def densities(keys: ImuKeys) -> np.ndarray:
    """Noise of force and rates, walk of their biases, (4,): m/s^2, rad/s, m/s^3, rad/s^2, each per sqrt(Hz)."""
    noise = (keys.accelerometer_noise_density, keys.gyroscope_noise_density)
    return np.array([*noise, keys.accelerometer_bias_walk, keys.gyroscope_bias_walk])


def bias_std(keys: ImuKeys) -> np.ndarray:
    """Standard deviations of [b_a, b_g] when a flight begins, (6,), m/s^2 and rad/s."""
    return np.repeat([keys.accelerometer_bias_std, keys.gyroscope_bias_std], 3)


def means(before: Expression, after: Expression, duration: Expression, gravity: Expression) -> Expression:
    """Mean specific force (m/s^2) and mean rates (rad/s), body axes at mid-interval, (6,), between two states (13,).

    duration: s. gravity: m/s^2, downwards.
    """
    turned = logarithm(product(conjugate(before[ATTITUDE]), after[ATTITUDE]))
    middle = product(before[ATTITUDE], exponential(turned / 2))
    acceleration = (after[VELOCITY] - before[VELOCITY]) / duration + ca.vertcat(0, 0, gravity)
    return ca.vertcat(ca.mtimes(rotation_matrix(middle).T, acceleration), turned / duration)


def read(
    exact: Expression, bias: Expression, duration: Expression, noise: Expression, stated: Expression
) -> tuple[Expression, Expression]:
    """[a_m, w_m] (6,) of an interval (s), and the biases (6,) after it.

    exact: see `means`. bias: (6,). noise: standard normal, (12,). stated: see `densities`.
    """
    spread = ca.vertcat(*(stated[i] for i in range(4) for _ in range(3)))
    reading = exact + bias + spread[:N_READING] / ca.sqrt(duration) * noise[:N_READING]
    return reading, bias + spread[N_READING:] * ca.sqrt(duration) * noise[N_READING:]
