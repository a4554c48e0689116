"""Betaflight's blackbox log (.bbl, .bfl), decoded by orangebox: the numbers as the firmware writes them, to SI and FLU.
https://betaflight.com/docs/development/Blackbox-Internals

    time                us
    gyroADC[i]          gyro_scale of the header times deg/s: roll, pitch, yaw about x forward, y left, z up
    accSmooth[i]        1/acc_1G of g
    motor[i]            from motorOutput[0] (stopped) to motorOutput[1] (full)
    eRPM[i]             hundreds of electrical turns a minute; motor_poles of the header over two is the pole pairs
    vbatLatest          0.01 V (since 4.0)
    imuQuaternion[i]    x, y, z of body to world times 2^15 - 1, w positive (since 4.5); the world's x where the
                        heading is zero, z up

Motors of frame X: back right, front right, back left, front left.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.log.store import first_line
from quadexp.physics.rotation import continuous
from quadexp.plugins.logs.importers.quantities import ROTORS
from quadexp.plugins.logs.importers.raw import RawLog, sorted_stream
from quadexp.plugins.logs.units import STANDARD_GRAVITY, UNITS

ABOUT = "Betaflight; needs [betaflight]"
HEAD = b"H Product:Blackbox"
QUAD_X = ("back_right", "front_right", "back_left", "front_left")
QUATERNION_SCALE = 2**15 - 1  # 16 bits with sign
MOST_COLUMNS = 8  # of a field: motors
USUAL_POLES = 14  # Betaflight's own default
USUAL_OUTPUT = (1000.0, 2000.0)  # DShot and PWM, the least and the largest (us)

Numbers = dict[str, np.ndarray]  # field of the log -> values, (k,)


def recognises(path: Path, head: bytes | None) -> bool:
    return (head or b"").startswith(HEAD)


def read(path: Path, named: str) -> RawLog:
    """Streams of the longest log of a file. Raises DataError where orangebox is missing, the file is damaged, or has
    neither gyro nor accelerometer."""
    notes: list[str] = []
    header, fields = decoded(path, notes)
    log = RawLog("betaflight", {}, "betaflight", notes=notes)
    t = fields.get("time", np.zeros(0)) * UNITS["time"]["us"]
    if len(t) < 2:
        raise DataError(f"{path}: {len(t)} frames of flight data")
    for name, values in quantities(header, fields).items():
        log.streams[name] = sorted_stream(path, name, t, values, notes)
    if not {"rate", "acceleration"} & log.streams.keys():
        raise DataError(f"{path}: has neither gyroADC nor accSmooth: nothing that shows the motion was logged")
    if "motor_command" in log.streams and log.streams["motor_command"].values.shape[1] == len(QUAD_X):
        log.layout = QUAD_X
    return log


def decoded(path: Path, notes: list[str]) -> tuple[dict[str, Any], Numbers]:
    """The header and the fields of the longest log of a file."""
    try:
        from orangebox import Parser
    except ImportError:
        text = "install `quadexp[betaflight]` to read it, or make a table of it: `blackbox_decode LOG.BBL`"
        raise DataError(f"{path}: Betaflight's log: {text}") from None
    try:
        parser = Parser.load(str(path), allow_invalid_header=True)
        count = parser.reader.log_count
        if count > 1:
            ends = [*parser.reader.log_pointers[1:], path.stat().st_size]
            sizes = np.subtract(ends, parser.reader.log_pointers)
            longest = int(np.argmax(sizes)) + 1
            notes.append(f"{count} logs in one file: the longest, number {longest}, is read")
            parser.set_log_index(longest)
        names = list(parser.field_names)
        rows = [frame.data[: len(names)] for frame in parser.frames() if frame.type.value in "IP"]
        header = dict(parser.headers)
    except Exception as error:  # damage raises what it likes
        cause = f"{type(error).__name__}: {first_line(error)}"
        raise DataError(f"{path}: damaged ({cause}); `blackbox_decode LOG.BBL` may make a table of the rest") from None
    wanted = ("time", "gyroADC", "accSmooth", "motor[", "eRPM", "vbatLatest", "imuQuaternion")
    fields: Numbers = {}
    for place, name in enumerate(names):
        if name.startswith(wanted):
            fields.setdefault(name, np.array([_number(row, place) for row in rows], float))
    return header, fields


def _number(row: tuple[Any, ...], place: int) -> float:
    """NaN where a frame has no such field, or text in it."""
    value = row[place] if place < len(row) else None
    return float(value) if isinstance(value, (int, float)) else np.nan


def quantities(header: dict[str, Any], fields: Numbers) -> Numbers:
    """Quantity of an import -> values (k, m) in SI and FLU."""
    low, high = _output(header)
    pole_pairs = float(header.get("motor_poles", USUAL_POLES)) / 2
    result: Numbers = {}
    for quantity, field, zero, scale in (
        ("rate", "gyroADC", 0.0, _scale(header.get("gyro_scale", 1.0)) * UNITS["rate"]["deg/s"]),
        ("acceleration", "accSmooth", 0.0, STANDARD_GRAVITY / float(header.get("acc_1G", 2048))),
        ("attitude", "imuQuaternion", 0.0, 1 / QUATERNION_SCALE),
        ("motor_command", "motor", low, 1 / (high - low) if high != low else np.nan),
        ("rotor_speed", "eRPM", 0.0, 100.0 / pole_pairs * UNITS["rotor_speed"]["rpm"]),
    ):
        columns = [fields[f"{field}[{i}]"] for i in range(MOST_COLUMNS) if f"{field}[{i}]" in fields]
        if len(columns) == 3 or (columns and quantity in ROTORS):
            result[quantity] = (np.column_stack(columns) - zero) * scale
    if "attitude" in result:
        vector = result["attitude"]
        square = 1.0 - np.sum(vector**2, axis=1)
        scalar = np.sqrt(np.maximum(square, 0.0))
        result["attitude"] = continuous(np.column_stack([scalar, vector]))
    if not np.nanmax(result.get("rotor_speed", 0.0), initial=0.0) > 0:  # no telemetry
        result.pop("rotor_speed", None)
    if "vbatLatest" in fields:
        result["battery_voltage"] = fields["vbatLatest"][:, None] * UNITS["voltage"]["cV"]
    return result


def _scale(value: Any) -> float:
    """A number, or the bits of a 32-bit float: in hexadecimal digits, as Betaflight writes it, or as a whole number."""
    hexadecimal = isinstance(value, str) and value.lower().startswith("0x")
    bits = int(value, 16) if hexadecimal else value
    if hexadecimal or (isinstance(bits, int) and bits > 10_000):
        return float(np.uint32(bits).view(np.float32))
    return float(value)


def _output(header: dict[str, Any]) -> tuple[float, float]:
    """Values of `motor` at a stop and at full command."""
    output = header.get("motorOutput")
    if isinstance(output, list) and len(output) == 2:
        return float(output[0]), float(output[1])
    low, high = USUAL_OUTPUT
    return float(header.get("minthrottle", low)), float(header.get("maxthrottle", high))
