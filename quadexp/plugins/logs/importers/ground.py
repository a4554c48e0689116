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
REST_HEIGHT = 0.05  # m above the lowest: stands on the ground
REST_DISTANCE = 0.1  # m from where it begins or ends: stands there
CLEARANCE = 0.5  # m above the ground
AUTO_MARGIN = 1.5  # s cut off after take-off and before landing
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
        kept |= _away(t, start, stop, margin, begins=start == 0, ends=stop == len(t))
    return kept


def _away(t: np.ndarray, start: int, stop: int, margin: float, *, begins: bool, ends: bool) -> np.ndarray:
    """Mask (k,) of the samples start..stop - 1 that lie `margin` (s) away from both ends, but for an end at which the
    log begins or ends."""
    away = np.zeros(len(t), bool)
    away[start:stop] = True
    if not begins:
        away &= t >= t[start] + margin
    if not ends:
        away &= t <= t[stop - 1] - margin
    return away


def _in_flight(t: np.ndarray, values: dict[str, np.ndarray], notes: list[str]) -> np.ndarray:
    """Mask of the rows left where the vehicle neither rests nor takes off nor lands; all where it never flies."""
    every = np.ones(len(t), bool)
    streams = {letter: values[name] for name, letter in LETTERS.items() if name in values}
    thrust = thrust_of(values)
    rest = at_rest(t, streams, thrust)
    position = values.get("position")
    if position is not None:
        stands = _still_ends(t, position)
        if thrust is not None:
            stands &= thrust < RUNNING * flying_level(thrust, streams.get("f"))
        rest |= stands
    if not rest.any():
        return every
    kept = np.zeros(len(t), bool)
    for start, stop in runs(~rest):
        risen = landed = np.arange(start, stop)
        begins = start == 0
        ends = stop == len(t)
        if position is not None and not begins:  # above where it stood before
            risen = risen[position[risen, 2] > position[start - 1, 2] + CLEARANCE]
        if position is not None and not ends:  # above where it stands after
            landed = landed[position[landed, 2] > position[stop, 2] + CLEARANCE]
        if len(risen) and len(landed):
            kept |= _away(t, risen[0], landed[-1] + 1, AUTO_MARGIN, begins=begins, ends=ends)
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
    for end in (0, len(t) - 1):
        still = lowest & (norms(position - position[end]) < REST_DISTANCE)
        for start, stop in runs(still):
            if start <= end < stop and t[stop - 1] - t[start] > REST_TIME:
                rest[start:stop] = True
    return rest
