"""Time offsets between the sensors of a flight.

The IMU against the attitude: body rates are seen by both, whatever frame or unit they are in, so their magnitudes are
correlated first, and the vectors where those agree better. Motors against the accelerometer: the lag of the motors is
part of that offset. Below 2 Hz, where vehicles turn and motion capture does not shake.
"""

from __future__ import annotations

import numpy as np

from quadexp.errors import DataError
from quadexp.flight.check.finding import Finding
from quadexp.flight.check.windows import attitude_rate
from quadexp.flight.signal import Offset, estimate_offset

BAND = 2.0  # Hz
ALLOWED = 0.025  # s: a quarter of the time in which a racing quadrotor turns by a radian, and clean logs' 0.02 s
BLOCKS = 0.1  # s
MOTOR_LAG = (-0.03, 0.15)  # s: motors follow their command by up to this
LARGEST = 0.5  # s


def imu_offset(t: np.ndarray, streams: dict[str, np.ndarray], good: np.ndarray, *, vectors: bool) -> Offset | None:
    """Offset of the body rates behind the attitude; None where it cannot be estimated. good: rows to use, (k,).

    vectors: whether frames and units are known to agree; else magnitudes are compared.
    """
    if "q" not in streams or "w" not in streams:
        return None
    usable = good & np.isfinite(streams["q"]).all(axis=1) & np.isfinite(streams["w"]).all(axis=1)
    own, q, w = t[usable], streams["q"][usable], streams["w"][usable]
    if len(own) < 50 or np.any(np.diff(own) <= 0):
        return None
    rate = attitude_rate(own, q)
    near = np.diff(own) < 3.5 * np.median(np.diff(own))
    middle, rate = ((own[1:] + own[:-1]) / 2)[near], rate[near]
    if not vectors:
        rate, w = np.linalg.norm(rate, axis=1), np.linalg.norm(w, axis=1)
    try:
        return estimate_offset((middle, rate), (own, w), largest=LARGEST, band=BAND)
    except DataError:
        return None


def motor_offset(t: np.ndarray, command: np.ndarray, push: np.ndarray) -> Offset | None:
    """Offset of the specific force along z, (k,), behind the sum of the commands, (k,)."""
    usable = np.isfinite(command) & np.isfinite(push)
    if usable.sum() < 50 or np.any(np.diff(t[usable]) <= 0):
        return None
    try:
        return estimate_offset((t[usable], command[usable]), (t[usable], push[usable]), largest=LARGEST, band=2 * BAND)
    except DataError:
        return None


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
                Finding("time_offset", severity, "w_*, acc_* against q_*, p_*", text, allowed, "import corrects it")
            )
    if motor is not None and motor.certain and motor.correlation > 0.7:
        low, high = MOTOR_LAG[0] - 3 * motor.error, MOTOR_LAG[1] + 3 * motor.error
        text = f"thrust follows its command by {motor.seconds * 1e3:.1f} ms (standard error {motor.error * 1e3:.1f})"
        if not low <= motor.seconds <= high:
            allowed = f"{low * 1e3:.0f}..{high * 1e3:.0f} ms"
            found.append(Finding("time_offset", "warning", "commands against acc_z", text, allowed))
    return found
