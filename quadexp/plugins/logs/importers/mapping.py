"""A mapping: which columns of a log are what, in which unit, frame and order. YAML that a user writes in a few lines:

    world: ENU                  # of the log; ENU, NWU, NED, ..., or axes such as "y x -z"
    body: FLU
    time: {column: t, unit: s}
    position: {columns: [x, y, z], unit: m}
    attitude: {columns: [qx, qy, qz, qw], order: xyzw, direction: body_to_world}
    rate: {columns: [gx, gy, gz], unit: deg/s}
    acceleration: {columns: [ax, ay, az], unit: g, kind: specific_force, mounting: [0.5, -7.8, 0]}
    motor_command: {columns: [m1, m2, m3, m4], range: [0, 65535], layout: [front_right, ...]}
    rotor_speed: {columns: [e1, e2, e3, e4], unit: erpm, pole_pairs: 7}
    crop: {height: 0.5, margin: 1.5}
    corrections: [{rate: {unit: deg/s}}, {body: FRD}]

Every key may be left out but `time`. corrections: made one after the other on what the other keys give, each as if that
were a log in SI units, ENU and FLU of which its lines are the mapping. mounting: roll, pitch and yaw (deg) of the
sensor in the body, after `frame`: v_body = R_z(yaw) R_y(pitch) R_x(roll) v_sensor. offset: its bias, taken off last. Of
an attitude, angles: [1, -1, 1] are signs of roll, pitch and yaw, turn: degrees about the world's z. Every value is
checked; errors name file, line and key. A log that says itself what its fields are (format: ulog, rosbag, ..; csv where
its table is recognised) takes crop and corrections alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from collections.abc import Mapping as Mapped
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.parts.yaml_files import read_mapping
from quadexp.plugins.logs.units import (
    BODY_FRAMES,
    ELECTRICAL,
    UNITS,
    WORLD_FRAMES,
    axes_matrix,
    mounting_matrix,
    unit_factor,
)


class Quantity(NamedTuple):
    """columns: of a flight; {} stands for the number of a rotor. dimension: of its units. keys: that it alone has."""

    columns: tuple[str, ...]
    dimension: str
    keys: tuple[str, ...] = ()


def _vector(name: str, axes: str = "xyz") -> tuple[str, ...]:
    return tuple(f"{name}_{axis}" for axis in axes)


QUANTITIES: dict[str, Quantity] = {
    "position": Quantity(_vector("p"), "length"),
    "attitude": Quantity(_vector("q", "wxyz"), "angle", ("order", "direction", "angles", "turn")),
    "velocity": Quantity(_vector("v"), "velocity"),
    "rate": Quantity(_vector("w"), "rate", ("mounting", "offset")),
    "acceleration": Quantity(_vector("acc"), "acceleration", ("kind", "mounting", "offset")),
    "motor_command": Quantity(("motor_command_{}",), "none", ("range", "layout")),
    "rotor_speed": Quantity(("rotor_speed_{}",), "rotor_speed", ("layout", "pole_pairs")),
    "rotor_thrust": Quantity(("u_{}",), "force", ("layout",)),
    "thrust_acceleration": Quantity(("thrust_acceleration",), "acceleration"),
    "battery_voltage": Quantity(("battery_voltage",), "voltage"),
    "wind": Quantity(_vector("wind"), "velocity"),
    "reference_position": Quantity(_vector("ref_p"), "length"),
    "reference_velocity": Quantity(_vector("ref_v"), "velocity"),
    "reference_attitude": Quantity(_vector("ref_q", "wxyz"), "angle", ("order", "direction")),
}
ROTORS = ("motor_command", "rotor_speed", "rotor_thrust")
# Where the places of a rotor are, as signs of x and y in FLU.
PLACES = {
    "front_right": (1, -1), "back_right": (-1, -1), "back_left": (-1, 1), "front_left": (1, 1),
    "front": (1, 0), "right": (0, -1), "back": (-1, 0), "left": (0, 1),
}  # fmt: skip
DIRECTIONS = ("body_to_world", "world_to_body")
KINDS = ("specific_force", "coordinate")
# Values of `format`.
TABLES = ("text", "hdf5", "parquet")
SELF_DESCRIBING = ("csv", "ulog", "rosbag", "ardupilot", "betaflight")
IN_BODY = ("rate", "acceleration")  # unless `frame` says otherwise
_TOP = ("name", "about", "format", "signature", "world", "body", "time", "crop", "corrections", *QUANTITIES)
_ENTRY = ("column", "columns", "unit", "scale", "frame", "time")


def columns_of(quantity: str, width: int) -> tuple[str, ...]:
    """Names of the flight's columns that a stream of `width` values fills."""
    names = QUANTITIES[quantity].columns
    return tuple(names[0].format(i) for i in range(width)) if quantity in ROTORS else names


@dataclass(frozen=True)
class Crop:
    """What is cut off. mode: "auto" (ground phases, from height and motion), "height", or "none".

    height: of the vehicle above which it flies (m). margin: cut off both ends of the flight besides (s).
    """

    mode: str = "auto"
    height: float | None = None
    margin: float = 0.0


class Clock(NamedTuple):
    """factor: to seconds."""

    column: str
    factor: float


@dataclass(frozen=True)
class Entry:
    """One quantity. factor: to SI (times `scale`). axes: (3, 3) to ENU or FLU. in_body: whether that is FLU.

    order: of a quaternion's columns, or "rpy" for angles. inverse: the log's attitude turns world into body vectors.
    coordinate: the acceleration is that of the motion, without gravity. low, high: values of commands 0 and 1.
    offset: bias of a sensor, taken off last (SI, body). angles: signs of roll, pitch and yaw; turn: about the world's
    z axis (rad); both of an attitude from body to ENU.
    """

    columns: tuple[str, ...]
    factor: np.ndarray
    clock: Clock | None = None
    axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    in_body: bool = False
    order: str = "wxyz"
    inverse: bool = False
    world: np.ndarray = field(default_factory=lambda: np.eye(3))
    coordinate: bool = False
    low: float = 0.0
    high: float = 1.0
    mounting: np.ndarray = field(default_factory=lambda: np.eye(3))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    angles: tuple[float, ...] = (1.0, 1.0, 1.0)
    turn: float = 0.0


@dataclass(frozen=True)
class Mapping:
    """name, the kind of file (`format`), its clock, an entry for every quantity it has, and corrections."""

    name: str
    format: str
    clock: Clock
    entries: dict[str, Entry]
    layout: tuple[str, ...] | None
    crop: Crop
    signature: tuple[str, ...] = ()
    corrections: tuple[Mapping, ...] = ()

    @property
    def columns(self) -> list[str]:
        """All columns that are read."""
        clocks = [self.clock, *(entry.clock for entry in self.entries.values() if entry.clock)]
        return [*(c.column for c in clocks), *(name for e in self.entries.values() for name in e.columns)]


def load_mapping(path: Path) -> Mapping:
    """Read a mapping; raises UsageError naming file, line and key."""
    import yaml

    try:
        values = read_mapping(path)
        root = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except OSError as error:
        raise UsageError(f"{path}: no mapping can be read there ({error.strerror or error})") from None
    return _Reader(path, _lines(root)).mapping(values)


def correction(lines: dict[str, Any], widths: Mapped[str, int]) -> Mapping:
    """Lines of `corrections` as a mapping. widths: columns by quantity, of the streams that they mend."""
    return _Reader(Path("correction"), {}).correction(lines, widths)


def _lines(node: Any, prefix: str = "") -> dict[str, int]:
    """Dotted key -> line."""
    lines: dict[str, int] = {}
    for key, value in node.value if getattr(node, "id", "") == "mapping" else ():
        name = f"{prefix}{key.value}"
        lines |= {name: key.start_mark.line + 1, **_lines(value, f"{name}.")}
    return lines


class _Reader:
    """Checks the values of one file; `lines` says where a key stands."""

    def __init__(self, path: Path, lines: Mapped[str, int]) -> None:
        self.path, self.lines = path, lines

    def at(self, key: str) -> str:
        """The key with its file and line, or the line of what holds it."""
        place = key
        while place and place not in self.lines:
            place = place.rpartition(".")[0]
        return f"{self.path}:{self.lines.get(place, 1)}: {key}"

    def fail(self, key: str, text: str) -> UsageError:
        return UsageError(f"{self.at(key)}: {text}")

    def one_of(self, key: str, value: Any, allowed: Sequence[str]) -> str:
        if value not in allowed:
            raise self.fail(key, f"{value!r} is not known; allowed are {', '.join(allowed)}")
        return str(value)

    def known(self, key: str, value: Any, allowed: Sequence[str]) -> None:
        """Whether a value is a mapping of no other keys than these."""
        if not isinstance(value, dict):
            raise self.fail(key, f"must be a mapping {{{', '.join(allowed)}}}")
        for name in map(str, value):
            if name not in allowed:
                where = f"{key}.{name}".removeprefix(".")
                raise self.fail(where, f"unknown key{suggestion(name, allowed)}; allowed are {', '.join(allowed)}")

    def numbers(
        self, key: str, value: Any, counts: Sequence[int], what: str, allowed: Callable[[float], bool] = math.isfinite
    ) -> list[float]:
        """A number, or a list of so many of them, each finite and allowed."""
        items = value if isinstance(value, list) else [value]
        real = all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in items)
        if not real or len(items) not in counts or not all(map(allowed, items)):
            raise self.fail(key, f"{value!r} must be {what}")
        return items

    def mapping(self, values: dict[str, Any]) -> Mapping:
        self.known("", values, _TOP)
        form = self.one_of("format", values.get("format", "text"), (*TABLES, *SELF_DESCRIBING))
        if form in SELF_DESCRIBING:
            return self.additions(form, values)
        if "time" not in values:
            raise self.fail("time", "is missing: `time: {column: t, unit: s}`")
        frames = {
            kind: axes_matrix(kind, values.get(kind, usual), self.at(kind))
            for kind, usual in (("world", "ENU"), ("body", "FLU"))
        }
        entries = {name: self.entry(name, values[name], frames) for name in QUANTITIES if values.get(name) is not None}
        if not entries:
            raise self.fail("time", f"a clock alone is no flight: give at least one of {', '.join(QUANTITIES)}")
        layouts = {tuple(lay) for name in ROTORS if (lay := (values.get(name) or {}).get("layout"))}
        if len(layouts) > 1:
            raise self.fail("layout", "two quantities with different layouts: one log has one order of motors")
        return Mapping(
            str(values.get("name", self.path.stem)), form, self.clock("time", values["time"]), entries,
            next(iter(layouts), None), self.crop(values.get("crop", "auto")),
            tuple(map(str, values.get("signature") or [])), self.corrections(
                values.get("corrections") or [], {name: len(entry.columns) for name, entry in entries.items()}
            ),
        )  # fmt: skip

    def additions(self, form: str, values: dict[str, Any]) -> Mapping:
        """What a mapping adds to a log that says itself what its fields are: ground phases and corrections."""
        self.known("", values, ("name", "about", "format", "crop", "corrections"))
        widths = {name: len(quantity.columns) for name, quantity in QUANTITIES.items()}
        corrections = self.corrections(values.get("corrections") or [], widths)
        crop = self.crop(values.get("crop", "auto"))
        return Mapping(str(values.get("name", self.path.stem)), form, Clock("", 1.0), {}, None, crop, (), corrections)

    def corrections(self, value: Any, entries: Mapped[str, int]) -> tuple[Mapping, ...]:
        """Each as a mapping whose log is the flight that the other keys give. entries: columns by quantity."""
        if not isinstance(value, list) or not all(isinstance(correction, dict) for correction in value):
            raise self.fail("corrections", "must be a list of lines of a mapping, such as `- rate: {unit: deg/s}`")
        allowed = ("world", "body", "time", *entries)
        reader = _Reader(self.path, dict.fromkeys(allowed, self.lines.get("corrections", 1)))
        for key, lines in ((key, lines) for correction in value for key, lines in correction.items()):
            if key not in allowed:
                raise self.fail("corrections", f"{key!r}: allowed are {', '.join(allowed)}")
            if key in entries:
                keys = [name for name in QUANTITIES[key].keys if name != "layout"]
                reader.known(key, lines, ("unit", "scale", "frame", *keys))
            elif key == "time":
                reader.known(key, lines, ("unit", "scale"))
        return tuple(reader.correction(correction, entries) for correction in value)

    def correction(self, lines: dict[str, Any], widths: Mapped[str, int]) -> Mapping:
        """Lines as a mapping of which streams in SI, ENU and FLU are the log. widths: columns by quantity."""
        streams = {name: {"columns": list(columns_of(name, n)), **lines.get(name, {})} for name, n in widths.items()}
        return self.mapping({**lines, **streams, "time": {"column": "t", **lines.get("time", {})}})

    def clock(self, key: str, value: Any) -> Clock:
        self.known(key, value, ("column", "unit", "scale"))
        if not isinstance(value.get("column"), (str, int)):
            raise self.fail(f"{key}.column", "must name one column")
        factor = unit_factor("time", str(value.get("unit", "s")), self.at(f"{key}.unit"))
        (scale,) = self.numbers(f"{key}.scale", value.get("scale", 1.0), [1], "one positive number", lambda x: x > 0)
        return Clock(str(value["column"]), factor * scale)

    def entry(self, name: str, value: Any, frames: dict[str, np.ndarray]) -> Entry:
        dimension, keys = QUANTITIES[name][1:]
        self.known(name, value, (*_ENTRY, *keys))
        columns = self.names(name, value)
        options: dict[str, Any] = {"clock": self.clock(f"{name}.time", value["time"]) if "time" in value else None}
        if dimension == "angle":
            options |= self.attitude(name, value, len(columns), frames)
        else:
            options |= self.frame(name, value, frames)
        factor, unit = 1.0, str(value.get("unit", next(iter(UNITS[dimension]))))
        if options.get("order", "rpy") == "rpy":  # a quaternion has no unit
            factor = unit_factor(dimension, unit, self.at(f"{name}.unit"))
        if name == "rotor_speed":
            factor /= self.pole_pairs(unit, value.get("pole_pairs"))
        if "kind" in value:
            options["coordinate"] = self.one_of(f"{name}.kind", value["kind"], KINDS) == "coordinate"
        if value.get("mounting") is not None:
            if not options["in_body"]:
                raise self.fail(f"{name}.mounting", "turns a sensor in the body, but `frame` says world")
            what = "[roll, pitch, yaw] of the sensor in the body (deg)"
            options["mounting"] = mounting_matrix(self.numbers(f"{name}.mounting", value["mounting"], [3], what))
        if "offset" in value:
            bias = self.numbers(f"{name}.offset", value["offset"], [3], "[x, y, z], the bias in SI units")
            options["offset"] = np.array(bias, float)
        if "range" in value:
            what = "[value of command 0, value of command 1]"
            low, high = map(float, self.numbers(f"{name}.range", value["range"], [2], what))
            if low == high:
                raise self.fail(f"{name}.range", f"must be {what}, and these differ")
            options |= {"low": low, "high": high}
        if value.get("layout"):
            self.layout(name, value["layout"], len(columns))
        what = "one number, or one a column, and not zero"
        scale = self.numbers(f"{name}.scale", value.get("scale", 1.0), [1, len(columns)], what, bool)
        return Entry(columns, factor * np.array(scale, float), **options)

    def pole_pairs(self, unit: str, value: Any) -> float:
        """Turns of the field for one of the rotor, 1 for a unit that counts the rotor's own."""
        key, electrical = "rotor_speed.pole_pairs", unit == ELECTRICAL
        if electrical == (value is None):
            text = f"goes with unit {ELECTRICAL}, not {unit}" if value is not None else f"is missing, with unit {unit}"
            raise self.fail(key, f"{text}: magnets of the motor over two, as `pole_pairs: 7`")
        what = "a whole number from 1 to 100"
        pairs = 1 if value is None else value
        return float(self.numbers(key, pairs, [1], what, lambda x: isinstance(x, int) and 1 <= x <= 100)[0])

    def names(self, name: str, value: dict[str, Any]) -> tuple[str, ...]:
        stated = value.get("columns", value.get("column"))
        if isinstance(stated, (str, int)) and not isinstance(stated, bool):
            stated = [stated]
        width = len(QUANTITIES[name].columns)
        least, most = (3, 4) if width == 4 else (1, 32) if name in ROTORS else (width, width)
        if not isinstance(stated, list) or len(set(map(str, stated))) < len(stated) or not least <= len(stated) <= most:
            count = f"{least} to {most}" if least < most else str(least)
            raise self.fail(f"{name}.columns", f"must be a list of the log's columns: {count} are needed, each once")
        return tuple(map(str, stated))

    def frame(self, name: str, value: dict[str, Any], frames: dict[str, np.ndarray]) -> dict[str, Any]:
        """axes and in_body of a vector; the body frame is the default of rate and acceleration."""
        key = f"{name}.frame"
        if len(QUANTITIES[name].columns) != 3:
            if "frame" in value:
                raise self.fail(key, "is of no use here: the quantity is no vector")
            return {}
        text = str(value.get("frame", "body" if name in IN_BODY else "world")).strip().lower()
        kind, _, axes = text.partition(" ")
        if text in WORLD_FRAMES or text in BODY_FRAMES:
            kind, axes = "world" if text in WORLD_FRAMES else "body", text
            if kind == "body" and name not in (*IN_BODY, "velocity"):
                raise self.fail(key, "must be a world frame")
        elif kind not in frames:
            allowed = ", ".join([*WORLD_FRAMES, *BODY_FRAMES]).upper()
            raise self.fail(
                key, f'{text!r} is not known; allowed: {allowed}, or axes such as "body x -y -z" or "world y x -z"'
            )
        return {"axes": axes_matrix(kind, axes, self.at(key)) if axes else frames[kind], "in_body": kind == "body"}

    def attitude(self, name: str, value: dict[str, Any], count: int, frames: dict[str, Any]) -> dict[str, Any]:
        order = str(value.get("order", "wxyz" if count == 4 else "rpy")).lower()
        if count == 3 or sorted(order) != sorted("wxyz"):
            self.one_of(f"{name}.order", order, ("wxyz", "xyzw") if count == 4 else ("rpy",))
        direction = self.one_of(f"{name}.direction", value.get("direction", DIRECTIONS[0]), DIRECTIONS)
        if "frame" in value:
            raise self.fail(f"{name}.frame", "give the frames as `world:` and `body:` at the top")
        if np.linalg.det(frames["world"] @ frames["body"]) < 0:
            raise self.fail("body", "of the world and the body frame one is left-handed: no attitude joins them")
        what = "signs of roll, pitch and yaw, as [1, -1, 1]"
        signs = self.numbers(f"{name}.angles", value.get("angles", [1, 1, 1]), [3], what, lambda sign: abs(sign) == 1)
        (turn,) = self.numbers(f"{name}.turn", value.get("turn", 0.0), [1], "degrees about the world's z axis")
        return {
            "order": order, "inverse": direction == DIRECTIONS[1], "axes": frames["body"], "world": frames["world"],
            "angles": tuple(map(float, signs)), "turn": math.radians(turn),
        }  # fmt: skip

    def layout(self, name: str, value: Any, count: int) -> None:
        if not isinstance(value, list) or len(value) != count or len(set(map(str, value))) != count:
            raise self.fail(f"{name}.layout", f"must be {count} different places, one for every column")
        for place in value:
            self.one_of(f"{name}.layout", place, tuple(PLACES))

    def crop(self, value: Any) -> Crop:
        if value in ("auto", "none", False, None):
            return Crop("auto" if value == "auto" else "none")
        self.known("crop", value, ("height", "margin"))
        (margin,) = self.numbers("crop.margin", value.get("margin", 0.0), [1], "a number")
        if value.get("height") is None:
            return Crop("auto", None, float(margin))
        (height,) = self.numbers("crop.height", value["height"], [1], "a number")
        return Crop("height", float(height), float(margin))
