"""What the names of a table's columns say of their quantity, axis and unit."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import NamedTuple

Groups = dict[str, list[list[int]]]  # quantity -> groups of columns, the likeliest first


# ------------------------------------------------------------------------------------------------------------ names
class Hint(NamedTuple):
    """quantity: of raw.QUANTITIES, or "time", "euler", "motor". axis: "x", "0", ... group: the name without its axis.
    rank: place in the list of patterns, 100 more for an estimate or a second source."""

    quantity: str
    axis: str
    group: str
    rank: int


_UNIT = re.compile(r"[\[(]\s*([^\[\]()]*?)\s*[\])]\s*$")


# Units at the end of a name -> ours; those in brackets may be written in more ways. "1/s" and the like are left.
_SUFFIXES = {
    "rads": "rad/s", "radps": "rad/s", "rad_s": "rad/s", "degs": "deg/s", "degps": "deg/s", "deg_s": "deg/s",
    "dps": "deg/s", "deg": "deg", "rad": "rad", "mps2": "m/s^2", "mss": "m/s^2", "mps": "m/s", "rpm": "rpm",
    "erpm": "erpm", "ns": "ns", "us": "us", "usec": "us", "ms": "ms", "sec": "s", "s": "s", "g": "g", "volt": "V",
    "volts": "V", "mv": "mV",
}  # fmt: skip


_UNITS = _SUFFIXES | {
    "secs": "s", "seconds": "s", "µs": "us", "m": "m", "cm": "cm", "mm": "mm", "m/s": "m/s", "m s^-1": "m/s",
    "ms^-1": "m/s", "cm/s": "cm/s", "rad/s": "rad/s", "rad s^-1": "rad/s", "deg/s": "deg/s", "°/s": "deg/s", "gs": "g",
    "m/s^2": "m/s^2", "m/s/s": "m/s^2", "m/s2": "m/s^2", "m/s²": "m/s^2", "m s^-2": "m/s^2", "mg": "mg",
    "degrees": "deg", "°": "deg", "v": "V", "cv": "cV", "dv": "dV", "erpm": "erpm", "hz": "Hz", "n": "N", "mn": "mN",
}  # fmt: skip


_SUFFIX = re.compile(rf"[_ ]({'|'.join(sorted(_SUFFIXES, key=len, reverse=True))})$")


NOT_MEASURED = re.compile(
    r"(^|[^a-z])(des|desired|ref|reference|sp|setpoint|set|target|ctrltarget|cmd|err|error|bias|cov|covariance|var|std"
    r"|model|res|residual|controller|pid|integral|raw|mag|baro|dmot|snap|jerk|stick|rccommand|axis[pidf]+|debug)"
    r"([^a-z]|$)|^b[^a-z]|(des|dot_des|_d|ref)$|ang(ular)?[ _.]?acc"
)


_SECOND = re.compile(r"est|kalman|ekf|filter|odom|vicon|mocap|2$")


_AXES = {"roll": "x", "pitch": "y", "yaw": "z", "heading": "z"}


_A = r"(?:[ ._](?:b|body|w|world|enu|ned|flu|frd|nav|local))?[\s._\[/:-]*([xyz012])\]?"


_Q = r"[\s._\[/:-]*([wxyz0123])\]?"


_N = r"[\s._\[/:#-]*m?(\d{1,2})\]?"


_W = r"(?:.*[^a-z])?"


_ROTOR = _W + r"(?:rotor|motor|prop(?:eller)?|esc)s?[ ._]?"
_SPEED = r"(?:speed|omega|rate|vel|velocity|rpm)s?"


_PATTERNS: list[tuple[str, re.Pattern[str]]] = [
    ("rotor_speed", re.compile(_ROTOR + _SPEED + _N)),  # before velocity and rate, which have numbered axes too
    ("rotor_speed", re.compile(_ROTOR + r"\[?(\d{1,2})\]?[ ._]?" + _SPEED)),
    ("time", re.compile(_W + r"(?:time|timestamp|stamp|t|ts|timeus|time_?s|timestamp_sample|secs?)")),
    ("attitude", re.compile(_W + r"(?:q|quat|quaternion|orientation|rot|att|q_rs|q_wb|q_nb|attitude)" + _Q)),
    ("euler", re.compile(_W + r"(roll|pitch|yaw|heading)")),
    ("wind", re.compile(_W + r"(?:wind|vwind|wind_?speed|wind_?vel)" + _A)),
    ("rate", re.compile(
        _W + r"(?:w|g|omega|om|gyro|gyr|gyr?oadc|gyro_rad|gyrounfilt|gyro_filt|ang[ ._]?vel|angular[ ._]?velocity"
        r"|angvel|rate|rates|body_?rates?|w_rs_s|xyz|angular|bodyrate|ang_rate)" + _A)),
    ("rate", re.compile(_W + r"(rollspeed|pitchspeed|yawspeed|roll_?rate|pitch_?rate|yaw_?rate)")),
    ("velocity", re.compile(_W + r"([xyz])[._ ]?dot")),
    ("velocity", re.compile(_W + r"(?:v|vel|velocity|speed|v_rs_r|twist[._/]linear|linear_velocity|lin_vel"
        r"|vel_world)" + _A)),
    ("acceleration", re.compile(
        _W + r"(?:a|acc|accel|accelerometer|accsmooth|accadc|accelerometer_m_s2|acceleration"
        r"|linear[ ._]?acceleration|lin_acc"
        r"|a_rs_s|imu_acc|specific_force|sf|a_lin|acc_lin)" + _A)),
    ("rotor_speed", re.compile(_W + r"(?:rpm|erpm|rotor|rotor_?speeds?|motor_?speeds?|motor_?rpm|r|esc_rpm"
        r"|mot|omega_rotor|speed_motor|prop)" + _N)),
    ("rotor_speed", re.compile(r"esc\[(\d+)\]\.esc_rpm")),
    ("motor", re.compile(_W + r"(?:motor|motors|mot|m|pwm|output|outputs|control|actuator|act|u|esc|thrust"
        r"|motor_?pwm|motor_?commands?|servo)" + _N)),
    ("battery_voltage", re.compile(_W + r"(?:vbat\w*|v_?batt?(?:ery)?|voltage\w*"
        r"|batt?(?:ery)?(?:[ _.]?v(?:olt(?:age)?)?)?|pm[._]vbat)()")),
    ("position", re.compile(_W + r"(?:p|pos|position|loc|location|p_rs_r|t|xyz_world|pose[._/]position"
        r"|translation)" + _A)),
    ("position", re.compile(r"(?:vicon|mocap|odom|est\w*|state\w*|pose)?[\s._-]*([xyz])")),
]  # fmt: skip


def unit_of(name: str) -> tuple[str, str | None]:
    """The name without its unit, and the unit in our writing, if it has one."""
    brackets = _UNIT.search(name)
    if brackets:
        bare = name[: brackets.start()].strip()
        unit = brackets[1].strip().lower()
        if unit in _UNITS:
            return bare, _UNITS[unit]
        if bare and not unit and name[brackets.start()] == "[":
            return bare, "1"
    suffix = _SUFFIX.search(name.lower())
    if suffix and suffix.start() > 1:
        return name[: suffix.start()], _SUFFIXES[suffix[1]]
    return name, None


def hint(name: str) -> Hint | None:
    """What a name says, or None."""
    bare, _ = unit_of(name)
    for text in dict.fromkeys((bare.strip().lower(), name.strip().lower())):
        if NOT_MEASURED.search(text):
            return None
        for rank, (quantity, pattern) in enumerate(_PATTERNS):
            match = pattern.fullmatch(text)
            if match is None:
                continue
            axis = ""
            group = text
            if pattern.groups and match[1]:
                axis = match[1]
                group = f"{text[: match.start(1)]}#{text[match.end(1) :]}"
            if quantity == "euler" or axis[:3] in ("rol", "pit", "yaw", "hea"):
                group = "angles" if text in _AXES else text.replace(axis, "#")
                axis = next(a for word, a in _AXES.items() if axis.startswith(word[:3]))
            return Hint(quantity, axis, group, rank + (100 if _SECOND.search(text) else 0))
    return None


def groups(names: Sequence[str]) -> Groups:
    """Quantity -> groups of columns (in the order x, y, z, or of their numbers), best name first."""
    groups: dict[tuple[str, str], dict[str, int]] = defaultdict(dict)  # quantity, group -> axis -> column
    ranks: dict[tuple[str, str], int] = {}
    for i, name in enumerate(names):
        said = hint(name)
        if said is not None:
            groups[said.quantity, said.group].setdefault(said.axis, i)
            ranks.setdefault((said.quantity, said.group), said.rank)
    ranked: dict[str, list[tuple[int, list[int]]]] = defaultdict(list)
    for (quantity, group), columns in groups.items():
        for order in _orders(quantity, columns):
            if set(order) <= columns.keys():
                ranked[quantity].append((ranks[quantity, group], [columns[axis] for axis in order]))
                break
    return {quantity: [columns for _, columns in sorted(items)] for quantity, items in ranked.items()}


def _orders(quantity: str, axes: Mapping[str, int]) -> Sequence[Sequence[str]]:
    """The axes that a group of a quantity must have, in their order; any of these."""
    if quantity in ("time", "battery_voltage"):
        return [list(axes)[:1]]
    if quantity == "attitude":
        return ("wxyz", "0123")
    if quantity not in ("motor", "rotor_speed"):
        return ("xyz", "012")
    numbers = sorted(axes, key=int)
    in_a_row = int(numbers[-1]) - int(numbers[0]) == len(numbers) - 1
    return [numbers[:8]] if len(numbers) >= 3 and in_a_row else []


def numbered_quaternion(names: Sequence[str], columns: Sequence[int]) -> bool:
    """Whether the four columns are distinguished by numbers, which say nothing of where w is."""
    return any((said := hint(names[i])) is not None and said.axis.isdigit() for i in columns)
