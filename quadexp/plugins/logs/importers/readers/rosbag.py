"""ROS 1 and ROS 2 bags, read by rosbags. Messages are chosen by type; the topic's name only breaks ties.

    nav_msgs/Odometry                  position, attitude (world), velocity and rate (child frame: body, REP 147)
    geometry_msgs/PoseStamped, TransformStamped (Vicon), PoseWithCovarianceStamped
    geometry_msgs/TwistStamped         velocity, rate   (body where the frame is a body's, else world)
    sensor_msgs/Imu                    rate, specific force
    sensor_msgs/BatteryState           voltage
    px4_msgs/..                        as the topics of a ULog, in NED and FRD
    mav_msgs/Actuators, mavros ESCStatus/ESCTelemetry, and any message of `motor`s or `rpm`   rotor speeds or commands

Channels of other types are not looked into, whatever their encoding. ROS is ENU and FLU already (REP 103). Several
topics of one kind: estimate before reference, most messages first.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError, QuadexpError, missing_package
from quadexp.log.integrity import allowed_bytes
from quadexp.log.store import first_line
from quadexp.names import distinct
from quadexp.plugins.logs.importers.raw import RawLog, sorted_stream, velocity_to_world
from quadexp.plugins.logs.importers.readers.ulog import TOPICS, read_topics
from quadexp.plugins.logs.units import UNITS

MOST_MESSAGES = 20_000_000  # 5 h at 1 kHz
PER_MESSAGE = 400  # bytes that a message takes once it is read
MOST_ROTORS = 16  # of PX4's actuator messages
NOT_MEASURED = re.compile(r"setpoint|reference|desired|target|command/pose|cmd_vel|goal|raw_odom|waypoint")
BODY_FRAME = re.compile(r"base_link|body|imu|fcu|drone|quad|child")
RPM = UNITS["rotor_speed"]["rpm"]
LEAST_MESSAGES = 10  # fewer are no stream of a sensor


class _Rows(NamedTuple):
    """What one topic gave for one quantity. in_body: whether vectors are in the body frame."""

    topic: str
    in_body: bool
    t: list[float]
    values: list[list[float]]


ABOUT = "ROS 1 and ROS 2; needs [logs]"
MAGIC = (b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3\x00")


def recognises(path: Path, head: bytes | None) -> bool:
    """A file of ROS 1 or of ROS 2; a folder of ROS 2."""
    return (path / "metadata.yaml").is_file() if head is None else head.startswith(MAGIC)


def read(path: Path, named: str) -> RawLog:
    """Streams of a bag (a file of ROS 1, a folder or MCAP of ROS 2). Raises DataError."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise missing_package(path, "rosbags", "logs") from None
    rows: _Found = {}
    px4: dict[str, list[dict[str, Any]]] = {}
    others: list[str] = []
    notes: list[str] = []
    try:
        source = path
        if path.suffix in (".db3", ".mcap") and (path.parent / "metadata.yaml").is_file():
            source = path.parent
        with _opened(AnyReader, source, get_typestore(Stores.ROS2_HUMBLE)) as (reader, others):
            wanted = reader.connections
            if not wanted:
                there = ", ".join(others[:8]) or "none"
                raise DataError(f"no topic of pose, motion, IMU or motors; topics: {there}")
            declared = sum(c.msgcount for c in wanted)
            if declared > MOST_MESSAGES or declared * PER_MESSAGE > allowed_bytes(source):
                raise DataError(f"declares {declared} messages: too many for its size, or for any log")
            for connection, stamp, raw in reader.messages(connections=wanted):
                message = reader.deserialize(raw, connection.msgtype)
                if topic := _px4_topic(connection.msgtype):
                    px4.setdefault(topic, []).append(_flat(message))
                    continue
                _take(rows, _fields(connection.msgtype), connection.topic, _time(message, stamp), message)
    except QuadexpError as error:
        raise DataError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    except Exception as error:  # readers of bags, decompressors and databases raise what they like
        if not any(rows.values()) and not px4:
            raise DataError(f"{path}: not a bag, or damaged ({type(error).__name__}: {first_line(error)})") from None
        notes.append(f"damaged ({first_line(error)}): what could be read was")
    if others:
        notes.append(f"topics of other types: {', '.join(others[:6])}{', ..' if len(others) > 6 else ''}: not read")
    if px4:
        log = read_topics(path, {name: [_columns(messages)] for name, messages in px4.items()}, {})
        notes += [f"{name}: px4_msgs are taken instead" for name in rows]
        return replace(log, format="rosbag", notes=[*notes, *log.notes])
    log = RawLog("rosbag", {}, "ros", notes=notes)
    _choose(path, log, rows)
    return log


@contextlib.contextmanager
def _opened(reader_class: Any, source: Path, typestore: Any) -> Iterator[tuple[Any, list[str]]]:
    """A reader of the channels that are read, and what the others are, whose definitions are not parsed."""
    from rosbags.rosbag2 import storage_mcap

    others: set[str] = set()
    reader, known = reader_class([source], default_typestore=typestore), storage_mcap.get_msgdef

    def definition(schema: Any) -> Any:
        try:
            return known(schema)
        except KeyError:  # an encoding of another program
            return known(None)

    def of_use(connection: Any) -> bool:
        encoding = getattr(connection.ext, "serialization_format", "cdr")
        return encoding == "cdr" and bool(_fields(connection.msgtype) or _px4_topic(connection.msgtype))

    def narrowed(topic: Any, begin: Callable[[], None]) -> None:
        begin()
        others.update(f"{c.topic} ({c.msgtype})" for c in topic.connections if not of_use(c))
        topic.connections[:] = [c for c in topic.connections if of_use(c)]

    for part in reader.readers:
        part.open = partial(narrowed, part, part.open)
    storage_mcap.get_msgdef = definition
    try:
        with reader:
            yield reader, sorted(others)
    finally:
        storage_mcap.get_msgdef = known


def _px4_topic(kind: str) -> str:
    """The ULog's name of a message of PX4, or "" where it is of no use."""
    match = re.fullmatch(r"px4_msgs/msg/(\w+)", kind)
    name = re.sub(r"(?<=.)([A-Z])", r"_\1", match[1]).lower() if match else ""
    return name if name in TOPICS else ""


def _flat(message: Any) -> dict[str, Any]:
    """Fields of a message as a ULog names them, "q[0]" and so on."""
    flat: dict[str, Any] = {}
    for name, value in vars(message).items():
        values = np.asarray(value)
        if values.dtype.kind not in "biuf":
            continue
        flat |= {name: value} if values.ndim == 0 else {f"{name}[{i}]": x for i, x in enumerate(values.ravel())}
    return flat


def _columns(messages: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    return {name: np.array([message[name] for message in messages]) for name in messages[0]}


def _time(message: Any, stamp: int) -> float:
    """The header's time; the recorder's where there is none (s)."""
    header = getattr(message, "header", None)
    if header is not None and (header.stamp.sec or header.stamp.nanosec):
        return float(header.stamp.sec) + 1e-9 * float(header.stamp.nanosec)
    return 1e-9 * stamp


_Found = dict[str, dict[str, _Rows]]  # quantity -> topic -> its rows
_Fields = tuple[tuple[str, str], ...]  # (quantity, where it stands in a message), the first that there is of a quantity
_SPEEDS: _Fields = tuple(
    ("rotor_speed", name)
    for name in ("rpm", "motor_rpm", "rpms", "motor_speeds", "rotor_speeds", "speeds", "motors", "motor_speed")
)
_MESSAGES: tuple[tuple[str, _Fields], ...] = (  # type -> what it holds
    (r".*/Odometry", (("position", "pose.pose.position"), ("attitude", "pose.pose.orientation"),
                      ("velocity", "twist.twist.linear"), ("rate", "twist.twist.angular"))),
    (r"geometry_msgs/(msg/)?Pose(WithCovariance)?Stamped",
     (("position", "pose.pose.position"), ("position", "pose.position"), ("attitude", "pose.pose.orientation"),
      ("attitude", "pose.orientation"))),
    (r"geometry_msgs/(msg/)?TransformStamped",
     (("position", "transform.translation"), ("attitude", "transform.rotation"))),
    (r"geometry_msgs/(msg/)?Twist(WithCovariance)?Stamped",
     (("velocity", "twist.twist.linear"), ("velocity", "twist.linear"), ("rate", "twist.twist.angular"),
      ("rate", "twist.angular"))),
    (r"sensor_msgs/(msg/)?Imu",
     (("rate", "angular_velocity"), ("acceleration", "linear_acceleration"), ("attitude", "orientation"))),
    (r"sensor_msgs/(msg/)?BatteryState", (("battery_voltage", "voltage"),)),
    (r".*/Actuators",
     (("rotor_speed", "angular_velocities"), ("rotor_speed", "velocity"), ("motor_command", "normalized"))),
    (r".*/(ESCStatus|ESCTelemetry)", (("rotor_speed", "esc_status.rpm"), ("rotor_speed", "esc_telemetry.rpm"))),
    (r".*/(QuadState|QuadStateEstimate|QuadrotorState)",  # pose, velocity (twist in the world) and motors in one
     (("position", "pose.position"), ("attitude", "pose.orientation"), ("velocity", "velocity.linear"),
      ("rate", "velocity.angular"), ("rotor_speed", "motors"))),
    (r".*/\w*(RPM|Rpm|MotorSpeed|RotorSpeed|MotorSpeeds|EscFeedback)s?", _SPEEDS),
)  # fmt: skip
# numbers of a message
_WIDTHS = {"position": 3, "velocity": 3, "rate": 3, "acceleration": 3, "attitude": 4, "battery_voltage": 1}


@cache
def _fields(kind: str) -> _Fields:
    return next((fields for pattern, fields in _MESSAGES if re.fullmatch(pattern, kind)), ())


def _take(recognised: _Found, fields: _Fields, topic: str, t: float, message: Any) -> None:
    """Put what a message holds to its rows."""
    done = set()
    for quantity, place in fields:
        values = _values(message, place)
        count = len(values)
        fits = count == _WIDTHS[quantity] if quantity in _WIDTHS else 3 <= count <= MOST_ROTORS
        if place == "orientation":  # which an IMU may not know
            fits &= abs(sum(x * x for x in values) - 1) < 1e-2 and message.orientation_covariance[0] >= 0
        if quantity in done or not fits:
            continue
        done.add(quantity)
        in_body = quantity == "velocity" and _in_body(topic, message)
        rows = recognised.setdefault(quantity, {}).setdefault(topic, _Rows(topic, in_body, [], []))
        if not rows.values or count == len(rows.values[0]):
            rows.t.append(t)
            rows.values.append(values)


def _values(message: Any, place: str) -> list[float]:
    """Numbers at a place of a message, quaternions w first, speeds in rad/s; empty where there are none."""
    item = message
    for name in place.split("."):
        item = [getattr(part, name, 0.0) for part in item] if isinstance(item, list) else getattr(item, name, None)
    if hasattr(item, "x"):
        return [float(getattr(item, axis)) for axis in ("wxyz" if hasattr(item, "w") else "xyz")]
    values = np.ravel([] if item is None else item)
    if values.dtype.kind not in "fiu":
        return []
    if "rpm" in place:
        values = RPM * np.abs(values)
    return values.astype(float).tolist()


def _in_body(topic: str, message: Any) -> bool:
    """Whether a velocity is in the body: an odometry is in the frame of its child, a twist where its frame says."""
    if hasattr(message, "child_frame_id"):
        return not message.child_frame_id or message.child_frame_id != message.header.frame_id
    if not hasattr(message, "twist"):
        return False
    return "body" in topic or (
        bool(BODY_FRAME.search(message.header.frame_id)) and "local" not in topic.rsplit("/", 1)[-1]
    )


def _choose(path: Path, log: RawLog, recognised: _Found) -> None:
    """Of every quantity the topic to take, then everything into ENU and FLU."""
    chosen: dict[str, _Rows] = {}
    for quantity in distinct(("position", "attitude", "velocity", "rate", "acceleration", *sorted(recognised))):
        topics = [rows for rows in recognised.get(quantity, {}).values() if len(rows.t) >= LEAST_MESSAGES]
        if not topics:
            continue
        pose = chosen["position"].topic if "position" in chosen else None
        best = max(topics, key=lambda rows: _rank(rows, quantity, pose))
        others = [rows.topic for rows in topics if rows is not best]
        if others:
            log.notes.append(f"{quantity}: {best.topic} taken, not {', '.join(others[:4])}")
        chosen[quantity] = best
        name = f"{quantity} ({best.topic})"
        log.streams[quantity] = sorted_stream(path, name, np.array(best.t), np.array(best.values), log.notes)
    if not chosen:
        raise DataError(f"{path}: no topic has {LEAST_MESSAGES} messages of use")
    if "velocity" in chosen and chosen["velocity"].in_body and "attitude" in log.streams:
        velocity_to_world(log.streams)
    log.about["topics"] = {quantity: rows.topic for quantity, rows in chosen.items()}


def _rank(rows: _Rows, quantity: str, pose: str | None) -> tuple[bool, bool, bool, int]:
    """Measured before wanted; rates of an IMU before others; what comes with the pose; most messages."""
    imu = quantity in ("rate", "acceleration") and "imu" in rows.topic.lower()
    return (not NOT_MEASURED.search(rows.topic.lower()), imu, rows.topic == pose, len(rows.t))
