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

Every key may be left out but `time`. corrections: made one after the other on what the other keys give,
each as if that were a log in SI units, ENU and FLU of which its lines are the mapping. mounting: roll, pitch and yaw
(deg) of the sensor in the body, after `frame`: v_body = R_z(yaw) R_y(pitch) R_x(roll) v_sensor. Every value is checked;
errors name file, line and key.
"""

from __future__ import annotations

import math
from collections.abc import Mapping as Mapped
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import UsageError
from quadexp.log.importers.raw import QUANTITIES, ROTORS, Crop, columns_of
from quadexp.log.units import (
    BODY_FRAMES,
    ELECTRICAL,
    UNITS,
    WORLD_FRAMES,
    axes_matrix,
    is_rotation,
    mounting_matrix,
    unit_factor,
)
from quadexp.messages import suggestion
from quadexp.parts.plain_data import read_data

# Where the places of a rotor are, as signs of x and y in FLU.
PLACES = {
    "front_right": (1, -1), "back_right": (-1, -1), "back_left": (-1, 1), "front_left": (1, 1),
    "front": (1, 0), "right": (0, -1), "back": (-1, 0), "left": (0, 1),
}  # fmt: skip
DIRECTIONS = ("body_to_world", "world_to_body")
KINDS = ("specific_force", "coordinate")
_TOP = ("name", "about", "format", "signature", "world", "body", "time", "crop", "corrections", *QUANTITIES)
_ENTRY = ("column", "columns", "unit", "scale", "frame", "time")
_OWN = {
    "attitude": ("order", "direction"),
    "reference_attitude": ("order", "direction"),
    "rate": ("mounting",),
    "acceleration": ("kind", "mounting"),
    "motor_command": ("range", "layout"),
    "rotor_speed": ("layout", "pole_pairs"),
    "rotor_thrust": ("layout",),
}
_DIMENSION = {
    "position": "length", "velocity": "velocity", "rate": "rate", "acceleration": "acceleration",
    "rotor_speed": "rotor_speed", "rotor_thrust": "force", "thrust_acceleration": "acceleration",
    "battery_voltage": "voltage", "wind": "velocity", "reference_position": "length",
    "reference_velocity": "velocity", "motor_command": "none",
}  # fmt: skip


@dataclass(frozen=True)
class Clock:
    """column, and factor to seconds."""

    column: str
    factor: float


@dataclass(frozen=True)
class Entry:
    """One quantity. factor: to SI (times `scale`). axes: (3, 3) to ENU or FLU. in_body: whether that is FLU.

    order: of a quaternion's columns, or "rpy" for angles. inverse: the log's attitude turns world into body vectors.
    coordinate: the acceleration is that of the motion, without gravity. low, high: values of commands 0 and 1.
    """

    columns: tuple[str, ...]
    factor: np.ndarray
    axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    in_body: bool = False
    clock: Clock | None = None
    order: str = "wxyz"
    inverse: bool = False
    world: np.ndarray = field(default_factory=lambda: np.eye(3))
    coordinate: bool = False
    low: float = 0.0
    high: float = 1.0
    mounting: np.ndarray = field(default_factory=lambda: np.eye(3))


@dataclass(frozen=True)
class Mapping:
    """name, the kind of file ("text" or "hdf5"), its clock, an entry for every quantity it has, and corrections."""

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
        values = read_data(path)
        root = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except FileNotFoundError:
        raise UsageError(f"{path}: no such mapping") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: cannot be read ({error})") from None
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        raise UsageError(f"{path}{line}: not YAML ({getattr(error, 'problem', None) or error})") from None
    if not isinstance(values, dict):
        raise UsageError(f"{path}: not a mapping: `time: {{column: ..., unit: s}}` and such lines are needed")
    return _Reader(path, _lines(root)).mapping(values)


def correction(lines: dict[str, Any], widths: Mapped[str, int]) -> Mapping:
    """Lines of `corrections` as a mapping. widths: columns by quantity, of the streams that they mend."""
    return _Reader(Path("correction"), {}).correction(lines, widths)


def _lines(node: Any, prefix: str = "") -> dict[str, int]:
    """Dotted key -> line."""
    import yaml

    found: dict[str, int] = {}
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            name = f"{prefix}{key.value}"
            found[name] = key.start_mark.line + 1
            found |= _lines(value, f"{name}.")
    return found


class _Reader:
    """Checks the values of one file; `lines` says where a key stands."""

    def __init__(self, path: Path, lines: Mapped[str, int]) -> None:
        self.path, self.lines = path, lines

    def fail(self, key: str, text: str) -> UsageError:
        parts = key.split(".")
        line = next((self.lines[k] for n in range(len(parts), 0, -1) if (k := ".".join(parts[:n])) in self.lines), 1)
        return UsageError(f"{self.path}:{line}: {key}: {text}")

    def at(self, key: str) -> str:
        return str(self.fail(key, "")).removesuffix(": ")

    def mapping(self, values: dict[str, Any]) -> Mapping:
        for key in values:
            if key not in _TOP:
                raise self.fail(str(key), f"unknown key{suggestion(str(key), _TOP)}; allowed are {', '.join(_TOP)}")
        form = values.get("format", "text")
        if form not in ("text", "hdf5"):
            raise self.fail("format", f"{form!r} is not known; allowed are text, hdf5")
        if "time" not in values:
            raise self.fail("time", "is missing: `time: {column: t, unit: s}`")
        frames = {
            "world": self.axes("world", values.get("world", "ENU")),
            "body": self.axes("body", values.get("body", "FLU")),
        }
        entries = {name: self.entry(name, values[name], frames) for name in QUANTITIES if values.get(name) is not None}
        if not entries:
            raise self.fail("time", f"a clock alone is no flight: give at least one of {', '.join(QUANTITIES)}")
        layouts = {tuple(lay) for name in ROTORS if (lay := (values.get(name) or {}).get("layout"))}
        if len(layouts) > 1:
            raise self.fail("layout", "two quantities with different layouts: one log has one order of motors")
        signature = values.get("signature") or []
        return Mapping(
            str(values.get("name", self.path.stem)), form, self.clock("time", values["time"]), entries,
            next(iter(layouts), None), self.crop(values.get("crop", "auto")), tuple(map(str, signature)),
            self.corrections(values.get("corrections") or [], entries),
        )  # fmt: skip

    def corrections(self, value: Any, entries: dict[str, Entry]) -> tuple[Mapping, ...]:
        """Each as a mapping whose log is the flight that the other keys give."""
        if not isinstance(value, list) or not all(isinstance(one, dict) for one in value):
            raise self.fail("corrections", "must be a list of lines of a mapping, such as `- rate: {unit: deg/s}`")
        allowed = ("world", "body", "time", *entries)
        reader = _Reader(self.path, dict.fromkeys(allowed, self.lines.get("corrections", 1)))
        made = []
        for one in value:
            for key, lines in one.items():
                if key not in allowed:
                    raise self.fail("corrections", f"{key!r}: allowed are {', '.join(allowed)}")
                if key not in ("world", "body"):
                    own = [name for name in _OWN.get(key, ()) if name != "layout"]
                    reader.known(key, lines, ("unit", "scale", *(["frame"] if key != "time" else []), *own))
            made.append(reader.correction(one, {name: len(entry.columns) for name, entry in entries.items()}))
        return tuple(made)

    def correction(self, lines: dict[str, Any], widths: Mapped[str, int]) -> Mapping:
        """Lines as a mapping of which streams in SI, ENU and FLU are the log. widths: columns by quantity."""
        streams = {name: {"columns": list(columns_of(name, n)), **lines.get(name, {})} for name, n in widths.items()}
        return self.mapping({**lines, **streams, "time": {"column": "t", **lines.get("time", {})}})

    def axes(self, kind: str, frame: Any, key: str = "") -> np.ndarray:
        return axes_matrix(kind, frame, self.at(key or kind))

    def clock(self, key: str, value: Any) -> Clock:
        self.known(key, value, ("column", "unit", "scale"))
        if not isinstance(value.get("column"), (str, int)):
            raise self.fail(f"{key}.column", "must name one column")
        factor = unit_factor("time", str(value.get("unit", "s")), self.at(f"{key}.unit"))
        scale = value.get("scale", 1.0)
        if isinstance(scale, list) or not self.numbers(f"{key}.scale", scale) > 0:
            raise self.fail(f"{key}.scale", f"{scale!r} must be one positive number")
        return Clock(str(value["column"]), factor * scale)

    def known(self, key: str, value: Any, allowed: tuple[str, ...]) -> None:
        if not isinstance(value, dict):
            raise self.fail(key, f"must be a mapping {{{', '.join(allowed)}}}")
        for name in value:
            if name not in allowed:
                raise self.fail(f"{key}.{name}", f"unknown key; allowed are {', '.join(allowed)}")

    def entry(self, name: str, value: Any, frames: dict[str, np.ndarray]) -> Entry:
        self.known(name, value, (*_ENTRY, *_OWN.get(name, ())))
        columns = self.names(name, value)
        options: dict[str, Any] = {"clock": self.clock(f"{name}.time", value["time"]) if "time" in value else None}
        if name.endswith("attitude"):
            options |= self.attitude(name, value, columns, frames)
            factor = options.pop("unit")
        else:
            dimension = _DIMENSION[name]
            unit = str(value.get("unit", next(iter(UNITS[dimension]))))
            factor = unit_factor(dimension, unit, self.at(f"{name}.unit"))
            options |= self.frame(name, value, frames)
            if name == "rotor_speed":
                factor /= self.pole_pairs(unit, value.get("pole_pairs"))
        if name == "acceleration":
            kind = value.get("kind", "specific_force")
            if kind not in KINDS:
                raise self.fail(f"{name}.kind", f"{kind!r} is not known; allowed are {', '.join(KINDS)}")
            options["coordinate"] = kind == "coordinate"
        if value.get("mounting") is not None:
            if not options["in_body"]:
                raise self.fail(f"{name}.mounting", "turns a sensor in the body, but `frame` says world")
            options["mounting"] = self.mounting(f"{name}.mounting", value["mounting"])
        if name == "motor_command":
            options |= self.range(value.get("range", [0, 1]))
        if name in ROTORS and value.get("layout"):
            self.layout(name, value["layout"], len(columns))
        scale = np.atleast_1d(np.asarray(self.numbers(f"{name}.scale", value.get("scale", 1.0)), float))
        if len(scale) not in (1, len(columns)) or not scale.all():
            raise self.fail(f"{name}.scale", "must be one number, or one a column, and not zero")
        return Entry(columns, factor * scale, **options)

    def mounting(self, key: str, value: Any) -> np.ndarray:
        if not isinstance(value, list) or len(value) != 3:
            raise self.fail(key, f"{value!r} must be [roll, pitch, yaw] of the sensor in the body (deg)")
        return mounting_matrix(self.numbers(key, value))

    def pole_pairs(self, unit: str, value: Any) -> float:
        """Turns of the field for one of the rotor, 1 for a unit that counts the rotor's own."""
        if unit not in ELECTRICAL:
            if value is not None:
                raise self.fail("rotor_speed.pole_pairs", f"goes with unit {' or '.join(ELECTRICAL)}, not {unit}")
            return 1.0
        if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= 100:
            what = "is missing" if value is None else f"{value!r} must be a whole number from 1 to 100"
            raise self.fail("rotor_speed.pole_pairs", f"{what}: magnets of the motor over two, as `pole_pairs: 7`")
        return float(value)

    def names(self, name: str, value: dict[str, Any]) -> tuple[str, ...]:
        given = value.get("columns", value.get("column"))
        if isinstance(given, (str, int)) and not isinstance(given, bool):
            given = [given]
        if not isinstance(given, list) or not given:
            raise self.fail(f"{name}.columns", "must be a list of the log's columns")
        widths = (3, 4) if name.endswith("attitude") else range(1, 33) if name in ROTORS else (len(QUANTITIES[name]),)
        if len(given) not in widths:
            count = " or ".join(map(str, widths)) if name not in ROTORS else "1 to 32"
            raise self.fail(f"{name}.columns", f"{len(given)} columns are given, {count} are needed")
        if len(set(map(str, given))) < len(given):
            raise self.fail(f"{name}.columns", "one column is given twice")
        return tuple(map(str, given))

    def numbers(self, key: str, value: Any) -> Any:
        items = value if isinstance(value, list) else [value]
        if not all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in items):
            raise self.fail(key, f"{value!r} is not a number")
        return value

    def frame(self, name: str, value: dict[str, Any], frames: dict[str, np.ndarray]) -> dict[str, Any]:
        """axes and in_body of a vector; the body frame is the default of rate and acceleration."""
        if len(QUANTITIES[name]) != 3:
            if "frame" in value:
                raise self.fail(f"{name}.frame", "is of no use here: the quantity is no vector")
            return {}
        text = str(value.get("frame", "body" if name in ("rate", "acceleration") else "world")).strip().lower()
        kind, _, axes = text.partition(" ")
        if kind in ("world", "body"):
            return {"axes": self.axes(kind, axes, f"{name}.frame") if axes else frames[kind], "in_body": kind == "body"}
        if text in WORLD_FRAMES or text in BODY_FRAMES:
            kind = "world" if text in WORLD_FRAMES else "body"
            made = {"axes": self.axes(kind, text, f"{name}.frame"), "in_body": kind == "body"}
        else:
            raise self.fail(
                f"{name}.frame", f"{text!r} is not known; allowed: {', '.join([*WORLD_FRAMES, *BODY_FRAMES]).upper()},"
                ' or axes such as "body x -y -z" or "world y x -z"'
            )  # fmt: skip
        if made["in_body"] and name in ("position", "wind", "reference_position", "reference_velocity"):
            raise self.fail(f"{name}.frame", "must be a world frame")
        return made

    def attitude(
        self, name: str, value: dict[str, Any], columns: tuple[str, ...], frames: dict[str, Any]
    ) -> dict[str, Any]:
        order = str(value.get("order", "wxyz" if len(columns) == 4 else "rpy")).lower()
        allowed = ("wxyz", "xyzw") if len(columns) == 4 else ("rpy",)
        if order not in allowed and not (len(columns) == 4 and sorted(order) == sorted("wxyz")):
            raise self.fail(f"{name}.order", f"{order!r} is not known; allowed are {', '.join(allowed)}")
        direction = str(value.get("direction", DIRECTIONS[0]))
        if direction not in DIRECTIONS:
            raise self.fail(f"{name}.direction", f"{direction!r} is not known; allowed are {', '.join(DIRECTIONS)}")
        if "frame" in value:
            raise self.fail(f"{name}.frame", "give the frames as `world:` and `body:` at the top")
        if not is_rotation(frames["world"] @ frames["body"]):
            raise self.fail("body", "of the world and the body frame one is left-handed: no attitude joins them")
        unit = unit_factor("angle", str(value.get("unit", "rad")), self.at(f"{name}.unit")) if order == "rpy" else 1.0
        return {
            "order": order, "inverse": direction == DIRECTIONS[1], "unit": unit,
            "axes": frames["body"], "world": frames["world"],
        }  # fmt: skip

    def range(self, value: Any) -> dict[str, float]:
        if not isinstance(value, list) or len(value) != 2 or value[0] == value[1]:
            raise self.fail("motor_command.range", "must be [value of command 0, value of command 1]")
        low, high = self.numbers("motor_command.range", value)
        return {"low": float(low), "high": float(high)}

    def layout(self, name: str, value: Any, count: int) -> None:
        if not isinstance(value, list) or len(value) != count or len(set(map(str, value))) != count:
            raise self.fail(f"{name}.layout", f"must be {count} different places, one for every column")
        for place in value:
            if place not in PLACES:
                raise self.fail(f"{name}.layout", f"{place!r} is not known; allowed are {', '.join(PLACES)}")

    def crop(self, value: Any) -> Crop:
        if value in ("auto", "none", False, None):
            return Crop("auto" if value == "auto" else "none")
        self.known("crop", value, ("height", "margin"))
        height, margin = value.get("height"), value.get("margin", 0.0)
        self.numbers("crop.margin", margin)
        if height is None:
            return Crop("auto", None, float(margin))
        return Crop("height", float(self.numbers("crop.height", height)), float(margin))
