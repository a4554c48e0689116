"""PX4's ULog, read by pyulog: topics of older and newer versions as streams, NED and FRD to ENU and FLU.

The layout is declared by the file, so it is checked before any data is taken in.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, QuadexpError, missing_package
from quadexp.log.store import first_line
from quadexp.physics.state import finite_rows
from quadexp.plugins.logs.importers.quantities import place_of
from quadexp.plugins.logs.importers.raw import RawLog, sorted_stream, turn_attitude, velocity_to_world
from quadexp.plugins.logs.signal import Stream
from quadexp.plugins.logs.units import UNITS, axes_matrix

ABOUT = "PX4"
LARGEST = 4 << 30  # bytes
MOST_DAMAGES = 2000  # places where the reader had to find its way again
MESSAGE = 1 << 16  # bytes a message can have at most
_SIZES = {"int8_t": 1, "uint8_t": 1, "bool": 1, "char": 1, "int16_t": 2, "uint16_t": 2, "int32_t": 4, "uint32_t": 4,
          "float": 4, "int64_t": 8, "uint64_t": 8, "double": 8}  # fmt: skip

Topic = Mapping[str, np.ndarray]  # field -> (k,); arrays are "q[0]", ...
Topics = Mapping[str, Sequence[Topic]]  # name -> instances

NED = axes_matrix("world", "NED", "")
FRD = axes_matrix("body", "FRD", "")
RPM = UNITS["rotor_speed"]["rpm"]
MOST_ROTORS = 12  # of PX4's actuator messages
QUAD_X = ("front_right", "back_left", "front_left", "back_right")


def _fields(source: str) -> tuple[str, list[str]]:
    """The topic of a line of SOURCES, and its fields as pyulog names them."""
    topic, *names = source.split()
    name, array, count = names[0].rstrip("]").partition("[")
    return topic, [f"{name}[{i}]" for i in range(int(count))] if array else names


# Where a quantity stands, best first: the topic, then its fields. "[3]" is an array of three.
_SOURCES = {
    "position": ("vehicle_local_position x y z", "vehicle_odometry position[3]", "vehicle_odometry x y z",
                 "vehicle_local_position_groundtruth x y z"),
    "velocity": ("vehicle_local_position vx vy vz", "vehicle_odometry velocity[3]", "vehicle_odometry vx vy vz",
                 "vehicle_local_position_groundtruth vx vy vz"),
    "attitude": ("vehicle_attitude q[4]", "vehicle_odometry q[4]", "vehicle_attitude_groundtruth q[4]"),
    "rate": ("vehicle_angular_velocity xyz[3]", "vehicle_attitude rollspeed pitchspeed yawspeed",
             "sensor_combined gyro_rad[3]", "vehicle_odometry angular_velocity[3]",
             "vehicle_odometry rollspeed pitchspeed yawspeed", "vehicle_angular_velocity_groundtruth xyz[3]"),
    "acceleration": ("sensor_combined accelerometer_m_s2[3]", "vehicle_acceleration xyz[3]"),
    "battery_voltage": ("battery_status voltage_v", "battery_status voltage_filtered_v"),
    "wind": ("wind windspeed_north windspeed_east", "wind_estimate windspeed_north windspeed_east"),
    "reference_position": ("vehicle_local_position_setpoint x y z",),
    "reference_velocity": ("vehicle_local_position_setpoint vx vy vz",),
}  # fmt: skip
SOURCES = {name: [_fields(source) for source in sources] for name, sources in _SOURCES.items()}
# Signals of the rotors, best first: quantity, topic, field by number. Outputs are pulse widths (us), DShot or 0 to 1.
ROTOR_TOPICS = (
    ("motor_command", "actuator_motors", "control[{}]"),
    ("motor_command", "actuator_outputs", "output[{}]"),
    ("rotor_speed", "esc_status", "esc[{}].esc_rpm"),
)
TOPICS = sorted({topic for topic, _ in chain(*SOURCES.values())} | {topic for _, topic, _ in ROTOR_TOPICS})
# What the estimator itself says of its horizontal and its vertical part.
VALID = {"position": ("xy_valid", "z_valid"), "velocity": ("v_xy_valid", "v_z_valid")}
RESETS = {
    "position": ("xy_reset_counter", "z_reset_counter", "reset_counter"),
    "velocity": ("vxy_reset_counter", "vz_reset_counter", "reset_counter"),
    "attitude": ("quat_reset_counter", "reset_counter"),
}
ROTORS_OF_TYPE = {2: 4, 13: 6, 14: 8, 15: 3}  # MAV_TYPE
# Vehicles whose rotors do not alone carry them, by MAV_TYPE.
OTHER_VEHICLES = {1: "a fixed wing", 10: "a rover", 11: "a boat", 12: "a submarine"}
OTHER_VEHICLES |= dict.fromkeys(range(19, 26), "a VTOL")
MOTION = {"position", "attitude", "velocity", "rate", "acceleration"}
ODOMETRY = "vehicle_odometry"
# What an odometry says of its axes: north, east, down; of any heading ("local"); of the body, of its velocity.
FRAMES = {1: "NED", 2: "local", 3: "body"}
FORMER_FRAMES = {0: "NED", 1: "local", 3: "body"}  # before PX4 1.14, with `local_frame` for `pose_frame`
WORLDS = ("NED", "local")
OF_WORLD = ("position", "velocity", "attitude", "wind", "reference_position", "reference_velocity")


def recognises(path: Path, head: bytes | None) -> bool:
    return (head or b"").startswith(b"ULog\x01\x12\x35")


# ------------------------------------------------------------------------------------------------------------ the file
def read(path: Path, named: str) -> RawLog:
    """Streams of a ULog. Raises DataError where it is damaged beyond use or has no topic of a flight."""
    size = path.stat().st_size
    if size > LARGEST:
        raise DataError(f"{path}: {size / 2**30:.1f} GB; at most {LARGEST >> 30} GB are read: cut the log into pieces")
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            file = _reader(path)(str(path), TOPICS)
    except QuadexpError as error:
        raise DataError(f"{path}: {error}") from None
    except Exception as error:  # pyulog's own have no common ancestor of use, and damage raises what it likes
        raise DataError(f"{path}: not a ULog, or damaged ({type(error).__name__}: {first_line(error)})") from None
    topics: dict[str, list[dict[str, np.ndarray]]] = {}
    for data in sorted(file.data_list, key=lambda instance: instance.multi_id):
        if "timestamp" in data.data and len(data.data["timestamp"]):
            topics.setdefault(data.name, []).append(data.data)
    if not topics:
        raise DataError(f"{path}: a ULog without data of {', '.join(TOPICS[-3:])}: truncated, or no flight was logged")
    parameters = {key: value for key, value in file.initial_parameters.items() if isinstance(value, (int, float))}
    log = read_topics(path, topics, parameters)
    if file.file_corruption or "corruption" in printed.getvalue():
        log.notes.append("the file is damaged in places: what could be read was")
    if file.dropouts:
        lost = sum(dropout.duration for dropout in file.dropouts) / 1000
        log.notes.append(f"{len(file.dropouts)} dropouts of the logger, {lost:.2g} s in all")
    information = file.msg_info_dict
    log.about |= {k: str(information[k]) for k in ("ver_sw_release_str", "sys_name", "ver_hw") if k in information}
    return log


def _reader(path: Path) -> Any:
    """pyulog's class, refusing files that declare messages that cannot be, or that are damaged all over."""
    try:
        from pyulog import ULog
    except ImportError:
        raise missing_package(path, "pyulog", "logs") from None

    class Checked(ULog):
        damages = 0

        def _read_file_definitions(self) -> None:
            super()._read_file_definitions()
            _check_formats({name: message_format.fields for name, message_format in self._message_formats.items()})

        def _check_packet_corruption(self, header: Any) -> bool:
            damaged = super()._check_packet_corruption(header)
            self.damages += damaged
            if self.damages > MOST_DAMAGES:
                raise DataError(f"damaged in more than {MOST_DAMAGES} places")
            return damaged

    return Checked


def _check_formats(formats: dict[str, Any]) -> None:
    """Refuse a message whose declared size no message can have, or that contains itself. Raises DataError."""

    def size(name: str, above: tuple[str, ...]) -> int:
        if name in above:
            raise DataError(f"its format {name!r} contains itself")
        total = 0
        for kind, count, _ in formats[name]:
            if count < 0:
                raise DataError(f"its format {name!r} declares an array of {count}")
            inner = size(kind, (*above, name)) if kind in formats else _SIZES.get(kind, MESSAGE)
            total += inner * max(count, 1)
        if total > MESSAGE:
            raise DataError(f"its format {name!r} declares more than the {MESSAGE} bytes of a message")
        return total

    for name in TOPICS:
        if name in formats:
            size(name, ())


# ---------------------------------------------------------------------------------------------------------- its topics
def read_topics(path: Path, topics: Topics, parameters: Mapping[str, float]) -> RawLog:
    """Streams of one log. parameters: of the vehicle, as logged. Raises DataError where there is neither attitude nor
    motion."""
    log = RawLog("ulog", {}, "px4")
    used: dict[str, str] = {}
    log.about["topics"] = used
    refused: set[str] = set()
    frames: dict[str, str | None] = {}  # of which axes the quantities are
    axes = ""  # of the world, "NED" or "local", by the first quantity that says it
    for name, sources in SOURCES.items():
        for topic, fields in sources:
            instance = _instance(topics, topic, fields)
            if instance is None or name in used or (name in refused and not topic.endswith("groundtruth")):
                continue
            frame = _frame(name, topic, instance, fields)
            if frame is None or (frame in WORLDS and axes not in ("", frame)):
                known = f"of other axes ({frame}) than what goes before" if frame else "it does not say of which axes"
                log.notes.append(f"{name} ({topic}): {known}: left out")
                continue
            instance = _valid(name, topic, instance, log)
            if instance is None:  # then the estimator's other topics have nothing better
                refused.add(name)
                continue
            stream = _stream(path, f"{name} ({topic})", instance, fields, log.notes)
            if stream is None:
                continue
            log.streams[name] = turned(name, stream)
            used[name] = topic
            frames[name] = frame
            axes = frame if frame in WORLDS else axes
    _motors(path, log, topics, parameters, used)
    if not MOTION & used.keys():
        there = ", ".join(sorted(topics)[:10]) or "none"
        wanted = "vehicle_attitude, vehicle_local_position nor sensor_combined"
        raise DataError(f"{path}: neither {wanted}; topics: {there}")
    absent = MOTION - {"velocity"} - used.keys() - refused
    if absent:
        missing = [f"{name} ({SOURCES[name][0][0]})" for name in SOURCES if name in absent]
        log.notes.append(f"topics missing: {', '.join(missing)}")
    kind = OTHER_VEHICLES.get(int(parameters.get("MAV_TYPE", 0)))
    if kind is not None:
        what = "models here are of multirotors, their drag and thrust"
        log.notes.append(f"warning: the log is of {kind} (MAV_TYPE): {what}")
    if axes == "local":
        log.notes.append("the world's axes are those of vehicle_odometry: x and y may have any heading")
    if frames.get("velocity") != "body":
        return log
    if "attitude" in used:  # in FRD, and turned as if it were NED: turned back, into FLU, and into the world
        t, values = log.streams["velocity"]
        log.streams["velocity"] = Stream(t, values @ NED @ FRD.T)
        velocity_to_world(log.streams)
    else:
        log.notes.append("velocity (vehicle_odometry): in the body, whose attitude is not known: left out")
        del log.streams["velocity"], used["velocity"]
    return log


def _frame(name: str, topic: str, instance: Topic, fields: Sequence[str]) -> str | None:
    """Of which axes a quantity is: "NED", "local", "body"; None where it does not say, "" where it is of no axes."""
    if name not in OF_WORLD:
        return ""
    numbers, stated = (FORMER_FRAMES, "local_frame") if "local_frame" in instance else (FRAMES, "pose_frame")
    if name == "velocity":
        stated = "velocity_frame"
    if topic != ODOMETRY or stated not in instance:
        return "NED"
    known = finite_rows(_columns(instance, fields))
    frames = {numbers.get(int(number)) for number in np.asarray(instance[stated])[known]}
    frame = frames.pop() if len(frames) == 1 else None
    return frame if frame in WORLDS or name == "velocity" else None


def _columns(topic: Topic, fields: Sequence[str]) -> np.ndarray:
    return np.column_stack([np.asarray(topic[field], float) for field in fields])


def _instance(topics: Topics, name: str, fields: Sequence[str]) -> Topic | None:
    """The first instance that has the fields, unless another has more than twice its rows."""
    instances = [topic for topic in topics.get(name, []) if all(field in topic for field in fields)]
    if not instances:
        return None
    most = max(instances, key=lambda topic: len(topic["timestamp"]))
    return most if len(most["timestamp"]) > 2 * len(instances[0]["timestamp"]) else instances[0]


def _valid(name: str, source: str, topic: Topic, log: RawLog) -> Topic | None:
    """The rows that the estimator holds to be valid, horizontally and vertically; None where there are none. Its resets
    are added to the log."""
    where = f"{name} ({source})"
    flags = [flag for flag in VALID.get(name, ()) if flag in topic]
    if flags:
        valid = _columns(topic, flags) > 0
        good = valid.all(axis=1)
        if not good.any():
            never = [flag for flag, holds in zip(flags, valid.T, strict=True) if not holds.any()]
            said = " and ".join(never) or "flags"
            log.notes.append(f"{where}: the estimator never had a valid one ({said}): left out")
            return None
        if not good.all():
            log.notes.append(f"{where}: not valid in {int((~good).sum())} of {len(valid)} rows: left out")
            topic = {field: np.asarray(values)[good] for field, values in topic.items()}
    t = _times(topic)
    resets = []
    for counter in RESETS.get(name, ()):
        for row in np.flatnonzero(np.diff(topic.get(counter, ()))):
            resets.append((t[row], t[row + 1]))
    if resets:
        log.notes.append(f"{where}: reset by the estimator {len(resets)} times: a new segment begins there")
    log.resets += resets
    return topic


def _times(topic: Topic) -> np.ndarray:
    """Of the samples, (k,) (s)."""
    stamp = np.asarray(topic.get("timestamp_sample", 0))
    if not (stamp > 0).all():
        stamp = np.asarray(topic["timestamp"])
    return stamp.astype(np.int64) * 1e-6


def _stream(path: Path, name: str, topic: Topic, fields: Sequence[str], notes: list[str]) -> Stream | None:
    """The fields of a topic as one stream at the times of the samples (s); None where they hold no number."""
    t = _times(topic)
    values = _columns(topic, fields)
    if not finite_rows(values).any():
        return None
    back = int((np.diff(np.argsort(t, kind="stable")) < 0).sum())  # times of samples may lie a little out of order
    if back > 0.01 * len(t):
        raise DataError(f"{path}: {name}: its times jump back ({int((np.diff(t) < 0).sum())} times in {len(t)} rows)")
    return sorted_stream(path, name, t, values, notes)


def turned(name: str, stream: Stream) -> Stream:
    """NED to ENU, FRD to FLU."""
    t, values = stream
    if name == "attitude":
        return Stream(t, turn_attitude(values, NED, FRD))
    if name == "wind":
        return Stream(t, np.column_stack([values[:, 1], values[:, 0], np.zeros(len(t))]))
    if name in ("rate", "acceleration"):
        return Stream(t, values @ FRD.T)
    return Stream(t, values @ NED.T if values.shape[1] == 3 else values)


# ---------------------------------------------------------------------------------------------------------- its rotors
def _motors(path: Path, log: RawLog, topics: Topics, parameters: Mapping[str, float], used: dict[str, str]) -> None:
    """Commands and speeds of the rotors, and where they are."""
    most = int(parameters.get("CA_ROTOR_COUNT", 0))
    if not 3 <= most <= MOST_ROTORS:
        most = ROTORS_OF_TYPE.get(int(parameters.get("MAV_TYPE", 0)), MOST_ROTORS)
    for quantity, topic, field in ROTOR_TOPICS:
        # the leading outputs that move, at most so many, of the instance where most do
        moving = [_moving(instance, field, most) for instance in topics.get(topic, [])]
        if quantity in used or max(moving, default=0) < 3:
            continue
        instance = topics[topic][moving.index(max(moving))]
        fields = [field.format(i) for i in range(max(moving))]
        stream = _stream(path, f"{quantity} ({topic})", instance, fields, log.notes)
        if stream is not None:
            used[quantity] = topic
            log.streams[quantity] = Stream(stream.t, _in_si(topic, stream.values, parameters, log))
    counts = [log.streams[name].values.shape[1] for name in ("motor_command", "rotor_speed") if name in used]
    log.layout = _layout(max(counts, default=0), parameters, log.notes)


def _in_si(topic: str, values: np.ndarray, parameters: Mapping[str, float], log: RawLog) -> np.ndarray:
    """Rotor speeds in rad/s, commands as signals from 0 to 1."""
    if topic == "esc_status":
        return RPM * np.abs(values)
    if topic == "actuator_outputs":
        return _pwm(values, parameters, log.notes)
    factor = float(parameters.get("THR_MDL_FAC", 0.0))
    if not 0 < factor <= 1:
        return values
    log.about["thr_mdl_fac"] = factor
    what = f"the signal that THR_MDL_FAC {factor:g} makes of the thrust logged"
    log.notes.append(f"motor_command (actuator_motors): {what}")
    return signal_of_thrust(np.clip(values, 0.0, 1.0), factor)


def signal_of_thrust(thrust: np.ndarray, factor: float) -> np.ndarray:
    """Signal s of a motor from PX4's thrust u = f s^2 + (1 - f) s, f: THR_MDL_FAC."""
    return (np.sqrt((1 - factor) ** 2 + 4 * factor * thrust) - (1 - factor)) / (2 * factor)


def _moving(topic: Topic, field: str, most: int) -> int:
    """How many of the leading outputs of a topic move."""
    for i in range(most):
        values = np.asarray(topic.get(field.format(i), ()), float)
        values = values[np.isfinite(values)]
        if len(values) < 2 or np.ptp(values) == 0:
            return i
    return most


def _layout(count: int, parameters: Mapping[str, float], notes: list[str]) -> tuple[str, ...] | None:
    """Where the motors are: by the control allocation's parameters (FRD), or the order of PX4's quad-x."""
    places = {}
    for i in range(count):
        x = parameters.get(f"CA_ROTOR{i}_PX", 0.0)
        y = parameters.get(f"CA_ROTOR{i}_PY", 0.0)
        places[place_of(x, -y)] = i
    if count and "" not in places and len(places) == count:
        return tuple(places)
    if count == 4:
        notes.append("motors in the order of PX4's quad-x: front right, back left, front left, back right")
        return QUAD_X
    return None


def _pwm(values: np.ndarray, parameters: Mapping[str, float], notes: list[str]) -> np.ndarray:
    """actuator_outputs from 0 to 1: pulse widths (us) between PWM_MIN and PWM_MAX, DShot, or as they are."""
    largest = float(np.percentile(values, 99.9))
    if largest <= 1.5:
        return values
    low = parameters.get("PWM_MAIN_MIN", parameters.get("PWM_MIN", 1000.0))
    high = parameters.get("PWM_MAIN_MAX", parameters.get("PWM_MAX", 2000.0))
    flying = values[values > 0.2 * largest]
    if len(flying) and np.median(flying) < 850:
        low = 0.0
        high = 1999.0
        notes.append("actuator_outputs taken as DShot (0 to 1999)")
    elif low >= high:
        low = 1000.0
        high = 2000.0
    return np.where(values < low, 0.0, (values - low) / (high - low))
