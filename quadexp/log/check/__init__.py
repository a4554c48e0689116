"""Quality check of a recorded flight: faults by name, with their place, their size and what is allowed.

The order matters. Bad samples are found first and left out of what follows. Then units, frames, signs and the clock are
tested against the motion. Then, with the faults found so far corrected, come offsets, spikes and commands: a log in
degrees is reported as such, not as one that spins too fast.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from quadexp.log.check import clock, commands, rotors, timing
from quadexp.log.check import samples as sample_checks
from quadexp.log.check.dead import check_dead
from quadexp.log.check.duplicates import check_duplicates
from quadexp.log.finding import Finding, worst_first
from quadexp.log.hypotheses import search
from quadexp.log.hypotheses.hypothesis import KEYS
from quadexp.log.hypotheses.windows import STREAMS, Windows, cut, window_starts
from quadexp.log.schema import Flight
from quadexp.log.signal import Offset, increasing
from quadexp.physics.vehicle import Vehicle

__all__ = ["Finding", "check_flight", "check_flights", "inspect_flight"]

LEAST_WINDOWS = 10
SHORT = 2.0  # s
MOST_ROWS = 50_000  # that a median is taken over
CHUNK = 100_000  # samples that are corrected at once
THRUST_MARGIN = 2.0  # times the largest thrust: knocks and vibration besides
HARD_LIMIT = 320.0  # m/s^2: a 32 g accelerometer


def check_flight(flight: Flight, vehicle: Vehicle | None = None) -> list[Finding]:
    """Everything that is wrong with one flight, worst first.

    vehicle: whose limits the commands must keep; None: unknown. Raises DataError where there is no column t.
    """
    motions: list[rotors.Motion] = []
    found, _ = inspect_flight(flight, vehicle, motions)
    if vehicle is not None and motions:
        found += rotors.rotor_findings(rotors.judge(motions, vehicle), rotors.signal_kind(flight), vehicle)
    return worst_first(found)


def inspect_flight(
    flight: Flight, vehicle: Vehicle | None = None, motions: list[rotors.Motion] | None = None
) -> tuple[list[Finding], dict[str, np.ndarray]]:
    """The findings, but for those of the rotors; and the bad samples, (k,) masks by the name of the finding.

    Arguments as check_flight; motions: what the flight tells about its rotors is appended to it.
    """
    t = np.asarray(flight.t, float)
    streams = _streams(flight)
    bad_rows: dict[str, np.ndarray] = {}
    if len(t) < 3:
        return [
            Finding("no_flight", "blocking", "all samples", f"{len(t)} samples", f"{SHORT:g} s of flight")
        ], bad_rows
    segment = flight.columns.get("segment")
    found = clock.check_clock(t, position=streams.get("p"), velocity=streams.get("v"), segment=segment)
    found += sample_checks.check_finite(flight.columns, t)
    repeated, first = sample_checks.check_repeats(flight.columns, t)
    if repeated:  # the clock's complaints about those samples are its symptom
        found = [one for one in found if one.name not in ("clock_repeated", "clock_jump")] + repeated
        found += [one for one in clock.check_clock(t[first]) if one.name == "clock_jump"]
        bad_rows["duplicated_rows"] = ~first
    if "q" in streams:
        found += sample_checks.check_quaternion(streams["q"], t)
    if any(one.name in ("clock_repeated", "clock_jump") and one.blocks for one in found):
        first = first & increasing(t)
    kept = flight
    if not first.all():  # a long flight is not copied without need
        t, streams = t[first], {name: values[first] for name, values in streams.items()}
        segment = None if segment is None else np.asarray(segment)[first]
        kept = Flight({name: values[first] for name, values in flight.columns.items()}, flight.metadata)

    def mark(name: str, mask: np.ndarray) -> None:
        if mask.any():
            whole_mask = bad_rows.setdefault(name, np.zeros(len(first), bool))
            whole_mask[np.flatnonzero(first)[mask]] = True

    if len(t) < 3 or not np.isfinite(t).all():
        return worst_first(found), bad_rows
    flown = commands.check_flown(kept, streams, vehicle)
    found += flown
    if any(one.blocks for one in flown):
        return worst_first(found), bad_rows

    dead, lost = check_dead(streams, t)
    found += dead
    mark("dead_logger", lost)
    frozen, masks = sample_checks.check_frozen(streams, t)
    found += [] if dead and masks and all((mask & ~lost).sum() == 0 for mask in masks.values()) else frozen
    bad = _spiky(streams) | lost
    for mask in masks.values():
        bad |= mask
        mark("frozen_sensor", mask)
    for values in streams.values():
        bad |= ~np.isfinite(values).all(axis=1)
    repaired, explained = _consistency(t, streams, bad, segment)
    found += explained

    imu = timing.imu_offset(t, repaired, ~bad, vectors=True)
    motor = _motor_offset(kept, t, repaired)
    found += timing.offset_findings(imu, motor)
    spikes, spiky = sample_checks.check_spikes(repaired, t, _limits(vehicle))
    for name, mask in spiky.items():
        mark(f"{KEYS[name]}_outlier", mask)
    without = [spiky[name] for name in "pv" if name in spiky]
    for one, when in _stray(t, repaired, segment, [*without, lost]):
        found.append(one)
        spike = spiky.get("w" if one.name == "rate_outlier" else "f", np.zeros(len(t), bool))
        mark(one.name, _within(t, when[~_holds(t, when, spike)]))  # a spike is bad, not the windows around it
    found += [one for one in spikes if one.name not in {other.name for other in found}]
    found += commands.check_commands(kept, vehicle)
    mark("impossible_command", commands.impossible_rows(kept, vehicle))
    found += commands.check_voltage(kept, vehicle)
    if vehicle is not None and motions is not None and "w" in repaired:
        motion = rotors.motion_of(kept, vehicle, repaired["w"], bad)
        if motion is not None:
            motions.append(motion)
    if t[-1] - t[0] < SHORT:
        found.append(Finding("short", "warning", "all samples", f"{t[-1] - t[0]:.2f} s", f"{SHORT:g} s"))
    return worst_first(_without_symptoms(found)), bad_rows


def _holds(t: np.ndarray, when: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Whether each stretch of `when`, (n, 2) (s), contains one of the samples, (n,)."""
    count = np.concatenate([[0], np.cumsum(samples)])
    return count[np.searchsorted(t, when[:, 1], side="right")] > count[np.searchsorted(t, when[:, 0])]


def _within(t: np.ndarray, when: np.ndarray) -> np.ndarray:
    """Samples in any of the stretches when (n, 2) (s), (k,)."""
    edges = np.zeros(len(t) + 1, int)
    np.add.at(edges, np.searchsorted(t, when[:, 0]), 1)
    np.add.at(edges, np.searchsorted(t, when[:, 1], side="right"), -1)
    return np.cumsum(edges)[:-1] > 0


def check_flights(
    flights: Mapping[str, Flight], vehicles: Mapping[str, Vehicle | None] | Vehicle | None = None
) -> dict[str, list[Finding]]:
    """Findings of every flight by its name, those about several flights (duplicates, rotors) among them."""
    same = check_duplicates(flights)
    found: dict[str, list[Finding]] = {}
    silent: dict[tuple[Vehicle, str], list[tuple[str, rotors.Motion]]] = {}
    for name, flight in flights.items():
        vehicle = vehicles.get(name) if isinstance(vehicles, Mapping) else vehicles
        motions: list[rotors.Motion] = []
        found[name] = same.get(name, []) + inspect_flight(flight, vehicle, motions)[0]
        if vehicle is None or not motions:
            continue
        verdict = rotors.judge(motions, vehicle)
        found[name] += rotors.rotor_findings(verdict, rotors.signal_kind(flight), vehicle)
        if verdict is None or not (verdict.sure and verdict.spin):
            silent.setdefault((vehicle, rotors.signal_kind(flight)), []).append((name, motions[0]))
    for (vehicle, kind), members in silent.items():  # flights too short by themselves may tell it together
        if len(members) > 1:
            verdict = rotors.judge([motion for _, motion in members], vehicle)
            for name, _ in members:
                known = {one.name for one in found[name]}
                made = rotors.rotor_findings(verdict, kind, vehicle)
                found[name] += [one for one in made if one.name not in known]
    return {name: worst_first(findings) for name, findings in found.items()}


def _streams(flight: Flight) -> dict[str, np.ndarray]:
    """The motion's streams that the flight has, those without a single finite sample left out."""
    found = {}
    for name, columns in STREAMS.items():
        if all(column in flight.columns for column in columns):
            values = _together([flight.columns[column] for column in columns])
            if np.isfinite(values).all(axis=1).any():
                found[name] = values
    return found


def _together(columns: list[np.ndarray]) -> np.ndarray:
    """Columns side by side, (k, m); not copied where all are columns of one array."""
    base = columns[0].base
    if isinstance(base, np.ndarray) and base.shape == (len(columns[0]), len(columns)) and base.dtype == np.float64:
        views = [base[:, i] for i in range(len(columns))]
        places = [(v.__array_interface__["data"][0], v.strides) for v in views]
        if places == [(c.__array_interface__["data"][0], c.strides) for c in columns]:
            return base
    return np.stack(columns, axis=-1).astype(float, copy=False)


def _spiky(streams: Mapping[str, np.ndarray]) -> np.ndarray:
    """Mask (k,) of samples far from the stream's median, whatever its unit."""
    length = len(next(iter(streams.values()))) if streams else 0
    bad = np.zeros(length, bool)
    for name, values in streams.items():
        if name == "q":
            continue
        some = values[:: max(1, length // MOST_ROWS)]
        middle = np.nanmedian(some, axis=0)
        spread = np.nanmax(np.nanquantile(np.abs(some - middle), 0.8, axis=0))
        for column, centre in zip(values.T, middle, strict=True):
            bad |= np.abs(column - centre) > 12 * spread
    return bad if bad.mean() < 0.5 else np.zeros(length, bool)


def _consistency(
    t: np.ndarray, streams: dict[str, np.ndarray], bad: np.ndarray, segment: np.ndarray | None
) -> tuple[dict[str, np.ndarray], list[Finding]]:
    """The streams after the corrections that were found, and the findings."""
    starts, half = window_starts(t, ~bad, segment)
    if len(starts) < LEAST_WINDOWS:
        return streams, []
    start = timing.imu_offset(t, streams, ~bad, vectors=False)
    shifted = dict(streams)
    if start is not None and start.certain and start.correlation > 0.7 and abs(start.seconds) > timing.ALLOWED:
        for name in ("w", "f"):
            if name in streams:
                columns = np.nan_to_num(streams[name]).T
                shifted[name] = np.stack([np.interp(t + start.seconds, t, column) for column in columns], axis=-1)
    explained, windows, doubtful = search.explain(cut(t, shifted, starts, half))
    found = [one.finding() for one in explained] + doubtful + search.disagreements(windows)
    repaired = _repaired(t, streams, explained) if explained else streams
    return repaired, found


def _stray(
    t: np.ndarray, streams: dict[str, np.ndarray], segment: np.ndarray | None, without: list[np.ndarray]
) -> list[tuple[Finding, np.ndarray]]:
    """Stretches where a sensor contradicts the others, and their times. without: masks of samples of a wrong motion."""
    good = ~np.logical_or.reduce([np.zeros(len(t), bool), *without])
    for values in streams.values():
        good &= np.isfinite(values).all(axis=1)
    starts, half = window_starts(t, good, segment)
    return search.stray(cut(t, streams, starts, half)) if len(starts) >= LEAST_WINDOWS else []


def _repaired(
    t: np.ndarray, streams: Mapping[str, np.ndarray], explained: list[search.Explained]
) -> dict[str, np.ndarray]:
    """The streams with all repairs done, chunk by chunk."""
    made = {name: np.empty_like(values) for name, values in streams.items()}
    for start in range(0, len(t), CHUNK):
        samples = slice(start, start + CHUNK)
        part = Windows.of_streams(t[None, samples], {name: values[None, samples] for name, values in streams.items()})
        for one in explained:
            part = one.hypothesis.apply(part)
        for name in made:
            made[name][samples] = getattr(part, name)[0]
    return made


def _motor_offset(flight: Flight, t: np.ndarray, streams: Mapping[str, np.ndarray]) -> Offset | None:
    if "f" not in streams:
        return None
    for kind, names in commands.command_columns(flight).items():
        samples = timing.spread(t)
        values = flight.stack(names)[samples].astype(float)
        thrust = np.sum(values if kind == "u" else values**2, axis=1)
        velocity = None
        if "q" in streams and "v" in streams:
            from quadexp.physics.rotation import air_velocity  # CasADi takes a while

            wind = None if flight.wind is None else flight.wind[samples]
            velocity = air_velocity(streams["q"][samples], streams["v"][samples], wind)
        return timing.motor_offset(t[samples], thrust, streams["f"][samples, 2], velocity)
    return None


def _limits(vehicle: Vehicle | None) -> dict[str, float]:
    """Largest specific force that can be real."""
    if vehicle is None:
        return {"f": HARD_LIMIT}
    thrust = vehicle.n_rotors * vehicle.thrust_max / vehicle.mass
    return {"f": min(HARD_LIMIT, THRUST_MARGIN * thrust + 2 * vehicle.gravity)}


def _without_symptoms(found: list[Finding]) -> list[Finding]:
    """Leave out `inconsistent` where a finding about a broken sensor explains it."""
    names = {one.name for one in found if one.blocks}
    broken = {"acceleration_outlier", "rate_outlier", "position_outlier", "velocity_outlier", "frozen_sensor",
              "dead_logger"}  # fmt: skip
    if names & broken or any(one.name in broken for one in found):
        found = [one for one in found if one.name != "inconsistent"]
    return found
