"""Quality check of a recorded flight: faults by name, with their place, their size and what is allowed.

The order matters. Bad samples are found first and left out of what follows. Then units, frames, signs and the clock are
tested against the motion. Then, with the faults found so far corrected, come offsets, spikes and commands: a log in
degrees is reported as such, not as one that spins too fast.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from quadexp.log.runs import longest
from quadexp.log.schema import Flight, describe
from quadexp.physics.state import finite_rows
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.check import rotors, samples, signals
from quadexp.plugins.check.agreement import stray
from quadexp.plugins.check.candidates import KEYS
from quadexp.plugins.check.delay import consistency
from quadexp.plugins.check.duplicates import check_duplicates
from quadexp.plugins.check.recording import Recording, finite
from quadexp.plugins.logs.finding import Finding, of_rows, worst_first
from quadexp.plugins.logs.signal import increasing
from quadexp.plugins.logs.signal.rest import at_rest, thrust_of
from quadexp.plugins.logs.signal.windows import streams_of

SHORT = 2.0  # s
MOST_ROWS = 50_000  # that a median is taken over
FAR = 12.0  # times the spread of four fifths of the samples: beyond, a sample is left out of the consistency check
THRUST_MARGIN = 2.0  # times the largest thrust: knocks and vibration besides
HARD_LIMIT = 320.0  # m/s^2: a 32 g accelerometer
CLEARANCE = 0.5  # m that a flight is above where it rests
GROUND = 0.02  # share of the samples at rest
GROUND_BLOCKS = 0.05  # share from which on nothing is fitted
CLOCK = ("clock_repeated", "clock_jump")
# Faults of samples, of which the finding `inconsistent` is a symptom.
BROKEN = {"acceleration_outlier", "rate_outlier", "position_outlier", "velocity_outlier", "frozen_sensor",
          "dead_logger"}  # fmt: skip

Masks = dict[str, np.ndarray]  # bad samples, (k,), by the name of the finding


def check_flight(flight: Flight, vehicle: Vehicle | None = None) -> list[Finding]:
    """Everything that is wrong with one flight, worst first.

    vehicle: whose limits the commands must keep; None: unknown. Raises DataError where there is no column t.
    """
    return check_flights({"": flight}, vehicle)[""]


def check_flights(
    flights: Mapping[str, Flight], vehicles: Mapping[str, Vehicle | None] | Vehicle | None = None
) -> dict[str, list[Finding]]:
    """Findings of every flight by its name, those about several flights (duplicates, rotors) among them."""
    by_name = check_duplicates(flights) if len(flights) > 1 else {}
    unsure: dict[tuple[Vehicle, str], dict[str, rotors.Motion]] = {}
    for name, flight in flights.items():
        vehicle = vehicles.get(name) if isinstance(vehicles, Mapping) else vehicles
        findings, _, motion = inspect_flight(flight, vehicle)
        by_name[name] = by_name.get(name, []) + findings
        if vehicle is not None and motion is not None:
            verdict = rotors.judge([motion], vehicle)
            kind = signals.signal_kind(flight)
            by_name[name] += rotors.rotor_findings(verdict, kind, vehicle)
            if verdict is None or not (verdict.sure and verdict.spin):
                unsure.setdefault((vehicle, kind), {})[name] = motion
    for (vehicle, kind), motions in unsure.items():  # flights too short by themselves may tell it together
        if len(motions) > 1:
            together = rotors.rotor_findings(rotors.judge([*motions.values()], vehicle), kind, vehicle)
            for name in motions:
                by_name[name] += _without(together, {finding.name for finding in by_name[name]})
    return {name: worst_first(by_name[name]) for name in flights}


def inspect_flight(flight: Flight, vehicle: Vehicle | None) -> tuple[list[Finding], Masks, rotors.Motion | None]:
    """The findings, but for those of the rotors; the bad samples, (k,) masks by the name of the finding; and what the
    flight tells about its rotors. Arguments as check_flight."""
    if len(flight) < 3:
        few = Finding("no_flight", "blocking", "all samples", f"{len(flight)} samples", f"{SHORT:g} s of flight")
        return [few], {}, None
    findings, first, usable = _check_rows(flight)
    masks = {} if first.all() else {"duplicated_rows": ~first}
    kept = flight
    if not usable.all():  # a long flight is not copied without need
        kept = Flight({name: values[usable] for name, values in flight.columns.items()}, flight.metadata)
    motion = None
    if len(kept) >= 3 and np.isfinite(kept.t).all():
        more, bad, motion = _check_motion(kept, vehicle)
        findings += more
        for name, mask in bad.items():
            if mask.any():
                masks.setdefault(name, np.zeros(len(flight), bool))[np.flatnonzero(usable)[mask]] = True
    return worst_first(findings), masks, motion


def _without(findings: list[Finding], names: Collection[str]) -> list[Finding]:
    return [finding for finding in findings if finding.name not in names]


def _streams(flight: Flight) -> dict[str, np.ndarray]:
    return {name: x for name, x in streams_of(flight).items() if finite_rows(x).any()}


def _check_rows(flight: Flight) -> tuple[list[Finding], np.ndarray, np.ndarray]:
    """Findings about clock, numbers and repeated samples; the samples that repeat no earlier one, (k,), and those of
    them whose clock goes on."""
    t = np.asarray(flight.t, float)
    streams = _streams(flight)
    clock = samples.check_clock(t, streams, flight.columns.get("segment"))
    repeated, first = samples.check_repeats(flight.columns, t)
    if repeated:  # the clock's complaints about those samples are its symptom
        jumps = [finding for finding in samples.check_clock(t[first]) if finding.name == "clock_jump"]
        clock = _without(clock, CLOCK) + jumps
    # A column that no schema has is a controller's own, with NaN where it knows nothing.
    known = {name: values for name, values in flight.columns.items() if describe(name).description}
    findings = clock + samples.check_finite(known, t) + repeated
    if "q" in streams:
        findings += samples.check_quaternion(streams["q"], t)
    usable = first
    if any(finding.blocks for finding in clock if finding.name in CLOCK):
        usable = first & increasing(t)
    return findings, first, usable


def _check_motion(flight: Flight, vehicle: Vehicle | None) -> tuple[list[Finding], Masks, rotors.Motion | None]:
    """As inspect_flight, of a flight whose clock goes on."""
    t = np.asarray(flight.t, float)
    streams = _streams(flight)
    segment = flight.columns.get("segment")
    findings = signals.check_flown(flight, streams, vehicle)
    if any(finding.blocks for finding in findings):
        return findings, {}, None
    findings += _check_ground(flight, streams, t)
    dead, lost = samples.check_dead(streams, t)
    frozen, stuck = samples.check_frozen(streams, t)
    findings += dead
    if not dead or not stuck.any() or (stuck & ~lost).any():
        findings += frozen
    bad = _far(streams, len(t)) | lost | stuck
    mended, consistent = consistency(Recording(t, streams, ~bad, segment))
    findings += consistent
    spikes, spiky = samples.check_spikes(mended.streams, t, {"f": _hardest(vehicle)})
    masks = {}
    unsound = lost
    for name, mask in spiky.items():
        masks[f"{KEYS[name]}_outlier"] = mask
        if name in "pv":
            unsound = unsound | mask
    sound = replace(mended, good=~unsound)
    for finding, when in stray(sound.windows()):
        findings.append(finding)
        known = masks.get(finding.name, np.zeros(len(t), bool))
        masks[finding.name] = known | _stray_rows(t, when, known)
    findings += _without(spikes, {finding.name for finding in findings})
    commands, impossible = signals.check_signals(flight, vehicle)
    findings += commands
    if t[-1] - t[0] < SHORT:
        findings.append(Finding("short", "warning", "all samples", f"{t[-1] - t[0]:.2f} s", f"{SHORT:g} s"))
    if not BROKEN.isdisjoint(finding.name for finding in findings):
        findings = _without(findings, ["inconsistent"])
    masks |= {"dead_logger": lost, "frozen_sensor": stuck, "impossible_command": impossible}
    motion = None
    if vehicle is not None and "w" in mended.streams:
        motion = rotors.motion_of(flight, vehicle, mended.streams["w"], ~(~bad & finite(streams)))
    return findings, masks, motion


def _hardest(vehicle: Vehicle | None) -> float:
    """The largest specific force of a flight (m/s^2)."""
    if vehicle is None:
        return HARD_LIMIT
    thrust = vehicle.n_rotors * vehicle.thrust_max / vehicle.mass
    return min(HARD_LIMIT, THRUST_MARGIN * thrust + 2 * vehicle.gravity)


def _check_ground(flight: Flight, streams: Mapping[str, np.ndarray], t: np.ndarray) -> list[Finding]:
    """Rest on the ground, of which a fit would learn the push of the ground."""
    commands = {kind: flight.stack(names) for kind, names in signals.command_columns(flight).items()}
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
    stray = np.zeros(len(t), bool)
    for start, end in when:
        rows = slice(np.searchsorted(t, start), np.searchsorted(t, end, side="right"))
        if not spikes[rows].any():
            stray[rows] = True
    return stray


def _far(streams: Mapping[str, np.ndarray], rows: int) -> np.ndarray:
    """Mask (rows,) of samples far from the stream's median, whatever its unit; none where that would be most."""
    far = np.zeros(rows, bool)
    for name, values in streams.items():
        if name != "q":
            some = values[:: max(1, rows // MOST_ROWS)]
            middle = np.nanmedian(some, axis=0)
            spread = np.nanquantile(np.abs(some - middle), 0.8, axis=0)
            far |= (np.abs(values - middle) > FAR * np.nanmax(spread)).any(axis=1)
    if far.mean() >= 0.5:
        far[:] = False
    return far
