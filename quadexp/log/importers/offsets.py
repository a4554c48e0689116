"""Time offsets between what moves alike: gyro against the attitude's turning, accelerometer against velocity, motors
against the accelerometer's z axis.

They are estimated and reported only; moving a stream is asked for (`--align`), for an offset may be a delay of the
thing itself (motors take time to spin up).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.log.check.timing import drag_signals, neighbours, turning
from quadexp.log.importers.raw import RawLog
from quadexp.log.signal import Offset, Stream, estimate_offset, resample
from quadexp.physics.vehicle import GRAVITY

REFERENCES = ("attitude", "velocity", "position")  # whose clock the others are moved onto
# Which stream is compared with which other one; the position where there is no velocity.
PAIRS = (("rate", "attitude"), ("acceleration", "velocity"), ("acceleration", "position"),
         ("acceleration", "motor_command"), ("acceleration", "rotor_speed"))  # fmt: skip
LARGEST = 0.5  # s
LONGEST = 120.0  # s of the log that are used
FASTEST = 200.0  # Hz
LEAST_SAMPLES = 50
BAND = 4.0  # Hz: vehicles turn slower, motion capture shakes faster
LEAST_CORRELATION = {"rate": 0.7, "acceleration": 0.9}  # an accelerometer feels more than the motion


def find_offsets(log: RawLog) -> dict[tuple[str, str], Offset]:
    """(stream, behind which) -> offset; those that cannot be estimated are left out."""
    streams = {name: _part(stream) for name, stream in log.streams.items() if len(stream.t) >= LEAST_SAMPLES}
    found: dict[tuple[str, str], Offset] = {}
    for pair in PAIRS:
        if (pair[1] == "position" and ("acceleration", "velocity") in found) or not set(pair) <= streams.keys():
            continue
        try:
            first, second, beside = _compared(*pair, streams)
            one = estimate_offset(first, second, largest=LARGEST, band=BAND, beside=beside)
        except (DataError, ValueError, np.linalg.LinAlgError):
            continue
        known = pair[1] in REFERENCES or beside is not None  # else drag may pass for a delay
        certain = one.certain and known and one.correlation > LEAST_CORRELATION[pair[0]]
        found[pair] = one._replace(certain=bool(certain))
    return found


def _part(stream: Stream) -> Stream:
    """The middle of a stream, at most `LONGEST` seconds of it."""
    t, values = stream
    spare = max(0.0, (t[-1] - t[0] - LONGEST) / 2)
    low, high = np.searchsorted(t, [t[0] + spare, t[-1] - spare + 1e-9])
    return Stream(t[low:high], values[low:high])


def _compared(name: str, source: str, streams: dict[str, Stream]) -> tuple[Stream, Stream, Stream | None]:
    """What a stream shall follow, what is compared with it, and what that follows besides."""
    late, early = streams[name], streams[source]
    if name == "rate":
        return turning(*early), late, None
    if source in REFERENCES:
        # Sizes do not depend on the attitude, whose own delay would turn gravity into a force along x and y.
        motion = neighbours(*early) if source == "velocity" else neighbours(*neighbours(*early))
        return _size(Stream(motion.t, motion.values + [0.0, 0.0, GRAVITY])), _size(late), None
    beside = None
    if {"attitude", "velocity"} <= streams.keys():
        both = {key: streams[key] for key in ("attitude", "velocity")}
        rate = min([FASTEST, *(1 / float(np.median(np.diff(one.t))) for one in both.values())])
        made = resample(both, rate, quaternions=("attitude",))
        R = Rotation.from_quat(made.values["attitude"], scalar_first=True)
        beside = Stream(made.t, drag_signals(R.apply(made.values["velocity"], inverse=True)))
    thrust = Stream(early.t, np.sum(early.values**2, axis=1, keepdims=True))
    return thrust, Stream(late.t, late.values[:, 2:]), beside


def _size(stream: Stream) -> Stream:
    return Stream(stream.t, np.linalg.norm(stream.values, axis=1, keepdims=True))


def align_streams(log: RawLog, found: dict[tuple[str, str], Offset]) -> None:
    """Move gyro and accelerometer onto the clock of attitude and velocity, by the offsets that are certain."""
    for (name, behind), offset in found.items():
        if offset.certain and behind in REFERENCES:
            stream = log.streams[name]
            log.streams[name] = Stream(stream.t - offset.seconds, stream.values)
