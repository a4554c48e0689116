"""Bad samples: not finite, repeated, frozen, spikes, quaternions not of norm one."""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.log.finding import LEAVE_OUT, Finding, place, span
from quadexp.log.hypotheses.hypothesis import COLUMNS, KEYS
from quadexp.log.hypotheses.windows import STREAMS, attitude_rate
from quadexp.log.signal.crop import runs

NORM = 0.01  # of a quaternion: what rounding to two digits leaves
NORM_BLOCKS = 0.1
FROZEN = 0.2  # s
LEAST_ROWS = 8
MOVES = 0.05  # rad/s or m/s: what a frozen sensor would have had to see
MOST_ROWS = 20_000  # that are looked at for axes that never move
MANY_OUTLIERS, LEAST_OUTLIERS = 0.005, 8  # share of the samples, and samples, beyond which spikes block
SPIKE = 12.0  # robust standard deviations
# The least that counts as a spike: beyond what flying does within a few samples.
SPIKE_FLOOR = {"p": 0.05, "v": 0.5, "w": 8.0, "f": 30.0}


def check_finite(columns: dict[str, np.ndarray], t: np.ndarray) -> list[Finding]:
    """Columns with NaN or infinity."""
    found = []
    for name, values in columns.items():
        if name == "t" or values.dtype.kind != "f":
            continue
        bad = ~np.isfinite(values)
        if not bad.any():
            continue
        bursts = runs(bad)
        start, stop = max(bursts, key=lambda run: run[1] - run[0])
        text = f"{bad.sum()} values in {len(bursts)} {'run' if len(bursts) == 1 else 'runs'}"
        where = f"{name}, {place(start, stop, t)}"
        found.append(Finding("not_finite", "blocking", where, text, "none", span=span(t, start, stop)))
    return _gathered(found)


def _gathered(found: list[Finding]) -> list[Finding]:
    """Columns that fail alike, as one finding."""
    groups: dict[tuple[Any, ...], list[str]] = {}
    for one in found:
        column, _, place = one.where.partition(", ")
        groups.setdefault((one.name, one.severity, place, one.measured, one.allowed, one.span), []).append(column)
    return [
        Finding(name, severity, f"{' '.join(columns)}, {place}", measured, allowed, span=when)
        for (name, severity, place, measured, allowed, when), columns in groups.items()
    ]


def check_quaternion(q: np.ndarray, t: np.ndarray) -> list[Finding]:
    """Norm and sign of quaternions (k, 4)."""
    off = np.abs(np.linalg.norm(q, axis=1) - 1)
    off = np.where(np.isfinite(off), off, 0)
    found = []
    if off.max(initial=0) > NORM:
        start, stop = max(runs(off > NORM), key=lambda run: run[1] - run[0])
        text = f"norm off by {off.max():.3g}, {np.mean(off > NORM):.2%} of the samples by more than allowed"
        severity = "blocking" if off.max() > NORM_BLOCKS else "warning"
        where = f"q_*, {place(start, stop, t)}"
        found.append(Finding("quaternion_norm", severity, where, text, f"{NORM:g}", span=span(t, start, stop)))
    flips = np.flatnonzero(np.sum(q[1:] * q[:-1], axis=1) < -0.5)
    if len(flips):
        text = f"the sign flips {len(flips)} times (the same attitude)"
        where = f"q_*, {place(flips[0] + 1, flips[0] + 2, t)} first"
        found.append(Finding("quaternion_sign", "info", where, text, "none where it is interpolated"))
    return found


def check_repeats(columns: dict[str, np.ndarray], t: np.ndarray) -> tuple[list[Finding], np.ndarray]:
    """Samples that occur twice, time aside; and a mask of the first of each, (k,)."""
    names = [name for name in columns if name != "t" and name != "segment" and columns[name].dtype.kind in "fiu"]
    kept = np.ones(len(t), bool)
    if not names or len(t) < LEAST_ROWS:
        return [], kept
    number = _row_numbers([columns[name] for name in names])
    _, first, inverse = np.unique(number, return_index=True, return_inverse=True)
    again = first[inverse.ravel()] < np.arange(len(t))
    stuck = np.zeros(len(t), bool)
    for start, stop in runs(np.concatenate([[False], number[1:] == number[:-1]])):
        stuck[start:stop] = stop - start >= LEAST_ROWS  # all sensors frozen, or nothing moves: see check_frozen
    again &= ~stuck
    if again.sum() < 2:
        return [], kept
    start, stop = max(runs(again), key=lambda run: run[1] - run[0])
    source = int(first[inverse.ravel()[start]])
    text = f"{again.sum()} samples ({again.mean():.2%}) repeat earlier ones to the last digit, these {source} and on"
    severity = "blocking" if again.mean() > 0.001 else "warning"
    finding = Finding("duplicated_rows", severity, place(start, stop, t), text, "none", LEAVE_OUT, span(t, start, stop))
    return [finding], kept & ~again


def _row_numbers(columns: list[np.ndarray]) -> np.ndarray:
    """A number for every sample, (k,): the same for the same bits, another one (but for 1 in 2^64) for others."""
    total = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        total += np.ascontiguousarray(column, dtype=float).view(np.uint64)
        total ^= total >> np.uint64(29)
        total *= np.uint64(0xBF58476D1CE4E5B9)  # steps of splitmix64 (Steele et al. 2014), each one to one
        total ^= total >> np.uint64(32)
    return total


def check_frozen(streams: dict[str, np.ndarray], t: np.ndarray) -> tuple[list[Finding], dict[str, np.ndarray]]:
    """Sensors that repeat one value while the vehicle moves; masks of those samples by stream."""
    found, masks = [], {}
    step = float(np.median(np.diff(t))) if len(t) > 2 else 0.0
    least = max(LEAST_ROWS, int(np.ceil(FROZEN / step))) if step > 0 else len(t) + 1
    moving = _moving(streams, t)
    for name, values in streams.items():
        same = np.concatenate([[False], (values[1:] == values[:-1]).all(axis=1)])
        stuck, worst, total = np.zeros(len(t), bool), None, 0
        for start, stop in runs(same):
            if stop - start + 1 >= least and np.mean(moving[name][start - 1 : stop]) > MOVES:
                stuck[start - 1 : stop] = True
                total += 1
                if worst is None or stop - start > worst[1] - worst[0] - 1:
                    worst = (start - 1, stop)
        axes, proved = ([], False) if total else _dead(name, values, streams, t)
        if worst is not None:
            masks[name] = stuck
            text = f"one value for {t[worst[1] - 1] - t[worst[0]]:.2f} s while the vehicle moves, {total} times"
            share = stuck.mean()
            severity = "blocking" if share > 0.02 else "warning"
            text += f" ({share:.1%} of the samples)"
            where = f"{COLUMNS[name]}, {place(*worst, t)}"
            when = span(t, *worst)
            found.append(Finding("frozen_sensor", severity, where, text, f"{FROZEN:g} s", LEAVE_OUT, when))
        elif axes:
            columns = " ".join(STREAMS[name][i] for i in axes)
            text = "one value throughout while " + ("the vehicle moves along it" if proved else "the others change")
            severity = "blocking" if proved else "warning"
            found.append(Finding("frozen_sensor", severity, columns, text, f"{FROZEN:g} s"))
    return found, masks


def _dead(name: str, values: np.ndarray, streams: dict[str, np.ndarray], t: np.ndarray) -> tuple[list[int], bool]:
    """Axes that never change though others of the sensor do, and whether another stream moves along one of them.

    A simulated flight in a plane has such axes, and its attitude too: nothing is wrong with it.
    """
    still = np.ptp(values, axis=0) == 0
    if name == "q" or still.all() or not still.any():
        return [], False
    axes = np.flatnonzero(still)
    twin = {"p": "v", "v": "p", "w": "q"}.get(name)
    if twin not in streams:
        return ([int(i) for i in axes], False) if name != "f" or values[0, axes].any() else ([], False)
    part = slice(None, None, max(1, len(t) // MOST_ROWS))
    own, other = t[part], streams[twin][part]
    if name == "v":
        other = np.diff(other, axis=0) / np.diff(own)[:, None]
    elif name == "w":
        other = attitude_rate(own, other)
    moving = [int(i) for i in axes if np.sqrt(np.nanmean(other[:, i] ** 2)) > MOVES]
    return moving, bool(moving)


def _moving(streams: dict[str, np.ndarray], t: np.ndarray) -> dict[str, np.ndarray]:
    """Rate and speed of the vehicle (rad/s, m/s), (k,), from the streams other than the named one."""
    step = np.maximum(np.diff(t), 1e-9)

    def change(x: np.ndarray, sign: float = 1.0) -> np.ndarray:
        """Length of x_k+1 - sign x_k, column by column: a long flight is not copied."""
        total = np.zeros(len(t))
        for column in x.T:
            total[:-1] += (column[1:] - sign * column[:-1]) ** 2
        return np.nan_to_num(np.sqrt(total))

    speed = {}
    if "v" in streams:
        speed["v"] = np.nan_to_num(_length(streams["v"]))
    if "p" in streams:
        speed["p"] = change(streams["p"])
        speed["p"][:-1] /= step
    turning = {}
    if "w" in streams:
        turning["w"] = np.nan_to_num(_length(streams["w"]))
    if "q" in streams:  # twice the chord of half the angle
        turning["q"] = 2 * np.minimum(change(streams["q"]), change(streams["q"], -1.0))
        turning["q"][:-1] /= step
    zero = np.zeros(len(t))
    linear = {name: sum((x for key, x in speed.items() if key != name), zero) for name in "pv"}
    angular = {name: sum((x for key, x in turning.items() if key != name), zero) for name in "qw"}
    every = sum(speed.values(), zero) + sum(turning.values(), zero)
    return {**linear, **angular, "f": every}


def _length(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("ki,ki->k", x, x))


def check_spikes(
    streams: dict[str, np.ndarray], t: np.ndarray, limit: dict[str, float]
) -> tuple[list[Finding], dict[str, np.ndarray]]:
    """Single values far from their neighbours, or beyond a limit; masks of those samples by stream.

    limit: largest magnitude that the vehicle allows, by stream.
    """
    from scipy.ndimage import median_filter

    found, masks = [], {}
    for name, values in streams.items():
        if name == "q" or len(t) < 9:
            continue
        size = _length(np.where(np.isfinite(values), values, 0))
        beyond = size > limit.get(name, np.inf)
        excess = np.where(beyond, size, 0)
        bad, away, threshold = beyond.copy(), [], []
        for own in values.T:
            filled = np.where(np.isfinite(own), own, 0)
            apart = np.abs(filled - median_filter(filled, size=7, mode="nearest"))
            threshold.append(max(SPIKE * 1.4826 * float(np.median(apart)), SPIKE_FLOOR[name]))
            away.append(apart.astype(np.float32))
            bad |= apart > threshold[-1]
        if not bad.any():
            continue
        masks[name] = bad
        share = bad.mean()
        worst = int(np.argmax(excess + np.max([a / h for a, h in zip(away, threshold, strict=True)], axis=0)))
        start, stop = next(run for run in runs(bad) if run[0] <= worst < run[1])
        if beyond[worst]:
            axis = int(np.argmax(np.abs(np.nan_to_num(values[worst]))))
            text = f"magnitude {size[worst]:.4g}, {STREAMS[name][axis]} {values[worst, axis]:.4g}"
            allowed = f"magnitude {limit[name]:.3g}"
        else:
            axis = int(np.argmax([a[worst] / h for a, h in zip(away, threshold, strict=True)]))
            text = f"{values[worst, axis]:.4g}, {away[axis][worst]:.3g} from its neighbours"
            allowed = f"{threshold[axis]:.3g} from the neighbours"
        column = STREAMS[name][axis]
        many = max(LEAST_OUTLIERS, MANY_OUTLIERS * len(t))
        severity = "blocking" if bad.sum() > many or beyond.sum() > max(2, 0.0005 * len(t)) else "warning"
        where = f"{column}, {place(start, stop, t)}"
        text, name = f"{text}; {bad.sum()} samples ({share:.2%})", f"{KEYS[name]}_outlier"
        found.append(Finding(name, severity, where, text, allowed, LEAVE_OUT, span(t, start, stop)))
    return found, masks
