"""Quality check of a recorded flight: faults by name, with their place, their size and what is allowed.

The order matters. Bad samples are found first and left out of what follows. Then units, frames, signs and the clock are
tested against the motion. Then, with the faults found so far corrected, come offsets, spikes and commands: a log in
degrees is reported as such, not as one that spins too fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadexp.log.runs import longest
from quadexp.log.schema import Flight
from quadexp.physics.rotation import continuous
from quadexp.physics.state import finite_rows
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.check import rotors, samples, search
from quadexp.plugins.check.candidates import COLUMNS, KEYS, Candidate
from quadexp.plugins.check.duplicates import check_duplicates
from quadexp.plugins.check.rotors import check_commands, check_flown, check_voltage
from quadexp.plugins.logs.finding import SEVERITIES, Finding, of_rows, worst_first
from quadexp.plugins.logs.signal import Stream, increasing
from quadexp.plugins.logs.signal.offset import Offset, aligned, find_offsets, turning_offset
from quadexp.plugins.logs.signal.rest import at_rest, thrust_of
from quadexp.plugins.logs.signal.windows import Windows, cut, streams_of

SHORT = 2.0  # s
MOST_ROWS = 50_000  # that a median is taken over
THRUST_MARGIN = 2.0  # times the largest thrust: knocks and vibration besides
HARD_LIMIT = 320.0  # m/s^2: a 32 g accelerometer
ALLOWED = 0.025  # s: a quarter of the time in which a racing quadrotor turns by a radian, and clean logs' 0.02 s
OFFSET_BLOCKS = 0.1  # s
SAME_OFFSET = 0.005  # s: gyro and accelerometer of one board
CLEARANCE = 0.5  # m that a flight is above where it rests
GROUND, GROUND_BLOCKS = 0.02, 0.05  # share of the samples at rest
LETTERS = {key: letter for letter, key in KEYS.items()}
TURNS = {"mounting", "heading", "scale", "bias"}  # what a delay may look like
LEAST_LATE, MOST_LATE = 0.008, 0.3  # s: that is looked for in place of a turn
LEAST_CORRELATION = 0.7  # half of the variance is common
# Faults of samples, of which the finding `inconsistent` is a symptom.
BROKEN = {"acceleration_outlier", "rate_outlier", "position_outlier", "velocity_outlier", "frozen_sensor",
          "dead_logger"}  # fmt: skip


@dataclass(frozen=True)
class LateStreams:
    """moves: by how much streams are late (s), by letter. rivals: turns that explain the flight as well."""

    moves: dict[str, float]
    rivals: list[Candidate]

    def said(self, offsets: list[Finding]) -> list[Finding]:
        """The findings of offsets with the rivals named, and one of these streams where there is none."""
        doubt = (
            "; or " + " and ".join(f"{finding.where}: {finding.text}" for finding in self.rivals) if self.rivals else ""
        )
        lines = ", ".join(line for finding in self.rivals for line in finding.lines)
        decide = f"; decide between this and {lines}, which the flight does not" if self.rivals else ""
        if not offsets:
            sizes = {KEYS[name]: seconds for name, seconds in self.moves.items()}
            text = ", ".join(f"{name} is {1e3 * seconds:+.0f} ms late" for name, seconds in sizes.items())
            where = ", ".join(COLUMNS[name] for name in self.moves)
            size = max(abs(seconds) for seconds in self.moves.values())
            severity = "blocking" if size > OFFSET_BLOCKS else "warning"
            advice = "a flight that does not repeat itself tells it, then `import --align` corrects it"
            offsets = [Finding("time_offset", severity, where, text, f"{1e3 * ALLOWED:.0f} ms", advice)]
        return [
            replace(finding, measured=finding.measured + doubt, advice=finding.advice + decide) for finding in offsets
        ]


def check_flight(flight: Flight, vehicle: Vehicle | None = None) -> list[Finding]:
    """Everything that is wrong with one flight, worst first.

    vehicle: whose limits the commands must keep; None: unknown. Raises DataError where there is no column t.
    """
    return check_flights({"": flight}, vehicle)[""]


def check_flights(
    flights: Mapping[str, Flight], vehicles: Mapping[str, Vehicle | None] | Vehicle | None = None
) -> dict[str, list[Finding]]:
    """Findings of every flight by its name, those about several flights (duplicates, rotors) among them."""
    same = check_duplicates(flights) if len(flights) > 1 else {}
    by_name: dict[str, list[Finding]] = {}
    unsure: dict[tuple[Vehicle, str], dict[str, rotors.Motion]] = {}
    for name, flight in flights.items():
        vehicle = vehicles.get(name) if isinstance(vehicles, Mapping) else vehicles
        findings, _, motion = inspect_flight(flight, vehicle)
        by_name[name] = same.get(name, []) + findings
        if vehicle is not None and motion is not None:
            verdict, kind = rotors.judge([motion], vehicle), rotors.signal_kind(flight)
            by_name[name] += rotors.rotor_findings(verdict, kind, vehicle)
            if verdict is None or not (verdict.sure and verdict.spin):
                unsure.setdefault((vehicle, kind), {})[name] = motion
    for (vehicle, kind), motions in unsure.items():  # flights too short by themselves may tell it together
        verdict = rotors.judge([*motions.values()], vehicle) if len(motions) > 1 else None
        together = rotors.rotor_findings(verdict, kind, vehicle)
        for name in motions:
            known = {finding.name for finding in by_name[name]}
            by_name[name] += [finding for finding in together if finding.name not in known]
    return {name: worst_first(findings) for name, findings in by_name.items()}


def inspect_flight(
    flight: Flight, vehicle: Vehicle | None = None
) -> tuple[list[Finding], dict[str, np.ndarray], rotors.Motion | None]:
    """The findings, but for those of the rotors; the bad samples, (k,) masks by the name of the finding; and what the
    flight tells about its rotors. Arguments as check_flight."""
    t = np.asarray(flight.t, float)
    bad_rows: dict[str, np.ndarray] = {}
    if len(t) < 3:
        text = f"{len(t)} samples"
        return [Finding("no_flight", "blocking", "all samples", text, f"{SHORT:g} s of flight")], bad_rows, None
    streams = {name: x for name, x in streams_of(flight).items() if finite_rows(x).any()}
    findings = samples.check_clock(t, streams, flight.columns.get("segment"))
    findings += samples.check_finite(flight.columns, t)
    repeated, first = samples.check_repeats(flight.columns, t)
    if repeated:  # the clock's complaints about those samples are its symptom
        findings = [finding for finding in findings if finding.name not in ("clock_repeated", "clock_jump")] + repeated
        findings += [finding for finding in samples.check_clock(t[first]) if finding.name == "clock_jump"]
        bad_rows["duplicated_rows"] = ~first
    if "q" in streams:
        findings += samples.check_quaternion(streams["q"], t)
    if any(finding.name in ("clock_repeated", "clock_jump") and finding.blocks for finding in findings):
        first = first & increasing(t)
    kept = flight
    if not first.all():  # a long flight is not copied without need
        t, streams = t[first], {name: values[first] for name, values in streams.items()}
        kept = Flight({name: values[first] for name, values in flight.columns.items()}, flight.metadata)
    segment = kept.columns.get("segment")

    def mark(name: str, mask: np.ndarray) -> None:
        if mask.any():
            bad_rows.setdefault(name, np.zeros(len(first), bool))[np.flatnonzero(first)[mask]] = True

    if len(t) < 3 or not np.isfinite(t).all():
        return worst_first(findings), bad_rows, None
    findings += check_flown(kept, streams, vehicle)
    if any(finding.name == "no_flight" and finding.blocks for finding in findings):
        return worst_first(findings), bad_rows, None

    findings += _check_ground(kept, streams, t)
    dead, lost = samples.check_dead(streams, t)
    frozen, stuck = samples.check_frozen(streams, t)
    findings += dead + ([] if dead and stuck.any() and not (stuck & ~lost).any() else frozen)
    mark("dead_logger", lost)
    mark("frozen_sensor", stuck)
    bad = _spiky(streams, len(t)) | lost | stuck | ~_finite(streams)
    repaired, explained, late = _consistency(t, streams, bad, segment)
    offsets = _check_offset(repaired, t, ~bad)
    findings += explained + (offsets if late is None else late.said(offsets))
    hardest = HARD_LIMIT
    if vehicle is not None:
        thrust = vehicle.n_rotors * vehicle.thrust_max / vehicle.mass
        hardest = min(HARD_LIMIT, THRUST_MARGIN * thrust + 2 * vehicle.gravity)
    spikes, spiky = samples.check_spikes(repaired, t, {"f": hardest})
    for name, mask in spiky.items():
        mark(f"{KEYS[name]}_outlier", mask)
    wrong = np.logical_or.reduce([lost, *(spiky[name] for name in "pv" if name in spiky)])
    for finding, when in search.stray(cut(t, repaired, _finite(repaired) & ~wrong, segment)):
        findings.append(finding)
        spike = spiky.get("w" if finding.name == "rate_outlier" else "f", np.zeros(len(t), bool))
        mark(finding.name, _stray_rows(t, when, spike))
    findings += [finding for finding in spikes if finding.name not in {other.name for other in findings}]
    commands, impossible = check_commands(kept, vehicle)
    if (unit := rotors.check_rotor_unit(kept, vehicle)) and any("rotor_speed" in command.where for command in commands):
        commands = [command for command in commands if "rotor_speed" not in command.where]  # its symptom
        impossible[:] = False
    commands += unit
    mark("impossible_command", impossible)
    findings += commands + check_voltage(kept, vehicle)
    if t[-1] - t[0] < SHORT:
        findings.append(Finding("short", "warning", "all samples", f"{t[-1] - t[0]:.2f} s", f"{SHORT:g} s"))
    if any(finding.name in BROKEN for finding in findings):
        findings = [finding for finding in findings if finding.name != "inconsistent"]
    motion = None if vehicle is None or "w" not in repaired else rotors.motion_of(kept, vehicle, repaired["w"], bad)
    return worst_first(findings), bad_rows, motion


def _check_ground(flight: Flight, streams: Mapping[str, np.ndarray], t: np.ndarray) -> list[Finding]:
    """Rest on the ground, of which a fit would learn the push of the ground."""
    commands = {kind: flight.stack(names) for kind, names in rotors.command_columns(flight).items()}
    rest = at_rest(t, streams, thrust_of(commands))
    if not commands and "p" in streams:  # an ideal hover is still too, but not below the flight
        height = streams["p"][:, 2]
        rest &= height < np.nanquantile(height, 0.95) - CLEARANCE
    if rest.mean() <= GROUND:
        return []
    text = f"at rest with motors off, or still, in {rest.mean():.1%} of the samples"
    severity = "blocking" if commands and rest.mean() > GROUND_BLOCKS else "warning"
    advice = "`import` without --no-crop and with `crop: auto` leaves ground phases out"
    return [of_rows("ground_phase", severity, "", longest(rest), t, text, f"{GROUND:.0%}", advice)]


def _stray_rows(t: np.ndarray, when: np.ndarray, spikes: np.ndarray) -> np.ndarray:
    """Samples, (k,), in the stretches when (n, 2) (s) that hold no spike, (k,): else the spike alone is bad."""
    first, stop = np.searchsorted(t, when[:, 0]), np.searchsorted(t, when[:, 1], side="right")
    count = np.concatenate([[0], np.cumsum(spikes)])
    without = count[stop] == count[first]
    edges = np.zeros(len(t) + 1, int)
    np.add.at(edges, first[without], 1)
    np.add.at(edges, stop[without], -1)
    return np.cumsum(edges)[:-1] > 0


def _finite(streams: Mapping[str, np.ndarray]) -> np.ndarray:
    """Samples at which every stream has numbers, (k,)."""
    return np.logical_and.reduce([finite_rows(values) for values in streams.values()])


def _spiky(streams: Mapping[str, np.ndarray], length: int) -> np.ndarray:
    """Mask (k,) of samples far from the stream's median, whatever its unit."""
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
) -> tuple[dict[str, np.ndarray], list[Finding], LateStreams | None]:
    """The streams after the corrections that were found, the findings, and streams that are late where a turn would
    explain the flight no better."""
    if len(cut(t, {}, ~bad, segment).t) < search.LEAST_WINDOWS:
        return streams, [], None
    shifted = dict(streams)
    if {"q", "w"} <= streams.keys() and (~bad).sum() >= 50:
        turning = turning_offset(*(Stream(t[~bad], streams[name][~bad]) for name in "qw"))
        if turning is not None and turning.certain and turning.correlation > 0.7 and abs(turning.seconds) > ALLOWED:
            shifted |= _moved(t, streams, dict.fromkeys("wf", turning.seconds))
    taken, findings = search.explain(cut(t, shifted, ~bad, segment))
    again = _repaired(t, streams, taken)
    offsets = _offsets(again, t, ~bad)
    late = any(offset.certain and _late(offset, t) > ALLOWED for offset in offsets.values())
    if late and not any(candidate.fault == "clock_scale" for candidate in taken):
        on_one_clock = aligned({KEYS[name]: Stream(t, values) for name, values in streams.items()}, offsets)
        moves = {name: t - on_one_clock[KEYS[name]].t for name in streams}
        shifted = dict(streams) | _moved(t, streams, {name: by for name, by in moves.items() if by.any()})
        taken, findings = search.explain(cut(t, shifted, ~bad, segment))
        again = _repaired(t, streams, taken)
    late_streams = _late_instead(t, shifted, taken, ~bad, segment)
    if late_streams is None:
        return again, findings, None
    moved = shifted | _moved(t, shifted, late_streams.moves)
    taken, findings = search.explain(cut(t, moved, ~bad, segment))
    return _repaired(t, streams, taken), findings, late_streams


def _late_instead(
    t: np.ndarray, streams: dict[str, np.ndarray], taken: list[Candidate], good: np.ndarray, segment: np.ndarray | None
) -> LateStreams | None:
    """Streams that are late, where that explains the flight as well as the turns and factors that were taken.

    On a circle at a constant speed a delay tau turns what is measured by omega tau about the vertical.
    """
    doubtful = [candidate for candidate in taken if candidate.fault in TURNS]
    if not doubtful:
        return None
    rest = [candidate for candidate in taken if candidate.fault not in TURNS]
    plain = _repaired(t, streams, rest)
    before = _evidence(t, plain, good, segment)
    offsets = _offsets(plain, t, good)
    explained = _evidence(t, _repaired(t, streams, taken), good, segment)
    explained -= search.PER_COST * sum(candidate.cost for candidate in doubtful)
    best, most = None, before + search.MARGIN
    for moves in _possible_moves(offsets):
        after = _evidence(t, plain | _moved(t, plain, moves), good, segment) - search.PER_COST * len(moves)
        if after > most:
            best, most = moves, after
    if best is None:
        return None
    moved = plain | _moved(t, plain, best)
    besides, _ = search.explain(cut(t, moved, good & _finite(moved), segment))
    with_others = _evidence(t, _repaired(t, moved, besides), good, segment)
    with_others -= search.PER_COST * (len(best) + sum(candidate.cost for candidate in besides))
    if with_others < explained - search.MARGIN:
        return None
    return LateStreams(best, [] if with_others > explained + search.MARGIN else doubtful)


def _possible_moves(offsets: Mapping[tuple[str, str], Offset]) -> list[dict[str, float]]:
    """Streams by letter and by how much each may be late (s)."""
    known = {}
    for (name, _), offset in offsets.items():
        if offset.correlation > LEAST_CORRELATION and LEAST_LATE < abs(offset.seconds) < MOST_LATE:
            known[name] = offset.seconds
    moves = []
    if "rate" in known:
        rate = known["rate"]
        moves += [{"w": rate}, {"q": -rate}, {"w": rate, "f": known.get("acceleration", rate)}]
    if "acceleration" in known:
        force = known["acceleration"]
        moves += [{"f": force}, {"p": -force, "v": -force}]
    return moves


def _evidence(t: np.ndarray, streams: dict[str, np.ndarray], good: np.ndarray, segment: np.ndarray | None) -> float:
    """How well the streams agree (log units)."""
    return search.evidence(search.agreements(cut(t, streams, good & _finite(streams), segment)))


def _moved(t: np.ndarray, streams: dict[str, np.ndarray], late: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Streams by letter that come `late` (s, a number or (k,)), at the times that they are of."""
    moved = {}
    for name in late.keys() & streams.keys():
        values = continuous(np.nan_to_num(streams[name])) if name == "q" else np.nan_to_num(streams[name])
        moved[name] = np.stack([np.interp(t + late[name], t, column) for column in values.T], axis=-1)
    return moved


def _offsets(streams: Mapping[str, np.ndarray], t: np.ndarray, good: np.ndarray) -> dict[tuple[str, str], Offset]:
    good = good & _finite(streams)
    return find_offsets({KEYS[name]: Stream(t[good], values[good]) for name, values in streams.items()})


def _late(offset: Offset, t: np.ndarray) -> float:
    """The largest that an offset becomes in a flight (s)."""
    return max(abs(float(x)) for x in offset.at(t[[0, -1]])) if offset.drift else abs(offset.seconds)


def _repaired(t: np.ndarray, streams: dict[str, np.ndarray], taken: list[Candidate]) -> dict[str, np.ndarray]:
    """The streams with all corrections made; attitudes that are none stay as they are."""
    if not taken:
        return streams
    q = streams.get("q", np.ones((len(t), 4)))
    none = ~(np.linalg.norm(q, axis=1, keepdims=True) > 1e-6)
    usable = streams | ({"q": np.where(none, [1.0, 0.0, 0.0, 0.0], q)} if "q" in streams else {})
    windows = Windows(t[None], {name: values[None] for name, values in usable.items()})
    for candidate in taken:
        windows = candidate.apply(windows)
    mended = {name: values[0] for name, values in windows.streams.items()}
    return mended | ({"q": np.where(none, q, mended["q"])} if "q" in mended else {})


def _check_offset(streams: Mapping[str, np.ndarray], t: np.ndarray, good: np.ndarray) -> list[Finding]:
    """Streams that are late or early, or drift apart, beyond what clean logs do; gyro and accelerometer that are so by
    as much are one finding. good: samples to be used, (k,)."""
    offsets: dict[str, tuple[Finding, Offset]] = {}
    for (name, behind), offset in _offsets(streams, t, good).items():
        size = _late(offset, t)
        limit = max(ALLOWED, 3 * offset.error)
        if not offset.certain or (size <= limit and not offset.drift):
            continue
        side = "behind" if offset.seconds > 0 else "ahead of"
        text = f"{name} is {abs(offset.seconds) * 1e3:.1f} ms {side} the {behind} {offset.words}"
        severity = "blocking" if size > OFFSET_BLOCKS else "warning"
        where = f"{COLUMNS[LETTERS[name]]} against {COLUMNS[LETTERS[behind]]}"
        kind, advice = "clock_drift" if offset.drift else "time_offset", "`import --align` corrects it"
        finding = Finding(kind, severity, where, text, f"{limit * 1e3:.0f} ms, no drift", advice)
        offsets[name] = finding, offset
    if {"rate", "acceleration"} <= offsets.keys():
        (rate, by), (force, other) = offsets["rate"], offsets.pop("acceleration")
        if rate.name == force.name and abs(by.seconds - other.seconds) < SAME_OFFSET + 3 * (by.error + other.error):
            worse = max(rate.severity, force.severity, key=SEVERITIES.index)
            text = f"{rate.measured}, and {force.measured}"
            where = f"{rate.where}, {force.where}"
            offsets["rate"] = replace(rate, severity=worse, where=where, measured=text), by
        else:
            offsets["acceleration"] = force, other
    return [finding for finding, _ in offsets.values()]
