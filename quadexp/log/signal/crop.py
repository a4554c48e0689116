"""Where a log is in the air: ground phases, take-off and landing left out.

In the air is where the height above the ground exceeds a clearance; of every such stretch a margin is taken off both
ends, because of ground effect and the transients of take-off and landing.
"""

from __future__ import annotations

import numpy as np

CLEARANCE = 0.5  # m
MARGIN = 1.5  # s
DIP = 0.2  # s: shorter losses of height or of its measurement do not end a stretch


def crop(
    t: np.ndarray,
    height: np.ndarray | None = None,
    *,
    thrust: np.ndarray | None = None,
    ground: float = 0.0,
    clearance: float = CLEARANCE,
    margin: float = MARGIN,
) -> np.ndarray:
    """Mask (k,) of the samples in the air and `margin` (s) away from the ground phases.

    height: (k,) m, up. ground: height of the ground. thrust: (k,), any unit that is 0 at rest (sum of commands,
    collective thrust): used where there is no height; in the air is where it exceeds half its median of the samples
    above a tenth of its peak. Without either all is in the air.
    A log that starts or ends in the air loses nothing at that end. All False: no flight.
    """
    t, up = np.asarray(t, float), np.ones(len(t), bool)
    if height is not None:
        up = _without_dips(t, np.asarray(height, float) > ground + clearance)
    elif thrust is not None:
        peak = np.nanmax(thrust)
        up = _without_dips(t, (thrust > 0.5 * np.median(thrust[thrust > 0.1 * peak])) if peak > 0 else ~up)
    kept = up.copy()
    for start, stop in runs(up):
        low = t[start] + margin if start > 0 else -np.inf
        high = t[stop - 1] - margin if stop < len(t) else np.inf
        kept[start:stop] = (t[start:stop] >= low) & (t[start:stop] <= high)
    return kept


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """The maximal runs of True in a mask, (start, stop)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _without_dips(t: np.ndarray, up: np.ndarray) -> np.ndarray:
    up = up.copy()
    for start, stop in runs(~up):
        if start > 0 and stop < len(t) and t[stop] - t[start - 1] < DIP:
            up[start:stop] = True
    return up
