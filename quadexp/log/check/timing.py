"""Time offsets between the sensors of a flight.

The IMU against the attitude: both show body rates. Magnitudes, which need no common frame, are correlated first, then
vectors, once frames and units are known to agree. Motors against the accelerometer: the lag of the motors is part of
that offset. Below 2 Hz, where vehicles turn and motion capture does not shake.
"""

from __future__ import annotations

import numpy as np

from quadexp.errors import DataError
from quadexp.log.finding import Finding
from quadexp.log.hypotheses.windows import attitude_rate
from quadexp.log.signal import Offset, Stream, estimate_offset

BAND = 2.0  # Hz
ALLOWED = 0.025  # s: a quarter of the time in which a racing quadrotor turns by a radian, and clean logs' 0.02 s
BLOCKS = 0.1  # s
MOTOR_LAG = (-0.03, 0.15)  # s: motors follow their command by up to this
LARGEST = 0.5  # s
PARTS, PART = 6, 20.0  # how many stretches of a long flight are looked at, and how long (s)


def spread(t: np.ndarray) -> np.ndarray:
    """Mask (k,) of the samples looked at: all of a short flight, stretches spread over a long one."""
    length = float(t[-1] - t[0])
    if length <= PARTS * PART:
        return np.ones(len(t), bool)
    since = (t - t[0]) / length * PARTS
    return (since % 1.0) * length / PARTS < PART


def imu_offset(t: np.ndarray, streams: dict[str, np.ndarray], good: np.ndarray, *, vectors: bool) -> Offset | None:
    """Offset of the body rates behind the attitude; None where it cannot be estimated. good: samples to use, (k,).

    vectors: whether frames and units are known to agree; else magnitudes are compared.
    """
    if "q" not in streams or "w" not in streams:
        return None
    samples = np.flatnonzero(good & spread(t))
    q, w = streams["q"][samples], streams["w"][samples]
    usable = np.isfinite(q).all(axis=1) & np.isfinite(w).all(axis=1)
    own, q, w = t[samples][usable], q[usable], w[usable]
    if len(own) < 50 or np.any(np.diff(own) <= 0):
        return None
    middle, rate = turning(own, q)
    if not vectors:
        rate, w = np.linalg.norm(rate, axis=1), np.linalg.norm(w, axis=1)
    try:
        return estimate_offset((middle, rate), (own, w), largest=LARGEST, band=BAND)
    except DataError:
        return None


def turning(t: np.ndarray, q: np.ndarray) -> Stream:
    """Body rate (rad/s) of an attitude q (k, 4), between samples without a gap."""
    return _between(t, attitude_rate(t, q))


def neighbours(t: np.ndarray, x: np.ndarray) -> Stream:
    """Rate of change of x (k, m), between samples without a gap."""
    return _between(t, np.diff(x, axis=0) / np.diff(t)[:, None])


def _between(t: np.ndarray, values: np.ndarray) -> Stream:
    near = np.diff(t) < 3.5 * np.median(np.diff(t))
    return Stream(((t[1:] + t[:-1]) / 2)[near], values[near])


def motor_offset(
    t: np.ndarray, command: np.ndarray, push: np.ndarray, body_velocity: np.ndarray | None
) -> Offset | None:
    """Offset of the specific force along z, (k,), behind the thrust commanded, (k,), in any unit.

    body_velocity: (k, 3); without it drag cannot be told from a delay, and the offset is not certain.
    """
    usable = np.isfinite(command) & np.isfinite(push)
    if usable.sum() < 50 or np.any(np.diff(t[usable]) <= 0):
        return None
    own = t[usable]
    try:
        beside = None if body_velocity is None else (own, drag_signals(body_velocity[usable]))
        found = estimate_offset(
            (own, command[usable]), (own, push[usable]), largest=LARGEST, band=2 * BAND, beside=beside
        )
        return found._replace(certain=found.certain and beside is not None)
    except DataError:
        return None


def drag_signals(body_velocity: np.ndarray) -> np.ndarray:
    """What a rotor's thrust follows besides its command, (k, 2): inflow along its axis, and across it squared."""
    return np.column_stack([body_velocity[:, 2], np.sum(body_velocity[:, :2] ** 2, axis=1)])


def offset_findings(imu: Offset | None, motor: Offset | None) -> list[Finding]:
    found = []
    if imu is not None and imu.certain and imu.correlation > 0.7:
        limit = max(ALLOWED, 3 * imu.error)
        if abs(imu.seconds) > limit:
            side = "behind" if imu.seconds > 0 else "ahead of"
            severity = "blocking" if abs(imu.seconds) > BLOCKS else "warning"
            text = (
                f"rates are {abs(imu.seconds) * 1e3:.1f} ms (standard error {imu.error * 1e3:.1f}) {side} the attitude,"
                f" correlation {imu.correlation:.2f}"
            )
            allowed = f"{limit * 1e3:.0f} ms"
            found.append(
                Finding(
                    "time_offset",
                    severity,
                    "w_*, acc_* against q_*, p_*",
                    text,
                    allowed,
                    "`import --align` corrects it",
                )
            )
    if motor is not None and motor.certain and motor.correlation > 0.7:
        low, high = MOTOR_LAG[0] - 3 * motor.error, MOTOR_LAG[1] + 3 * motor.error
        text = f"thrust follows its command by {motor.seconds * 1e3:.1f} ms (standard error {motor.error * 1e3:.1f})"
        if not low <= motor.seconds <= high:
            allowed = f"{low * 1e3:.0f}..{high * 1e3:.0f} ms"
            found.append(Finding("time_offset", "warning", "commands against acc_z", text, allowed))
    return found
