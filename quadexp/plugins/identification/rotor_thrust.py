"""Thrust that the rotors delivered between two samples of a flight, from commands that act late and from rotor speeds.

    y'  = (c(t - d) - y) / tau            y = T and c = u, or y = sqrt(T) and c = sqrt(u): quadexp.physics.motor
    T_k = k w_k^2                         where the rotor speeds w_k were logged
    T(t) = T_model(t) + what the measured ones are beside it, interpolated between the samples

Commands u are held from sample to sample, act d late, and through the lag tau, which may be another one upwards than
downwards. A transition needs the mean of T over its time. For commands it is exact, because the lag has a closed form;
measured thrusts correct the model at both ends of the transition. Where the state comes from an estimator that is late,
its transitions belong to earlier times: with commands alone this adds to d and cannot be distinguished from it.

`fit_timing` finds lag and delays: by the measured thrusts where rotor speeds were logged, and the delay of the state by
the residual; without rotor speeds tau and d too by the residual, in which commands that act late leave part of their
changes:

    score = mean over a_z, tau_x, tau_y of log(rms of what a regression on simple terms leaves, beyond known noise)

which does not depend on units. Terms: 1, v, v|v|, and the thrusts' own first and second powers on that axis, so that
neither drag nor a scale of the thrust is taken for a delay. Of no lag, one of lag and delay, and both, the simplest is
taken that comes within WORTH of the best: where nothing in the logs speaks for a lag, commands remain what they are.
The lag is tried of the thrust and of the rotor speed, with one time constant and with one up and one down.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from quadexp.errors import DataError
from quadexp.log.schema import Flight
from quadexp.models.dataset import consecutive
from quadexp.models.residual import VELOCITY
from quadexp.physics.state import N_STATE, STATE_COLUMNS, in_motion, input_columns, root_mean_square
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.identification.ages import integral_of
from quadexp.plugins.identification.held_commands import ROUNDING, HeldCommands, Timing
from quadexp.plugins.logs.samples import rotor_columns

TARGETS = ("a_z", "tau_x", "tau_y")
INDISTINCT = 0.005  # share of the variance, beside known noise, that tells nothing
WORTH = 0.05  # mean decrease of log rms from which a lag or a delay is taken to be real
MEASURED_APART = 0.01  # of the hover thrust, rms, from which measured thrusts are others than the commands
LARGEST_LAG = 0.3  # s
LARGEST_DELAY = 0.12  # s
FIRST_STEP = 0.006  # s, of a descent
SETTLING = 0.3  # s at the beginning of a flight, when the thrusts before are not known
LONGEST = 40.0  # s of flights that the search uses; more determine it no better


def measured_thrust(flight: Flight, vehicle: Vehicle) -> np.ndarray | None:
    """Thrusts (k, n) (N) by the logged rotor speeds, None where these or the vehicle's thrust coefficient are unknown.

    A first row without a reading, as simulated flights may have, is that of the second.
    """
    columns = rotor_columns(flight, "rotor_speed")
    if vehicle.thrust_coefficient is None or len(columns) != vehicle.n_rotors:
        return None
    speed = flight.stack(columns).astype(float)
    if len(speed) > 1 and not np.isfinite(speed[0]).all():
        speed[0] = speed[1]
    if not np.isfinite(speed).all():
        return None
    return vehicle.thrust_coefficient * speed**2


def held_commands(flight: Flight, vehicle: Vehicle, timing: Timing) -> HeldCommands:
    """The commands of a flight. Before the first one acts a simulated flight has the thrusts of its reference where
    that begins in motion (experiment.rollout), else those of hover; of a recorded one they are not known."""
    command = flight.stack(input_columns(vehicle.n_rotors)).astype(float)
    before = command[0]
    if not flight.metadata.get("recorded", False):
        before = np.full(vehicle.n_rotors, vehicle.hover_thrust)
        columns = [f"ref_{name}" for name in (*STATE_COLUMNS, *input_columns(vehicle.n_rotors))]
        if set(columns) <= set(flight.columns):
            state, thrust = np.split(flight.stack(columns)[0].astype(float), [N_STATE])
            if in_motion(state):
                before = np.clip(thrust, vehicle.thrust_min, vehicle.thrust_max)
    return HeldCommands(np.asarray(flight.t, float), command, timing, before)


def mean_thrust(flight: Flight, vehicle: Vehicle, timing: Timing) -> np.ndarray:
    """Mean thrusts (k - 1, n) (N) between the samples of the logged state.

    NaN where these belong to a time before the flight.
    """
    t = np.asarray(flight.t, float)
    if timing.is_ideal:
        return flight.stack(input_columns(vehicle.n_rotors)).astype(float)[:-1]
    model = held_commands(flight, vehicle, timing)
    at = t - timing.state_delay
    impulse = model.integral(at)
    late = timing.state_delay
    if timing.measured:
        measured = measured_thrust(flight, vehicle)
        assert measured is not None
        impulse += integral_of(t, measured - model.value(t))(at)
    else:
        late += timing.delay
    mean = np.diff(impulse, axis=0) / np.diff(t)[:, None]
    mean[t[:-1] < t[0] + late - ROUNDING] = np.nan
    return mean


@dataclass(frozen=True)
class TimingFit:
    """timing: what was found. before, after: rms of what remains, (3,): a_z (m/s^2), tau_x, tau_y (N m)."""

    timing: Timing
    before: tuple[float, float, float]
    after: tuple[float, float, float]

    def as_dict(self) -> dict[str, Any]:
        """JSON types."""
        return {**asdict(self.timing), "before": list(self.before), "after": list(self.after)}

    @property
    def line(self) -> str:
        """For the report of a data set."""
        timing = self.timing
        if timing.is_ideal:
            return "no motor lag and no delay of the commands found in these flights"
        down = f" up and {1e3 * timing.lag_down:.1f} ms down" if timing.lag_up != timing.lag_down else ""
        lags = f"{1e3 * timing.lag_up:.1f} ms{down}"
        known = f"motor lag {lags} of the {timing.lag_of.replace('_', ' ')}, commands {1e3 * timing.delay:.1f} ms late"
        source = "by the rotor speeds" if timing.measured else "by the least residual"
        behind = f", state {1e3 * timing.state_delay:.1f} ms behind the rotors" if timing.measured else ""
        dead = timing.delay + timing.state_delay
        return (
            f"{known} ({source}){behind}: a_z {self.before[0]:.3g} -> {self.after[0]:.3g} m/s^2 rms;"
            f" give a controller timing.motor_lag={timing.lag:.3g} timing.dead_time={dead:.3g}"
        )


def fit_timing(
    flights: Sequence[Flight], vehicle: Vehicle, tables: Sequence[Mapping[str, np.ndarray]], *,
    noise: Mapping[str, float] | None = None, known: Timing | None = None,
) -> TimingFit:  # fmt: skip
    """Timing of flights of one vehicle. tables: `transitions` of each under the commands as thrusts.

    noise: known standard deviations of the targets, which no timing can take away; None: not known. known: by the
    accelerometer; taken unless the transitions show clearly another one, since it does not differentiate an estimate.
    """
    score = _Score(flights, vehicle, tables, noise or {})
    measured = []
    for flight in score.flights:
        thrust = measured_thrust(flight, vehicle)
        if thrust is not None:
            measured.append((flight, thrust))
    if measured and len(measured) == len(score.flights):
        timing = _by_rotor_speed(measured, vehicle, score)
    else:
        timing = _search(score)
        if known is not None:
            residual = float(np.mean(np.log(score.rms(known))))
            least = float(np.mean(np.log(score.rms(timing))))
            if residual < least + WORTH:
                timing = known
    return TimingFit(timing, score.rms(Timing()), score.rms(timing))


def _settled(flight: Flight) -> np.ndarray:
    """Which samples come after the thrusts of before the flight have died away, (k,)."""
    return np.asarray(flight.t, float) > flight.t[0] + SETTLING


class _Score:
    """What remains of the targets under a timing, after the regression on simple terms.

    flights: of LONGEST (s) altogether, evenly chosen. Of their settled transitions under the commands as thrusts: u
    (r, n), targets (r, 3), terms (r, q).
    """

    def __init__(
        self, flights: Sequence[Flight], vehicle: Vehicle, tables: Sequence[Mapping[str, np.ndarray]],
        noise: Mapping[str, float],
    ) -> None:  # fmt: skip
        parts = []
        seconds = 0.0
        for flight, table in zip(flights, tables, strict=True):
            transition = consecutive(np.asarray(flight.t, float), flight.columns.get("segment"))
            settled = _settled(flight)[transition]
            if settled.any():
                of_flight = {name: column[settled] for name, column in table.items()}
                parts.append((flight, of_flight, transition[settled]))
                seconds += float(flight.t[-1] - flight.t[0])
        if not parts:
            said = f"no flight is longer than {SETTLING:g} s, too short to find how late the thrusts are"
            raise DataError(f"{said}: fly longer, or set collect.thrust=commanded")
        parts = parts[:: max(1, round(seconds / LONGEST))]
        self.flights = [flight for flight, _, _ in parts]
        self._transitions = [transition for _, _, transition in parts]
        self._vehicle = vehicle
        self._noise = np.array([noise.get(name, 0.0) for name in TARGETS])
        # Per thrust: acceleration along z, torque about x and y.
        self._effect = np.vstack([np.full(vehicle.n_rotors, 1 / vehicle.mass), vehicle.allocation[1:3]])

        def rows(names: Sequence[str]) -> np.ndarray:
            return np.column_stack([np.concatenate([table[name] for _, table, _ in parts]) for name in names])

        self._u = rows(input_columns(vehicle.n_rotors))
        self._target = rows(TARGETS)
        v = rows(VELOCITY)
        self._terms = np.column_stack([np.ones(len(v)), v, v * np.abs(v)])

    def rms(self, timing: Timing) -> tuple[float, float, float]:
        """Of every target."""
        means = []
        for flight, transition in zip(self.flights, self._transitions, strict=True):
            means.append(mean_thrust(flight, self._vehicle, timing)[transition])
        thrust = np.concatenate(means)
        target = self._target + (self._u - thrust) @ self._effect.T
        remaining = []
        for effect, wanted in zip(self._effect, target.T, strict=True):
            design = np.column_stack([self._terms, thrust @ effect, thrust**2 @ effect])
            remaining.append(root_mean_square(wanted - _explained(design, wanted)))
        return remaining[0], remaining[1], remaining[2]

    def __call__(self, timing: Timing) -> float:
        square = np.square(self.rms(timing))
        beyond = np.maximum(square - self._noise**2, INDISTINCT * square)
        return float(np.mean(np.log(np.maximum(beyond, 1e-24)) / 2))


def _explained(design: np.ndarray, target: np.ndarray) -> np.ndarray:
    """What the columns (k, p) explain of the target (k,), also where some are nearly alike."""
    design = design / np.maximum(np.sqrt(np.mean(design**2, axis=0)), 1e-12)
    normal = design.T @ design + 1e-9 * len(design) * np.eye(design.shape[1])
    return design @ np.linalg.solve(normal, design.T @ target)


def _by_rotor_speed(measured: Sequence[tuple[Flight, np.ndarray]], vehicle: Vehicle, score: _Score) -> Timing:
    """Lag and delay of the commands by the measured thrusts of flights; the delay of the state by the residual."""

    def beside(timing: Timing, *, scaled: bool = True) -> float:
        """rms (N) of what is measured beside the commands; scaled: by the factors that fit, see `_scaled`."""
        errors = []
        for flight, thrust in measured:
            t = np.asarray(flight.t, float)
            rest = _settled(flight)
            model = held_commands(flight, vehicle, timing).value(t)[rest]
            if scaled:
                model = _scaled(model, thrust[rest], t[rest])
            errors.append((thrust[rest] - model).ravel())
        return root_mean_square(np.concatenate(errors))

    timing = Timing()
    if beside(timing, scaled=False) > MEASURED_APART * vehicle.hover_thrust:
        floor = 1e-4 * vehicle.hover_thrust  # below it no difference counts
        timing = replace(_search(lambda at: float(np.log(beside(at) + floor))), measured=True)
    late, least = _least(lambda state_delay: score(replace(timing, state_delay=state_delay)), LARGEST_DELAY)
    if least < score(timing) - WORTH:
        return replace(timing, state_delay=late)
    return timing


def _scaled(model: np.ndarray, measured: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Thrusts (k, n) times the factors of each rotor that fit the measured ones best: a constant, a share of the
    collective thrust, whose current a battery's voltage follows, and a drift over the time t, (k,)."""
    factors = np.column_stack([np.ones(len(t)), model.mean(axis=1), t - t.mean()])
    scaled = []
    for u, y in zip(model.T, measured.T, strict=True):
        scaled.append(_explained(u[:, None] * factors, y))
    return np.column_stack(scaled)


def _search(score: Callable[[Timing], float]) -> Timing:
    """Timing of the least score, but the simplest that comes within WORTH of it: without any, with a lag or a delay
    alone, with both, and with a lag of its own up and down. A lag or delay alone always shows that there is one."""
    none = Timing()

    def with_lag(kind: str, lag: float) -> float:
        return score(Timing(lag, lag, kind))

    def with_both(kind: str, at: Sequence[float]) -> float:
        """Of a lag, or one up and one down, and the delay that follows them."""
        return score(Timing(at[0], at[-2], kind, at[-1]))

    delay = _least(lambda delay: score(Timing(delay=delay)), LARGEST_DELAY)[0]
    lags = []
    for kind in ("thrust", "rotor_speed"):
        lag = _least(partial(with_lag, kind), LARGEST_LAG)[0]
        lags.append(Timing(lag, lag, kind))
    alone = [Timing(delay=delay), *lags]
    if min(map(score, alone)) > score(none) - WORTH:
        return none
    both = []
    apart = []
    for first in lags:
        kind = first.lag_of
        lag, late = _descent(partial(with_both, kind), [first.lag / 2, delay / 2])
        up, down, behind = _descent(partial(with_both, kind), [lag, lag, late])
        both.append(Timing(lag, lag, kind, late))
        apart += [Timing(up, down, kind), Timing(up, down, kind, behind)]
    best = [min(group, key=score) for group in ([none], alone, both, apart)]
    scores = list(map(score, best))
    limit = min(scores) + WORTH
    return next(timing for timing, value in zip(best, scores, strict=True) if value <= limit)


def _descent(score: Callable[[np.ndarray], float], start: Sequence[float]) -> list[float]:
    """Where a score of lags and, last, a delay (s) is least, from `start`; what is under 0.1 ms is 0."""
    bounds = [(0.0, LARGEST_LAG)] * (len(start) - 1) + [(0.0, LARGEST_DELAY)]
    simplex = np.array(start) + np.vstack([np.zeros(len(start)), FIRST_STEP * np.eye(len(start))])
    options = {"initial_simplex": simplex, "xatol": 3e-5, "fatol": 1e-5, "maxfev": 60 * len(start)}
    best = minimize(score, np.array(start), method="Nelder-Mead", bounds=bounds, options=options).x
    return [float(value) if value > 1e-4 else 0.0 for value in best]


def _least(score: Callable[[float], float], largest: float) -> tuple[float, float]:
    """Where a score of a lag or delay alone is least up to `largest`, and the score there; the grid's steps grow with
    the value."""
    grid = np.concatenate([[0.0], np.geomspace(0.003, largest, 10)]).tolist()
    scores = [score(at) for at in grid]
    k = int(np.argmin(scores))
    bounds = (grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)])
    best = minimize_scalar(score, bounds=bounds, method="bounded", options={"xatol": 2e-5})
    if best.fun < scores[k]:
        return float(best.x), float(best.fun)
    return grid[k], scores[k]
