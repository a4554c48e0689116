"""A discrete gust of one-minus-cosine shape (14 CFR 25.341; as a ramp in MIL-F-8785C, 3.7.1.3), added to a mean wind.

    w(t) = w_mean + A / 2 (1 - cos(2 pi (t - t_0) / D))     for t_0 <= t <= t_0 + D, else w_mean         world, m/s

Its integral over the gust is A D / 2. A gust of length l that is met at the speed V lasts D = l / V.
"""

from __future__ import annotations

import math

import casadi as ca

from quadexp.physics.expression import Expression


def one_minus_cosine(t: Expression, start: Expression, duration: Expression, amplitude: Expression) -> Expression:
    """Velocity (3,) (m/s) that the gust adds at the time t (s), in the axes of its amplitude A (3,) (m/s).

    start t_0 and duration D: s.
    """
    share = ca.fmin(ca.fmax((t - start) / duration, 0), 1)  # both ends are zeros of the shape
    return amplitude / 2 * (1 - ca.cos(2 * math.pi * share))
