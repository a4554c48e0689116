"""Posterior over age a, total delay D = dead time + lag, lag l, and by how much rates are newer than the pose, r: a
pure function of the bank's moments, as equations.

    log p(a, D, l, r) = - sum over filters  kappa n / 2 log(SSE)  - (a + D) / mean_delay - log(lags of D) - odds(r)

Thrusts tell D and l, velocities a, attitudes r, and the gyroscope a - r + D and l. odds: rates_odds, of rates
with the pose, of now, or in between.

SSE: sum of n squared innovations of the hypothesis, its variance profiled out, and so is a scale of the thrust (and of
the torque) with a normal prior, and the bias of the sensor (ridge regression). kappa: what an innovation is
worth, at most one half: (1 - rho) / (1 + rho) where successive ones are correlated by rho (Bayley & Hammersley 1946).
Where readings are weighted, SSE is divided by what their noise adds to it, since a mean of several is less noisy than
one (bias compensation, Soderstrom 2007). The likeliest noise model counts. The grid is fixed: coarse over all
hypotheses, then a finer one around a mode, which moves while its mode is on its edge.
"""

from __future__ import annotations

import ctypes
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp.compile.backend import BufferedFunction, CFunction, linked_library
from quadexp.compile.memory import Memory
from quadexp.compile.symbolic import ca
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, call, copy
from quadexp.control.delivered import INSTANT
from quadexp.physics.expression import dense_function, limited, named_function, named_symbols
from quadexp.plugins.auto.bank import AXES, GYROS, Bank, Layout, first_order_gain
from quadexp.plugins.auto.responses import command_weights, reading_weights, tails
from quadexp.plugins.auto.settings import BANK
from quadexp.plugins.remedies.observers.filters import inverse

SOURCE = Path(__file__).with_name("posterior.c")
LATE, PROMPT, BETWEEN = range(3)
STEPS = np.array([BANK.age_step, BANK.total_step, BANK.lag_step, BANK.age_step])  # of a, D, l, r (s)
LARGEST = np.array([BANK.largest_age, BANK.largest_dead_time + BANK.largest_lag, BANK.largest_lag, BANK.largest_age])
NEVER = 1e30  # a log odds, or a sum of squares
# Of age, total and lag (s): mean, deviation, 2.5 and 97.5 % quantiles; by how much rates are newer; log posterior
FOUND = {"mean": 3, "deviation": 3, "lower": 3, "upper": 3, "newer": 1, "best": 1}


class BankSettings(NamedTuple):
    """What a posterior knows beside the bank's moments. period: of the bank (s). spans, turn_noise: see Bank."""

    period: float
    spans: tuple[float, float]
    turn_noise: tuple[float, float]


class Search:
    """Operations that look for the posterior of what a bank has seen so far: the coarse grid where flags["searches"],
    and at most flags["rounds"] finer ones, around its mode, or that of the last finer one. against: odds against rates.

    memory: what they leave, by name, which the next instants read.
    """

    def __init__(self, bank: Bank, backend: str, flags: dict[str, np.ndarray], against: np.ndarray) -> None:
        bank_settings, self._flags = BankSettings(bank.period, bank.spans, bank.turn_noise), flags
        known = {name: bank.part(name) for name in ("weights", "lateral")}
        known |= {name: side_by_side(moments) for name, moments in bank.moments.items()}
        self.coarse = grid_posterior(backend, bank_settings, 1, known | {"against": against})
        self.left = dict(self.coarse.results)
        handed = {"centre": self.left["mode"], "models": self.left["chosen"], "against": self.left["allowed"]}
        handed["rounds"] = flags["rounds"]
        self.fine = grid_posterior(backend, bank_settings, BANK.fine, known | handed)
        self.found = {name: self.fine.results[name] for name in ("mode", "moved", *FOUND)}
        found = {f"fine_{name}": values for name, values in self.found.items()}
        self.memory = Memory("Search", worked=self.left | found)

    def calls(self) -> list[Call]:
        """What is to be done at an instant."""
        return [call(self.coarse, self._flags["searches"]), call(self.fine, self._flags["rounds"])]

    def moved(self) -> Call:
        """The finer grid goes on from its own mode."""
        return copy(self.left["mode"], self.found["mode"], self._flags["rounds"])


def grid_posterior(
    backend: str, bank_settings: BankSettings, fine: int, shared: dict[str, np.ndarray]
) -> BufferedFunction:
    """See grid_function: in C, or as equations in the virtual machine of CasADi."""
    if backend == "compiled":
        return Kernel(bank_settings, fine, shared)
    return Rounds(cached_function(backend, grid_function, bank_settings, fine), shared)


class Rounds(BufferedFunction):
    """A posterior of `grid_function` as equations, once more from its own mode while that is on the edge."""

    def __call__(self) -> None:
        centre = self.arguments["centre"].copy()
        for _ in range(max(1, int(self.arguments["rounds"][0]))):
            self._trigger()
            if not self.results["moved"]:
                break
            self.arguments["centre"][...] = self.results["mode"]
        self.arguments["centre"][...] = centre


class Kernel(BufferedFunction):
    """A posterior of `grid_function` in C, posterior.c, on the same arrays. source: its text, compiled unless the cache
    has it."""

    def __init__(self, bank_settings: BankSettings, fine: int, shared: dict[str, np.ndarray]) -> None:
        super().__init__(cached_function("interpreted", grid_function, bank_settings, fine), shared)
        self.source = kernel_source(bank_settings)
        library = linked_library("posterior", (self.source, ()))
        code = getattr(ctypes.PyDLL(str(library)), self.function.name())
        places = [
            np.array([array.ctypes.data for array in arrays.values()], np.uintp)
            for arrays in (self.arguments, self.results)
        ]
        self.for_c = CFunction(code, *places, np.zeros(1, np.int64), np.zeros(1))
        code.argtypes = [*[ctypes.c_void_p] * 4, ctypes.c_int]
        self._trigger = partial(code, *(array.ctypes.data for array in self.for_c.arrays), 0)


def kernel_source(bank_settings: BankSettings) -> str:
    """posterior.c for these settings, complete."""
    layout, whole, steps = Layout(bank_settings.period), (LARGEST / STEPS).round().astype(int) + 1, 2 * BANK.fine + 1
    times = 2 * whole[0] - 1 + max(whole[1], steps)
    counts = {
        "COMMANDS": layout.commands, "READINGS": layout.readings, "GYROS": GYROS,
        "VELOCITIES": len(BANK.velocity_models), "FINE": BANK.fine, "SIDE": max(*whole, steps),
        "SIDES": 2 * max(*whole, steps), "MOST": times * max(whole[2], steps),
    }  # fmt: skip
    numbers: dict[str, float] = {f"STEP_{name}": step for name, step in zip("ADL", STEPS.tolist(), strict=False)}
    numbers |= {f"LARGEST_{name}": most for name, most in zip("ADL", LARGEST.tolist(), strict=False)}
    numbers |= {
        "PERIOD": bank_settings.period,
        "INSTANT": INSTANT,
        "NEVER": NEVER,
        "LARGEST_DEAD_TIME": BANK.largest_dead_time,
    }
    numbers |= dict(zip(("SPAN_FORCE", "SPAN_RATE"), bank_settings.spans, strict=True))
    numbers |= dict(zip(("TURN_NOISE", "ATTITUDE_NOISE"), bank_settings.turn_noise, strict=True))
    names = (
        "mean_delay", "scale_deviation", "inertia_deviation", "bias_deviation", "rate_bias_deviation", "floor",
        "least_information", "most_information",
    )  # fmt: skip
    numbers |= {name.upper(): getattr(BANK, name) for name in names}
    lines = [f"enum {{ {', '.join(f'{name} = {count}' for name, count in counts.items())} }};"]
    lines += [f"#define {name} ((REAL){value!r})" for name, value in numbers.items()]
    lines.append(f"#define VELOCITY_NOISES {{{', '.join(map(repr, BANK.velocity_models))}}}")
    return "\n".join([*lines, SOURCE.read_text(encoding="utf-8")])


def side_by_side(moments: np.ndarray) -> np.ndarray:
    """Of all models, as a function reads them."""
    return moments.reshape(-1, moments.shape[-1])


def rates_of(age: Any, newer: Any) -> Any:
    """LATE, PROMPT or BETWEEN, by how much rates are newer (s)."""
    between = ca.if_else(ca.fabs(age - newer) < INSTANT, PROMPT, BETWEEN)
    return ca.if_else(newer < INSTANT, LATE, between)


def grid_function(bank_settings: BankSettings, fine: int) -> ca.Function:
    """Posterior on a grid, all hypotheses for fine = 1, or of steps a `fine`-th as large within one step of `centre`,
    (a, D, l, r).

    against: log odds against rates LATE, PROMPT, BETWEEN. models: of the noise of gyroscope and velocity, of a finer
    grid. rounds: of a finer grid at most, each around the mode of the last while that is on its edge, or `moved`; see
    Rounds. Leaves the mode, its rates, and odds that allow these alone; the likeliest noise models; log Bayes factors
    against no age and no total; whether the mode is the last that there is (a, D, l); of a finer grid FOUND.
    """
    layout, steps, whole = Layout(bank_settings.period), STEPS / fine, fine == 1
    sizes = [round(of) + 1 for of in (LARGEST if whole else 2 * STEPS) / steps]
    n_a, n_D, n_l, n_r = sizes
    commands, both, noises = layout.commands + 3, 2 * layout.columns, ca.DM(BANK.velocity_models)
    shapes: dict[str, Any] = {"gyro": (commands, GYROS * commands), "thrust": (commands, commands)}
    shapes |= {"velocity": (both, noises.numel() * both), "attitude": (both, both)}
    shapes |= {"against": 3, "centre": 4, "models": 2, "weights": 3, "lateral": 1, "rounds": 1}
    a = named_symbols(ca.MX, shapes)

    def models(name: str, size: int, model: Any) -> list[Any]:
        """The moments of each noise model, or of the one that counts."""
        if whole:
            return ca.horzsplit(a[name], size)
        return [ca.reshape(a[name][ca.DM(range(size**2)) + size**2 * model], size, size)]

    reach = LARGEST if whole else STEPS
    low, high = ca.fmax(a["centre"] - reach, 0), ca.fmin(a["centre"] + reach, LARGEST)
    grids = [low[i] + steps[i] * ca.DM(range(size)) for i, size in enumerate(sizes)]
    inside = [grid < high[i] + INSTANT for i, grid in enumerate(grids)]
    ages, totals, lags, newer = grids

    # thrusts, of total and lag
    total, lag = ca.repmat(totals, 1, n_l), ca.repmat(lags.T, n_D, 1)
    dead_time = total - lag
    possible = ca.mtimes(inside[1], inside[2].T) * (dead_time > -INSTANT)
    possible = possible * (dead_time < BANK.largest_dead_time + INSTANT)
    by_thrust = commands_function("thrust", bank_settings, layout, n_D, n_l)
    thrust = by_thrust(a["thrust"], totals, lags, possible, a["weights"][0])
    ways = ca.fmin(total, BANK.largest_lag) - ca.fmax(total - BANK.largest_dead_time, 0)
    prior = -total / BANK.mean_delay - ca.log(ca.fmax(ways, 0) + BANK.lag_step)
    of_total = ca.if_else(possible, thrust + prior, -NEVER)

    # gyroscope, of lag and the total beside what rates are old by, a - r
    n_old = n_a if whole else n_a + n_r - 1
    first = ca.fmax(low[0] - high[3], 0)
    times = first + low[1] + steps[0] * ca.DM(range(n_old + n_D - 1))
    told_of = times < ca.fmax(high[0] - low[3], 0) + high[1] + INSTANT
    wait = ca.repmat(times, 1, n_l) - ca.repmat(lags.T, times.numel(), 1)
    told_of = ca.mtimes(told_of, inside[2].T) * (wait > -INSTANT)
    told_of = told_of * (wait < BANK.largest_dead_time + BANK.largest_age + INSTANT)
    by_gyro = commands_function("gyro", bank_settings, layout, n_old + n_D - 1, n_l)
    each = models("gyro", commands, a["models"][0])
    by_gyro_model = [ca.if_else(told_of, by_gyro(M, times, lags, told_of, a["weights"][0]), -NEVER) for M in each]
    gyro_model, of_gyro = _likeliest(by_gyro_model)
    by_old = [of_total + of_gyro[i : i + n_D, :] for i in range(n_old)]

    # velocities and attitudes, of age and of what rates are newer by
    reading = bank_settings.period * ca.sqrt(a["lateral"])
    by_velocity, by_attitude = (
        readings_function(*of) for of in (("velocity", bank_settings, n_a), ("attitude", bank_settings, n_r))
    )
    by_noise = ca.vertsplit(noises) if whole else [ca.MX(noises)[a["models"][1]]]
    of_velocity = zip(models("velocity", both, a["models"][1]), by_noise, strict=True)
    by_model = [by_velocity(M, ages, inside[0], a["weights"][1], reading, noise) for M, noise in of_velocity]
    velocity_model, of_age = _likeliest(by_model)
    of_age = of_age - ages / BANK.mean_delay
    of_newer = by_attitude(a["attitude"], newer, inside[3], a["weights"][2], *bank_settings.turn_noise)
    age, by = ca.repmat(ages, 1, n_r), ca.repmat(newer.T, n_a, 1)
    rates = ca.MX(rates_of(age, by))
    counts = ca.mtimes(inside[0], inside[3].T) * (age - by > -INSTANT)
    # less is how rates go between readings
    counts = counts * ca.logic_or(rates != BETWEEN, by > BANK.age_step - INSTANT)
    odds = _taken(a["against"], rates)
    alone = ca.repmat(of_age, 1, n_r) + ca.repmat(of_newer.T, n_a, 1) - odds
    old = ca.MX(limited(ca.floor((ca.fmax(age - by, 0) - first) / steps[0] + 0.5), 0, n_old - 1))
    log = ca.if_else(counts, alone + _taken(ca.vertcat(*map(ca.mmax, by_old)), old), -NEVER)
    without_total = alone + _taken(ca.vertcat(*(ca.mmax(one[0, :]) for one in by_old)), old)
    without_total = ca.if_else(counts, without_total, -NEVER)

    best, at = _largest(log)
    at_old = ca.vec(old)[at]
    stacked = ca.horzcat(*map(ca.vec, by_old))
    _, at_total = _largest(stacked[ca.DM(range(n_D * n_l)) + n_D * n_l * at_old])
    row, row_of_total = ca.fmod(at, n_a), ca.fmod(at_total, n_D)
    place = ca.vertcat(row, row_of_total, (at_total - row_of_total) / n_D, (at - row) / n_a)
    mode = low + steps * place
    moved = ca.mmax(ca.fabs(mode - a["centre"]) >= STEPS - INSTANT) * (not whole)
    of_mode = rates_of(mode[0], mode[3])
    results = {
        "mode": mode, "rates": of_mode, "allowed": ca.if_else(ca.DM(range(3)) == of_mode, a["against"], NEVER),
        "chosen": ca.vertcat(gyro_model, velocity_model),
        "odds": ca.vertcat(best - ca.mmax(log[0, :]), best - ca.mmax(without_total)),
        "at_end": mode[:3] > LARGEST[:3] - INSTANT, "moved": moved,
    }  # fmt: skip
    if whole:
        return named_function("coarse", a, {name: ca.densify(value) for name, value in results.items()})

    results["best"] = best
    likely, share_of_age, share = ca.exp(log - best), 0, 0
    for i, one in enumerate(by_old):
        here = likely * (old == i)
        by_total = ca.exp(one - ca.mmax(one))
        share_of_age = share_of_age + ca.sum2(here) * ca.sum1(ca.sum2(by_total))
        share = share + ca.sum1(ca.sum2(here)) * by_total
    beside = STEPS[[0, 2, 2]] / fine  # a total goes along with a lag that is between points of the grid
    shares = share_of_age, ca.sum2(share), ca.sum1(share).T
    spread = [_summary(*of) for of in zip(shares, grids[:3], steps[:3], beside, strict=True)]
    for name, values in zip(("mean", "deviation", "lower", "upper"), zip(*spread, strict=True), strict=True):
        results[name] = ca.vertcat(*values)
    results["newer"] = ca.if_else(of_mode == PROMPT, results["mean"][0], mode[3])
    return named_function("fine", a, {name: ca.densify(value) for name, value in results.items()})


def _taken(table: Any, at: Any) -> Any:
    """The elements at these places, as an array like them."""
    return ca.reshape(table[ca.vec(at)], *at.shape)


def _largest(values: Any) -> tuple[Any, Any]:
    """The largest value, and the first place where it is."""
    most = ca.mmax(values)
    return most, ca.find(ca.vec(values) >= most)


def _likeliest(found: list[Any]) -> tuple[Any, Any]:
    """Of the log likelihoods by several noise models those that have the largest, and which model it is."""
    best, which = found[0], ca.MX(0)
    for i, other in enumerate(found[1:], 1):
        better = ca.mmax(other) > ca.mmax(best)
        best, which = ca.if_else(better, other, best), ca.if_else(better, i, which)
    return which, best


def _summary(share: Any, grid: Any, step: float, beside: float) -> tuple[Any, ...]:
    """Mean, deviation and quantiles; a point of the grid stands for a step around it, and may be off by half of
    `beside` (s)."""
    share = share / ca.sum1(share)
    mean = ca.dot(share, grid)
    deviation = ca.sqrt(ca.dot(share, (grid - mean) ** 2) + step**2 / 12)
    below, begins = ca.cumsum(share) - share, grid[0] - step / 2

    def quantile(p: float) -> Any:
        passed = limited((p - below) / ca.fmax(share, 1 / NEVER), 0, 1)
        return begins + step * ca.sum1(passed)

    return mean, deviation, ca.fmax(quantile(0.025) - beside / 2, 0), quantile(0.975) + beside / 2


def commands_function(name: str, bank_settings: BankSettings, layout: Layout, totals: int, lags: int) -> ca.Function:
    """Log likelihood, (D, l), of a filter that commands drive, by its moments; of hypotheses that are possible."""
    m, T = layout.commands, bank_settings.period
    shapes = {"M": (m + 3, m + 3), "total": totals, "lag": lags, "possible": (totals, lags), "count": 1}
    M, total, lag, possible, count = (a := named_symbols(ca.MX, shapes)).values()
    n, deviation, span = ca.fmax(count, 1), BANK.scale_deviation, bank_settings.spans[0]
    if name == "gyro":  # two readings differ by the mean in between
        n, total, span, deviation = 2 * n, total + bank_settings.spans[1] / 2, T, BANK.inertia_deviation
    phi = slice(2, 2 + m)
    cross, square = tails(M[0, phi], M[phi, phi], T, total, lag, span)
    least = ca.mmin(ca.if_else(possible, M[0, 0] - 2 * cross + square, NEVER))
    ridge = ca.fmax(least, 0) / n / deviation**2 + BANK.floor
    scale = (cross + ridge) / (square + ridge)
    sse = ca.fmax(M[0, 0] - 2 * scale * cross + scale**2 * square, 0)
    _, best = _largest(-ca.if_else(possible, sse, NEVER))
    row = ca.fmod(best, totals)
    h = ca.vec(scale)[best] * command_weights(T, m, total[row], lag[(best - row) / totals], span)
    now, before = ca.vertcat(1, 0, -h, 0), ca.vertcat(0, 1, 0, -h)
    moved = ca.mtimes(M, now)
    kappa = _information(ca.dot(before, moved), ca.dot(now, moved))
    return dense_function(name, a, {"log": -kappa * n / 2 * ca.log(sse / n + BANK.floor)})


def readings_function(name: str, bank_settings: BankSettings, ages: int) -> ca.Function:
    """Log likelihood of ages (a,), by a filter that integrates readings. reading: deviation of what a reading adds in a
    period. noise: of the state that it is compared with."""
    layout, velocity = Layout(bank_settings.period), name == "velocity"
    c, r = layout.columns, layout.readings
    shapes = {"M": (2 * c, 2 * c), "age": ages, "inside": ages, "count": 1, "reading": 1, "noise": 1}
    M, age, inside, count, reading, noise = (a := named_symbols(ca.MX, shapes)).values()
    n, prior = (2, BANK.bias_deviation) if velocity else (AXES, BANK.rate_bias_deviation)
    n = n * ca.fmax(count, 1)
    square, products = M[:c, :c], M[:c, c:]
    known, bias = slice(0, 1 + r), slice(1 + r, c)
    weights = reading_weights(bank_settings.period, r, age - bank_settings.spans[not velocity] / 2)
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
    _, best = _largest(-ca.if_else(inside, sse, NEVER))
    whole = ca.horzcat(h, -estimate)[best + ages * ca.DM(range(c))]
    kappa = _information(ca.mtimes([whole.T, products, whole]), ca.mtimes([whole.T, square, whole]))
    return dense_function(name, a, {"log": -kappa * n / 2 * ca.log(sse / n + BANK.floor)})


def _information(product: Any, square: Any) -> Any:
    """Of an innovation, by the correlation of successive ones."""
    rho = product / ca.fmax(square, BANK.floor**2)
    return limited((1 - rho) / (1 + rho), BANK.least_information, BANK.most_information)
