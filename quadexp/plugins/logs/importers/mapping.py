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
from quadexp.plugins.logs.importers.quantities import PLACES, QUANTITIES, ROTORS, columns_of
from quadexp.plugins.logs.units import ELECTRICAL, FRAMES, UNITS, axes_matrix, unit_factor

# Values of `format`.
TABLES = ("text", "hdf5", "parquet")
SELF_DESCRIBING = ("csv", "ulog", "rosbag", "ardupilot", "betaflight")
IN_BODY = ("rate", "acceleration")  # unless `frame` says otherwise
ADDITIONS = ("name", "about", "format", "crop", "corrections")  # to a log that says itself what its fields are
_TOP = (*ADDITIONS, "signature", "world", "body", "time", *QUANTITIES)
_ENTRY = ("column", "columns", "unit", "scale", "frame", "time")
CORRECTED = {name: [key for key in quantity.keys if key != "layout"] for name, quantity in QUANTITIES.items()}
CHOICES = {"kind": ("specific_force", "coordinate"), "direction": ("body_to_world", "world_to_body")}


class Numbers(NamedTuple):
    """counts: how many they may be. what: they are. allowed: whether one of them is."""

    counts: tuple[int, ...]
    what: str
    allowed: Callable[[float], bool] = math.isfinite


NUMBERS = {
    "mounting": Numbers((3,), "[roll, pitch, yaw] of the sensor in the body (deg)"),
    "offset": Numbers((3,), "[x, y, z], the bias in SI units"),
    "range": Numbers((2,), "[value of command 0, value of command 1]"),
    "angles": Numbers((3,), "signs of roll, pitch and yaw, as [1, -1, 1]", lambda sign: abs(sign) == 1),
    "turn": Numbers((1,), "degrees about the world's z axis"),
    "pole_pairs": Numbers((1,), "a whole number from 1 to 100", lambda n: isinstance(n, int) and 1 <= n <= 100),
}


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

    order: of a quaternion's columns, or "rpy" for angles; world: (3, 3) to ENU, of an attitude, whose `axes` are to
    FLU. The others as in a mapping: the values of commands 0 and 1; a sensor's mounting (deg) and bias, taken off last
    (SI, body); signs of roll, pitch and yaw, and a turn about the world's z axis (deg), both from body to ENU.
    """

    columns: tuple[str, ...]
    factor: np.ndarray
    clock: Clock | None = None
    layout: tuple[str, ...] = ()
    axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    in_body: bool = False
    world: np.ndarray = field(default_factory=lambda: np.eye(3))
    order: str = "wxyz"
    direction: str = "body_to_world"
    kind: str = "specific_force"
    range: Sequence[float] = (0.0, 1.0)
    mounting: Sequence[float] = (0.0, 0.0, 0.0)
    offset: Sequence[float] = (0.0, 0.0, 0.0)
    angles: Sequence[float] = (1.0, 1.0, 1.0)
    turn: float = 0.0

    @property
    def is_motion(self) -> bool:
        """Whether an acceleration is that of the motion, without gravity."""
        return self.kind == "coordinate"


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
        names = [self.clock.column]
        for entry in self.entries.values():
            names += entry.columns
            if entry.clock:
                names.append(entry.clock.column)
        return names


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
    if getattr(node, "id", "") != "mapping":
        return lines
    for key, value in node.value:
        name = f"{prefix}{key.value}"
        lines[name] = key.start_mark.line + 1
        lines |= _lines(value, f"{name}.")
    return lines


class _Reader:
    """Checks the values of one file; `lines` says where a key stands."""

    def __init__(self, path: Path, lines: Mapped[str, int]) -> None:
        self.path = path
        self.lines = lines

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

    def numbers(self, key: str, value: Any, wanted: Numbers) -> list[float]:
        """A number, or a list of so many of them, each finite and allowed."""
        items = value if isinstance(value, list) else [value]
        for item in items:
            real = isinstance(item, (int, float)) and not isinstance(item, bool) and math.isfinite(item)
            if not real or not wanted.allowed(item) or len(items) not in wanted.counts:
                raise self.fail(key, f"{value!r} must be {wanted.what}")
        return items

    def mapping(self, values: dict[str, Any]) -> Mapping:
        form = self.one_of("format", values.get("format", "text"), (*TABLES, *SELF_DESCRIBING))
        clock = Clock("", 1.0)
        entries: dict[str, Entry] = {}
        widths = {name: len(quantity.columns) for name, quantity in QUANTITIES.items()}
        if form in SELF_DESCRIBING:
            self.known("", values, ADDITIONS)
        else:
            self.known("", values, _TOP)
            clock = self.clock("time", values.get("time"))
            entries = self.entries(values)
            widths = {name: len(entry.columns) for name, entry in entries.items()}
        layouts = {entry.layout for entry in entries.values() if entry.layout}
        if len(layouts) > 1:
            raise self.fail("layout", "two quantities with different layouts: one log has one order of motors")
        return Mapping(
            name=str(values.get("name", self.path.stem)),
            format=form,
            clock=clock,
            entries=entries,
            layout=next(iter(layouts), None),
            crop=self.crop(values.get("crop", "auto")),
            signature=tuple(map(str, values.get("signature") or [])),
            corrections=self.corrections(values.get("corrections") or [], widths),
        )

    def entries(self, values: dict[str, Any]) -> dict[str, Entry]:
        """Every quantity that is there, one at least."""
        world = axes_matrix("world", values.get("world", "ENU"), self.at("world"))
        body = axes_matrix("body", values.get("body", "FLU"), self.at("body"))
        frames = {"world": world, "body": body}
        entries = {name: self.entry(name, values[name], frames) for name in QUANTITIES if values.get(name) is not None}
        if not entries:
            raise self.fail("time", f"a clock alone is no flight: give at least one of {', '.join(QUANTITIES)}")
        return entries

    def corrections(self, value: Any, widths: Mapped[str, int]) -> tuple[Mapping, ...]:
        """Each as a mapping whose log is the flight that the other keys give. widths: columns by quantity."""
        if not isinstance(value, list) or not all(isinstance(lines, dict) for lines in value):
            raise self.fail("corrections", "must be a list of lines of a mapping, such as `- rate: {unit: deg/s}`")
        allowed = ("world", "body", "time", *widths)
        reader = _Reader(self.path, dict.fromkeys(allowed, self.lines.get("corrections", 1)))
        corrections = []
        for lines in value:
            for key, stated in lines.items():
                if key not in allowed:
                    raise self.fail("corrections", f"{key!r}: allowed are {', '.join(allowed)}")
                if key in widths:
                    reader.known(key, stated, ("unit", "scale", "frame", *CORRECTED[key]))
                elif key == "time":
                    reader.known(key, stated, ("unit", "scale"))
            corrections.append(reader.correction(lines, widths))
        return tuple(corrections)

    def correction(self, lines: dict[str, Any], widths: Mapped[str, int]) -> Mapping:
        """Lines as a mapping of which streams in SI, ENU and FLU are the log. widths: columns by quantity."""
        streams = dict(lines)
        streams["time"] = {"column": "t", **lines.get("time", {})}
        for name, width in widths.items():
            streams[name] = {"columns": list(columns_of(name, width)), **lines.get(name, {})}
        return self.mapping(streams)

    def clock(self, key: str, value: Any) -> Clock:
        if value is None:
            raise self.fail(key, "is missing: `time: {column: t, unit: s}`")
        self.known(key, value, ("column", "unit", "scale"))
        if not isinstance(value.get("column"), (str, int)):
            raise self.fail(f"{key}.column", "must name one column")
        factor = unit_factor("time", str(value.get("unit", "s")), self.at(f"{key}.unit"))
        wanted = Numbers((1,), "one positive number", lambda x: x > 0)
        (scale,) = self.numbers(f"{key}.scale", value.get("scale", 1.0), wanted)
        return Clock(str(value["column"]), factor * scale)

    def entry(self, name: str, value: Any, frames: dict[str, np.ndarray]) -> Entry:
        _, dimension, keys = QUANTITIES[name]
        self.known(name, value, (*_ENTRY, *keys))
        columns = self.names(name, value)
        options: dict[str, Any] = {}
        for key, stated in value.items():
            if key in CHOICES:
                options[key] = self.one_of(f"{name}.{key}", stated, CHOICES[key])
            elif key in NUMBERS and stated is not None:
                numbers = self.numbers(f"{name}.{key}", stated, NUMBERS[key])
                options[key] = numbers if len(numbers) > 1 else numbers[0]
        if "time" in value:
            options["clock"] = self.clock(f"{name}.time", value["time"])
        if value.get("layout"):
            options["layout"] = self.layout(name, value["layout"], len(columns))
        low, high = options.get("range", (0.0, 1.0))
        if low == high:
            raise self.fail(f"{name}.range", f"must be {NUMBERS['range'].what}, and these differ")
        turned = self.attitude if dimension == "angle" else self.frame
        options |= turned(name, value, frames)
        if "mounting" in options and not options["in_body"]:
            raise self.fail(f"{name}.mounting", "turns a sensor in the body, but `frame` says world")
        factor = 1.0
        unit = str(value.get("unit", next(iter(UNITS[dimension]))))
        if options.get("order", "rpy") == "rpy":  # a quaternion has no unit
            factor = unit_factor(dimension, unit, self.at(f"{name}.unit"))
        if name == "rotor_speed":
            factor /= self.pole_pairs(unit, options.pop("pole_pairs", None))
        wanted = Numbers((1, len(columns)), "one number, or one a column, and not zero", bool)
        scale = self.numbers(f"{name}.scale", value.get("scale", 1.0), wanted)
        return Entry(columns, factor * np.array(scale, float), **options)

    def pole_pairs(self, unit: str, pairs: float | None) -> float:
        """Turns of the field for one of the rotor, 1 for a unit that counts the rotor's own."""
        if (unit == ELECTRICAL) == (pairs is None):
            text = f"is missing, with unit {unit}" if pairs is None else f"goes with unit {ELECTRICAL}, not {unit}"
            raise self.fail("rotor_speed.pole_pairs", f"{text}: magnets of the motor over two, as `pole_pairs: 7`")
        return pairs or 1

    def names(self, name: str, value: dict[str, Any]) -> tuple[str, ...]:
        stated = value.get("columns", value.get("column"))
        if isinstance(stated, (str, int)) and not isinstance(stated, bool):
            stated = [stated]
        least = most = len(QUANTITIES[name].columns)
        if name in ROTORS:
            most = 32
        elif most == 4:  # a quaternion, or angles
            least = 3
        if not isinstance(stated, list) or len(set(map(str, stated))) < len(stated) or not least <= len(stated) <= most:
            count = f"{least} to {most}" if least < most else str(least)
            raise self.fail(f"{name}.columns", f"must be a list of the log's columns: {count} are needed, each once")
        return tuple(map(str, stated))

    def frame(self, name: str, value: dict[str, Any], frames: dict[str, np.ndarray]) -> dict[str, Any]:
        """axes and in_body of a vector; the body frame is the default of rate and acceleration."""
        key = f"{name}.frame"
        if not QUANTITIES[name].is_vector:
            if "frame" in value:
                raise self.fail(key, "is of no use here: the quantity is no vector")
            return {}
        text = str(value.get("frame", "body" if name in IN_BODY else "world")).strip().lower()
        kind, _, axes = text.partition(" ")
        if text in FRAMES:
            kind = FRAMES[text]
            axes = text
        if kind not in frames:
            allowed = ", ".join(FRAMES).upper()
            example = 'or axes such as "body x -y -z" or "world y x -z"'
            raise self.fail(key, f"{text!r} is not known; allowed: {allowed}, {example}")
        if kind == "body" and name not in (*IN_BODY, "velocity"):
            raise self.fail(key, "must be a world frame")
        return {"axes": axes_matrix(kind, axes, self.at(key)) if axes else frames[kind], "in_body": kind == "body"}

    def attitude(self, name: str, value: dict[str, Any], frames: dict[str, np.ndarray]) -> dict[str, Any]:
        """order, and the axes of world and body."""
        four = len(value.get("columns", ())) == 4
        order = str(value.get("order", "wxyz" if four else "rpy")).lower()
        if not four or sorted(order) != sorted("wxyz"):
            self.one_of(f"{name}.order", order, ("wxyz", "xyzw") if four else ("rpy",))
        if "frame" in value:
            raise self.fail(f"{name}.frame", "give the frames as `world:` and `body:` at the top")
        if np.linalg.det(frames["world"] @ frames["body"]) < 0:
            raise self.fail("body", "of the world and the body frame one is left-handed: no attitude joins them")
        return {"order": order, "axes": frames["body"], "world": frames["world"]}

    def layout(self, name: str, value: Any, count: int) -> tuple[str, ...]:
        if not isinstance(value, list) or len(value) != count or len(set(map(str, value))) != count:
            raise self.fail(f"{name}.layout", f"must be {count} different places, one for every column")
        return tuple(self.one_of(f"{name}.layout", place, PLACES) for place in value)

    def crop(self, value: Any) -> Crop:
        if value in ("auto", "none", False, None):
            return Crop("auto" if value == "auto" else "none")
        self.known("crop", value, ("height", "margin"))
        a_number = Numbers((1,), "a number")
        (margin,) = self.numbers("crop.margin", value.get("margin", 0.0), a_number)
        if value.get("height") is None:
            return Crop("auto", None, float(margin))
        (height,) = self.numbers("crop.height", value["height"], a_number)
        return Crop("height", float(height), float(margin))
