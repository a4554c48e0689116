"""Bad samples: not finite, repeated, frozen, spikes, quaternions not of norm one."""

from __future__ import annotations

import numpy as np

from quadexp.log.finding import LEAVE_OUT, Finding, place, span
from quadexp.log.hypotheses.candidates import COLUMNS, KEYS
from quadexp.log.hypotheses.windows import STREAMS, attitude_rate
from quadexp.log.signal.crop import runs

NORM, NORM_BLOCKS = 0.01, 0.1  # of a quaternion: what rounding to two digits leaves
FROZEN = 0.2  # s
LEAST_ROWS = 8
MOVES = 0.05  # rad/s or m/s: what a frozen sensor would have had to see
MOST_ROWS = 20_000  # that are looked at for axes that never move
MANY_OUTLIERS, LEAST_OUTLIERS = 0.005, 8  # share of the samples, and samples, beyond which spikes block
SPIKE = 12.0  # robust standard deviations
# The least that counts as a spike: beyond what flying does within a few samples.
SPIKE_FLOOR = {"p": 0.05, "v": 0.5, "w": 8.0, "f": 30.0}


def check_finite(columns: dict[str, np.ndarray], t: np.ndarray) -> list[Finding]:
    """Columns with NaN or infinity; those that fail in the same samples as one finding."""
    alike: dict[bytes, tuple[np.ndarray, list[str]]] = {}
    for name, values in columns.items():
        bad = ~np.isfinite(values) if values.dtype.kind == "f" and name != "t" else np.zeros(len(t), bool)
        if bad.any():
            alike.setdefault(bad.tobytes(), (bad, []))[1].append(name)
    found = []
    for bad, names in alike.values():
        bursts = runs(bad)
        start, stop = max(bursts, key=lambda run: run[1] - run[0])
        text = f"{bad.sum()} values in {len(bursts)} {'run' if len(bursts) == 1 else 'runs'}"
        where = f"{' '.join(names)}, {place(start, stop, t)}"
        found.append(Finding("not_finite", "blocking", where, text, "none", span=span(t, start, stop)))
    return found


def check_quaternion(q: np.ndarray, t: np.ndarray) -> list[Finding]:
    """Norm of quaternions (k, 4)."""
    off = np.abs(np.nan_to_num(np.linalg.norm(q, axis=1), nan=1.0, posinf=1.0) - 1)
    if off.max(initial=0) <= NORM:
        return []
    start, stop = max(runs(off > NORM), key=lambda run: run[1] - run[0])
    text = f"norm off by {off.max():.3g}, {np.mean(off > NORM):.2%} of the samples by more than allowed"
    severity = "blocking" if off.max() > NORM_BLOCKS else "warning"
    where = f"q_*, {place(start, stop, t)}"
    return [Finding("quaternion_norm", severity, where, text, f"{NORM:g}", span=span(t, start, stop))]


def check_repeats(columns: dict[str, np.ndarray], t: np.ndarray) -> tuple[list[Finding], np.ndarray]:
    """Samples that occur twice, time aside; and a mask of the first of each, (k,)."""
    names = [name for name in columns if name not in ("t", "segment") and columns[name].dtype.kind in "fiu"]
    kept = np.ones(len(t), bool)
    if not names or len(t) < LEAST_ROWS:
        return [], kept
    number = _row_numbers([columns[name] for name in names])
    _, first, inverse = np.unique(number, return_index=True, return_inverse=True)
    again = first[inverse.ravel()] < np.arange(len(t))
    for start, stop in runs(np.concatenate([[False], number[1:] == number[:-1]])):
        again[start:stop] &= stop - start < LEAST_ROWS  # else all sensors froze, or nothing moves: see check_frozen
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
        stuck = [
            (start - 1, stop) for start, stop in runs(same)
            if stop - start + 1 >= least and np.mean(moving[name][start - 1 : stop]) > MOVES
        ]  # fmt: skip
        if stuck:
            mask = masks[name] = np.zeros(len(t), bool)
            for start, stop in stuck:
                mask[start:stop] = True
            worst = max(stuck, key=lambda run: run[1] - run[0])
            text = f"one value for {t[worst[1] - 1] - t[worst[0]]:.2f} s while the vehicle moves, {len(stuck)} times"
            text += f" ({mask.mean():.1%} of the samples)"
            severity = "blocking" if mask.mean() > 0.02 else "warning"
            where, when = f"{COLUMNS[name]}, {place(*worst, t)}", span(t, *worst)
            found.append(Finding("frozen_sensor", severity, where, text, f"{FROZEN:g} s", LEAVE_OUT, when))
            continue
        axes, proved = _still_axes(name, values, streams, t)
        if axes:
            columns = " ".join(STREAMS[name][i] for i in axes)
            text = "one value throughout while " + ("the vehicle moves along it" if proved else "the others change")
            found.append(Finding("frozen_sensor", "blocking" if proved else "warning", columns, text, f"{FROZEN:g} s"))
    return found, masks


def _still_axes(name: str, values: np.ndarray, streams: dict[str, np.ndarray], t: np.ndarray) -> tuple[list[int], bool]:
    """Axes that never change though others of the sensor do, and whether another stream moves along one of them.

    A simulated flight in a plane has such axes, and its attitude too: nothing is wrong with it.
    """
    still = np.ptp(values, axis=0) == 0
    if name == "q" or still.all() or not still.any():
        return [], False
    axes = [int(i) for i in np.flatnonzero(still)]
    twin = {"p": "v", "v": "p", "w": "q"}.get(name)
    if twin not in streams:
        return (axes if name != "f" or values[0, axes].any() else []), False
    part = slice(None, None, max(1, len(t) // MOST_ROWS))
    other = streams[twin][part]
    if name == "v":
        other = np.diff(other, axis=0) / np.diff(t[part])[:, None]
    elif name == "w":
        other = attitude_rate(t[part], other)
    moving = [i for i in axes if np.sqrt(np.nanmean(other[:, i] ** 2)) > MOVES]
    return moving, bool(moving)


def _moving(streams: dict[str, np.ndarray], t: np.ndarray) -> dict[str, np.ndarray]:
    """Rate and speed of the vehicle (rad/s, m/s), (k,), from the streams other than the named one."""
    zero = np.zeros(len(t))

    def change(x: np.ndarray, sign: float = 1.0) -> np.ndarray:
        """Length of x_k+1 - sign x_k over the step, column by column: a long flight is not copied."""
        total = np.zeros(len(t))
        for column in x.T:
            total[:-1] += (column[1:] - sign * column[:-1]) ** 2
        total[:-1] /= np.maximum(np.diff(t), 1e-9) ** 2
        return np.nan_to_num(np.sqrt(total))

    motion = {name: np.nan_to_num(_length(streams[name])) for name in "vw" if name in streams}
    if "p" in streams:
        motion["p"] = change(streams["p"])
    if "q" in streams:  # twice the chord of half the angle
        motion["q"] = 2 * np.minimum(change(streams["q"]), change(streams["q"], -1.0))
    twins = {name: motion.get(twin, zero) for name, twin in zip("pvqw", "vpwq", strict=True)}
    return {**twins, "f": sum(motion.values(), zero)}


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
        away, worst = (
            np.where(beyond, size, 0.0),
            (0.0, 0, 0.0, 0.0),
        )  # in thresholds; of one axis: that, axis, size, limit
        bad, row = beyond.copy(), 0
        for axis, column in enumerate(values.T):
            filled = np.where(np.isfinite(column), column, 0)
            apart = np.abs(filled - median_filter(filled, size=7, mode="nearest"))
            threshold = max(SPIKE * 1.4826 * float(np.median(apart)), SPIKE_FLOOR[name])
            bad |= apart > threshold
            k = int(np.argmax(away + apart / threshold))
            if (value := float(away[k] + apart[k] / threshold)) > worst[0]:
                worst, row = (value, axis, float(apart[k]), threshold), k
        if not bad.any():
            continue
        masks[name] = bad
        start, stop = next(run for run in runs(bad) if run[0] <= row < run[1])
        _, axis, apart_by, threshold = worst
        if beyond[row]:
            axis = int(np.argmax(np.abs(np.nan_to_num(values[row]))))
            text, allowed = f"magnitude {size[row]:.4g}, {STREAMS[name][axis]}", f"magnitude {limit[name]:.3g}"
            text += f" {values[row, axis]:.4g}"
        else:
            text = f"{values[row, axis]:.4g}, {apart_by:.3g} from its neighbours"
            allowed = f"{threshold:.3g} from the neighbours"
        many = max(LEAST_OUTLIERS, MANY_OUTLIERS * len(t))
        severity = "blocking" if bad.sum() > many or beyond.sum() > max(2, 0.0005 * len(t)) else "warning"
        where, when = f"{STREAMS[name][axis]}, {place(start, stop, t)}", span(t, start, stop)
        text += f"; {bad.sum()} samples ({bad.mean():.2%})"
        found.append(Finding(f"{KEYS[name]}_outlier", severity, where, text, allowed, LEAVE_OUT, when))
    return found, masks
