"""What a flight with remedies=auto assumed of its world, with 95 % bands, and what was true where the world says so.

What is assumed no better than LIMITS was not identifiable on this path: nothing in it showed that quantity.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError, WrongFileError
from quadexp.log.schema import Flight
from quadexp.physics.state import ATTITUDE, VELOCITY
from quadexp.plugins.auto.responses import command_weights
from quadexp.plugins.auto.settings import INTERVAL, LIMITS, REPORT
from quadexp.plugins.drawing.style import HUES, Figure, styled
from quadexp.report.table import Table

MS = 1e3  # of a second
QUANTITIES = {  # column: name, unit, column of the deviation; "": there are those of both ends of an interval
    "auto_age": ("age of the state", "ms", ""),
    "auto_delay": ("dead time and lag of commands", "ms", ""),
    "observer_thrust_scale": ("scale of the thrust", "1", "auto_thrust_scale_sd"),
    **{f"observer_wind_{a}": (f"wind, {a}", "m/s", f"auto_wind_{a}_sd") for a in "xyz"},
    **{f"observer_force_{a}": (f"force, {a}", "N", f"auto_force_{a}_sd") for a in "xyz"},
}


class Belief(NamedTuple):
    """One quantity over a flight, with its 95 % interval. value, low, high: (k,), NaN as long as nothing is assumed;
    high is infinite where the value is one "at least". true: (k,), or NaN where the world does not say. limit: half of
    an interval that tells nothing."""

    name: str
    unit: str
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    true: np.ndarray
    limit: float

    @property
    def identifiable(self) -> bool:
        """Whether it is known at the end."""
        return bool(self.high[-1] - self.low[-1] < 2 * self.limit)

    @property
    def covers(self) -> np.ndarray:
        """Whether the interval contains the truth, (k,)."""
        inside: np.ndarray = (self.low <= self.true) & (self.true <= self.high)
        return inside


def beliefs(flight: Flight) -> list[Belief]:
    """Those of a flight with remedies=auto, none of one that was over at once; WrongFileError for another one."""
    columns = flight.columns
    if "auto_age" not in columns:
        raise WrongFileError("this flight assumed nothing: it was not flown with remedies=auto")
    if len(flight) < 2:
        return []
    vehicle = flight.metadata["config"]["vehicle"]
    true = truths(flight)
    quantities = []
    for column, (name, unit, deviation) in QUANTITIES.items():
        of_force = unit == "N"
        if of_force and "thinned" in flight.metadata:  # what moves between samples is not known
            continue
        value, limit = columns[column], LIMITS[unit]
        if of_force:
            limit *= vehicle["mass"] * vehicle["gravity"]
        if deviation:
            moves = force_variance(flight, column) if of_force else 0.0
            half = INTERVAL.band * np.sqrt(columns[deviation] ** 2 + moves)
            low, high = value - half, value + half
        else:
            low, high = columns[f"{column}_low"], columns[f"{column}_high"]
        is_known = np.isfinite(low)
        if is_known.any():
            value = np.where(is_known, value, np.nan)
            truth = true.get(column, np.full(len(flight), np.nan))
            factor = MS if unit == "ms" else 1.0
            value, low, high, truth = (factor * series for series in (value, low, high, truth))
            quantities.append(Belief(name, unit, value, low, high, truth, limit))
    return quantities


def force_variance(flight: Flight, column: str) -> np.ndarray:
    """Variance of a force (N^2), (k,), by what moves. The observer is behind the force; and where commands give the
    thrust, a timing that is off by d shows it late: by d / lag of how far a low pass would be behind the thrust."""
    columns = flight.columns
    axis = "xyz".index(column[-1])
    lag = columns["auto_force_lag"]
    variance = behind(flight.t, columns[column], lag) ** 2
    if by_rotor_speeds(flight):
        return variance
    acts = columns["auto_acts_dead_time"] + columns["auto_acts_lag"]
    half = (columns["auto_delay_high"] - columns["auto_delay_low"]) / 2  # NaN: nothing is known yet
    timing = np.hypot(half / INTERVAL.band, columns["auto_delay"] - acts)
    thrust = flight.input.sum(axis=1) * _up(flight)[:, axis]
    moved = behind(flight.t, thrust, lag)
    late = np.where(moved > 0, timing, 0.0) / lag * moved
    return variance + late**2


def behind(t: np.ndarray, value: np.ndarray, lag: np.ndarray) -> np.ndarray:
    """How far a low pass is behind what moves, (k,): by what it moved itself in its time constant, lag (s), (k,). Half
    of the square is that of now, half its mean over some time constants: where what moves turns round, the low
    pass stands still for an instant, and is off all the same."""
    moved = np.nan_to_num(value - np.interp(t - lag, t, value)) ** 2
    total = np.concatenate([[0.0], np.cumsum(moved[1:] * np.diff(t))])
    span = REPORT.recent * lag
    recent = (total - np.interp(t - span, t, total)) / span
    return np.sqrt((moved + np.maximum(recent, 0.0)) / 2)


def truths(flight: Flight) -> dict[str, np.ndarray]:
    """What the world of a simulated flight states, by column of QUANTITIES, (k,)."""
    timing = flight.metadata.get("timing")
    if timing is None:
        return {}
    size, dead_time = len(flight), timing["dead_time"]
    actuator = flight.metadata["config"].get("actuator", {})
    up, down = (actuator.get(f"time_constant_{way}", 0.0) for way in ("up", "down"))
    lag = timing["lag"] - max(up, down) + lag_of(up, down)  # the slower way is stated
    true: dict[str, np.ndarray] = {
        "auto_age": np.full(size, _age(flight, timing["age"])),
        "auto_delay": np.full(size, dead_time + lag),
        "observer_thrust_scale": _thrust_scale(flight, dead_time, lag),
    }
    for axis in "xyz":
        true[f"observer_wind_{axis}"] = flight.columns.get(f"wind_{axis}", np.zeros(size))
    if flight.metadata["residual"]["name"] == "none" and size > 1 and "thinned" not in flight.metadata:
        force = true_force(flight, dead_time, lag)
        for i, axis in enumerate("xyz"):
            true[f"observer_force_{axis}"] = force[:, i]
    return true


def _thrust_scale(flight: Flight, dead_time: float, lag: float) -> np.ndarray:
    """What rotors gave lately of what was commanded, after dead time and lag (s), over the mass in that which is
    assumed, (k,). NaN where no column shows what the world has: a drawn factor, a payload, a rotor that fails."""
    columns, config = flight.columns, flight.metadata["config"]
    actuator, truth = config.get("actuator", {}), config.get("truth", {})
    is_drawn = actuator.get("rotor_scale_std") or actuator.get("flight_scale_std")
    changes = "payload" in config or "health" in config or config["plant"].get("schedule")
    if is_drawn or changes or len(flight) < 2 or "thinned" in flight.metadata:
        return np.full(len(flight), np.nan)
    given = commanded = commanded_thrust(flight, dead_time, lag, 0.0)
    if "rotor_speed_0" in columns:
        given = _thrust_of_speeds(flight)
    elif "delivered_0" in columns:
        given = flight.stack([f"delivered_{i}" for i in range(flight.input.shape[1])]).sum(axis=1)
    samples = round(REPORT.last / _period(flight))
    window = np.ones(min(max(samples, 1), len(flight)))
    share = np.convolve(given, window)[: len(flight)] / np.convolve(commanded, window)[: len(flight)]
    return share * truth.get("thrust_coefficient", 1.0) / truth.get("mass", 1.0)


def lag_of(up: float, down: float) -> float:
    """The one lag (s) that goes most like motors with one up and another down (s), of least squares over commands with
    steps or noise: within 3 % the square of the mean root."""
    return (math.sqrt(up) + math.sqrt(down)) ** 2 / 4


def _age(flight: Flight, stated: float) -> float:
    """Mean age of the attitudes that were given (s): a reading with a rate grows older until the next one comes.
    stated: that of what is given at every instant."""
    taken = flight.columns.get("taken_attitude", np.full(len(flight), flight.t[0]))
    ages = (flight.t - taken)[taken > flight.t[0]]  # until the first arrives the start's holds
    return float(ages.mean()) if len(ages) else stated


def by_rotor_speeds(flight: Flight) -> bool:
    """Whether rotor speeds given the thrusts: with them alone the air is scaled."""
    return bool(np.ptp(flight.columns.get("observer_air_scale", np.ones(1))) > 0)


def true_force(flight: Flight, dead_time: float, lag: float) -> np.ndarray:
    """What acts beside gravity and the thrusts that are assumed, on a model without air: m (a + g e_z) - T R e_z,
    world (N), (k, 3); m: the mass that is assumed, a: of the true velocity over the last period. T: of the commands
    after dead time and lag, or at the instants that of the rotors' speeds, times the scale that is assumed."""
    vehicle, period = flight.metadata["config"]["vehicle"], _period(flight)
    thrust = commanded_thrust(flight, dead_time, lag, period)
    if by_rotor_speeds(flight):
        off = _thrust_of_speeds(flight) - commanded_thrust(flight, dead_time, lag, 0.0)
        thrust = thrust + (off + np.roll(off, 1)) / 2
    thrust = flight.columns.get("observer_thrust_scale", 1.0) * thrust
    acceleration = np.diff(flight.state[:, VELOCITY], axis=0, prepend=np.nan) / period
    up = _up(flight)
    middle = (up + np.roll(up, 1, axis=0)) / 2
    return vehicle["mass"] * (acceleration + [0, 0, vehicle["gravity"]]) - thrust[:, None] * middle


def commanded_thrust(flight: Flight, dead_time: float, lag: float, span: float) -> np.ndarray:
    """Thrust of all rotors by the commands after dead time and lag (s), at each sample or its mean over `span` (s)
    before, (k,) (N)."""
    period = _period(flight)
    sent = flight.input.sum(axis=1)
    count = 2 + math.ceil((dead_time + REPORT.settled * lag) / period)
    [weights] = command_weights(period, count, np.array([dead_time + lag]), np.array([lag]), span)
    commands = np.concatenate([np.full(count, sent[0]), sent])
    return np.convolve(commands, weights)[count - 1 :][: len(sent)]


def _thrust_of_speeds(flight: Flight) -> np.ndarray:
    """Thrust of all rotors by their true speeds, (k,) (N)."""
    squares = sum(flight.columns[f"rotor_speed_{i}"] ** 2 for i in range(flight.input.shape[1]))
    thrust: np.ndarray = flight.metadata["config"]["vehicle"]["thrust_coefficient"] * squares
    return thrust


def _period(flight: Flight) -> float:
    """From one sample to the next (s)."""
    return float(flight.t[1] - flight.t[0])


def _up(flight: Flight) -> np.ndarray:
    """Direction of the thrusts, world, (k, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(flight.state[:, ATTITUDE], scalar_first=True).apply([0, 0, 1])


def _text(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.3g}"


def _to_show(flight: Flight) -> list[Belief]:
    """Its beliefs; DataError where there are none."""
    quantities = beliefs(flight)
    if not quantities:
        raise DataError("this flight assumed nothing: it was over at once")
    return quantities


def _band_text(low: float, high: float) -> str:
    if np.isnan(low):
        return ""
    return f"at least {low:.3g}" if np.isinf(high) else f"{low:.3g} .. {high:.3g}"


def _verdict(belief: Belief) -> str:
    """On the end of the flight."""
    if not belief.identifiable:
        return "not identifiable on this path"
    if np.isnan(belief.true[-1]):
        return ""
    return "in the band" if belief.covers[-1] else "outside"


def beliefs_table(flight: Flight) -> Table:
    """At the end of the flight. DataError where it assumed nothing."""
    rows = []
    for belief in _to_show(flight):
        value, low, high, true = (float(x[-1]) for x in (belief.value, belief.low, belief.high, belief.true))
        if abs(value) < REPORT.rounded * (high - low) < math.inf:
            value = 0.0
        band = _band_text(low, high)
        rows.append((belief.name, belief.unit, _text(value), band, _text(true), _verdict(belief)))
    columns = "assumed at the end", "unit", "value", "95 % band", "true", ""
    return Table(columns, rows, left=frozenset({0, 1, 5}))


@styled
def beliefs_figure(flight: Flight) -> Figure:
    """A panel for each quantity: what was assumed, its band, and what was true. DataError where there is none."""
    quantities = _to_show(flight)
    figure = Figure(figsize=(9.0, 1.5 * len(quantities) + 0.6))
    panels = np.atleast_1d(figure.subplots(len(quantities), sharex=True))
    for panel, belief in zip(panels, quantities, strict=True):
        _draw(panel, flight.t, belief)
    panels[0].legend(loc="best", ncols=2)
    panels[-1].set_xlabel("time, s")
    return figure


def _draw(panel: Any, t: np.ndarray, belief: Belief) -> None:
    """One quantity over time, t (k,) (s). A band without an upper end goes up to the largest value."""
    largest = np.nanmax(np.maximum(belief.value, belief.low), initial=0.0)
    high = np.where(np.isinf(belief.high), largest, belief.high)
    panel.fill_between(t, belief.low, high, color=HUES["blue"], alpha=0.2, linewidth=0)
    panel.plot(t, belief.value, color=HUES["blue"], label="assumed, 95 % band")
    if np.isfinite(belief.true).any():
        panel.plot(t, belief.true, color=HUES["vermillion"], linestyle=":", label="true")
    late = np.isfinite(high) & (t > t[-1] / 10)
    if late.any():
        ends = np.concatenate([belief.low[late], high[late], belief.true[late]])
        panel.set_ylim(np.nanmin(ends), np.nanmax(ends) + REPORT.height)
    title = belief.name
    if belief.unit != "1":
        title += f", {belief.unit}"
    if not belief.identifiable:
        title += ": not identifiable on this path"
    panel.set_title(title)
