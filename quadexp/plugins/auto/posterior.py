"""Posterior over age a, total delay D = dead time + lag, lag l, and by how much rates are newer than the pose, r: a
pure function of the bank's moments, plainly in NumPy here, and for every flight that is compiled in posterior.c.

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
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp.compile.backend import BufferedFunction, CFunction, linked_library
from quadexp.compile.memory import Memory
from quadexp.compile.symbolic import ca
from quadexp.control.control_step import Call, call, copy
from quadexp.physics.expression import named_function, named_symbols
from quadexp.plugins.auto.bank import AXES, GYROS, Bank, Layout, first_order_gain
from quadexp.plugins.auto.responses import command_weights, reading_weights
from quadexp.plugins.auto.settings import BANK, NEVER, QUANTILES
from quadexp.plugins.remedies.sent_commands import INSTANT, NO_LAG

SOURCE = Path(__file__).with_name("posterior.c")
LATE, PROMPT, BETWEEN = range(3)
STEPS = np.array([BANK.age_step, BANK.total_step, BANK.lag_step, BANK.age_step])  # of a, D, l, r (s)
LARGEST = np.array([BANK.largest_age, BANK.largest_dead_time + BANK.largest_lag, BANK.largest_lag, BANK.largest_age])
# Of age, total and lag (s): mean, deviation, 2.5 and 97.5 % quantiles; by how much rates are newer; log posterior
FOUND = {"mean": 3, "deviation": 3, "lower": 3, "upper": 3, "newer": 1, "best": 1}


# What a grid leaves: the mode (a, D, l, r), its rates, and odds that allow these alone; the likeliest noise models of
# gyroscope and velocity; log Bayes factors against no age and no total; whether the mode is the last that there is (a,
# D, l), and whether that of a finer grid is on its edge
LEFT = {"mode": 4, "rates": 1, "allowed": 3, "chosen": 2, "odds": 2, "at_end": 3, "moved": 1}


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
        self._flags, about = flags, BankSettings(bank.period, bank.spans, bank.turn_noise)
        form = Kernel if backend == "compiled" else Posterior
        known = {name: bank.part(name) for name in ("weights", "lateral")}
        for name, moments in bank.moments.items():
            known[name] = moments.reshape(-1, moments.shape[-1])
        self.coarse = form(about, 1, known | {"against": against})
        self.left = dict(self.coarse.results)
        handed = {"centre": self.left["mode"], "models": self.left["chosen"], "against": self.left["allowed"]}
        self.fine = form(about, BANK.fine, known | handed | {"rounds": flags["rounds"]})
        self.found = {name: self.fine.results[name] for name in ("mode", "moved", *FOUND)}
        found = {f"fine_{name}": values for name, values in self.found.items()}
        self.memory = Memory("Search", worked=self.left | found)

    def calls(self) -> list[Call]:
        """What is to be done at an instant."""
        return [call(self.coarse, self._flags["searches"]), call(self.fine, self._flags["rounds"])]

    def moved(self) -> Call:
        """The finer grid goes on from its own mode."""
        return copy(self.left["mode"], self.found["mode"], self._flags["rounds"])


class Posterior(BufferedFunction):
    """The posterior on a grid, on arrays: all hypotheses for fine = 1, or steps a `fine`-th as large within one step of
    `centre`, (a, D, l, r).

    Arguments: moments of the bank, one noise model after another; against: log odds against rates LATE, PROMPT,
    BETWEEN; of a finer grid models: which noise models count, and rounds: how many grids at most, each around the mode
    of the last while that is on its edge. Results: LEFT, and of a finer grid FOUND.
    """

    def __init__(self, about: BankSettings, fine: int, shared: Mapping[str, np.ndarray]) -> None:
        self.about, self.fine = about, fine
        layout = Layout(about.period)
        commands, both = layout.commands + 3, 2 * layout.columns
        shapes: dict[str, Any] = {"gyro": (commands, GYROS * commands), "thrust": (commands, commands)}
        shapes |= {"velocity": (both, len(BANK.velocity_models) * both), "attitude": (both, both)}
        shapes |= {"against": 3, "centre": 4, "models": 2, "weights": 3, "lateral": 1, "rounds": 1}
        results = LEFT if fine == 1 else LEFT | FOUND
        sizes = {name: ca.DM.zeros(size) for name, size in results.items()}  # what is found is found elsewhere
        name = "coarse" if fine == 1 else "fine"
        super().__init__(named_function(name, named_symbols(ca.SX, shapes), sizes), shared)

    def __call__(self) -> None:
        centre = self.arguments["centre"]
        for _ in range(max(1, int(self.arguments["rounds"][0]))):
            found = self._around(centre)
            for name, values in found.items():
                self.results[name][...] = values
            centre = found["mode"]
            if not found["moved"]:
                break

    def _around(self, centre: np.ndarray) -> dict[str, Any]:
        """On the grid around a mode."""
        given, whole, steps = self.arguments, self.fine == 1, STEPS / self.fine
        reach = LARGEST if whole else STEPS
        low, high = np.maximum(centre - reach, 0), np.minimum(centre + reach, LARGEST)
        sizes = np.floor((high - low + INSTANT) / steps).astype(int) + 1
        grids = [low[i] + steps[i] * np.arange(sizes[i]) for i in range(4)]
        ages, totals, lags, newer = grids

        # thrusts, of lag and total; gyroscope, of lag and the total beside what rates are old by, a - r
        first = max(ages[0] - newer[-1], 0)
        olds = first + steps[0] * np.arange(round((max(ages[-1] - newer[0], 0) - first) / steps[0]) + 1)
        ways = np.minimum(totals, BANK.largest_lag) - np.maximum(totals - BANK.largest_dead_time, 0)
        prior = -totals / BANK.mean_delay - np.log(np.maximum(ways, 0) + BANK.lag_step)
        of_total = self._by_commands("thrust", 0, totals, lags) + prior
        times = olds[0] + totals[0] + steps[0] * np.arange(len(olds) + len(totals) - 1)
        models = range(GYROS) if whole else [int(given["models"][0])]
        gyro_model, of_gyro = _likeliest({i: self._by_commands("gyro", i, times, lags) for i in models})
        by_old = np.array([of_total + of_gyro[:, i : i + len(totals)] for i in range(len(olds))])

        # velocities and attitudes, of age and of what rates are newer by
        models = range(len(BANK.velocity_models)) if whole else [int(given["models"][1])]
        velocity_model, of_age = _likeliest({i: self._by_readings("velocity", i, ages) for i in models})
        age, by = np.meshgrid(ages, newer)
        rates = rates_of(age, by)
        counts = age - by > -INSTANT
        counts &= (rates != BETWEEN) | (by > BANK.age_step - INSTANT)  # less is how rates go between readings
        old = np.clip(np.rint((age - by - first) / steps[0]).astype(int), 0, len(olds) - 1)
        of_newer = self._by_readings("attitude", 0, newer)
        alone = of_age - ages / BANK.mean_delay + of_newer[:, None] - given["against"][rates]
        log = np.where(counts, alone + by_old.max(axis=(1, 2))[old], -NEVER)
        without_total = np.where(counts, alone + by_old[:, :, 0].max(axis=1)[old], -NEVER)

        best = log.max()
        at_newer, at_age = np.unravel_index(log.argmax(), log.shape)
        of_best = by_old[old[at_newer, at_age]]
        at_lag, at_total = np.unravel_index(of_best.argmax(), of_best.shape)
        mode = np.array([ages[at_age], totals[at_total], lags[at_lag], newer[at_newer]])
        of_mode = rates_of(mode[0], mode[3])
        found: dict[str, Any] = {
            "mode": mode,
            "rates": of_mode,
            "allowed": np.where(np.arange(3) == of_mode, given["against"], NEVER),
            "chosen": [gyro_model, velocity_model],
            "odds": [best - log[:, 0].max(), best - without_total.max()],
            "at_end": mode[:3] > LARGEST[:3] - INSTANT,
            "moved": not whole and (np.abs(mode - centre) >= STEPS - INSTANT).any(),
        }
        if whole:
            return found

        likely = np.exp(log - best)
        of_old = np.array([likely[old == i].sum() for i in range(len(olds))])
        by_total = np.exp(by_old - by_old.max(axis=(1, 2), keepdims=True))
        share_of_age = (likely * by_total.sum(axis=(1, 2))[old]).sum(axis=0)
        share = np.tensordot(of_old, by_total, axes=1)
        shares = share_of_age, share.sum(axis=0), share.sum(axis=1)
        beside = STEPS[[0, 2, 2]] / self.fine  # a total goes along with a lag that is between points of the grid
        spreads = [_summary(*of) for of in zip(shares, grids[:3], steps[:3], beside, strict=True)]
        found |= dict(zip(("mean", "deviation", "lower", "upper"), np.transpose(spreads), strict=True))
        found["newer"] = found["mean"][0] if of_mode == PROMPT else mode[3]
        return found | {"best": best}

    def _moments(self, name: str, model: int) -> np.ndarray:
        """Of one noise model."""
        moments = self.arguments[name]
        size = moments.shape[1]
        return moments[model * size : (model + 1) * size]

    def _by_commands(self, name: str, model: int, totals: np.ndarray, lags: np.ndarray) -> np.ndarray:
        """Log likelihood, (l, D), by the innovations of a filter that commands drive, their scale with a prior."""
        M, n, (total, lag) = self._moments(name, model), max(self.arguments["weights"][0], 1), np.meshgrid(totals, lags)
        longest, span, prior = BANK.largest_dead_time, self.about.spans[0], BANK.scale_deviation
        wait = total - lag
        if name == "gyro":  # two readings differ by the mean in between
            longest, span, prior = longest + BANK.largest_age, self.about.period, BANK.inertia_deviation
            n, total = 2 * n, total + self.about.spans[1] / 2
        possible = (wait > -INSTANT) & (wait < longest + INSTANT)
        h = command_weights(self.about.period, len(M) - 3, total[possible], lag[possible], span)
        cross = h @ M[0, 2:-1]
        square = np.sum(h @ M[2:-1, 2:-1] * h, axis=1)
        least = np.min(M[0, 0] - 2 * cross + square)
        ridge = max(least, 0) / n / prior**2 + BANK.floor
        scale = (cross + ridge) / (square + ridge)
        sse = np.maximum(M[0, 0] - 2 * scale * cross + scale**2 * square, 0)
        best = sse.argmin()
        weights = scale[best] * h[best]
        now, before = np.r_[1, 0, -weights, 0], np.r_[0, 1, 0, -weights]
        log = np.full(total.shape, -NEVER)
        log[possible] = _log_likelihood(sse, n, before @ M @ now, now @ M @ now)
        return log

    def _by_readings(self, name: str, model: int, ages: np.ndarray) -> np.ndarray:
        """Log likelihood, (a,), by the innovations of a filter that integrates readings, their bias with a prior.
        reading: deviation of what one adds in a period. noise: of the state that it is compared with."""
        M, (_, *weights) = self._moments(name, model), self.arguments["weights"]
        if name == "velocity":
            reading, noise = self.about.period * np.sqrt(self.arguments["lateral"][0]), BANK.velocity_models[model]
            n, span, prior = 2 * max(weights[0], 1), self.about.spans[0], BANK.bias_deviation
        else:
            reading, noise = self.about.turn_noise
            n, span, prior = AXES * max(weights[1], 1), self.about.spans[1], BANK.rate_bias_deviation
        columns = len(M) // 2
        square, products, known = M[:columns, :columns], M[:columns, columns:], columns - AXES
        of_readings = reading_weights(self.about.period, known - 1, ages - span / 2)
        h = np.hstack([np.ones((len(ages), 1)), -of_readings])
        sse = np.sum(h @ square[:known, :known] * h, axis=1)
        cross = h @ square[:known, known:]
        ridge = max(sse.min(), 0) / n / prior**2 + BANK.floor
        estimate = cross @ np.linalg.inv(square[known:, known:] + ridge * np.eye(AXES))
        sse = np.maximum(sse - np.sum(cross * estimate, axis=1), 0)
        # what white noise of readings adds to an innovation of a filter that keeps 1 - gain of its error
        kept = 1 - first_order_gain(reading / noise)
        places = np.arange(known - 1)
        correlated = of_readings @ kept ** np.abs(places[:, None] - places)
        added = reading**2 * np.sum(correlated * of_readings, axis=1) / (1 - kept**2) + 2 * noise**2 / (1 + kept)
        sse = sse * added[0] / added
        best = sse.argmin()
        whole = np.r_[h[best], -estimate[best]]
        return _log_likelihood(sse, n, whole @ products @ whole, whole @ square @ whole)


class Kernel(Posterior):
    """The same in C, posterior.c. source: its text, compiled unless the cache has it."""

    def __init__(self, about: BankSettings, fine: int, shared: Mapping[str, np.ndarray]) -> None:
        super().__init__(about, fine, shared)
        self.source = kernel_source(about)
        library = linked_library("posterior", (self.source, ()))
        code = getattr(ctypes.PyDLL(str(library)), self.function.name())
        code.argtypes = [*[ctypes.c_void_p] * 4, ctypes.c_int]
        places = []
        for arrays in (self.arguments, self.results):
            places.append(np.array([array.ctypes.data for array in arrays.values()], np.uintp))
        self.for_c = CFunction(code, *places, np.zeros(1, np.int64), np.zeros(1))
        self._code = partial(code, *(array.ctypes.data for array in self.for_c.arrays), 0)

    def __call__(self) -> None:
        self._code()


def kernel_source(about: BankSettings) -> str:
    """posterior.c for these settings, complete: the numbers of BankSettings under their names, and what is here."""
    layout, whole, steps = Layout(about.period), (LARGEST / STEPS).round().astype(int) + 1, 2 * BANK.fine + 1
    side, times = max(*whole, steps), 2 * whole[0] - 1 + max(whole[1], steps)
    counts = {
        "COMMANDS": layout.commands,
        "READINGS": layout.readings,
        "GYROS": GYROS,
        "VELOCITIES": len(BANK.velocity_models),
        "FINE": BANK.fine,
        "SIDE": side,
        "SIDES": 2 * side,
        "MOST": times * max(whole[2], steps),
    }
    numbers = {name.upper(): value for name, value in vars(BANK).items() if isinstance(value, float)}
    numbers |= {"PERIOD": about.period, "INSTANT": INSTANT, "NO_LAG": NO_LAG, "NEVER": NEVER}
    numbers |= dict(zip(("SPAN_FORCE", "SPAN_RATE"), about.spans, strict=True))
    numbers |= dict(zip(("TURN_NOISE", "ATTITUDE_NOISE"), about.turn_noise, strict=True))
    lines = [f"enum {{ {name} = {count} }};" for name, count in counts.items()]
    lines += [f"#define {name} ((SUM){value!r})" for name, value in numbers.items()]
    lines.append(f"#define VELOCITY_NOISES {{{', '.join(map(repr, BANK.velocity_models))}}}")
    return "\n".join([*lines, SOURCE.read_text(encoding="utf-8")])


def rates_of(age: Any, newer: Any) -> Any:
    """LATE, PROMPT or BETWEEN, by how much rates are newer (s)."""
    between = np.where(np.abs(age - newer) < INSTANT, PROMPT, BETWEEN)
    return np.where(newer < INSTANT, LATE, between)


def _likeliest(found: dict[int, np.ndarray]) -> tuple[int, np.ndarray]:
    """Of the log likelihoods by several noise models those that have the largest, and which model it is."""
    which = max(found, key=lambda model: found[model].max())
    return which, found[which]


def _log_likelihood(sse: np.ndarray, n: float, product: float, square: float) -> np.ndarray:
    """Of n innovations; what one is worth by the correlation of successive ones."""
    rho = product / max(square, BANK.floor**2)
    kappa = np.clip((1 - rho) / (1 + rho), BANK.least_information, BANK.most_information)
    return -kappa * n / 2 * np.log(sse / n + BANK.floor)


def _summary(share: np.ndarray, grid: np.ndarray, step: float, beside: float) -> tuple[float, ...]:
    """Mean, deviation and quantiles; a point of the grid stands for a step around it, and may be off by half of
    `beside` (s)."""
    share = share / share.sum()
    mean = share @ grid
    deviation = np.sqrt(share @ (grid - mean) ** 2 + step**2 / 12)
    below, ends = np.cumsum(share) - share, []
    for p in QUANTILES:
        passed = np.clip((p - below) / np.maximum(share, 1 / NEVER), 0, 1)
        ends.append(grid[0] - step / 2 + step * passed.sum())
    return mean, deviation, max(ends[0] - beside / 2, 0.0), ends[1] + beside / 2
