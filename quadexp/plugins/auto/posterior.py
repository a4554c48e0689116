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
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction, CFunction, linked_library
from quadexp.compile.memory import Memory
from quadexp.compile.symbolic import ca
from quadexp.control.control_step import Call, call, copy
from quadexp.physics.expression import named_function
from quadexp.plugins.auto.bank import AXES, GYROS, Bank, first_order_gain
from quadexp.plugins.auto.responses import command_weights, reading_weights
from quadexp.plugins.auto.settings import BANK, NEVER, QUANTILES
from quadexp.plugins.remedies.sent_commands import INSTANT, NO_LAG

SOURCE = Path(__file__).with_name("posterior.c")
LATE, PROMPT, BETWEEN = range(3)
STEPS = np.array([BANK.age_step, BANK.total_step, BANK.lag_step, BANK.age_step])  # of a, D, l, r (s)
LARGEST_TOTAL = BANK.largest_dead_time + BANK.largest_lag  # s
LARGEST = np.array([BANK.largest_age, LARGEST_TOTAL, BANK.largest_lag, BANK.largest_age])
# Of age, total and lag (s): mean, deviation, 2.5 and 97.5 % quantiles; by how much rates are newer (s)
FOUND = {"mean": 3, "deviation": 3, "lower": 3, "upper": 3, "newer": 1}
ENDS = np.append(LARGEST[:3], BANK.largest_dead_time)  # of a, D, l and dead time (s)
# What a grid leaves: the mode (a, D, l, r); the likeliest noise models of gyroscope and velocity; log Bayes factors
# against no age and no total; whether the mode is the last that there is (a, D, l, dead time), and whether that of a
# finer grid is on its edge
LEFT = {"mode": 4, "chosen": 2, "odds": 2, "at_end": 4, "moved": 1}


class Search:
    """Operations that look for the posterior of what a bank has seen so far: the coarse grid where flags["searches"],
    and at most flags["rounds"] finer ones, around its mode, or that of the last finer one.

    memory: what they leave, by name, which the next instants read.
    """

    def __init__(self, bank: Bank, backend: str, flags: dict[str, np.ndarray]) -> None:
        self._flags = flags
        form = Kernel if backend == "compiled" else Posterior
        seen = {name: moments.reshape(-1, moments.shape[-1]) for name, moments in bank.moments.items()}
        for name in ("weights", "lateral"):
            seen[name] = bank.memory.of_now[name]
        nowhere = {"centre": np.zeros(4), "models": np.zeros(2), "rounds": np.zeros(1)}
        self.coarse = form(bank, 1, seen | nowhere)
        self.left = self.coarse.results
        around = {"centre": self.left["mode"], "models": self.left["chosen"], "rounds": flags["rounds"]}
        self.fine = form(bank, BANK.fine, seen | around)
        self.found = {name: self.fine.results[name] for name in ("mode", "moved", *FOUND)}
        found = {f"fine_{name}": values for name, values in self.found.items()}
        self.memory = Memory("Search", worked=self.left | found)

    def calls(self) -> list[Call]:
        """What is to be done at an instant."""
        coarse = call(self.coarse, self._flags["searches"])
        fine = call(self.fine, self._flags["rounds"])
        return [coarse, fine]

    def moved(self) -> Call:
        """The finer grid goes on from its own mode."""
        return copy(self.left["mode"], self.found["mode"], self._flags["rounds"])


class Posterior(BufferedFunction):
    """The posterior on a grid, on arrays: all hypotheses for fine = 1, or steps a `fine`-th as large within one step of
    `centre`, (a, D, l, r).

    Arguments: moments of the bank, one noise model after another; of a finer grid models: which noise models count, and
    rounds: how many grids at most, each around the mode of the last while that is on its edge. Results: LEFT, and of a
    finer grid FOUND.
    """

    def __init__(self, bank: Bank, fine: int, given: Mapping[str, np.ndarray]) -> None:
        self.bank = bank
        self.fine = fine
        symbols = {name: ca.SX.sym(name, *array.T.shape) for name, array in given.items()}
        sizes = LEFT if fine == 1 else LEFT | FOUND
        results = {name: ca.DM.zeros(size) for name, size in sizes.items()}  # what is found is found elsewhere
        name = "coarse" if fine == 1 else "fine"
        super().__init__(named_function(name, symbols, results), given)

    def __call__(self) -> None:
        centre = self.arguments["centre"]
        for _ in range(max(1, int(self.arguments["rounds"][0]))):
            found = self._around(centre)
            for name, values in self.results.items():
                values[...] = found[name]
            centre = found["mode"]
            if not found["moved"]:
                break

    def _around(self, centre: np.ndarray) -> dict[str, Any]:
        """LEFT and FOUND on the grid around a mode. Arrays over hypotheses: (r, a, l, D)."""
        steps = STEPS / self.fine
        reach = LARGEST if self.fine == 1 else STEPS
        low = np.maximum(centre - reach, 0)
        high = np.minimum(centre + reach, LARGEST)
        ages, totals, lags, newer = map(points, low, high, steps)
        by, age, lag, total = np.meshgrid(newer, ages, lags, totals, indexing="ij", sparse=True)

        # rates are newer by up to the age; by less than a step is how they go between readings
        rates = rates_of(age, by)
        between_readings = (rates == BETWEEN) & (by < BANK.age_step - INSTANT)
        impossible = (by > age + INSTANT) | between_readings
        rates_old = np.maximum(age - by, 0)
        first = rates_old.min() + totals[0]
        last = rates_old.max() + totals[-1]
        times = points(first, last, steps[0])
        at_time = np.rint((rates_old + total - first) / steps[0]).astype(int)

        _, of_thrust = self._by_commands("thrust", totals, lags)
        gyro_model, of_gyro = self._by_commands("gyro", times, lags)
        velocity_model, of_age = self._by_readings("velocity", ages)
        _, of_newer = self._by_readings("attitude", newer)
        at_lag = np.arange(len(lags))[:, None]
        likelihood = of_thrust + of_gyro[at_lag, at_time] + of_age.reshape(age.shape)
        ways = np.minimum(total, BANK.largest_lag) - np.maximum(total - BANK.largest_dead_time, 0)
        of_ways = np.log(np.maximum(ways, 0) + BANK.lag_step)
        prior = -(age + total) / BANK.mean_delay - of_ways - np.take(BANK.rates_odds, rates)
        log = np.where(impossible, -NEVER, likelihood + of_newer.reshape(by.shape) + prior)

        best = log.max()
        ageless, prompt = log[:, 0].max(), log[..., 0].max()
        place = np.unravel_index(log.argmax(), log.shape)
        mode = np.array([ages[place[1]], totals[place[3]], lags[place[2]], newer[place[0]]])
        moved = np.abs(mode - centre) >= STEPS - INSTANT
        is_prompt = rates_of(mode[0], mode[3]) == PROMPT
        share = np.exp(log - best)
        off_age, off_total, off_lag = STEPS[[0, 2, 2]] / self.fine  # a total goes along with a lag between points
        summaries = [
            _summary(share.sum((0, 2, 3)), ages, steps[0], off_age),
            _summary(share.sum((0, 1, 2)), totals, steps[1], off_total),
            _summary(share.sum((0, 1, 3)), lags, steps[2], off_lag),
        ]
        mean, deviation, lower, upper = np.transpose(summaries)
        return {
            "mode": mode,
            "chosen": [gyro_model, velocity_model],
            "odds": [best - ageless, best - prompt],
            "at_end": np.append(mode[:3], mode[1] - mode[2]) > ENDS - INSTANT,
            "moved": self.fine > 1 and moved.any(),
            "mean": mean,
            "deviation": deviation,
            "lower": lower,
            "upper": upper,
            "newer": mean[0] if is_prompt else mode[3],
        }

    def _models(self, name: str, chosen: int) -> dict[int, np.ndarray]:
        """Moments of the noise models that count, by number: all, or of a finer grid the `chosen` of "models"."""
        moments = {i: M + np.tril(M, -1).T for i, M in enumerate(self.bank.moments[name])}
        if self.fine == 1 or len(moments) == 1:
            return moments
        model = int(self.arguments["models"][chosen])
        return {model: moments[model]}

    def _by_commands(self, name: str, totals: np.ndarray, lags: np.ndarray) -> tuple[int, np.ndarray]:
        """The likeliest noise model of a filter that commands drive, and log likelihoods, (l, D), by its innovations,
        whose scale has a prior."""
        bank = self.bank
        n = max(self.arguments["weights"][0], 1)
        if name == "gyro":  # two axes; two readings differ by the mean in between
            n *= 2
            longest = BANK.largest_dead_time + BANK.largest_age
            late, span, prior = bank.spans[1] / 2, bank.period, BANK.inertia_deviation
        else:
            longest = BANK.largest_dead_time
            late, span, prior = 0.0, bank.spans[0], BANK.scale_deviation
        lag, total = np.meshgrid(lags, totals, indexing="ij")
        dead_time = total - lag
        possible = (dead_time > -INSTANT) & (dead_time < longest + INSTANT)
        delays = total[possible] + late, lag[possible]
        h = command_weights(bank.period, bank.layout.commands, *delays, span)
        found = {}
        for model, M in self._models(name, 0).items():
            of_y = M[0, 0]
            cross = h @ M[0, 2:-1]
            square = np.sum(h @ M[2:-1, 2:-1] * h, axis=1)
            least = np.min(of_y - 2 * cross + square)
            ridge = max(least, 0) / n / prior**2 + BANK.floor
            scale = (cross + ridge) / (square + ridge)
            sse = np.maximum(of_y - 2 * scale * cross + scale**2 * square, 0)
            best = sse.argmin()
            weights = scale[best] * h[best]
            now = np.r_[1, 0, -weights, 0]
            before = np.r_[0, 1, 0, -weights]
            log = np.full(total.shape, -NEVER)
            log[possible] = _log_likelihood(sse, n, before @ M @ now, now @ M @ now)
            found[model] = log
        return _likeliest(found)

    def _by_readings(self, name: str, ages: np.ndarray) -> tuple[int, np.ndarray]:
        """The likeliest noise model of a filter that integrates readings, and log likelihoods, (a,), by its
        innovations; the readings' bias has a prior."""
        bank = self.bank
        _, of_velocity, of_attitude = np.maximum(self.arguments["weights"], 1)
        # reading: deviation of what one adds in a period; noises: of the state that it is compared with
        if name == "velocity":
            reading = bank.period * np.sqrt(self.arguments["lateral"][0])
            noises = BANK.velocity_models
            n, span, prior = 2 * of_velocity, bank.spans[0], BANK.bias_deviation
        else:
            reading, noise = bank.turn_noise
            noises = (noise,)
            n, span, prior = AXES * of_attitude, bank.spans[1], BANK.rate_bias_deviation
        columns, known = bank.layout.columns, bank.layout.columns - AXES
        of_readings = reading_weights(bank.period, known - 1, ages - span / 2)
        places = np.arange(known - 1)
        apart = np.abs(places[:, None] - places)
        h = np.insert(-of_readings, 0, 1, axis=1)
        found = {}
        for model, M in self._models(name, 1).items():
            square, products = M[:columns, :columns], M[:columns, columns:]
            sse = np.sum(h @ square[:known, :known] * h, axis=1)
            cross = h @ square[:known, known:]
            ridge = max(sse.min(), 0) / n / prior**2 + BANK.floor
            of_bias = square[known:, known:] + ridge * np.eye(AXES)
            estimate = cross @ np.linalg.inv(of_bias)
            sse = np.maximum(sse - np.sum(cross * estimate, axis=1), 0)
            # what white noise of readings adds to an innovation of a filter that keeps 1 - gain of its error; all else
            # in the least of them is noise of the state that readings are compared with
            kept = 1 - first_order_gain(reading / noises[model])
            correlated = of_readings @ kept**apart
            white = np.sum(correlated * of_readings, axis=1)
            of_reading = reading**2 * white / (1 - kept**2)
            rest = max(sse.min() / n - of_reading[sse.argmin()], 0) + BANK.floor
            added = of_reading + rest
            sse = sse * added[0] / added
            best = sse.argmin()
            whole = np.r_[h[best], -estimate[best]]
            found[model] = _log_likelihood(sse, n, whole @ products @ whole, whole @ square @ whole)
        return _likeliest(found)


class Kernel(Posterior):
    """The same in C, posterior.c. source: its text, compiled unless the cache has it."""

    def __init__(self, bank: Bank, fine: int, given: Mapping[str, np.ndarray]) -> None:
        super().__init__(bank, fine, given)
        self.source = kernel_source(bank)
        library = ctypes.PyDLL(str(linked_library("posterior", (self.source, ()))))
        self._code = getattr(library, self.function.name())
        self._code.argtypes = [*[ctypes.c_void_p] * 4, ctypes.c_int]
        work = np.zeros(1, np.int64), np.zeros(1)
        self.for_c = CFunction(self._code, _addresses(self.arguments), _addresses(self.results), *work)
        self._addresses = [array.ctypes.data for array in self.for_c.arrays]

    def __call__(self) -> None:
        self._code(*self._addresses, 0)


def _addresses(arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.array([array.ctypes.data for array in arrays.values()], np.uintp)


def kernel_source(bank: Bank) -> str:
    """posterior.c for these settings, complete: the numbers of BankSettings under their names, and what is here."""
    ages, totals, lags, _ = (LARGEST / STEPS).round().astype(int) + 1
    steps = 2 * BANK.fine + 1
    side = max(ages, totals, lags, steps)
    times = 2 * ages - 1 + max(totals, steps)
    counts = {
        "COMMANDS": bank.layout.commands,
        "READINGS": bank.layout.readings,
        "GYROS": GYROS,
        "VELOCITIES": len(BANK.velocity_models),
        "FINE": BANK.fine,
        "SIDE": side,
        "SIDES": 2 * side,
        "MOST": times * max(lags, steps),
    }
    numbers = {name.upper(): value for name, value in vars(BANK).items() if isinstance(value, float)}
    numbers |= {"PERIOD": bank.period, "INSTANT": INSTANT, "NO_LAG": NO_LAG, "NEVER": NEVER}
    numbers["SPAN_FORCE"], numbers["SPAN_RATE"] = bank.spans
    numbers["TURN_NOISE"], numbers["ATTITUDE_NOISE"] = bank.turn_noise
    lines = [f"enum {{ {name} = {count} }};" for name, count in counts.items()]
    lines += [f"#define {name} ((SUM){value!r})" for name, value in numbers.items()]
    for name, values in (("VELOCITY_NOISES", BANK.velocity_models), ("RATES_ODDS", BANK.rates_odds)):
        lines.append(f"#define {name} {{{', '.join(map(repr, values))}}}")
    return "\n".join([*lines, SOURCE.read_text(encoding="utf-8")])


def points(low: float, high: float, step: float) -> np.ndarray:
    """Of a grid, from low on up to high, `step` apart."""
    count = int((high - low + INSTANT) / step) + 1
    return low + step * np.arange(count)


def rates_of(age: Any, newer: Any) -> Any:
    """LATE, PROMPT or BETWEEN, by how much rates are newer (s)."""
    between = np.where(np.abs(age - newer) < INSTANT, PROMPT, BETWEEN)
    return np.where(newer < INSTANT, LATE, between)


def _likeliest(found: dict[int, np.ndarray]) -> tuple[int, np.ndarray]:
    """Of the log likelihoods by several noise models the model that has the largest, and its."""
    which = max(found, key=lambda model: found[model].max())
    return which, found[which]


def _log_likelihood(sse: np.ndarray, n: float, product: float, square: float) -> np.ndarray:
    """Of n innovations; what one is worth by the correlation of successive ones."""
    rho = product / max(square, BANK.floor**2)
    kappa = (1 - rho) / (1 + rho)
    kappa = np.clip(kappa, BANK.least_information, BANK.most_information)
    return -kappa * n / 2 * np.log(sse / n + BANK.floor)


def _summary(share: np.ndarray, grid: np.ndarray, step: float, beside: float) -> tuple[float, ...]:
    """Mean, deviation and quantiles; a point of the grid stands for a step around it, and may be off by half of
    `beside` (s)."""
    share = share / share.sum()
    mean = share @ grid
    deviation = np.sqrt(share @ (grid - mean) ** 2 + step**2 / 12)
    ends = np.append(grid - step / 2, grid[-1] + step / 2)
    below = np.append(0, share.cumsum())
    low, high = np.interp(QUANTILES, below, ends)
    return mean, deviation, max(low - beside / 2, 0.0), high + beside / 2
