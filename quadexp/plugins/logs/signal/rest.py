"""Where a vehicle rests on the ground, at any height and anywhere in a log.

    motors off    sum_i T(s_i) < LOW of its median in flight, and the accelerometer, where there is one, reads g
    still         | |f| - g | < STILL_FORCE, and |v|, |w - mean w| and |f - mean f| as small as on the ground

each over REST_TIME at least. T(s): s^2 of a rotor speed or a command, s of a thrust. Still alone does not do where
motors run: an ideal hover is still as well.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from quadexp.log.runs import period_of, runs
from quadexp.physics.state import norms
from quadexp.physics.vehicle import GRAVITY

REST_TIME = 0.5  # s
LOW = 0.3  # of the thrust in flight: motors off or idle
RUNNING = 0.5  # of the thrust in flight: motors that may carry the vehicle
STILL_FORCE = 0.5  # m/s^2: bias and noise of an accelerometer at rest
STILL_RATE = 0.05  # rad/s, of a gyro
STILL_SPEED = 0.1  # m/s
SHORT_BREAK = 0.3  # s: a knock does not end a rest


def at_rest(
    t: np.ndarray, streams: Mapping[str, np.ndarray], thrust: np.ndarray | None = None, *, motionless: bool = True
) -> np.ndarray:
    """Mask (k,) of the samples at rest.

    t: (k,) s. streams: f, w, v (k, 3) by letter, those that there are. thrust: (k,), any unit that is 0 with motors
    off, or None. motionless: whether stillness counts too, not only motors that are off.
    """
    step = period_of(t)
    width = max(3, round(REST_TIME / step))
    rest = np.zeros(len(t), bool)
    if len(t) < 2 * width:
        return rest
    if motionless and {"f", "w"} <= streams.keys():
        rest = _still(streams, width)
    if thrust is not None:
        level = flying_level(thrust, streams.get("f"))
        off = thrust < LOW * level
        if "f" in streams:  # and it does not fall
            off &= norms(_mean(streams["f"], width)) > 0.5 * GRAVITY
        rest = (rest & (thrust < RUNNING * level)) | off
    for start, stop in runs(~rest):
        if start > 0 and stop < len(t) and (stop - start) * step < SHORT_BREAK:
            rest[start:stop] = True
    for start, stop in runs(rest):
        if (stop - start) * step < REST_TIME:
            rest[start:stop] = False
    return rest


def flying_level(thrust: np.ndarray, force: np.ndarray | None = None) -> float:
    """The thrust that carries the vehicle: by the specific force (k, 3), else the median above a tenth of the peak."""
    peak = float(np.nanquantile(thrust, 0.995)) if len(thrust) else 0.0
    if not peak > 0:
        return 0.0
    if force is None:
        return float(np.median(thrust[thrust > 0.1 * peak]))
    flies = thrust > 0.05 * peak
    size = np.maximum(norms(force[flies]), 0.3 * GRAVITY)
    return float(np.median(thrust[flies] * GRAVITY / size))


def thrust_of(columns: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """A thrust (k,), up to its unit, from the rotor signals (k, n) of a log by their names; None: it has none."""
    for name in ("rotor_speed", "motor_command", "rotor_thrust", "u", "thrust_acceleration"):
        if name in columns:
            signal = np.nan_to_num(np.asarray(columns[name], float))
            if name == "motor_command":
                signal = np.clip(signal, 0.0, 1.0)  # what is beyond is no command
            if name in ("rotor_speed", "motor_command"):
                signal = signal**2
            return signal.sum(axis=1)
    return None


def _still(streams: Mapping[str, np.ndarray], width: int) -> np.ndarray:
    """Mask (k,): the specific force is gravity, and nothing moves, over `width` samples."""
    f = streams["f"]
    w = streams["w"]
    still = np.abs(norms(_mean(f, width)) - GRAVITY) < STILL_FORCE
    still &= _spread(f, width) < STILL_FORCE
    still &= _spread(w, width) < STILL_RATE
    if "v" in streams:
        still &= norms(_mean(streams["v"], width)) < STILL_SPEED
    return still


def _mean(x: np.ndarray, width: int) -> np.ndarray:
    from scipy.ndimage import uniform_filter1d

    return uniform_filter1d(np.nan_to_num(x), width, axis=0, mode="nearest")


def _spread(x: np.ndarray, width: int) -> np.ndarray:
    """Standard deviation (k,) over `width` samples, of the axis that shakes most."""
    variance = _mean(x**2, width) - _mean(x, width) ** 2
    return np.sqrt(np.maximum(variance, 0.0)).max(axis=1)
