"""Which column is the clock: it never goes back, and its unit makes the rate one that loggers have."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from quadexp.errors import DataError
from quadexp.log.importers.names import groups, unit_of
from quadexp.log.units import UNITS

SECONDS = {unit: UNITS["time"][unit] for unit in ("s", "ms", "us", "ns")}
RATES = (4.0, 8200.0)  # Hz, of loggers
EPOCHS = ((1e18, "ns"), (1e15, "us"), (1e12, "ms"))  # about now, since 1970


def find_clock(path: Path, names: list[str], data: np.ndarray) -> tuple[int, str, str, float]:
    """Column and unit of the clock, why, and how sure that is (0 to 1).

    data: (k, N), the columns `names`. Raises DataError where no column increases from row to row.
    """
    named = {columns[0] for columns in groups(names).get("time", [])}
    best = _steadiest(path, data, named)
    column = data[:, best]
    column = column[np.isfinite(column)]
    steps = np.diff(column)
    step = float(np.median(steps[steps > 0]))
    written = unit_of(names[best])[1]
    if written in SECONDS:
        return best, str(written), "the name says the unit", 0.98 if best in named else 0.9
    rates = {unit: 1 / (step * seconds) for unit, seconds in SECONDS.items()}
    fitting = [unit for unit, rate in rates.items() if RATES[0] <= rate <= RATES[1]]
    unit = fitting[0] if fitting else "s"
    first = abs(float(column[0]))
    for size, name in EPOCHS:
        if first > 0.9 * size and name in fitting:
            unit = name
            break
    why = f"increases by {step:.6g} a row: {rates[unit]:.4g} Hz" + (", and named so" if best in named else "")
    return best, unit, why, (0.97 if best in named else 0.85) if fitting else 0.4


def _steadiest(path: Path, data: np.ndarray, named: set[int]) -> int:
    """The column that increases most steadily; one whose name says `time` before others, a mere counter last."""
    scores = []
    for i, column in enumerate(data.T):
        column = column[np.isfinite(column)]
        if len(column) < 0.5 * len(data) or len(column) < 20:
            continue
        steps = np.diff(column)
        ahead = float((steps > 0).mean())
        if ahead < 0.3 or (steps < 0).mean() > 0.01 or column[-1] <= column[0]:
            continue
        counter = bool((steps == steps[0]).all() and steps[0] == 1.0 and column[0] in (0.0, 1.0))
        even = float(np.median(np.abs(steps - np.median(steps))) / max(np.median(steps), 1e-300))
        scores.append((2 * (i in named) + ahead - min(even, 1.0) - 1.5 * counter - 0.001 * i, i))
    if not scores:
        raise DataError(f"{path}: no column increases from row to row: there is no clock")
    return max(scores)[1]
