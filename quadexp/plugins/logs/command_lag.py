"""Dead time and lag of the thrust behind commands of any unit (a share, pulse width, rotor speed or force).

    f_z = sum_p c_p sum_i L[s_i^p] + c_v v_z + c_w |v_z| v_z + c_h |v_xy|^2     p = 1, 2

L: dead time d, then a first-order lag tau, of a signal that is held between its samples: T the period, y_j the state at
the beginning of the interval j in which t - d lies, a the time since then,

    L[s](t) = (1 - exp(-a / tau)) s_j + exp(-a / tau) y_j,      y_j+1 = exp(-T / tau) y_j + (1 - exp(-T / tau)) s_j

Every column goes through the band LOW .. HIGH (battery, wind and the slow part of the loop below it, noise above); c by
least squares at each (d, tau). The cost is n/2 log of the residual's square, n of samples that are independent in the
band. A dead time or a lag alone is taken where both are not SIMPLER more likely, and of dead times that are alike, as
those of a held command are over a period where nothing lags, the shortest. Interval:
blocks of BLOCK seconds drawn with replacement, all that is as likely as NEAR, and RESOLUTION at each end: of a sampled
log no finer time is given. A log does not say whether a signal was held between its samples: where a loop is faster
than its log, all is T/2 later than found, which the upper ends of the dead time and of the sum contain unless it is
known to have been held.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from quadexp.log.runs import period_of, runs

FINE = 1e-3  # s
LOW = 0.8  # Hz
HIGH = 12.0  # Hz
BLOCK = 1.0  # s, of the blocks that are resampled
DRAWS = 100  # resamplings for an interval
RESOLUTION = 3e-3  # s
EDGE = 0.3  # s, where the filters settle
LEAST_SECONDS = 4.0  # s of motion: four blocks
MOST_SECONDS = 240.0  # of all flights together
WORTH = 8.0  # log likelihood that a delay must bring to be real
ALIKE = 0.25  # log likelihood below the best: as good
SIMPLER = 2.0  # log likelihood that one more constant must bring
NEAR = 1.92  # log likelihood below the best: 95 %
DEAD_TIMES = np.arange(0.0, 0.0605, FINE)
LAGS = np.r_[0.0:0.006:FINE, 0.0075:0.02:0.0025, 0.02:0.05:0.005, 0.05:0.1601:0.01]
FINE_LAGS = np.arange(0.0, LAGS[-1] + FINE / 2, FINE)
NAMES = ("dead time", "lag", "sum")


class CommandLag(NamedTuple):
    """dead_time, lag (s). intervals: 95 %, low and high, of dead time, lag and their sum, (3, 2) (s). worth: log
    likelihood above that of commands that act at once. likelihood: log less the largest, by dead time and lag, in steps
    of FINE."""

    dead_time: float
    lag: float
    intervals: np.ndarray
    worth: float
    likelihood: np.ndarray = np.zeros((1, 1))

    @property
    def late(self) -> bool:
        """Whether the flights show that commands act late at all."""
        return self.worth > WORTH

    @property
    def error(self) -> float:
        """Standard error of the sum (s)."""
        low, high = self.intervals[2]
        return float(high - low) / (2 * 1.96)

    @property
    def at_bound(self) -> np.ndarray:
        """Whether dead time, lag or their sum may be beyond what is searched, (3,): no upper end is known."""
        largest = np.array([DEAD_TIMES[-1], LAGS[-1]])
        upper = self.intervals[:2, 1]
        beyond = upper > largest - FINE
        return np.append(beyond, beyond.any())

    def __str__(self) -> str:
        values = (self.dead_time, self.lag, self.dead_time + self.lag)
        parts = []
        for name, value, (low, high), open_end in zip(NAMES, values, self.intervals, self.at_bound, strict=True):
            span = f"at least {1e3 * low:.0f}" if open_end else f"[{1e3 * low:.0f}, {1e3 * high:.0f}]"
            parts.append(f"{name} {1e3 * value:.0f} {span} ms")
        return ", ".join(parts)


def lagged(signal: np.ndarray, period: float, dead_time: float, lag: float, *, ends: bool = False) -> np.ndarray:
    """L[s] at the samples, (k, n), of one stretch. signal: (k, n), held from each sample to the next; ends: over the
    interval that ends at the sample instead. Before the first sample it is that of the first."""
    back, kept = _place(period, dead_time, lag, ends)
    begins = _begins(signal, period, lag)
    at = np.maximum(np.arange(len(signal)) - back, 0)
    return (1 - kept) * signal[at] + kept * begins[at]


def _place(period: float, dead_time: float, lag: float, ends: bool) -> tuple[int, float]:
    """How many intervals before that of a sample a time `dead_time` before it lies, and exp(-a / tau)."""
    part = dead_time / period
    back = int(np.floor(part + 1e-9)) if ends else int(np.ceil(part - 1e-9))
    since = (back + ends - part) * period
    return back, _kept(since, lag)


def _kept(time: float, lag: float) -> float:
    """exp(-t / tau)."""
    return float(np.exp(-time / lag)) if lag > 0 else 0.0


def _begins(signal: np.ndarray, period: float, lag: float) -> np.ndarray:
    """y_j, (k, n)."""
    from scipy.signal import lfilter

    kept = _kept(period, lag)
    before = np.concatenate([signal[:1], signal[:-1]])
    return lfilter([1 - kept], [1.0, -kept], before, axis=0, zi=kept * signal[:1])[0]


def find_lag(
    time: np.ndarray, segment: np.ndarray, signal: np.ndarray, force: np.ndarray, velocity: np.ndarray, held: np.ndarray
) -> CommandLag | None:
    """Of flights one after another; None where they are too short or too slow.

    time: (k,) s. segment: (k,), ascending numbers. signal: (k, n). force: f_z, (k,) m/s^2. velocity: (k, 3) body, m/s.
    held: (k,), whether the signal is that of the interval that ends at the sample.
    """
    v_x, v_y, v_z = velocity.T
    beside = np.column_stack([v_z, np.abs(v_z) * v_z, v_x**2 + v_y**2, force])
    sums = []
    counts = []
    seconds = 0.0
    longest = 0.0
    for rows in _stretches(time, segment):
        period = period_of(time[rows])
        if period > 1 / (2.5 * HIGH):
            continue
        of_rows, count = _sums(signal[rows], beside[rows], period, bool(held[rows][0]))
        sums.append(of_rows)
        counts.append(count * min(1.0, 2 * HIGH * period))
        longest = max(longest, period)
        seconds += float(np.ptp(time[rows]))
        if seconds > MOST_SECONDS:
            break
    if seconds < LEAST_SECONDS:
        return None
    blocks = np.concatenate(sums, axis=2)
    count = np.concatenate(counts)
    cost = _cost(blocks, count, np.ones(len(count)))
    best, (low, high) = _likeliest(cost)
    alike = np.full(len(count), 1 / len(count))
    drawn = np.random.default_rng(0).multinomial(len(count), alike, DRAWS)
    likely = np.array([_likeliest(_cost(blocks, count, weight))[0] for weight in drawn])
    likely = np.column_stack([likely, likely.sum(axis=1)])
    lowest, highest = np.percentile(likely, [2.5, 97.5], axis=0)
    low = np.minimum(low, lowest) - RESOLUTION
    high = np.maximum(high, highest) + RESOLUTION
    if not held.all():
        high[[0, 2]] += longest / 2
    intervals = np.maximum(np.column_stack([low, high]), 0.0)
    likelihood = cost.min() - cost
    return CommandLag(float(best[0]), float(best[1]), intervals, -float(likelihood[0, 0]), likelihood)


def _stretches(time: np.ndarray, segment: np.ndarray) -> Iterator[slice]:
    """Evenly sampled stretches that are long enough."""
    for number in np.unique(segment):
        rows = np.flatnonzero(segment == number)
        step = np.diff(time[rows])
        if not len(step):
            continue
        period = np.median(step)
        for start, stop in runs(np.abs(step - period) < 0.1 * period):
            if time[rows[stop]] - time[rows[start]] > 2 * EDGE + 2 * BLOCK:
                yield slice(rows[start], rows[stop] + 1)


def _sums(signal: np.ndarray, beside: np.ndarray, period: float, held: bool) -> tuple[np.ndarray, np.ndarray]:
    """Sums of products of the columns and f_z by dead time, lag and block, (d, tau, b, 6, 6); samples of each block."""
    powers = np.column_stack([signal.sum(axis=1), np.sum(signal**2, axis=1)])
    fixed = _band(beside, period)
    most = int(np.ceil(DEAD_TIMES[-1] / period))
    edge = max(int(EDGE / period), most)
    inner = np.arange(edge, len(signal) - edge)
    n_blocks = int(len(inner) * period / BLOCK)
    blocks = np.array_split(inner, max(2, n_blocks))
    n_powers = powers.shape[1]
    size = n_powers + beside.shape[1]
    beginning = n_powers * (most + 1)  # of the columns y
    sums = np.zeros((len(DEAD_TIMES), len(LAGS), len(blocks), size, size))
    held_band = _band(powers, period)
    for j, lag in enumerate(LAGS):
        begun = _band(_begins(powers, period, lag), period)
        shifted = [np.roll(x, back, axis=0) for x in (held_band, begun) for back in range(most + 1)]
        columns = np.column_stack([*shifted, fixed])
        products = np.array([columns[block].T @ columns[block] for block in blocks])
        for i, dead_time in enumerate(DEAD_TIMES):
            back, kept = _place(period, dead_time, lag, held)
            chosen = np.zeros((columns.shape[1], size))
            for power in range(n_powers):
                chosen[n_powers * back + power, power] = 1 - kept
                chosen[beginning + n_powers * back + power, power] = kept
            chosen[-beside.shape[1] :, n_powers:] = np.eye(beside.shape[1])
            sums[i, j] = chosen.T @ products @ chosen
    return sums, np.array([len(block) for block in blocks])


def _band(x: np.ndarray, period: float) -> np.ndarray:
    """Between LOW and HIGH, (k, m), without phase."""
    from scipy.signal import butter, sosfiltfilt

    below = {}
    for frequency in (LOW, HIGH):
        sections = butter(2, frequency, fs=1 / period, output="sos")
        below[frequency] = sosfiltfilt(sections, x, axis=0)
    return below[HIGH] - below[LOW]


def _cost(blocks: np.ndarray, count: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Minus the log likelihood by dead time and lag, on grids of FINE, with blocks of these weights, (b,)."""
    from scipy.interpolate import Akima1DInterpolator

    total = np.tensordot(blocks, weight, (2, 0))
    power = total[..., -1, -1]
    normal = total[..., :-1, :-1]
    diagonal = np.einsum("...ii->...i", normal)
    size = np.sqrt(np.maximum(diagonal, 1e-300))
    normal = normal / (size[..., None] * size[..., None, :])
    normal += 1e-9 * np.eye(size.shape[-1])
    along = total[..., :-1, -1] / size
    solved = np.linalg.solve(normal, along[..., None])[..., 0]
    unexplained = power - np.sum(along * solved, axis=-1)
    half_count = float(weight @ count) / 2
    cost = half_count * np.log(np.maximum(unexplained, 1e-12 * power))
    return Akima1DInterpolator(LAGS, cost, axis=1, method="makima")(FINE_LAGS)


def _likeliest(cost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Dead time and lag, (2,) (s); and the lowest and highest of each and of their sum that is about as likely,
    (2, 3) (s)."""
    claimed = cost.copy()
    claimed[DEAD_TIMES > 0] += SIMPLER
    claimed[:, FINE_LAGS > 0] += SIMPLER
    alike, _ = np.nonzero(claimed < claimed.min() + ALIKE)
    first = alike.min()
    best = np.array([DEAD_TIMES[first], FINE_LAGS[claimed[first].argmin()]])
    rows, columns = np.nonzero(cost < cost.min() + NEAR)
    dead_time = DEAD_TIMES[rows]
    lag = FINE_LAGS[columns]
    near = np.stack([dead_time, lag, dead_time + lag])
    return best, np.stack([near.min(axis=1), near.max(axis=1)])
