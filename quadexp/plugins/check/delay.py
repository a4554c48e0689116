"""Streams that come late: what explains the flight once they are moved, and whether a delay does in place of a turn.

On a circle at a constant speed a delay tau turns what is measured by omega tau about the vertical.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from quadexp.plugins.check.agreement import LEAST_WINDOWS
from quadexp.plugins.check.candidates import COLUMNS, KEYS, LETTERS, Candidate
from quadexp.plugins.check.recording import Offsets, Recording
from quadexp.plugins.check.search import MARGIN, PER_COST, explain
from quadexp.plugins.logs.finding import SEVERITIES, Finding
from quadexp.plugins.logs.signal import Stream
from quadexp.plugins.logs.signal.offset import Offset, turning_offset

ALLOWED = 0.025  # s: a quarter of the time in which a racing quadrotor turns by a radian, and clean logs' 0.02 s
OFFSET_BLOCKS = 0.1  # s
SAME_OFFSET = 0.005  # s: gyro and accelerometer of one board
TURNS = {"mounting", "heading", "scale", "bias"}  # what a delay may look like
LEAST_LATE = 0.008  # s: that is looked for in place of a turn
MOST_LATE = 0.3  # s
LEAST_CORRELATION = 0.7  # half of the variance is common
LEAST_SAMPLES = 50  # of fewer a correlation may be chance

Moves = Mapping[str, float]  # by how much streams are late (s), by letter


def consistency(recording: Recording) -> tuple[Recording, list[Finding]]:
    """The streams after the corrections that were found, and the findings; streams that are late where a turn would
    explain the flight no better."""
    if len(recording.windows().t) < LEAST_WINDOWS:
        return recording, offset_findings(recording)
    shifted = recording.moved(_late_gyro(recording))
    taken, findings = explain(shifted.windows())
    repaired = recording.repaired(taken)
    offsets = repaired.offsets()
    late = any(offset.certain and _size(offset, recording.t) > ALLOWED for offset in offsets.values())
    if late and not any(candidate.fault == "clock_scale" for candidate in taken):
        shifted = recording.aligned(offsets)
        taken, findings = explain(shifted.windows())
        repaired = recording.repaired(taken)
    moves, rivals = _late_instead(shifted, taken)
    if not moves:
        return repaired, findings + offset_findings(repaired)
    taken, findings = explain(shifted.moved(moves).windows())
    repaired = recording.repaired(taken)
    offsets_named = offset_findings(repaired) or [_late_finding(moves)]
    return repaired, findings + [_with_rivals(finding, rivals) for finding in offsets_named]


def _late_gyro(recording: Recording) -> dict[str, float]:
    """How late gyro and accelerometer are by how fast the vehicle turns, in whatever frame; nothing where unsure."""
    usable = recording.usable
    if not {"q", "w"} <= recording.streams.keys() or usable.sum() < LEAST_SAMPLES:
        return {}
    q, w = (Stream(recording.t[usable], recording.streams[name][usable]) for name in "qw")
    turning = turning_offset(q, w)
    if turning is None or not turning.certain or turning.correlation < LEAST_CORRELATION:
        return {}
    if abs(turning.seconds) <= ALLOWED:
        return {}
    return dict.fromkeys("wf", turning.seconds)


def _late_instead(recording: Recording, taken: list[Candidate]) -> tuple[Moves, list[Candidate]]:
    """Streams that are late, where that explains the flight as well as the turns and factors that were taken, none
    where not; and those of them that explain it as well."""
    doubtful = [candidate for candidate in taken if candidate.fault in TURNS]
    if not doubtful:
        return {}, []
    plain = recording.repaired([candidate for candidate in taken if candidate.fault not in TURNS])
    moves: Moves = {}
    most = plain.evidence() + MARGIN
    for possible in _possible_moves(plain.offsets()):
        explained = plain.moved(possible).evidence() - PER_COST * len(possible)
        if explained > most:
            moves = possible
            most = explained
    if not moves:
        return {}, []
    moved = plain.moved(moves)
    besides, _ = explain(moved.windows())
    late = moved.repaired(besides).evidence() - PER_COST * (len(moves) + _cost(besides))
    turned = recording.repaired(taken).evidence() - PER_COST * _cost(doubtful)
    if late < turned - MARGIN:
        return {}, []
    if late > turned + MARGIN:
        return moves, []
    return moves, doubtful


def _cost(candidates: list[Candidate]) -> float:
    return sum(candidate.cost for candidate in candidates)


def _possible_moves(offsets: Offsets) -> list[Moves]:
    known = {}
    for (name, _), offset in offsets.items():
        if offset.correlation > LEAST_CORRELATION and LEAST_LATE < abs(offset.seconds) < MOST_LATE:
            known[name] = offset.seconds
    moves: list[Moves] = []
    if "rate" in known:
        rate = known["rate"]
        moves += [{"w": rate}, {"q": -rate}, {"w": rate, "f": known.get("acceleration", rate)}]
    if "acceleration" in known:
        force = known["acceleration"]
        moves += [{"f": force}, {"p": -force, "v": -force}]
    return moves


# ------------------------------------------------------------------------------------------------------------- findings
def _size(offset: Offset, t: np.ndarray) -> float:
    """The largest that an offset becomes in a flight (s)."""
    if not offset.drift:
        return abs(offset.seconds)
    ends = offset.at(t[[0, -1]])
    return float(np.abs(ends).max())


def _severity(seconds: float) -> str:
    return "blocking" if seconds > OFFSET_BLOCKS else "warning"


def offset_findings(recording: Recording) -> list[Finding]:
    """Streams that are late or early, or drift apart, beyond what clean logs do; gyro and accelerometer that are so by
    as much are one finding."""
    findings = {}
    known = {}
    for (name, behind), offset in recording.offsets().items():
        size = _size(offset, recording.t)
        limit = max(ALLOWED, 3 * offset.error)
        if not offset.certain or (size <= limit and not offset.drift):
            continue
        side = "behind" if offset.seconds > 0 else "ahead of"
        text = f"{name} is {abs(offset.seconds) * 1e3:.1f} ms {side} the {behind} {offset.words}"
        where = f"{COLUMNS[LETTERS[name]]} against {COLUMNS[LETTERS[behind]]}"
        fault = "clock_drift" if offset.drift else "time_offset"
        allowed = f"{limit * 1e3:.0f} ms, no drift"
        known[name] = offset
        findings[name] = Finding(fault, _severity(size), where, text, allowed, "`import --align` corrects it")
    if {"rate", "acceleration"} <= known.keys():
        gyro = findings["rate"]
        force = findings["acceleration"]
        by = known["rate"]
        other = known["acceleration"]
        near = abs(by.seconds - other.seconds) < SAME_OFFSET + 3 * (by.error + other.error)
        if near and gyro.name == force.name:
            worse = max(gyro.severity, force.severity, key=SEVERITIES.index)
            text = f"{gyro.measured}, and {force.measured}"
            where = f"{gyro.where}, {force.where}"
            findings["rate"] = replace(gyro, severity=worse, where=where, measured=text)
            del findings["acceleration"]
    return list(findings.values())


def _late_finding(moves: Moves) -> Finding:
    """Of streams whose offset the flight itself does not show, as it repeats itself."""
    text = ", ".join(f"{KEYS[name]} is {1e3 * seconds:+.0f} ms late" for name, seconds in moves.items())
    where = ", ".join(COLUMNS[name] for name in moves)
    severity = _severity(max(map(abs, moves.values())))
    advice = "a flight that does not repeat itself tells it, then `import --align` corrects it"
    return Finding("time_offset", severity, where, text, f"{1e3 * ALLOWED:.0f} ms", advice)


def _with_rivals(finding: Finding, rivals: list[Candidate]) -> Finding:
    """rivals: turns that explain the flight as well."""
    if not rivals:
        return finding
    others = " and ".join(f"{rival.where}: {rival.text}" for rival in rivals)
    lines = ", ".join(line for rival in rivals for line in rival.lines)
    advice = f"{finding.advice}; decide between this and {lines}, which the flight does not"
    return replace(finding, measured=f"{finding.measured}; or {others}", advice=advice)
