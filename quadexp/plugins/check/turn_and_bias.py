"""A sensor that is turned, biased, or both: which of these the flight tells.

    x_k = M y_k - b + noise         M: in SO(3), x_k: what the motion says over a window, y_k: what the sensor read

A specific force points along the body's z nearly always, so that a turn by a small angle and a bias of g times the
angle look alike; what tells them apart is that the force varies: M by the variations alone (Kabsch 1976, both sides
less their means), then b by the means. Two explanations are compared stretch by stretch of the flight, by the
difference of their squared residuals, less their means, and its own standard error (Vuong 1989); where that is less
than CLEAR, both are named. The means do not count: every sensor has a small bias beside what is looked for.
"""

from __future__ import annotations

import numpy as np

from quadexp.plugins.check.axis_scale import body_force
from quadexp.plugins.check.candidates import (
    BIAS,
    BIAS_SURE,
    KEYS,
    LEAST_MOTION,
    MOST_TURN,
    SENSORS,
    Candidate,
    certain_turn,
    stretches_of,
    turn_of,
    turn_words,
)
from quadexp.plugins.logs.signal.windows import RELATIONS, Windows, pairs

KEPT = 0.9  # share of the windows
CLEAR = 3.5  # standard errors of a difference of squared residuals
COST = 1.9  # log units: how much a turn with a bias claims, see Candidate.cost

Sides = dict[str, tuple[np.ndarray, np.ndarray]]  # letter -> what the motion says, what the sensor read, (n, 3)


def sides(windows: Windows) -> Sides:
    """Of gyro and accelerometer, where the motion tells them."""
    result: Sides = {}
    rate = next((pair for pair in pairs(windows, "w") if pair.name == "rate"), None)
    if rate is not None:
        moves = np.sqrt(np.mean(np.sum(rate.expected**2, axis=1)))
        if moves > LEAST_MOTION * RELATIONS["rate"].floor:
            result["w"] = rate.expected, rate.measured
    force = body_force(windows)
    if force is not None:
        result["f"] = force
    return result


def turned_and_biased(windows: Windows) -> list[Candidate]:
    """Of the gyro, the accelerometer, and both on one board: turned and biased at once, where the flight tells both."""
    known = sides(windows)
    candidates = []
    for streams, (_, _, words) in SENSORS.items():
        if set(streams) <= known.keys():
            candidate = _candidate(streams, {name: known[name] for name in streams}, len(windows.t), words)
            candidates += [] if candidate is None else [candidate]
    return candidates


def _candidate(streams: str, known: Sides, windows: int, words: str) -> Candidate | None:
    sides = []
    for name, (x, y) in known.items():
        floor = RELATIONS["rate" if name == "w" else "force"].floor
        sides.append(((x - x.mean(axis=0)) / floor, (y - y.mean(axis=0)) / floor))
    found = certain_turn(*turn_of(sides, windows), alone=streams == "f")
    if found is None:
        return None
    turn, error = found
    angles, text = turn_words(words, turn, error)
    lines: dict[str, dict[str, object]] = {KEYS[name]: {"mounting": angles} for name in sorted(streams)}
    biases = []
    for name, (x, y) in known.items():
        gap = turn.apply(y) - x
        bias = np.median(gap, axis=0)
        medians = np.array([np.median(part, axis=0) for part in _by_stretch(gap, windows)])
        uncertain = medians.std(axis=0, ddof=1) / np.sqrt(len(medians))
        bias = np.where(np.abs(bias) > BIAS_SURE * uncertain, bias, 0.0)
        _, least, most, unit = BIAS[name]
        if np.abs(bias).max() > most:  # it is another fault that looks like one
            return None
        if np.abs(bias).max() < least:
            continue
        offset = [float(f"{x:.3g}") + 0.0 for x in bias]
        lines[KEYS[name]]["offset"] = offset
        biases.append(f"{', '.join(f'{x:g}' for x in offset)} {unit}")
    if not biases:
        return None
    severity = "warning" if np.degrees(turn.magnitude()) <= MOST_TURN else "blocking"
    return Candidate("mounting", streams, f"{text}, with a bias of {' and '.join(biases)}", lines, COST, severity)


def _by_stretch(values: np.ndarray, windows: int) -> list[np.ndarray]:
    stretch = stretches_of(len(values), windows)
    return [values[stretch == k] for k in np.unique(stretch)]


def better(a: Windows, b: Windows, streams: str) -> float:
    """By how many standard errors the variations of these streams agree better in windows `a` than in `b`."""
    differences = []
    of_a, of_b = sides(a), sides(b)
    for name in set(streams) & of_a.keys() & of_b.keys():
        floor = RELATIONS["rate" if name == "w" else "force"].floor
        gaps = [y - x - np.median(y - x, axis=0) for x, y in (of_a[name], of_b[name])]
        squares = [np.sum(gap**2, axis=1) / floor**2 for gap in gaps]
        kept = np.logical_and.reduce([square <= np.quantile(square, KEPT) for square in squares])
        gained = np.where(kept, squares[1] - squares[0], 0.0)
        differences.append(np.array([part.mean() for part in _by_stretch(gained, len(a.t))]))
    if not differences or len(differences[0]) < 3:
        return 0.0
    total = np.sum(differences, axis=0)
    error = total.std(ddof=1) / np.sqrt(len(total))
    return float(total.mean() / max(error, 1e-12))
