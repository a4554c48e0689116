"""Motor lag and delays of logged streams, found by the residual that remains.

Where rotor speeds were logged, the lag tau and the delay d of commands are those with which the modelled thrusts come
closest to the measured ones, and the delay of the state that with which the residual becomes least. Without rotor
speeds tau and d are both found by the residual: commands that act late leave part of their changes in it.

    score = mean over a_z, tau_x, tau_y of log(rms of what a regression on simple terms leaves, beyond known noise)

which does not depend on units. Terms: 1, v, v|v|, and the thrusts' own first and second powers on that axis, so that
neither drag nor a scale of the thrust is taken for a delay. Of no lag, one of lag and delay, and both, the simplest is
taken that comes within WORTH of the best: where nothing in the logs speaks for a lag, commands remain what they are.
The lag is tried of the thrust and of the rotor speed, with one time constant and with one up and one down.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from quadexp.learn.dataset import consecutive
from quadexp.learn.rotor_thrust import Timing, held_commands, mean_thrust, measured_thrust
from quadexp.log.schema import Flight
from quadexp.physics.state import input_columns
from quadexp.physics.vehicle import Vehicle

TARGETS = ("a_z", "tau_x", "tau_y")
INDISTINCT = 0.005  # share of the variance, beside known noise, that tells nothing
WORTH = 0.05  # mean decrease of log rms from which a lag or a delay is taken to be real
MEASURED_APART = 0.01  # of the hover thrust, rms, from which measured thrusts are others than the commands
LARGEST_LAG, LARGEST_DELAY = 0.3, 0.12  # s
SETTLING = 0.3  # s at the beginning of a flight, when the thrusts before are not known
LONGEST = 40.0  # s of flights that the search uses; more determine it no better


@dataclass(frozen=True)
class TimingFit:
    """timing: what was found. before, after: rms of what remains, (3,): a_z (m/s^2), tau_x, tau_y (N m)."""

    timing: Timing
    before: tuple[float, float, float]
    after: tuple[float, float, float]

    def as_dict(self) -> dict[str, Any]:
        """JSON types."""
        return {**self.timing.as_dict(), "before": list(self.before), "after": list(self.after)}

    @property
    def line(self) -> str:
        """For the report of a data set."""
        timing = self.timing
        if timing.is_ideal:
            return "commands act at once, as far as these flights tell: no motor lag, no delay"
        lags = f"{1e3 * timing.lag_up:.1f} ms"
        if timing.lag_up != timing.lag_down:
            lags += f" up and {1e3 * timing.lag_down:.1f} ms down"
        known = f"motor lag {lags} of the {timing.lag_of.replace('_', ' ')}, commands {1e3 * timing.delay:.1f} ms late"
        source = "by the rotor speeds" if timing.measured else "by the residual that remains"
        behind = f", state {1e3 * timing.state_delay:.1f} ms behind the rotors" if timing.measured else ""
        dead = timing.delay + timing.state_delay
        return (
            f"{known} ({source}){behind}: a_z {self.before[0]:.3g} -> {self.after[0]:.3g} m/s^2 rms;"
            f" a controller is told by controller.motor_lag={timing.lag:.3g} controller.dead_time={dead:.3g}"
        )


@dataclass(frozen=True)
class _Rows:
    """A flight's transitions under the commands as thrusts: index k (r,), targets (r, 3), terms (r, 3, q)."""

    flight: Flight
    k: np.ndarray
    u: np.ndarray
    target: np.ndarray
    terms: np.ndarray


def fit_timing(
    flights: Sequence[Flight],
    vehicle: Vehicle,
    tables: Sequence[Mapping[str, np.ndarray]],
    *,
    noise: Mapping[str, float] | None = None,
) -> TimingFit:
    """Timing of flights of one vehicle. tables: `transitions` of each under the commands as thrusts.

    noise: known standard deviations of the targets, which no timing can take away; None: not known.
    """
    rows = [_rows(flight, vehicle, table) for flight, table in zip(flights, tables, strict=True)]
    rows = _some([one for one in rows if len(one.k)])
    score = _Score(rows, vehicle, noise or {})
    before = score.rms(Timing())
    measured = [measured_thrust(one.flight, vehicle) for one in rows]
    if rows and all(thrust is not None for thrust in measured):
        found = _by_rotor_speed(rows, measured, vehicle, score)
    else:
        found = _search(score)
    return TimingFit(found, before, score.rms(found))


def _rows(flight: Flight, vehicle: Vehicle, table: Mapping[str, np.ndarray]) -> _Rows:
    t = np.asarray(flight.t, float)
    k = consecutive(t, flight.columns.get("segment"))
    settled = t[k] > t[0] + SETTLING
    u = np.stack([table[name] for name in input_columns(vehicle.n_rotors)], axis=1)
    v = np.stack([table[f"v_{axis}"] for axis in "xyz"], axis=1)
    target = np.stack([table[name] for name in TARGETS], axis=1)
    drag = np.stack([np.ones(len(k)), *v.T, *(v * np.abs(v)).T], axis=1)
    terms = np.repeat(drag[:, None, :], 3, axis=1)
    return _Rows(flight, k[settled], u[settled], target[settled], terms[settled])


def _some(rows: Sequence[_Rows]) -> list[_Rows]:
    """Flights of LONGEST (s) altogether, evenly chosen."""
    seconds = [float(one.flight.t[-1] - one.flight.t[0]) for one in rows]
    step = max(1, round(sum(seconds) / LONGEST))
    return list(rows[::step])


class _Score:
    """What remains of the targets under a timing, after the regression on simple terms."""

    def __init__(self, rows: Sequence[_Rows], vehicle: Vehicle, noise: Mapping[str, float]) -> None:
        self._rows, self._vehicle = rows, vehicle
        self._noise = np.array([noise.get(name, 0.0) for name in TARGETS])
        # Per thrust: acceleration along z, torque about x and y.
        self._effect = np.vstack([np.full(vehicle.n_rotors, 1 / vehicle.mass), vehicle.allocation[1:3]])
        self._target = np.concatenate([one.target for one in rows])
        self._terms = np.concatenate([one.terms for one in rows])

    def rms(self, timing: Timing) -> tuple[float, float, float]:
        change, thrust = [], []
        for one in self._rows:
            delivered = mean_thrust(one.flight, self._vehicle, timing)[one.k]
            change.append(one.u - delivered)
            thrust.append(delivered)
        target = self._target + np.concatenate(change) @ self._effect.T
        powers = np.concatenate(thrust)
        found = []
        for axis, effect in enumerate(self._effect):
            own = np.stack([powers @ effect, powers**2 @ effect], axis=1)
            design = np.concatenate([self._terms[:, axis], own], axis=1)
            design /= np.maximum(np.sqrt(np.mean(design**2, axis=0)), 1e-12)
            normal = design.T @ design + 1e-9 * len(design) * np.eye(design.shape[1])
            left = target[:, axis] - design @ np.linalg.solve(normal, design.T @ target[:, axis])
            found.append(float(np.sqrt(np.mean(left**2))))
        return found[0], found[1], found[2]

    def __call__(self, timing: Timing) -> float:
        square = np.square(self.rms(timing))
        beyond = np.maximum(square - self._noise**2, INDISTINCT * square)
        return float(np.mean(np.log(np.maximum(beyond, 1e-24)) / 2))


def _by_rotor_speed(
    rows: Sequence[_Rows], measured: Sequence[np.ndarray | None], vehicle: Vehicle, score: _Score
) -> Timing:
    """Lag and delay of the commands by the measured thrusts; the delay of the state by the residual."""
    streams = [(one.flight, thrust) for one, thrust in zip(rows, measured, strict=True) if thrust is not None]

    def beside(timing: Timing, scaled: bool = True) -> float:
        """rms (N) of what is measured beside the commands; scaled: by the factors that fit, see `_scaled`."""
        error = []
        for flight, thrust in streams:
            t = np.asarray(flight.t, float)
            settled = t > t[0] + SETTLING
            model, own = held_commands(flight, vehicle, timing).value(t)[settled], thrust[settled]
            error.append((own - (_scaled(model, own, t[settled]) if scaled else model)).ravel())
        return float(np.sqrt(np.mean(np.concatenate(error) ** 2)))

    if beside(Timing(), scaled=False) <= MEASURED_APART * vehicle.hover_thrust:
        found = Timing()
    else:
        floor = 1e-4 * vehicle.hover_thrust  # below it no difference counts
        found = replace(_search(lambda timing: float(np.log(beside(timing) + floor))), measured=True)
    late, least = _least(lambda d: score(replace(found, state_delay=d)), 0.0, LARGEST_DELAY)
    return replace(found, state_delay=late) if least < score(found) - WORTH else found


def _scaled(model: np.ndarray, measured: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Thrusts (k, n) times the factors of each rotor that fit the measured ones best: a constant, a share of the
    collective thrust, whose current a battery's voltage follows, and a drift over the time t, (k,)."""
    found = np.empty_like(model)
    factors = np.stack([np.ones(len(t)), model.mean(axis=1), t - t.mean()], axis=1)
    for i in range(model.shape[1]):
        design = model[:, i, None] * factors
        design /= np.maximum(np.sqrt(np.mean(design**2, axis=0)), 1e-12)
        normal = design.T @ design + 1e-9 * len(t) * np.eye(design.shape[1])
        found[:, i] = design @ np.linalg.solve(normal, design.T @ measured[:, i])
    return found


def _search(score: Callable[[Timing], float]) -> Timing:
    """Timing of the least score, but the simplest that comes within WORTH of it: without any, with a lag or a delay
    alone, with both, and with a lag of its own up and down. A lag or delay alone always shows that there is one."""

    def delayed(delay: float) -> Timing:
        return Timing(delay=delay)

    def lagging(kind: str, lag: float, delay: float = 0.0) -> Timing:
        return Timing(lag, lag, kind, delay)

    delay = _least(lambda at: score(delayed(at)), 0.0, LARGEST_DELAY)[0]
    lags = {kind: _least(partial(_lag_score, score, kind), 0.0, LARGEST_LAG)[0] for kind in ("thrust", "rotor_speed")}
    found = [[Timing()], [delayed(delay), *(lagging(kind, lag) for kind, lag in lags.items())]]
    if min(map(score, found[1])) > score(Timing()) - WORTH:
        return Timing()
    both, apart = [], []
    for kind, lag in lags.items():
        one = _descent(partial(_joint_score, score, kind), (lag / 2, delay / 2))
        both.append(lagging(kind, *one))
        two = _descent(partial(_joint_score, score, kind), (one[0], one[0], one[1]))
        apart += [Timing(two[0], two[1], kind), Timing(two[0], two[1], kind, two[2])]
    found += [both, apart]
    scores = [[score(one) for one in group] for group in found]
    least = min(map(min, scores))
    simplest = next(i for i, values in enumerate(scores) if min(values) <= least + WORTH)
    return found[simplest][int(np.argmin(scores[simplest]))]


def _lag_score(score: Callable[[Timing], float], kind: str, lag: float) -> float:
    """Of one lag without a delay."""
    return score(Timing(lag, lag, kind))


def _joint_score(score: Callable[[Timing], float], kind: str, at: tuple[float, ...]) -> float:
    """Of a lag, or one up and one down, and the delay that follows them."""
    return score(Timing(at[0], at[-2], kind, at[-1]))


def _descent(score: Callable[[tuple[float, ...]], float], start: tuple[float, ...]) -> tuple[float, ...]:
    """Where a score of lags and, last, a delay (s) is least, from `start`; what is under 0.1 ms is 0."""
    from scipy.optimize import minimize

    largest = np.array([LARGEST_LAG] * (len(start) - 1) + [LARGEST_DELAY])

    def inside(at: np.ndarray) -> float:
        return score(tuple(np.clip(at, 0.0, largest).tolist())) + float(np.sum(np.maximum(-at, 0.0)))

    simplex = np.array(start) + np.vstack([np.zeros(len(start)), 0.006 * np.eye(len(start))])
    options = {"initial_simplex": simplex, "xatol": 3e-5, "fatol": 1e-5, "maxfev": 60 * len(start)}
    found = np.clip(minimize(inside, np.array(start), method="Nelder-Mead", options=options).x, 0.0, largest)
    return tuple(float(value) if value > 1e-4 else 0.0 for value in found)


def _least(score: Callable[[float], float], low: float, high: float) -> tuple[float, float]:
    """Where a score is least, and the score there; the grid's steps grow with the value."""
    from scipy.optimize import minimize_scalar

    grid = np.concatenate([[low], low + np.geomspace(0.003, high - low, 10)])
    scores = [score(float(at)) for at in grid]
    k = int(np.argmin(scores))
    bounds = (grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)])
    found = minimize_scalar(score, bounds=bounds, method="bounded", options={"xatol": 2e-5})
    return (float(found.x), float(found.fun)) if found.fun < scores[k] else (float(grid[k]), float(scores[k]))
