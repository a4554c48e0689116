"""Ground phases: take-off, landing and rest cut off a log, wherever they stand in it.

A rest is what the motors and the sensors show (signal/rest.py), or standing still on the lowest height at an end of
the log. From there on, the vehicle flies once it is CLEARANCE above where it stood, and AUTO_MARGIN later.
"""

from __future__ import annotations

import numpy as np

from quadexp.log.runs import runs
from quadexp.physics.state import norms
from quadexp.plugins.logs.importers.mapping import Crop
from quadexp.plugins.logs.signal.rest import REST_TIME, RUNNING, at_rest, flying_level, thrust_of

LEAST_ROWS = 10  # of a flight
REST_HEIGHT, REST_DISTANCE = 0.05, 0.1  # m: what counts as standing on the ground
CLEARANCE, AUTO_MARGIN = 0.5, 1.5  # m above the ground; s cut off after take-off and before landing
DIP = 0.2  # s: shorter losses of height or of its measurement do not end a stretch in the air
LETTERS = {"acceleration": "f", "rate": "w", "velocity": "v"}


def without_ground(t: np.ndarray, values: dict[str, np.ndarray], how: Crop, notes: list[str]) -> np.ndarray:
    """Mask of the rows kept; all where there is no flight (the quality check says that)."""
    every = np.ones(len(t), bool)
    if how.mode == "none":
        return every
    position = values.get("position")
    if how.mode == "auto" or position is None:
        return _in_flight(t, values, notes)
    kept = crop(t, position[:, 2], clearance=how.height or 0.0, margin=how.margin)
    if kept.sum() < LEAST_ROWS:
        notes.append("never in the air: nothing is cropped")
        return every
    return kept


def crop(t: np.ndarray, height: np.ndarray, *, clearance: float, margin: float) -> np.ndarray:
    """Mask (k,) of the samples in the air and `margin` (s) away from the ground phases: ground effect and transients.

    In the air is where the height (k,) (m) exceeds the clearance. A log that starts or ends in the air loses
    nothing at that end. All False: no flight.
    """
    up = height > clearance
    for start, stop in runs(~up):
        if start > 0 and stop < len(t) and t[stop] - t[start - 1] < DIP:
            up[start:stop] = True
    kept = np.zeros(len(t), bool)
    for start, stop in runs(up):
        low = t[start] + margin if start > 0 else -np.inf
        high = t[stop - 1] - margin if stop < len(t) else np.inf
        kept[start:stop] = (t[start:stop] >= low) & (t[start:stop] <= high)
    return kept


def _in_flight(t: np.ndarray, values: dict[str, np.ndarray], notes: list[str]) -> np.ndarray:
    """Mask of the rows left where the vehicle neither rests nor takes off nor lands; all where it never flies."""
    every = np.ones(len(t), bool)
    streams = {letter: values[name] for name, letter in LETTERS.items() if name in values}
    thrust = thrust_of(values)
    rest = at_rest(t, streams, thrust)
    position = values.get("position")
    if position is not None:
        stands = _still_ends(t, position)
        rest |= stands if thrust is None else stands & (thrust < RUNNING * flying_level(thrust, streams.get("f")))
    if not rest.any():
        return every
    height = None if position is None else position[:, 2]
    kept = np.zeros(len(t), bool)
    for start, stop in runs(~rest):
        up = np.arange(start, stop)
        if height is not None:  # above where it stood before, and where it stands after
            before = [height[start - 1]] if start > 0 else []
            landed = [height[stop]] if stop < len(t) else []
            high = [height[start:stop] > ground + CLEARANCE for ground in (*before, *landed)]
            first = np.argmax(high[0]) if before and high[0].any() else 0
            last = len(up) - 1 - (np.argmax(high[-1][::-1]) if landed and high[-1].any() else 0)
            up = up[first : last + 1] if all(above.any() for above in high) else up[:0]
        if not len(up):
            continue
        low = t[up[0]] + AUTO_MARGIN if start > 0 else -np.inf
        top = t[up[-1]] - AUTO_MARGIN if stop < len(t) else np.inf
        kept[up] = (t[up] >= low) & (t[up] <= top)
    if kept.sum() < LEAST_ROWS:
        if rest.all() or thrust is not None:  # else it may as well hover
            notes.append("never moves: nothing is cropped" if rest.all() else "never in the air: nothing is cropped")
        return every
    where = ", ".join(f"{t[a] - t[0]:.1f} to {t[b - 1] - t[0]:.1f} s" for a, b in runs(rest)[:6])
    notes.append(f"at rest in {rest.mean():.0%} of the log ({where}): left out with take-off and landing")
    return kept


def _still_ends(t: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Mask of the rows in which the vehicle stands still on its lowest height at an end of the log for a while."""
    lowest = position[:, 2] < position[:, 2].min() + REST_HEIGHT
    rest = np.zeros(len(t), bool)
    for end, order in ((0, slice(None)), (-1, slice(None, None, -1))):
        still = (lowest & (norms(position - position[end]) < REST_DISTANCE))[order]
        count = len(t) if still.all() else int(np.argmin(still))
        if count and abs(t[order][count - 1] - t[order][0]) > REST_TIME:
            rest[order][:count] = True
    return rest
