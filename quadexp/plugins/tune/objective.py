"""What a trial is worth: one number over its flights, the smaller the better.

    completed flight      ln(e / 1 m), e its mean error (or another metric)
    flight that did not         LOST (2 - s), s the share of its path that was flown; not flown at all: s = 0;
                                flown to the end, but outside its corridor: s = 1
    trial                       the mean over its flights; with a least delay margin, and a smaller one found:
                                + LOST (2 - margin / least)

The mean of logarithms is that of ratios: 10 % in a cell of 1 mm counts as 10 % in a cell of 1 m. LOST is larger than
the logarithm of any ratio of two errors of a flight (0.1 um to 10 m is 18), so that a lost flight is not made up for by
any error of another one; of two losses the later is better, so that a search can leave a region where all is lost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from quadexp.report.pairing import Rows

LOST = 20.0  # ln(5e8)
LEAST = 1e-9  # m, of an error, whose logarithm must exist


class Worth(NamedTuple):
    """value: see the module. error: geometric mean (m) over the completed flights, NaN for none. lost: number of
    the others. margin: smallest delay margin (s) of the flights, NaN where none is known."""

    value: float
    error: float
    lost: int
    margin: float


def worth(
    rows: Rows,
    durations: Sequence[float],
    *,
    metric: str = "mean_error",
    margins: Sequence[float] = (),
    least_margin: float = 0.0,
) -> Worth:
    """The worth of a trial. rows: of its flights. durations: of their paths (s). margins: delay margins (s) found."""
    costs = []
    logs = []
    for row, duration in zip(rows, durations, strict=True):
        value = float(row[metric])
        if row["outcome"] == "ok" and math.isfinite(value):
            logs.append(math.log(max(value, LEAST)))
            costs.append(logs[-1])
        else:
            flown = float(row["duration"]) if math.isfinite(float(row["duration"])) else 0.0
            costs.append(LOST * (2 - min(max(flown / duration, 0.0), 1.0)))
    total = sum(costs) / len(costs)
    margin = min(margins, default=math.nan)
    if least_margin and margin < least_margin:
        total += LOST * (2 - max(margin, 0.0) / least_margin)
    error = math.exp(sum(logs) / len(logs)) if logs else math.nan
    return Worth(total, error, len(costs) - len(logs), margin)
