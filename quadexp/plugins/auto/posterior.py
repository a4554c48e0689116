"""Posterior over age a, total delay D = dead time + lag, lag l, and by how much rates are newer than the pose, r: a
pure function of the bank's moments.

    log p(a, D, l, r) = - sum over filters  kappa n / 2 log(SSE)  - (a + D) / mean_delay - log(lags of D) - odds(r)

Thrusts tell D and l, velocities a, attitudes r, and the gyroscope a - r + D and l. odds: rates_odds, of rates
with the pose, of now, or in between.

SSE: sum of n squared innovations of the hypothesis, its variance profiled out, and so is a scale of the thrust (and of
the torque) with a normal prior, and the bias of the sensor (ridge regression). kappa: what an innovation is
worth, at most one half: (1 - rho) / (1 + rho) where successive ones are correlated by rho (Bayley & Hammersley 1946).
Where readings are weighted, SSE is divided by what their noise adds to it, since a mean of several is less noisy than
one (bias compensation, Soderstrom 2007). The likeliest noise model counts. The grid is fixed: coarse over all
hypotheses, then a finer one that moves while its mode is on its edge.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadexp.control.delivered import INSTANT
from quadexp.plugins.auto.bank import AXES, GYROS, Bank, first_order_gain
from quadexp.plugins.auto.responses import command_weights, reading_weights
from quadexp.plugins.auto.settings import BANK


class Posterior(NamedTuple):
    """Of age, total and lag (s): mean, deviation, lower and upper, the 2.5 and 97.5 % quantiles; upper is infinite
    where the mode is the last of the grid. age_odds, total_odds: log Bayes factors against none. newer: by how much the
    told rates are newer than the pose (s)."""

    mean: np.ndarray
    deviation: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    age_odds: float
    total_odds: float
    newer: float

    @property
    def at_end(self) -> bool:
        """Whether age or total may be any larger one."""
        return bool(np.isinf(self.upper[:2]).any())


LATE, PROMPT, BETWEEN = range(3)


class Choice(NamedTuple):
    """Noise models of gyroscope and velocity, and when rates are: with the pose, now, or in between."""

    gyro: int
    velocity: int
    rates: int


def posterior(bank: Bank) -> Posterior:
    """Of what the bank has seen; there must be some."""
    steps = np.array([BANK.age_step, BANK.total_step, BANK.lag_step, BANK.age_step])
    largest = BANK.largest_age, BANK.largest_dead_time + BANK.largest_lag, BANK.largest_lag, BANK.largest_age
    whole = [np.arange(0.0, most + INSTANT, step) for most, step in zip(largest, steps, strict=True)]
    log, choice = joint(bank, whole)
    mode = np.unravel_index(int(log.argmax()), log.shape)
    upper_end = [at == len(grid) - 1 for at, grid in zip(mode, whole, strict=True)]
    odds = float(log.max() - log[0].max()), float(log.max() - log[:, 0].max())
    refined = _refined(bank, log, whole, steps, largest, choice)
    if choice.rates == BETWEEN:  # one more number fits what lies between the points of a coarse grid
        rates = rates_of(whole[0], whole[3])[:, None, None]
        others = np.where(rates == BETWEEN, -np.inf, log)
        at = np.unravel_index(int(others.argmax()), log.shape)
        other = choice._replace(rates=int(rates[at[0], 0, 0, at[3]]))
        alternative = _refined(bank, others, whole, steps, largest, other)
        if alternative[0].max() > refined[0].max():
            refined, choice = alternative, other
    log, grids, centre = refined
    beside = steps[[0, 2, 2]] / BANK.fine  # a total goes along with a lag that is between points of the grid
    fine = zip(grids[:3], steps[:3] / BANK.fine, beside, strict=True)
    rows = [_marginal(log, axis, *of) for axis, of in enumerate(fine)]
    mean, deviation, lower, upper = np.array(rows).T
    upper[upper_end[:3]] = np.inf
    newer = mean[0] if choice.rates == PROMPT else centre[3]
    return Posterior(mean, deviation, lower, upper, *odds, float(newer))


def _refined(
    bank: Bank, log: np.ndarray, grids: list[np.ndarray], steps: np.ndarray, largest: tuple[float, ...], choice: Choice
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Log posterior on a finer grid around the mode of a coarse one, its grids and its mode."""
    mode = np.unravel_index(int(log.argmax()), log.shape)
    centre = np.array([grid[at] for grid, at in zip(grids, mode, strict=True)])
    for _ in range(BANK.passes):
        grids = [_finer(*of) for of in zip(centre, steps, largest, strict=True)]
        log, _ = joint(bank, grids, choice)
        mode = np.unravel_index(int(log.argmax()), log.shape)
        before, centre = centre, np.array([grid[at] for grid, at in zip(grids, mode, strict=True)])
        if (np.abs(centre - before) < steps - INSTANT).all():
            break
    return log, grids, centre


def rates_of(ages: np.ndarray, newer: np.ndarray) -> np.ndarray:
    """LATE, PROMPT or BETWEEN, (a, r), of ages and by how much rates are newer (s)."""
    is_prompt = np.abs(ages[:, None] - newer) < INSTANT
    rates: np.ndarray = np.where(newer < INSTANT, LATE, np.where(is_prompt, PROMPT, BETWEEN))
    return rates


def _finer(centre: float, step: float, largest: float) -> np.ndarray:
    """Grid over one coarse step to either side."""
    grid = centre + step / BANK.fine * np.arange(-BANK.fine, BANK.fine + 1)
    return grid[(grid > -INSTANT) & (grid < largest + INSTANT)]


def _marginal(log: np.ndarray, axis: int, grid: np.ndarray, step: float, beside: float) -> tuple[float, ...]:
    """Mean, deviation and quantiles of an axis; a point of the grid stands for a step around it, and may be off by half
    of `beside` (s)."""
    share = np.exp(log - log.max()).sum(axis=tuple(i for i in range(4) if i != axis))
    share /= share.sum()
    mean = share @ grid
    deviation = np.sqrt(share @ (grid - mean) ** 2 + step**2 / 12)
    below = np.concatenate([[0.0], np.cumsum(share)])
    edges = np.concatenate([grid - step / 2, grid[-1:] + step / 2])
    lower, upper = np.interp([0.025, 0.975], below, edges)
    return mean, deviation, max(lower - beside / 2, 0.0), upper + beside / 2


def joint(bank: Bank, grids: list[np.ndarray], choice: Choice | None = None) -> tuple[np.ndarray, Choice]:
    """Log posterior (a, D, l, r), but for a constant, on grids of them (s), and the choice; None: the likeliest."""
    ages, totals, lags, newer = grids
    dead_time = totals[:, None] - lags
    d, k = np.nonzero((dead_time > -INSTANT) & (dead_time < BANK.largest_dead_time + INSTANT))
    thrust = _by_commands(bank, "thrust", 0, totals[d], lags[k])
    of_rates = ages[:, None] - newer
    sums = np.maximum(of_rates, 0.0) + totals[:, None, None]
    times, at = np.unique(np.round(sums, 9), return_inverse=True)
    at = at.reshape(sums.shape)
    both = np.repeat(times, len(lags)), np.tile(lags, len(times))
    models = range(GYROS) if choice is None else [choice.gyro]
    by_gyro = {model: _by_commands(bank, "gyro", model, *both) for model in models}
    gyro = max(by_gyro, key=lambda model: float(by_gyro[model].max()))
    of_gyro = by_gyro[gyro].reshape(len(times), len(lags))[at[d], k[:, None, None]]

    reading = bank.period * bank.lateral_noise
    models = range(len(BANK.velocity_models)) if choice is None else [choice.velocity]
    by_velocity = {
        i: _by_readings(bank, "velocity", i, ages, reading, BANK.velocity_models[i], BANK.bias_deviation)
        for i in models
    }
    velocity = max(by_velocity, key=lambda model: float(by_velocity[model].max()))
    attitude = _by_readings(bank, "attitude", 0, newer, *bank.turn_noise, BANK.rate_bias_deviation)
    ways = np.minimum(totals[d], BANK.largest_lag) - np.maximum(totals[d] - BANK.largest_dead_time, 0.0)
    prior = -totals[d] / BANK.mean_delay - np.log(ways + BANK.lag_step)
    of_total = (thrust + prior)[:, None, None]
    of_age = (by_velocity[velocity] - ages / BANK.mean_delay)[:, None]
    rates = rates_of(ages, newer)
    possible = (of_rates > -INSTANT) & (rates == (rates if choice is None else choice.rates))
    possible &= (rates != BETWEEN) | (newer > BANK.age_step - INSTANT)  # less is how rates go between readings
    of_age = np.where(possible, of_age + attitude - np.array(BANK.rates_odds)[rates], -np.inf)
    log = np.full((len(ages), len(totals), len(lags), len(newer)), -np.inf)
    log[:, d, k] = np.moveaxis(of_total + of_age + of_gyro, 0, 1)
    at_mode = np.unravel_index(int(log.max(axis=(1, 2)).argmax()), rates.shape)
    return log, Choice(gyro, velocity, int(rates[at_mode]))


def _by_commands(bank: Bank, name: str, model: int, total: np.ndarray, lag: np.ndarray) -> np.ndarray:
    """Log likelihood (k,) of a filter that commands drive."""
    M, m = bank.moments[name][model], bank.layout.commands
    n = max(float(bank.part("weights")[0]), 1.0)
    span, deviation = bank.spans[0], BANK.scale_deviation
    if name == "gyro":  # two readings differ by the mean in between
        n, total, span, deviation = 2 * n, total + bank.spans[1] / 2, bank.period, BANK.inertia_deviation
    h = command_weights(bank.period, m, total, lag, span)
    phi = slice(2, 2 + m)
    cross = h @ M[0, phi]
    square = np.einsum("ki,ki->k", h @ M[phi, phi], h)
    ridge = max(float((M[0, 0] - 2 * cross + square).min()), 0.0) / n / deviation**2 + BANK.floor
    scale = (cross + ridge) / (square + ridge)
    sse = np.maximum(M[0, 0] - 2 * scale * cross + scale**2 * square, 0.0)
    best = int(sse.argmin())
    now = np.concatenate([[1.0, 0.0], -scale[best] * h[best], [0.0]])
    before = np.concatenate([[0.0, 1.0, 0.0], -scale[best] * h[best]])
    return -_information(now @ M @ before, now @ M @ now) * n / 2 * np.log(sse / n + BANK.floor)


def _by_readings(
    bank: Bank, name: str, model: int, ages: np.ndarray, reading: float, noise: float, prior: float
) -> np.ndarray:
    """Log likelihood of ages (a,), by a filter that integrates readings. reading: deviation of what a reading adds in a
    period. noise: of the state that it is compared with. prior: of the readings' bias."""
    velocity = name == "velocity"
    n = (2 if velocity else AXES) * max(float(bank.part("weights")[1 if velocity else 2]), 1.0)
    c, r = bank.layout.columns, bank.layout.readings
    M = bank.moments[name][model]
    square, products = M[:c, :c], M[:c, c:]
    known, bias = slice(0, 1 + r), slice(1 + r, c)
    weights = reading_weights(bank.period, r, ages - bank.spans[0 if velocity else 1] / 2)
    h = np.concatenate([np.ones((len(ages), 1)), -weights], axis=1)
    sse = np.einsum("ki,ki->k", h @ square[known, known], h)
    cross = h @ square[known, bias]
    ridge = max(float(sse.min()), 0.0) / n / prior**2 + BANK.floor
    estimate = cross @ np.linalg.inv(square[bias, bias] + ridge * np.eye(AXES))
    sse = np.maximum(sse - np.einsum("ki,ki->k", cross, estimate), 0.0)
    gain = first_order_gain(reading / noise)
    added = _added_noise(weights, reading, 1 - gain) + 2 * noise**2 / (2 - gain)
    sse = sse / (added / added[0])
    best = int(sse.argmin())
    whole = np.concatenate([h[best], -estimate[best]])
    kappa = _information(whole @ products @ whole, whole @ square @ whole)
    likelihood: np.ndarray = -kappa * n / 2 * np.log(sse / n + BANK.floor)
    return likelihood


def _information(product: float, square: float) -> float:
    """Of an innovation, by the correlation of successive ones."""
    rho = product / max(square, BANK.floor**2)
    return float(np.clip((1 - rho) / (1 + rho), BANK.least_information, BANK.most_information))


def _added_noise(weights: np.ndarray, reading: float, kept: float) -> np.ndarray:
    """Variance (k,) that white noise of readings has in an innovation of a filter that keeps this share of its error
    from step to step."""
    apart = np.abs(np.subtract.outer(range(weights.shape[1]), range(weights.shape[1])))
    variance: np.ndarray = reading**2 * np.einsum("ki,ki->k", weights @ kept**apart, weights) / (1 - kept**2)
    return variance
