"""A low pass of first order with the cut-off f_c (Hz), at steps of h (s):

    y_j = a y_{j-1} + b_1 x_{j-1} + b_0 x_j,   a = g / (1 + g),   b_1 = (1 - a) (D - g),   b_0 = 1 - a - b_1
    g = 2 D - 1/2 - sqrt(2 D^2 + 1/4 - 1 / (4 sin^2(pi f_c h))),   D = 1 / (2 pi f_c h)

It has two properties of 1 / (1 + s / (2 pi f_c)) whatever h: the gain at f_c is 1 / sqrt(2), -3 dB, and what is slow
comes late by D h. At half the rate of the steps nothing of a cut-off above can be seen: g = 0, the delay alone.
"""

from __future__ import annotations

import math


def group_delay(cutoff: float) -> float:
    """By which what is slow comes late behind a low pass with this cut-off (Hz) (s); 0 of none."""
    if not cutoff:
        return 0.0
    return 1 / (2 * math.pi * cutoff)


def low_pass(cutoff: float, step: float) -> tuple[float, float, float]:
    """a, b_1 and b_0 of a low pass with this cut-off (Hz), above 0, at steps of that length (s)."""
    delay = group_delay(cutoff) / step
    g = 0.0
    if cutoff * step < 0.5:
        sine = math.sin(math.pi * cutoff * step)
        g = 2 * delay - 0.5 - math.sqrt(2 * delay**2 + 0.25 - 0.25 / sine**2)
    decay = g / (1 + g)
    before = (1 - decay) * (delay - g)
    return decay, before, 1 - decay - before
