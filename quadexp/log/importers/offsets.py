"""Time offsets between what moves alike: gyro against the attitude's turning, accelerometer against velocity, motors
against the accelerometer's z axis.

Only estimated and said; moving a stream is asked for (`--align`), for an offset may be a delay of the thing itself
(motors take time to spin up).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.log.check.timing import drag_signals
from quadexp.log.importers.raw import RawLog
from quadexp.log.signal import Offset, Stream, continuous, derivative, estimate_offset, resample
from quadexp.physics.vehicle import GRAVITY

Pair = tuple[Stream, Stream, Stream | None]

REFERENCES = ("attitude", "velocity", "position")  # whose clock the others are moved onto
LARGEST = 0.5  # s
LONGEST = 120.0  # s of the log that are used
FASTEST = 200.0  # Hz
LEAST_ROWS = 50
BAND = 4.0  # Hz: vehicles turn slower, motion capture shakes faster
LEAST_CORRELATION = {"rate": 0.7, "acceleration": 0.9}  # an accelerometer feels more than the motion


def find_offsets(log: RawLog) -> dict[tuple[str, str], Offset]:
    """(stream, behind which) -> offset; those that cannot be estimated are left out."""
    found: dict[tuple[str, str], Offset] = {}
    for pair, make in (
        (("rate", "attitude"), _turning),
        (("acceleration", "velocity"), _force),
        (("acceleration", "position"), _force),
        (("acceleration", "motor_command"), _thrust),
        (("acceleration", "rotor_speed"), _thrust),
    ):
        if pair == ("acceleration", "position") and ("acceleration", "velocity") in found:
            continue
        if not set(pair) <= log.streams.keys() or min(len(log.streams[name].t) for name in pair) < LEAST_ROWS:
            continue
        try:
            first, second, beside = make(log, pair[1])
            one = estimate_offset(first, second, largest=LARGEST, band=BAND, beside=beside)
            known = make is not _thrust or beside is not None  # else drag may pass for a delay
            found[pair] = one._replace(
                certain=bool(one.certain and known and one.correlation > LEAST_CORRELATION[pair[0]])
            )
        except (DataError, ValueError, np.linalg.LinAlgError):
            continue
    return found


def _part(stream: Stream) -> Stream:
    """The middle of a stream, at most `LONGEST` seconds of it."""
    t, values = stream
    spare = max(0.0, (t[-1] - t[0] - LONGEST) / 2)
    low, high = np.searchsorted(t, [t[0] + spare, t[-1] - spare + 1e-9])
    return Stream(t[low:high], values[low:high])


def _uniform(streams: dict[str, Stream]) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray, float]:
    streams = {name: _part(s) for name, s in streams.items()}
    rate = min([FASTEST, *(1 / float(np.median(np.diff(t))) for t, _ in streams.values())])
    made = resample(streams, rate, quaternions=("attitude",))
    return made.t, made.values, made.segment, rate


def _turning(log: RawLog, _source: str) -> Pair:
    """Body rate from the attitude's derivative, and the gyro."""
    t, values, segment, _ = _uniform({"attitude": log.streams["attitude"]})
    q = continuous(values["attitude"])
    dq = derivative(t, q, window=0.1, segment=segment).values
    return Stream(t, _vector(q, dq)), _part(log.streams["rate"]), None


def _vector(q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """2 (conj(q) o dq), its vector part, (k, 3): the body rate (rad/s)."""
    w, x, y, z = q.T
    dw, dx, dy, dz = dq.T
    return 2 * np.stack(
        [w * dx - x * dw - y * dz + z * dy, w * dy - y * dw - z * dx + x * dz, w * dz - z * dw - x * dy + y * dx], 1
    )


def _force(log: RawLog, source: str) -> Pair:
    """Size of the specific force from velocity or position, and of the accelerometer's.

    Sizes do not depend on the attitude, whose own delay would turn gravity into a force along x and y.
    """
    t, values, segment, _ = _uniform({source: log.streams[source]})
    velocity = values[source]
    if source == "position":
        velocity = derivative(t, velocity, window=0.1, segment=segment).values
    motion = derivative(t, velocity, window=0.1, segment=segment).values + np.array([0.0, 0.0, GRAVITY])
    force = _part(log.streams["acceleration"])
    return Stream(t, _size(motion)), Stream(force.t, _size(force.values)), None


def _size(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=1, keepdims=True)


def _thrust(log: RawLog, source: str) -> Pair:
    """Sum of the motors' squares, the accelerometer's z axis, and what drag makes of the motion."""
    motors, force = _part(log.streams[source]), _part(log.streams["acceleration"])
    beside = None
    if {"attitude", "velocity"} <= log.streams.keys():
        t, values, _, _ = _uniform({name: log.streams[name] for name in ("attitude", "velocity")})
        R = Rotation.from_quat(values["attitude"], scalar_first=True)
        beside = Stream(t, drag_signals(R.apply(values["velocity"], inverse=True)))
    thrust = np.sum(motors.values**2, axis=1, keepdims=True)
    return Stream(motors.t, thrust), Stream(force.t, force.values[:, 2:]), beside


def align_streams(log: RawLog, found: dict[tuple[str, str], Offset]) -> None:
    """Move gyro and accelerometer onto the clock of attitude and velocity, by the offsets that are certain."""
    for (name, behind), offset in found.items():
        if offset.certain and behind in REFERENCES:
            stream = log.streams[name]
            log.streams[name] = Stream(stream.t - offset.seconds, stream.values)
