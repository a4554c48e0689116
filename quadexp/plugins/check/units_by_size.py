"""Units of a table's columns, by what their name says, by their size, or by their gain over what the motion says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from quadexp.physics.vehicle import GRAVITY
from quadexp.plugins.logs.units import UNITS

# Shown to a user; nothing is decided by them.
SURE = "sure"
LIKELY = "likely"
GUESS = "guess"
SECONDS = {unit: UNITS["time"][unit] for unit in ("s", "ms", "us", "ns")}
RATES = (4.0, 8200.0)  # Hz, of loggers
EPOCHS = {"ns": 1e18, "us": 1e15, "ms": 1e12, "s": 1e9}  # since 1970: from 2001 on
SLOWEST = 10.0  # s, between rows of a log whose times are since 1970
# Units of position and velocity: gain of the velocity over the derivative.
GAINS = {("m", "m/s"): 1.0, ("m", "mm/s"): 1e3, ("mm", "m/s"): 1e-3, ("m", "cm/s"): 100.0, ("cm", "m/s"): 0.01}
FULL_TURN = 6.4  # rad: larger angles are degrees
UPSIDE = 1.6  # rad: roll and pitch that stay below it are not
# Counts of a gyro for one deg/s, of 2000, 1000, 500 and 250 deg/s in 16 bits.
COUNTS_PER_DEGREE = (16.4, 32.8, 65.5, 131.0)
GYROS: dict[Any, float] = {**UNITS["rate"], **{n: UNITS["rate"]["deg/s"] / n for n in COUNTS_PER_DEGREE}}
COUNTS_PER_G = (2048.0, 4096.0, 512.0, 8192.0)  # of MPU and ICM accelerometers, of 16, 8, 4 and 64 g in 16 bits
IN_HOVER: dict[Any, float] = {unit: GRAVITY / factor for unit, factor in UNITS["acceleration"].items()}
IN_HOVER |= {counts: counts for counts in COUNTS_PER_G}
COUNTED = {"rate": "deg/s", "acceleration": "g"}  # what counts are counts of
APART = 0.03  # of the logarithm: units nearer to each other than this count as one
NEAR = {"rate": 0.15, "acceleration": 0.4}  # of the logarithm: a gain is known better than the mean of a flight's force
VOLTS = {"V": 60.0, "dV": 280.0, "cV": 6000.0, "mV": np.inf}  # up to which value a battery's voltage is in that unit
# Largest value of a motor's command, what else must hold, how sure, values of command 0 and 1, what they are.
RANGES = (
    (1.5, "", LIKELY, 0, 1, ""), (110, "", LIKELY, 0, 100, ""), (260, "", LIKELY, 0, 255, ""),
    (np.inf, "betaflight", LIKELY, 48, 2047, ": Betaflight counts"),
    (2200, "pulses", LIKELY, 1000, 2000, ": pulse widths in us"),
    (2200, "", LIKELY, 0, 2000, ": DShot or Betaflight counts"), (np.inf, "bits", LIKELY, 0, 65535, ": 16 bits"),
)  # fmt: skip

LEAST_PERCENT = 10  # of full command: no vehicle hovers with less


class Proposal(NamedTuple):
    """What stands under one key of a mapping. value: as it stands there, of a quantity without its columns. sureness:
    SURE, LIKELY or GUESS. why: the evidence."""

    value: Any
    sureness: str
    why: str


def apart(value: float, size: float) -> float:
    """Ratio of two sizes, as the logarithm."""
    return float(abs(np.log(max(value, 1e-12) / size)))


def nearest(value: float, sizes: Mapping[Any, float]) -> list[Any]:
    """Names of the sizes, the nearest by ratio first."""
    return sorted(sizes, key=lambda name: apart(value, sizes[name]))


def time_unit(values: np.ndarray, written: str | None) -> Proposal:
    """Of a clock (k,): that of its name, else the one in which it is of this century, or has a rate of loggers."""
    if written in SECONDS:
        return Proposal({"unit": written}, SURE, "the name says the unit")
    values = values[np.isfinite(values)]
    steps = np.diff(values)
    step = float(np.median(steps[steps > 0]))
    first = abs(float(values[0]))
    rates = {unit: 1 / (step * seconds) for unit, seconds in SECONDS.items()}  # Hz
    fitting = []
    for unit, size in EPOCHS.items():
        if 0.9 * size < first < 9 * size and rates[unit] > 1 / SLOWEST:
            fitting.append(unit)
    low, high = RATES
    for unit, rate in rates.items():
        if low <= rate <= high:
            fitting.append(unit)
    unit = fitting[0] if fitting else "s"
    why = f"increases by {step:.6g} a row: {rates[unit]:.4g} Hz"
    return Proposal({"unit": unit}, SURE if fitting else GUESS, why)


def motion_units(
    p: np.ndarray, v: np.ndarray, gain: float, correlation: float, written: str | None
) -> tuple[Proposal, Proposal]:
    """Of position and velocity, (k, 3), by the gain of v over dp/dt."""
    length, speed = nearest(gain, GAINS)[0]
    if GAINS[length, speed] == 1.0:
        far = np.median(np.ptp(p, axis=0))  # of two axes at least: a single one in mm is named by the search
        fastest = np.abs(v).max(axis=0)
        if written in ("mm", "cm"):
            length = written
        elif far > 500 and np.median(fastest) > 80:
            length = "mm"
        speed = f"{length}/s"
    why = f"the velocity is {gain:.3g} times its derivative, correlation {correlation:.3f}"
    sureness = SURE if correlation > 0.95 else LIKELY
    factor = gain * UNITS["velocity"][speed] / UNITS["length"][length]
    if abs(factor - 1) >= 0.1:
        sureness = GUESS
        why += "; that factor fits no unit: look at the time's unit too"
    return Proposal({"unit": length}, sureness, why), Proposal({"unit": speed}, sureness, why)


def angle_unit(angles: np.ndarray, written: str | None) -> tuple[Proposal, np.ndarray]:
    """Of roll, pitch and yaw (k, 3), and what one of each is in rad; a yaw in degrees may stand beside roll and pitch
    in rad."""
    largest = np.abs(angles).max(axis=0)
    unit = "deg" if largest.max() > FULL_TURN else "rad"
    if written is not None:
        unit = written
    lines: dict[str, Any] = {"order": "rpy", "unit": unit}
    factor = np.full(3, UNITS["angle"][unit])
    if written is None and largest[:2].max() < UPSIDE and largest[2] > FULL_TURN:
        factor = np.array([1.0, 1.0, UNITS["angle"]["deg"]])
        lines = {"order": "rpy", "unit": "rad", "scale": [1.0, 1.0, float(f"{factor[2]:.7g}")]}
    listed = ", ".join(f"{angle:.3g}" for angle in largest)
    return Proposal(lines, GUESS, f"named so; largest {listed}"), factor


def sensor_unit(value: float, sizes: Mapping[Any, float], dimension: str, written: str | None, why: str) -> Proposal:
    """Of a gyro or an accelerometer, by a size or a gain. sizes: of each unit, and by how many counts one `COUNTED` is.
    written: the unit that the columns' name says."""
    unit, rival = nearest(value, sizes)[:2]
    off = apart(value, sizes[unit])
    lines = {"unit": unit}
    sureness = SURE if off < NEAR[dimension] else GUESS
    if not isinstance(unit, str):
        if dimension == "acceleration" and sureness == SURE:  # no more is known of it than its mean size
            sureness = LIKELY
        lines = {"unit": COUNTED[dimension], "scale": 1 / unit}
        why += f": {unit:g} counts a {COUNTED[dimension]}"
    if apart(value, sizes[rival]) < max(2 * off, APART):
        words = rival if isinstance(rival, str) else f"{rival:g} counts a {COUNTED[dimension]}"
        return Proposal(lines, GUESS, f"{why}; or {words}: decide")
    if written not in (None, lines["unit"]):
        return Proposal(lines, GUESS, f"{why}; but the name says {written}")
    return Proposal(lines, sureness, why)


def rate_unit_by_size(x: np.ndarray, written: str | None) -> Proposal:
    """Of a gyro (k, 3) that nothing can be compared with."""
    spread = float(np.percentile(np.abs(x - np.median(x, axis=0)), 99))
    unit = "deg/s" if spread > 15 else "rad/s"
    sureness = GUESS if 8 <= spread <= 60 else LIKELY
    if written is not None:
        unit = written
        sureness = SURE
    return Proposal({"unit": unit}, sureness, f"by its name; 99 % of its values within {spread:.3g}")


def rotor_range(x: np.ndarray, speeds: bool, name: str, written: str | None, betaflight: bool) -> tuple[str, Proposal]:
    """Quantity, and its range or unit, of rotor signals (k, n) by their size. speeds: whether the name, in small
    letters, says so. betaflight: whether its blackbox_decode wrote the table."""
    largest = float(x.max())
    middle = float(np.median(x))
    why = f"median {middle:.4g}, largest {largest:.5g}"
    if written == "erpm" or (speeds and "erpm" in name):
        lines = {"unit": "erpm", "pole_pairs": 7}
        why += "; electrical turns: pole_pairs is a guess, magnets of the motor over two"
        if betaflight:
            lines["scale"] = 100
            why += "; Betaflight logs hundreds of them"
        return "rotor_speed", Proposal(lines, GUESS, why)
    if written in ("rpm", "rad/s", "Hz"):
        return "rotor_speed", Proposal({"unit": written}, SURE, f"the name says the unit; {why}")
    if written is not None:
        return "rotor_thrust", Proposal({"unit": written}, SURE, f"the name says the unit; {why}")
    if speeds and largest > 1.5:
        unit = "rpm" if middle > 3500 or "rpm" in name else "rad/s"
        return "rotor_speed", Proposal({"unit": unit}, LIKELY, f"named as speeds, {why}")
    if largest > 1.5 and np.percentile(x, 90) < LEAST_PERCENT:
        return "rotor_thrust", Proposal({"unit": "N"}, GUESS, f"{why}: too small for commands in percent")
    holds = {"": True, "betaflight": betaflight, "pulses": np.percentile(x, 1) > 850, "bits": largest > 30_000}
    for limit, condition, sureness, low, high, words in RANGES:
        if largest <= limit and holds[condition]:
            return "motor_command", Proposal({"range": [low, high]}, sureness, f"{why}{words}")
    return "rotor_speed", Proposal({"unit": "rpm"}, GUESS, why)
