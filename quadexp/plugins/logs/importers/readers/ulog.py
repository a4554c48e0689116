"""PX4's ULog, read by pyulog: topics of older and newer versions as streams, NED and FRD to ENU and FLU.

The layout is declared by the file, so it is checked before any data is taken in.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, QuadexpError, missing_package
from quadexp.log.store import first_line
from quadexp.physics.state import finite_rows
from quadexp.plugins.logs.importers.raw import RawLog, sorted_stream, turn_attitude, with_attitude
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

NED, FRD = axes_matrix("world", "NED", ""), axes_matrix("body", "FRD", "")
RPM = UNITS["rotor_speed"]["rpm"]
MOST_ROTORS = 12  # of PX4's actuator messages
QUAD_X = ("front_right", "back_left", "front_left", "back_right")
# Where a quantity stands, best first: the topic, then its fields. "[3]" is an array of three.
SOURCES: dict[str, tuple[str, ...]] = {
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
# Signals of the rotors, best first: quantity, topic, field by number. Outputs are pulse widths (us), DShot or 0 to 1.
ROTOR_TOPICS = (
    ("motor_command", "actuator_motors", "control[{}]"),
    ("motor_command", "actuator_outputs", "output[{}]"),
    ("rotor_speed", "esc_status", "esc[{}].esc_rpm"),
)
TOPICS = sorted({source.split()[0] for sources in SOURCES.values() for source in sources}
                | {topic for _, topic, _ in ROTOR_TOPICS})  # fmt: skip
# What the estimator itself says of its horizontal and its vertical part.
VALID = {"position": ("xy_valid", "z_valid"), "velocity": ("v_xy_valid", "v_z_valid")}
RESETS = {
    "position": ("xy_reset_counter", "z_reset_counter", "reset_counter"),
    "velocity": ("vxy_reset_counter", "vz_reset_counter", "reset_counter"),
    "attitude": ("quat_reset_counter", "reset_counter"),
}
ROTORS_OF_TYPE = {2: 4, 13: 6, 14: 8, 15: 3}  # MAV_TYPE
# Vehicles whose rotors do not alone carry them, by MAV_TYPE.
OTHER_VEHICLES = {
    1: "a fixed wing",
    10: "a rover",
    11: "a boat",
    12: "a submarine",
    **dict.fromkeys(range(19, 26), "a VTOL"),
}
ODOMETRY = "vehicle_odometry"
# What an odometry says of its axes: north, east, down; of any heading ("local"); of the body, of its velocity. Before
# PX4 1.14 with other numbers, and `local_frame` for `pose_frame`.
FRAMES, FORMER_FRAMES = {1: "NED", 2: "local", 3: "body"}, {0: "NED", 1: "local", 3: "body"}
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
            inner = _SIZES.get(kind) or (size(kind, (*above, name)) if kind in formats else MESSAGE)
            total += inner * max(count, 1)
            if total > MESSAGE:
                raise DataError(f"its format {name!r} declares more than the {MESSAGE} bytes of a message")
        return total

    for name in formats:
        if name in TOPICS:
            size(name, ())


# ---------------------------------------------------------------------------------------------------------- its topics
def read_topics(path: Path, topics: Topics, parameters: Mapping[str, float]) -> RawLog:
    """Streams of one log. parameters: of the vehicle, as logged. Raises DataError where there is neither attitude nor
    motion."""
    log = RawLog("ulog", {}, "px4")
    used: dict[str, str] = {}
    refused: set[str] = set()
    axes: str | None = None  # of the world, "NED" or "local"
    body_velocity = False
    for name, sources in SOURCES.items():
        for source in sources:
            topic, fields = _fields(source)
            instance = _instance(topics, topic, fields)
            if instance is None or (name in refused and not topic.endswith("groundtruth")):
                continue
            frame = _frame(name, topic, instance, fields)
            if frame not in ("", "body", axes or frame or "NED"):
                known = f"of other axes ({frame}) than what goes before" if frame else "it does not say of which axes"
                log.notes.append(f"{name} ({topic}): {known}: left out")
                continue
            instance = _valid(name, topic, instance, log)
            if instance is None:  # then the estimator's other topics have nothing better
                refused.add(name)
                continue
            stream = _stream(path, f"{name} ({topic})", instance, fields, log.notes)
            if stream is not None:
                log.streams[name], used[name] = turned(name, stream), topic
                body_velocity |= frame == "body"
                if frame in ("NED", "local"):
                    axes = frame
                break
    _motors(path, log, topics, parameters, used)
    if not {"position", "attitude", "velocity", "rate", "acceleration"} & set(log.streams):
        there = ", ".join(sorted(topics)[:10]) or "none"
        wanted = "vehicle_attitude, vehicle_local_position nor sensor_combined"
        raise DataError(f"{path}: neither {wanted}; topics: {there}")
    absent = {"position", "attitude", "rate", "acceleration"} - used.keys() - refused
    if missing := [f"{name} ({sources[0].split()[0]})" for name, sources in SOURCES.items() if name in absent]:
        log.notes.append(f"topics missing: {', '.join(missing)}")
    kind = OTHER_VEHICLES.get(int(parameters.get("MAV_TYPE", 0)))
    if kind is not None:
        log.notes.append(
            f"warning: the log is of {kind} (MAV_TYPE): models here are of multirotors, their drag and thrust"
        )
    if axes == "local":
        log.notes.append("the world's axes are those of vehicle_odometry: x and y may have any heading")
    if body_velocity and "attitude" in used:
        # in FRD, and turned as if it were NED: turned back, into FLU, and by the attitude into the world
        stream, R = with_attitude(log.streams, "velocity")
        log.streams["velocity"] = Stream(stream.t, R.apply(stream.values @ NED @ FRD.T))
    elif body_velocity:
        log.notes.append("velocity (vehicle_odometry): in the body, whose attitude is not known: left out")
        del log.streams["velocity"], used["velocity"]
    log.about["topics"] = used
    return log


def _frame(name: str, topic: str, instance: Topic, fields: Sequence[str]) -> str | None:
    """Of which axes a quantity is: "NED", "local", "body"; None where it does not say, "" where it is of no axes."""
    if name not in OF_WORLD or topic != ODOMETRY:
        return "NED" if name in OF_WORLD else ""
    former = "local_frame" in instance
    stated = "velocity_frame" if name == "velocity" else "local_frame" if former else "pose_frame"
    if stated not in instance:
        return "NED"
    known = np.isfinite(np.stack([np.asarray(instance[field], float) for field in fields])).all(axis=0)
    frames = {(FORMER_FRAMES if former else FRAMES).get(int(number)) for number in np.asarray(instance[stated])[known]}
    frame = frames.pop() if len(frames) == 1 else None
    return None if frame == "body" and name != "velocity" else frame


def _fields(source: str) -> tuple[str, list[str]]:
    """The topic of a line of SOURCES, and its fields as pyulog names them."""
    topic, *names = source.split()
    if names[0].endswith("]"):
        name, _, count = names[0].rstrip("]").partition("[")
        return topic, [f"{name}[{i}]" for i in range(int(count))]
    return topic, names


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
    notes = log.notes
    flags = {flag: np.asarray(topic[flag]) > 0 for flag in VALID.get(name, ()) if flag in topic}
    good = np.logical_and.reduce(list(flags.values())) if flags else np.ones(1, bool)
    if not good.any():
        where = " and ".join(flag for flag, holds in flags.items() if not holds.any())
        notes.append(f"{name} ({source}): the estimator never had a valid one ({where or 'flags'}): left out")
        return None
    if not good.all():
        notes.append(f"{name} ({source}): not valid in {int((~good).sum())} of {len(good)} rows: left out")
        topic = {field: np.asarray(values)[good] for field, values in topic.items()}
    counters = [np.asarray(topic[field]) for field in RESETS.get(name, ()) if field in topic]
    t = _times(topic)
    resets = [(t[k], t[k + 1]) for counter in counters for k in np.flatnonzero(np.diff(counter))]
    if resets:
        notes.append(f"{name} ({source}): reset by the estimator {len(resets)} times: a new segment begins there")
    log.resets += resets
    return topic


def _times(topic: Topic) -> np.ndarray:
    """Of the samples, (k,) (s)."""
    sampled = topic.get("timestamp_sample")
    stamp = sampled if sampled is not None and (np.asarray(sampled) > 0).all() else topic["timestamp"]
    return np.asarray(stamp).astype(np.int64) * 1e-6


def _stream(path: Path, name: str, topic: Topic, fields: Sequence[str], notes: list[str]) -> Stream | None:
    """The fields of a topic as one stream at the times of the samples (s); None where they hold no number."""
    t, values = _times(topic), np.stack([np.asarray(topic[f], float) for f in fields], 1)
    if not finite_rows(values).any():
        return None
    order = np.argsort(t, kind="stable")  # the sample's times of one topic may lie a little out of order
    if (np.diff(order) < 0).sum() > 0.01 * len(order):
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
        if quantity in used:
            continue
        # the leading outputs that move, at most so many, of the instance where most do
        counted = [(_moving(instance, field, most), instance) for instance in topics.get(topic, [])]
        count, instance = max(counted, key=lambda pair: pair[0], default=(0, {}))
        fields = [field.format(i) for i in range(count)]
        stream = _stream(path, f"{quantity} ({topic})", instance, fields, log.notes) if count >= 3 else None
        if stream is not None:
            log.streams[quantity], used[quantity] = stream, topic
    factor = float(parameters.get("THR_MDL_FAC", 0.0))
    if used.get("motor_command") == "actuator_motors" and 0 < factor <= 1:
        t, thrust = log.streams["motor_command"]
        log.streams["motor_command"] = Stream(t, signal_of_thrust(np.clip(thrust, 0.0, 1.0), factor))
        log.about["thr_mdl_fac"] = factor
        log.notes.append(
            f"motor_command (actuator_motors): the signal that THR_MDL_FAC {factor:g} makes of the thrust logged"
        )
    if used.get("motor_command") == "actuator_outputs":
        log.streams["motor_command"] = _pwm(log.streams["motor_command"], parameters, log.notes)
    if "rotor_speed" in used:
        t, values = log.streams["rotor_speed"]
        log.streams["rotor_speed"] = Stream(t, RPM * np.abs(values))
    counts = [log.streams[name].values.shape[1] for name in ("motor_command", "rotor_speed") if name in used]
    log.layout = _layout(max(counts, default=0), parameters, log.notes)


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
    places = []
    for i in range(count):
        x, y = parameters.get(f"CA_ROTOR{i}_PX"), parameters.get(f"CA_ROTOR{i}_PY")
        if x is None or y is None or not (x or y):
            break
        reach = 0.2 * max(abs(x), abs(y))
        words = ["front" if x > 0 else "back"] if abs(x) > reach else []
        words += ["right" if y > 0 else "left"] if abs(y) > reach else []
        places.append("_".join(words))
    if count and len(set(places)) == len(places) == count:
        return tuple(places)
    if count == 4:
        notes.append("motors in the order of PX4's quad-x: front right, back left, front left, back right")
        return QUAD_X
    return None


def _pwm(stream: Stream, parameters: Mapping[str, float], notes: list[str]) -> Stream:
    """actuator_outputs from 0 to 1: pulse widths (us) between PWM_MIN and PWM_MAX, DShot, or as they are."""
    t, values = stream
    largest = float(np.percentile(values, 99.9))
    if largest <= 1.5:
        return stream
    low = parameters.get("PWM_MAIN_MIN", parameters.get("PWM_MIN", 1000.0))
    high = parameters.get("PWM_MAIN_MAX", parameters.get("PWM_MAX", 2000.0))
    flying = values[values > 0.2 * largest]
    if len(flying) and np.median(flying) < 850:
        low, high = 0.0, 1999.0
        notes.append("actuator_outputs taken as DShot (0 to 1999)")
    elif low >= high:
        low, high = 1000.0, 2000.0
    return Stream(t, np.where(values < low, 0.0, (values - low) / (high - low)))
