"""What is left of a rotor's speed in the telegrams of its electronic speed controller, and of a rotor in a reading.

Bidirectional DShot tells the period of the motor's field, 60e6 / eRPM in us, as m 2^e, m of 9 bits and e of 3; what is
shifted away is lost (Betaflight's dshot_bidir; eRPM: turns per minute of the field, pole pairs times the rotor's).
BLHeli_32 on a serial line tells the speed in whole steps of 100 eRPM.

A rotor that is out of balance shakes the body with its angle phi, behind a low pass of cut-off f_c (Hz) by

    a = A (W / W_hover)^2 / sqrt(1 + (W / 2 pi f_c)^2) (cos phi, sin phi, cos phi)             body, m/s^2
"""

from __future__ import annotations

import math

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression

MANTISSA = 512  # of 9 bits
LARGEST_EXPONENT = 7  # of 3 bits
SLOWEST = 1.0  # rad/s, that is given everything slower
MICROSECOND = 1e-6  # s


def dshot_speed(speed: Expression, pole_pairs: int) -> Expression:
    """Rotor speeds (n,) (rad/s) as a telegram of bidirectional DShot has them."""
    turn = 2 * math.pi / (MICROSECOND * pole_pairs)  # of the field, rad/s of the rotor times its period in us
    period = turn / ca.fmax(speed, SLOWEST)
    unit = 2 ** sum(period >= MANTISSA * 2**e for e in range(LARGEST_EXPONENT))
    mantissa = ca.fmin(ca.floor(period / unit), MANTISSA - 1)
    return turn / (unit * mantissa)


def in_steps(value: Expression, step: float) -> Expression:
    """The nearest whole multiple of a step; the value itself where the step is 0."""
    if not step:
        return value
    return step * ca.floor(value / step + 0.5)


def vibration(angle: Expression, speed: Expression, hover: float, amplitude: Expression, cutoff: float) -> Expression:
    """Acceleration (3,) (m/s^2), the sum over rotors with angles (n,) (rad) and speeds (n,) (rad/s).

    hover: speed in hover (rad/s). amplitude: A (3,) (m/s^2). cutoff: Hz; 0: no low pass.
    """
    size = (speed / hover) ** 2
    if cutoff:
        size /= ca.sqrt(1 + (speed / (2 * math.pi * cutoff)) ** 2)
    cosine = ca.dot(size, ca.cos(angle))
    sine = ca.dot(size, ca.sin(angle))
    return amplitude * ca.vertcat(cosine, sine, cosine)
