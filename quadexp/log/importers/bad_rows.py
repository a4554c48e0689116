"""Bad samples (repeated, outliers, filled in by a dead logger), left out or made gaps.

"drop": a run of fewer than GAP_PERIODS rows is bridged between its neighbours, as lost samples are; a longer one is a
gap. "gap": every run is one. A gap starts a new segment.
"""

from __future__ import annotations

import numpy as np

from quadexp.errors import DataError
from quadexp.log.schema import Flight
from quadexp.log.signal import GAP_PERIODS, derivative, runs
from quadexp.log.signal.resample import interpolate
from quadexp.physics.vehicle import Vehicle

MODES = ("refuse", "drop", "gap")
MOST = 0.2  # share of the rows: beyond, the fault is not one of rows
ROUNDS = 3  # what is left out may have hidden something
SHORTEST = 5  # rows of a segment
ATTITUDES = (("q_w", "q_x", "q_y", "q_z"), ("ref_q_w", "ref_q_x", "ref_q_y", "ref_q_z"))
HELD = ("motor_command_", "u_", "battery_voltage", "wind_", "segment", "status")


def without_bad_rows(
    flight: Flight, vehicle: Vehicle | None, mode: str, *, derived: bool = False
) -> tuple[Flight, dict[str, int], list[str]]:
    """The flight without its bad samples; how many by the fault's name; and notes.

    mode: "drop" or "gap". derived: whether the velocity is the derivative of the position, and made anew.
    """
    from quadexp.log.check import inspect_flight

    counts: dict[str, int] = {}
    total, length = 0, len(flight)
    for _ in range(ROUNDS):
        _, masks, _ = inspect_flight(flight, vehicle)
        bad = np.zeros(len(flight), bool)
        for mask in masks.values():
            bad |= mask
        if not bad.any():
            break
        if total + int(bad.sum()) > MOST * length:
            text = f"{bad.mean():.1%} of the rows are bad ({', '.join(masks)}), {MOST:.0%} is the most that is left out"
            return flight, counts, [f"{text}: not done"]
        for name, mask in masks.items():
            counts[name] = counts.get(name, 0) + int(mask.sum())
        total += int(bad.sum())
        flight = _without(flight, bad, mode, derived)
    if not total:
        return flight, counts, []
    by_name = ", ".join(f"{count} {name}" for name, count in counts.items())
    what = "bridged where short, else made a gap" if mode == "drop" else "made gaps"
    return flight, counts, [f"left out: {total} of {length} rows ({total / length:.2%}; {by_name}), {what}"]


def _without(flight: Flight, bad: np.ndarray, mode: str, derived: bool) -> Flight:
    gap = bad.copy()
    for start, stop in runs(bad) if mode == "drop" else ():
        if stop - start < GAP_PERIODS and start > 0 and stop < len(bad):
            gap[start:stop] = False
    columns = _bridged(flight, bad, bad & ~gap)
    segment = np.asarray(columns.get("segment", np.zeros(len(flight), np.int32)))
    breaks = np.concatenate([[False], (np.diff(segment) != 0) | (gap[1:] & ~gap[:-1])])
    number = np.cumsum(breaks)
    count = np.bincount(number[~gap], minlength=number[-1] + 1)
    kept = ~gap & (count[number] >= SHORTEST)
    if kept.sum() < 2 * SHORTEST:
        raise DataError("nothing is left once bad rows are left out")
    columns = {name: values[kept] for name, values in columns.items()}
    _, columns["segment"] = np.unique(number[kept], return_inverse=True)
    columns["segment"] = columns["segment"].astype(np.int32)
    columns["t"] = columns["t"] - columns["t"][0]
    left = Flight(columns, flight.metadata)
    if derived:
        window = max(0.1, 5 * float(np.median(np.diff(left.t))))
        velocity = derivative(left.t, left.stack(["p_x", "p_y", "p_z"]), segment=left["segment"], window=window).values
        columns |= dict(zip(("v_x", "v_y", "v_z"), velocity.T, strict=True))
    return left


def _bridged(flight: Flight, bad: np.ndarray, filled: np.ndarray) -> dict[str, np.ndarray]:
    """The columns with the rows `filled` made from rows that are not bad."""
    columns = dict(flight.columns)
    if not filled.any():
        return columns
    t, good = flight.t, ~bad
    attitudes = [names for names in ATTITUDES if set(names) <= set(columns)]
    for names in (*attitudes, *((name,) for name in columns if name != "t" and name not in sum(attitudes, ()))):
        values = flight.stack(names)
        if values.dtype.kind not in "fiu":
            continue
        sphere, held = len(names) == 4, names[0].startswith(HELD) or values.dtype.kind != "f"
        bridge = interpolate(t[good], values[good].astype(float), t[filled], sphere=sphere, held=held)
        values[filled] = bridge
        columns |= dict(zip(names, values.T, strict=True))
    return columns
