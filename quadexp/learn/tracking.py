"""The scale of the thrust, tracked in flight from the accelerometer: what no model knows of the next flight's battery.

    f_z - a_z(v) = g c + e        g_k = (p r^k + sum_{j<k} r^{k-j} c_j y_j) / (p r^k + sum_{j<k} r^{k-j} c_j^2)

c is the thrust curve's collective acceleration, y what it should have been, r = exp(-dt / memory). g_k is made of
samples before k only, so a prediction with it is one that could have been made in flight. It starts at 1, held there by
p, the weight of half a second at first. The memory is long (10 s): a short one would repeat the last residual and call
that a model.
"""

from __future__ import annotations

import numpy as np

MEMORY = 10.0  # s
PRIOR = 0.5  # s


def tracked_scale(
    collective: np.ndarray, wanted: np.ndarray, dt: float, start: np.ndarray | None = None, *, memory: float = MEMORY
) -> np.ndarray:
    """g of the module before every sample, (k,).

    collective c, wanted y: (k,) m/s^2, one flight. dt: s. start: (k,) bool, where a flight begins and g goes back to 1.
    """
    from scipy.signal import lfilter

    start = np.zeros(len(collective), bool) if start is None else np.asarray(start, bool).copy()
    start[:1] = True
    scale = np.empty(len(collective))
    bounds = np.append(np.flatnonzero(start), len(collective))
    decay = float(np.exp(-dt / memory))
    for a, b in zip(bounds[:-1], bounds[1:], strict=True):
        c, y = collective[a:b], wanted[a:b]
        prior = PRIOR / dt * c[0] ** 2 * decay ** np.arange(b - a)
        past = lfilter([0.0, 1.0], [1.0, -decay], np.stack([c * y, c * c]), axis=1)
        scale[a:b] = (prior + past[0]) / (prior + past[1])
    return scale
