"""Posterior over age a, total delay D = dead time + lag, lag l, and by how much rates are newer than the pose, r: a
pure function of the bank's moments, as equations.

    log p(a, D, l, r) = - sum over filters  kappa n / 2 log(SSE)  - (a + D) / mean_delay - log(lags of D) - odds(r)

Thrusts tell D and l, velocities a, attitudes r, and the gyroscope a - r + D and l. odds: rates_odds, of rates
with the pose, of now, or in between.

SSE: sum of n squared innovations of the hypothesis, its variance profiled out, and so is a scale of the thrust (and of
the torque) with a normal prior, and the bias of the sensor (ridge regression). kappa: what an innovation is
worth, at most one half: (1 - rho) / (1 + rho) where successive ones are correlated by rho (Bayley & Hammersley 1946).
Where readings are weighted, SSE is divided by what their noise adds to it, since a mean of several is less noisy than
one (bias compensation, Soderstrom 2007). The likeliest noise model counts. The grid is fixed: `coarse` over all
hypotheses, then `fine`, a finer one around a mode, which moves while its mode is on its edge.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.built import built
from quadexp.control.delivered import INSTANT
from quadexp.physics.expression import dense_function, limited, named_symbols
from quadexp.plugins.auto.bank import AXES, GYROS, Bank, Layout, first_order_gain
from quadexp.plugins.auto.responses import command_weights, reading_weights, tails
from quadexp.plugins.auto.settings import BANK
from quadexp.plugins.remedies.observers.filters import inverse

LATE, PROMPT, BETWEEN = range(3)
STEPS = np.array([BANK.age_step, BANK.total_step, BANK.lag_step, BANK.age_step])  # of a, D, l, r (s)
LARGEST = np.array([BANK.largest_age, BANK.largest_dead_time + BANK.largest_lag, BANK.largest_lag, BANK.largest_age])
NEVER = 1e30  # a log odds, or a sum of squares
CHOSEN = {"gyro_model": 1, "velocity_model": 1, "rates": 1}  # noise models, and when rates are: see LATE


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


class Evidence:
    """The posterior of what a bank has seen so far, each time that it is called."""

    def __init__(self, bank: Bank, backend: str) -> None:
        told = Told(bank.period, bank.spans, bank.turn_noise)
        shared = {name: moments.reshape(-1, moments.shape[-1]) for name, moments in bank.moments.items()}
        shared |= {name: bank.part(name) for name in ("weights", "lateral")}
        self._coarse = BufferedFunction(built(backend, coarse_function, told), shared)
        self._found = self._coarse.results
        shared |= {name: self._found[name] for name in ("gyro_model", "velocity_model")}
        self._fine = BufferedFunction(built(backend, fine_function, told), shared)

    def __call__(self) -> Posterior:
        self._coarse()
        found = self._found
        best = self._refined(found["mode"], found["rates"])
        if found["rates"] == BETWEEN:  # one more number fits what lies between the points of a coarse grid
            other = self._refined(found["other"], found["other_rates"])
            best = other if other["best"] > best["best"] else best
        mean, deviation, lower, upper = (best[name] for name in ("mean", "deviation", "lower", "upper"))
        upper[found["at_end"] > 0] = np.inf
        odds = found["odds"].tolist()
        return Posterior(mean, deviation, lower, upper, *odds, best["newer"].item())

    def _refined(self, mode: np.ndarray, rates: np.ndarray) -> dict[str, np.ndarray]:
        """What `fine` leaves around a mode, once its own mode is not on the edge."""
        given, left = self._fine.arguments, self._fine.results
        given["centre"][...], given["rates"][...] = mode, rates
        for _ in range(BANK.passes):
            self._fine()
            moved = np.abs(left["mode"] - given["centre"])
            if (moved < STEPS - INSTANT).all():
                break
            given["centre"][...] = left["mode"]
        return {name: values.copy() for name, values in left.items()}


class Told(NamedTuple):
    """What a posterior knows beside the bank's moments. period: of the bank (s). spans: see Bank. turn_noise: likewise."""

    period: float
    spans: tuple[float, float]
    turn_noise: tuple[float, float]


class Axis(NamedTuple):
    """A grid of one quantity. values, inside: (k,), whether they count. low, high, step: (s)."""

    values: Any
    inside: Any
    low: Any
    high: Any
    step: float


def axis(low: Any, high: Any, step: float, size: int) -> Axis:
    """From low to high, of at most so many values; what is beyond them does not count."""
    values = low + step * ca.DM(range(size))
    return Axis(values, values < high + INSTANT, low, high, step)


def moments_of(layout: Layout) -> dict[str, tuple[int, int]]:
    """Shapes of the moments, models side by side."""
    commands, both = layout.commands + 3, 2 * layout.columns
    models = {"gyro": (commands, GYROS), "thrust": (commands, 1)}
    models |= {"velocity": (both, len(BANK.velocity_models)), "attitude": (both, 1)}
    return {name: (size, count * size) for name, (size, count) in models.items()}


def coarse_function(told: Told) -> ca.Function:
    """Over all hypotheses: the mode (a, D, l, r), the choice, log Bayes factors against no age and no total, whether the
    mode is the last one (a, D, l), and mode and choice of rates of the likeliest that is not BETWEEN."""
    layout = Layout(told.period)
    a = named_symbols(ca.MX, moments_of(layout) | {"weights": 3, "lateral": 1})
    axes = [axis(0.0, *of, round(of[0] / of[1]) + 1) for of in zip(LARGEST, STEPS, strict=True)]
    joint = Joint(told, layout, a, axes, None)
    best, mode = joint.mode(joint.of_ages)
    without_age, without_total = ca.mmax(joint.of_ages[0, :]), ca.mmax(joint.without_total)
    rates = joint.of(joint.rates, mode)
    _, other = joint.mode(ca.if_else(joint.rates == BETWEEN, -NEVER, joint.of_ages))
    results = {
        "mode": mode, "gyro_model": joint.gyro, "velocity_model": joint.velocity, "rates": rates,
        "odds": ca.vertcat(best - without_age, best - without_total), "at_end": mode[:3] > LARGEST[:3] - INSTANT,
        "other": other, "other_rates": joint.of(joint.rates, other),
    }  # fmt: skip
    return dense_function("coarse", a, results)


def fine_function(told: Told) -> ca.Function:
    """On the finer grid around a centre (a, D, l, r) for a choice: its mode and log posterior, then mean, deviation and
    the 2.5 and 97.5 % quantiles of a, D, l, and by how much rates are newer than the pose (s)."""
    layout, fine = Layout(told.period), STEPS / BANK.fine
    a = named_symbols(ca.MX, moments_of(layout) | {"weights": 3, "lateral": 1, "centre": 4} | CHOSEN)
    axes = []
    for i in range(4):
        low, high = a["centre"][i] - STEPS[i], a["centre"][i] + STEPS[i]
        low = ca.if_else(low < -INSTANT, a["centre"][i] - fine[i] * ca.floor(a["centre"][i] / fine[i] + INSTANT), low)
        axes.append(axis(low, ca.fmin(high, LARGEST[i]), float(fine[i]), 2 * BANK.fine + 1))
    joint = Joint(told, layout, a, axes, a)
    best, mode = joint.mode(joint.of_ages)
    beside = STEPS[[0, 2, 2]] / BANK.fine  # a total goes along with a lag that is between points of the grid
    of_axes = zip(joint.marginals(best), axes[:3], beside, strict=True)
    mean, deviation, lower, upper = zip(*(_summary(*of) for of in of_axes), strict=True)
    newer = ca.if_else(a["rates"] == PROMPT, mean[0], mode[3])
    spread = {"mean": mean, "deviation": deviation, "lower": lower, "upper": upper}
    results = {"mode": mode, "best": best, **{name: ca.vertcat(*of) for name, of in spread.items()}, "newer": newer}
    return dense_function("fine", a, results)


def _summary(share: Any, of: Axis, beside: float) -> tuple[Any, ...]:
    """Mean, deviation and quantiles of an axis; a point of the grid stands for a step around it, and may be off by half
    of `beside` (s)."""
    share = share / ca.sum1(share)
    mean = ca.dot(share, of.values)
    deviation = ca.sqrt(ca.dot(share, (of.values - mean) ** 2) + of.step**2 / 12)
    below = ca.cumsum(share) - share
    lower, upper = (
        of.low - of.step / 2 + of.step * ca.sum1(limited((p - below) / ca.fmax(share, 1 / NEVER), 0, 1))
        for p in (0.025, 0.975)
    )
    return mean, deviation, ca.fmax(lower - beside / 2, 0), upper + beside / 2


class Joint:
    """Log posterior, but for a constant, on a grid. of_ages: its maximum over totals and lags, (a, r); without_total: the
    same of a total of 0. rates: when they are, (a, r). gyro, velocity: noise models that count."""

    def __init__(self, told: Told, layout: Layout, a: dict[str, Any], axes: list[Axis], choice: dict[str, Any] | None):
        ages, totals, lags, newer = self.axes = axes
        self.spread = [one.values.numel() for one in axes]
        n_a, n_D, n_l, n_r = self.spread
        step = ages.step
        # thrust: of total and lag
        D, l = ca.repmat(totals.values, 1, n_l), ca.repmat(lags.values.T, n_D, 1)
        possible = ca.mtimes(totals.inside, lags.inside.T) * (D - l > -INSTANT)
        possible = possible * (D - l < BANK.largest_dead_time + INSTANT)
        thrust = commands_function("thrust", told, layout, n_D, n_l)(a["thrust"], totals.values, lags.values, possible, a["weights"][0])
        ways = ca.fmin(D, BANK.largest_lag) - ca.fmax(D - BANK.largest_dead_time, 0)
        prior = -D / BANK.mean_delay - ca.log(ca.fmax(ways, 0) + BANK.lag_step)
        self._of_total = ca.if_else(possible, thrust + prior, -NEVER)

        # gyroscope: of a - r + D and lag
        least = ca.fmax(ages.low - newer.high, 0)
        most = ca.fmax(ages.high - newer.low, 0)
        self.apart = n_a if choice is None else n_a + n_r - 1
        times = axis(least + totals.low, most + totals.high, step, self.apart + n_D - 1)
        by_gyro = commands_function("gyro", told, layout, times.values.numel(), n_l)
        inside = ca.mtimes(times.inside, lags.inside.T)
        models = ca.horzsplit(a["gyro"], layout.commands + 3)
        self.gyro, of_gyro = _likeliest(models, lambda M, _: by_gyro(M, times.values, lags.values, inside, a["weights"][0]), choice and choice["gyro_model"])
        self._by_apart = [self._of_total + of_gyro[i : i + n_D, :] for i in range(self.apart)]
        highest = ca.vertcat(*map(ca.mmax, self._by_apart))
        # velocity and attitude: of age, and of what is newer
        A, r = ca.repmat(ages.values, 1, n_r), ca.repmat(newer.values.T, n_a, 1)
        reading = told.period * ca.sqrt(a["lateral"])
        models = ca.horzsplit(a["velocity"], 2 * layout.columns)
        by_velocity = readings_function("velocity", told, layout, n_a)
        self.velocity, of_velocity = _likeliest(models, lambda M, noise: by_velocity(M, ages.values, ages.inside, a["weights"][1], reading, noise), choice and choice["velocity_model"], BANK.velocity_models)
        by_attitude = readings_function("attitude", told, layout, n_r)
        attitude = by_attitude(a["attitude"], newer.values, newer.inside, a["weights"][2], *told.turn_noise)
        self.rates = ca.MX(ca.if_else(r < INSTANT, LATE, ca.if_else(ca.fabs(A - r) < INSTANT, PROMPT, BETWEEN)))
        wanted = ca.mtimes(ages.inside, newer.inside.T) * (A - r > -INSTANT)
        if choice is not None:
            wanted = wanted * (self.rates == choice["rates"])
        # less is how rates go between readings
        wanted = wanted * ca.logic_or(self.rates != BETWEEN, r > BANK.age_step - INSTANT)
        late_odds, prompt_odds, between_odds = BANK.rates_odds
        odds = ca.if_else(self.rates == LATE, late_odds, ca.if_else(self.rates == PROMPT, prompt_odds, between_odds))
        of_age = of_velocity - ages.values / BANK.mean_delay
        alone = ca.repmat(of_age, 1, n_r) + ca.repmat(attitude.T, n_a, 1) - odds
        self._at = ca.floor((ca.fmax(A - r, 0) - least) / step + 0.5)
        self._at = ca.MX(limited(self._at, 0, self.apart - 1))
        self.of_ages = ca.if_else(wanted, alone + self._taken(highest), -NEVER)
        first = ca.vertcat(*(ca.mmax(one[0, :]) for one in self._by_apart))
        self.without_total = ca.if_else(wanted, alone + self._taken(first), -NEVER)

    def _taken(self, by_apart: Any) -> Any:
        """Of how much a is more than r, (a, r)."""
        return ca.reshape(by_apart[ca.vec(self._at)], *self._at.shape)

    def of(self, values: Any, mode: Any) -> Any:
        """The value, of (a, r), at a mode."""
        ages, _, _, newer = self.axes
        row, column = (mode[i] - one.low for i, one in ((0, ages), (3, newer)))
        return values[ca.floor(row / ages.step + 0.5) + self.spread[0] * ca.floor(column / newer.step + 0.5)]

    def mode(self, of_ages: Any) -> tuple[Any, Any]:
        """The largest value of an array like of_ages, and where it is, (a, D, l, r)."""
        ages, totals, lags, newer = self.axes
        best = ca.mmax(of_ages)
        at = ca.find(ca.vec(of_ages) >= best)
        row = ca.fmod(at, self.spread[0])
        column = (at - row) / self.spread[0]
        apart = ca.vec(self._at)[at]
        stacked = ca.horzcat(*map(ca.vec, self._by_apart))
        chosen = stacked[ca.DM(range(stacked.size1())) + stacked.size1() * apart]
        at = ca.find(chosen >= ca.mmax(chosen))
        of_total = ca.fmod(at, self.spread[1])
        of_lag = (at - of_total) / self.spread[1]
        return best, ca.vertcat(*(one.low + one.step * i for one, i in ((ages, row), (totals, of_total), (lags, of_lag), (newer, column))))

    def marginals(self, best: Any) -> tuple[Any, Any, Any]:
        """Of ages, totals and lags, but for a factor."""
        likely = ca.exp(self.of_ages - best)
        of_age, of_both = 0, 0
        for i, one in enumerate(self._by_apart):
            here = likely * (self._at == i)
            each = ca.exp(one - ca.mmax(one))
            of_age = of_age + ca.sum2(here) * ca.sum1(ca.sum2(each))
            of_both = of_both + ca.sum1(ca.sum2(here)) * each
        return of_age, ca.sum2(of_both), ca.sum1(of_both).T


def _likeliest(models: list[Any], likelihood: Any, chosen: Any, noises: Any = None) -> tuple[Any, Any]:
    """Of filters with several noise models: which counts, the chosen or else the likeliest, and its log likelihoods."""
    noises = noises or [0.0] * len(models)
    if chosen is not None:
        M, noise = models[0], noises[0]
        for i in range(1, len(models)):
            M, noise = ca.if_else(chosen == i, models[i], M), ca.if_else(chosen == i, noises[i], noise)
        return chosen, likelihood(M, noise)
    best, at = likelihood(models[0], noises[0]), 0
    for i in range(1, len(models)):
        found = likelihood(models[i], noises[i])
        better = ca.mmax(found) > ca.mmax(best)
        best, at = ca.if_else(better, found, best), ca.if_else(better, i, at)
    return at, best


def commands_function(name: str, told: Told, layout: Layout, totals: int, lags: int) -> ca.Function:
    """Log likelihood, (D, l), of a filter that commands drive, by its moments; of hypotheses that are possible."""
    m, T = layout.commands, told.period
    shapes = {"M": (m + 3, m + 3), "total": totals, "lag": lags, "possible": (totals, lags), "count": 1}
    M, total, lag, possible, count = (a := named_symbols(ca.MX, shapes)).values()
    n, deviation, span = ca.fmax(count, 1), BANK.scale_deviation, told.spans[0]
    if name == "gyro":  # two readings differ by the mean in between
        n, total, span, deviation = 2 * n, total + told.spans[1] / 2, T, BANK.inertia_deviation
    phi = slice(2, 2 + m)
    cross, square = tails(M[0, phi], M[phi, phi], T, total, lag, span)
    least = ca.mmin(ca.if_else(possible, M[0, 0] - 2 * cross + square, NEVER))
    ridge = ca.fmax(least, 0) / n / deviation**2 + BANK.floor
    scale = (cross + ridge) / (square + ridge)
    sse = ca.fmax(M[0, 0] - 2 * scale * cross + scale**2 * square, 0)
    counted = ca.vec(ca.if_else(possible, sse, NEVER))
    best = ca.find(counted <= ca.mmin(counted))
    row = ca.fmod(best, totals)
    h = ca.vec(scale)[best] * command_weights(T, m, total[row], lag[(best - row) / totals], span)
    now, before = ca.vertcat(1, 0, -h, 0), ca.vertcat(0, 1, 0, -h)
    moved = ca.mtimes(M, now)
    kappa = _information(ca.dot(before, moved), ca.dot(now, moved))
    return dense_function(name, a, {"log": -kappa * n / 2 * ca.log(sse / n + BANK.floor)})


def readings_function(name: str, told: Told, layout: Layout, ages: int) -> ca.Function:
    """Log likelihood of ages (a,), by a filter that integrates readings. reading: deviation of what a reading adds in a
    period. noise: of the state that it is compared with."""
    c, r, velocity = layout.columns, layout.readings, name == "velocity"
    shapes = {"M": (2 * c, 2 * c), "age": ages, "inside": ages, "count": 1, "reading": 1, "noise": 1}
    M, age, inside, count, reading, noise = (a := named_symbols(ca.MX, shapes)).values()
    n, prior = (2, BANK.bias_deviation) if velocity else (AXES, BANK.rate_bias_deviation)
    n = n * ca.fmax(count, 1)
    square, products = M[:c, :c], M[:c, c:]
    known, bias = slice(0, 1 + r), slice(1 + r, c)
    weights = reading_weights(told.period, r, age - told.spans[not velocity] / 2)
    h = ca.horzcat(ca.DM.ones(ages), -weights)
    sse = ca.sum2(ca.mtimes(h, square[known, known]) * h)
    cross = ca.mtimes(h, square[known, bias])
    ridge = ca.fmax(ca.mmin(ca.if_else(inside, sse, NEVER)), 0) / n / prior**2 + BANK.floor
    estimate = ca.mtimes(cross, inverse(square[bias, bias] + ridge * ca.DM.eye(AXES)))
    sse = ca.fmax(sse - ca.sum2(cross * estimate), 0)
    gain = first_order_gain(reading / noise)
    # what white noise of readings adds to an innovation of a filter that keeps 1 - gain of its error
    kept = (1 - gain) ** ca.DM(np.abs(np.subtract.outer(range(r), range(r))))
    added = reading**2 * ca.sum2(ca.mtimes(weights, kept) * weights) / (1 - (1 - gain) ** 2)
    added = added + 2 * noise**2 / (2 - gain)
    sse = sse * added[0] / added
    counted = ca.if_else(inside, sse, NEVER)
    best = ca.find(counted <= ca.mmin(counted))
    whole = ca.horzcat(h, -estimate)[best + ages * ca.DM(range(c))]
    kappa = _information(ca.mtimes([whole.T, products, whole]), ca.mtimes([whole.T, square, whole]))
    return dense_function(name, a, {"log": -kappa * n / 2 * ca.log(sse / n + BANK.floor)})


def _information(product: Any, square: Any) -> Any:
    """Of an innovation, by the correlation of successive ones."""
    rho = product / ca.fmax(square, BANK.floor**2)
    return limited((1 - rho) / (1 + rho), BANK.least_information, BANK.most_information)
