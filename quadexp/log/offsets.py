"""Time offsets between what moves alike: gyro against the attitude's turning, accelerometer against velocity, motors
against the accelerometer's z axis.

They are estimated and reported only; moving a stream is asked for (`--align`), for an offset may be a delay of the
thing itself (motors take time to spin up).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.log.finding import Finding
from quadexp.log.hypotheses.windows import attitude_rate
from quadexp.log.signal import Offset, Stream, estimate_offset, resample
from quadexp.physics.vehicle import GRAVITY

REFERENCES = ("attitude", "velocity", "position")  # whose clock the others are moved onto
# Which stream is compared with which other one; the position where there is no velocity.
PAIRS = (("rate", "attitude"), ("acceleration", "velocity"), ("acceleration", "position"),
         *(("acceleration", rotors) for rotors in ("motor_command", "rotor_thrust", "rotor_speed")))  # fmt: skip
LARGEST = 0.5  # s
FASTEST = 200.0  # Hz
LEAST_SAMPLES = 50
BAND = 4.0  # Hz: vehicles turn slower, motion capture shakes faster
LEAST_CORRELATION = {"rate": 0.7, "acceleration": 0.9}  # an accelerometer feels more than the motion
PARTS, PART = 6, 20.0  # how many stretches of a long flight are looked at, and how long (s)
ALLOWED = 0.025  # s: a quarter of the time in which a racing quadrotor turns by a radian, and clean logs' 0.02 s
BLOCKS = 0.1  # s
MOTOR_LAG = (-0.03, 0.15)  # s: motors follow their command by up to this


def find_offsets(
    streams: Mapping[str, Stream], pairs: Sequence[tuple[str, str]] = PAIRS
) -> dict[tuple[str, str], Offset]:
    """(stream, behind which) -> offset; those that cannot be estimated are left out."""
    parts = {name: spread(stream) for name, stream in streams.items() if len(stream.t) >= LEAST_SAMPLES}
    found: dict[tuple[str, str], Offset] = {}
    for pair in pairs:
        if (pair[1] == "position" and ("acceleration", "velocity") in found) or not set(pair) <= parts.keys():
            continue
        try:
            first, second, beside = _compared(*pair, parts)
            one = estimate_offset(first, second, largest=LARGEST, band=BAND, beside=beside)
        except (DataError, ValueError, np.linalg.LinAlgError):
            continue
        known = pair[1] in REFERENCES or beside is not None  # else drag may pass for a delay
        certain = one.certain and known and one.correlation > LEAST_CORRELATION[pair[0]]
        found[pair] = one._replace(certain=bool(certain))
    return found


def spread(stream: Stream) -> Stream:
    """All of a short stream, stretches spread over a long one."""
    t, values = stream
    length = float(t[-1] - t[0])
    if length <= PARTS * PART:
        return stream
    kept = ((t - t[0]) / length * PARTS) % 1.0 * length / PARTS < PART
    return Stream(t[kept], values[kept])


def turning(attitude: Stream) -> Stream:
    """Body rate (rad/s) of an attitude (k, 4), between samples without a gap."""
    return _between(attitude.t, attitude_rate(*attitude))


def turning_offset(attitude: Stream, rate: Stream) -> Offset | None:
    """Offset of body rates behind an attitude by their sizes, which need no common frame."""
    try:
        return estimate_offset(_size(turning(spread(attitude))), _size(spread(rate)), largest=LARGEST, band=BAND)
    except DataError:
        return None


def _compared(name: str, source: str, streams: Mapping[str, Stream]) -> tuple[Stream, Stream, Stream | None]:
    """What a stream shall follow, what is compared with it, and what that follows besides."""
    late, early = streams[name], streams[source]
    if name == "rate":
        return turning(early), late, None
    if source in REFERENCES:
        # Sizes do not depend on the attitude, whose own delay would turn gravity into a force along x and y.
        motion = _slopes(early) if source == "velocity" else _slopes(_slopes(early))
        return _size(Stream(motion.t, motion.values + [0.0, 0.0, GRAVITY])), _size(late), None
    beside = None
    if {"attitude", "velocity"} <= streams.keys():  # a rotor's thrust follows the inflow along its axis and across it
        both = {key: streams[key] for key in ("attitude", "velocity")}
        rate = min([FASTEST, *(1 / float(np.median(np.diff(one.t))) for one in both.values())])
        made = resample(both, rate, quaternions=("attitude",))
        R = Rotation.from_quat(made.values["attitude"], scalar_first=True)
        v = R.apply(made.values["velocity"], inverse=True)
        beside = Stream(made.t, np.column_stack([v[:, 2], np.sum(v[:, :2] ** 2, axis=1)]))
    thrust = np.sum(early.values ** (1 if source == "rotor_thrust" else 2), axis=1, keepdims=True)
    return Stream(early.t, thrust), Stream(late.t, late.values[:, 2:]), beside


def _slopes(stream: Stream) -> Stream:
    """Rate of change, between samples without a gap."""
    return _between(stream.t, np.diff(stream.values, axis=0) / np.diff(stream.t)[:, None])


def _between(t: np.ndarray, values: np.ndarray) -> Stream:
    near = np.diff(t) < 3.5 * np.median(np.diff(t))
    return Stream(((t[1:] + t[:-1]) / 2)[near], values[near])


def _size(stream: Stream) -> Stream:
    return Stream(stream.t, np.linalg.norm(stream.values, axis=1, keepdims=True))


def align_streams(streams: dict[str, Stream], found: Mapping[tuple[str, str], Offset]) -> None:
    """Move gyro and accelerometer onto the clock of attitude and velocity, by the offsets that are certain."""
    for (name, behind), offset in found.items():
        if offset.certain and behind in REFERENCES:
            streams[name] = Stream(streams[name].t - offset.seconds, streams[name].values)


def offset_findings(found: Mapping[tuple[str, str], Offset]) -> list[Finding]:
    """A gyro that is late or early beyond what clean logs are, and a thrust that no motor's lag explains."""
    findings = []
    for (name, behind), one in found.items():
        if not one.certain or (name == "acceleration" and behind in REFERENCES):
            continue
        error = f"standard error {one.error * 1e3:.1f}"
        if name == "rate" and abs(one.seconds) > (limit := max(ALLOWED, 3 * one.error)):
            side = "behind" if one.seconds > 0 else "ahead of"
            text = f"rates are {abs(one.seconds) * 1e3:.1f} ms ({error}) {side} the attitude"
            text += f", correlation {one.correlation:.2f}"
            severity, where = "blocking" if abs(one.seconds) > BLOCKS else "warning", "w_*, acc_* against q_*, p_*"
            advice = "`import --align` corrects it"
            findings.append(Finding("time_offset", severity, where, text, f"{limit * 1e3:.0f} ms", advice))
        low, high = MOTOR_LAG[0] - 3 * one.error, MOTOR_LAG[1] + 3 * one.error
        if name == "acceleration" and not low <= one.seconds <= high:
            text = f"thrust follows its command by {one.seconds * 1e3:.1f} ms ({error})"
            allowed = f"{low * 1e3:.0f}..{high * 1e3:.0f} ms"
            findings.append(Finding("time_offset", "warning", "commands against acc_z", text, allowed))
    return findings
