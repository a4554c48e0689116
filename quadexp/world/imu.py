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

import casadi as ca
import numpy as np

from quadexp.config.sensing import ImuKeys
from quadexp.physics.expression import Expression
from quadexp.physics.rotation import conjugate, exponential, logarithm, product, rotation_matrix
from quadexp.physics.state import ATTITUDE, VELOCITY

N_READING = 6  # [a_m, w_m]
N_BIAS = 6  # [b_a, b_g]
N_NOISE = N_READING + N_BIAS
FORCE, TURN = slice(0, 3), slice(3, 6)


@dataclass(frozen=True, kw_only=True)
class Imu(ImuKeys):
    """Accelerometer and gyroscope at the centre of mass."""

    def densities(self) -> np.ndarray:
        """Noise of force and rates, walk of their biases, (4,): m/s^2, rad/s, m/s^3, rad/s^2, each per sqrt(Hz)."""
        return np.array(
            [
                self.accelerometer_noise_density,
                self.gyroscope_noise_density,
                self.accelerometer_bias_walk,
                self.gyroscope_bias_walk,
            ]
        )

    def draw_bias(self, rng: np.random.Generator) -> np.ndarray:
        """[b_a, b_g] at the beginning of a flight, (6,) (m/s^2, rad/s)."""
        return rng.standard_normal(N_BIAS) * self.bias_std()

    def bias_std(self) -> np.ndarray:
        """(6,), m/s^2 and rad/s."""
        return np.repeat([self.accelerometer_bias_std, self.gyroscope_bias_std], 3)


def means(before: Expression, after: Expression, duration: Expression, gravity: Expression) -> Expression:
    """Mean specific force (m/s^2) and mean rates (rad/s), body axes at mid-interval, (6,), between two states (13,).

    duration: s. gravity: m/s^2, downwards.
    """
    turned = logarithm(product(conjugate(before[ATTITUDE]), after[ATTITUDE]))
    middle = product(before[ATTITUDE], exponential(turned / 2))
    acceleration = (after[VELOCITY] - before[VELOCITY]) / duration + ca.vertcat(0, 0, gravity)
    return ca.vertcat(ca.mtimes(rotation_matrix(middle).T, acceleration), turned / duration)


def read(
    exact: Expression, bias: Expression, duration: Expression, noise: Expression, densities: Expression
) -> tuple[Expression, Expression]:
    """[a_m, w_m] (6,) over an interval, and the biases (6,) after it; noise: standard normal, (12,)."""
    spread = ca.vertcat(*(densities[i] for i in range(4) for _ in range(3)))
    reading = exact + bias + spread[:N_READING] / ca.sqrt(duration) * noise[:N_READING]
    return reading, bias + spread[N_READING:] * ca.sqrt(duration) * noise[N_READING:]
