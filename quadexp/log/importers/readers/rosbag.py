"""ROS 1 and ROS 2 bags, read by rosbags. Messages are chosen by type; the topic's name only breaks ties.

    nav_msgs/Odometry                  position, attitude (world), velocity and rate (child frame: body, REP 147)
    geometry_msgs/PoseStamped, TransformStamped (Vicon), PoseWithCovarianceStamped
    geometry_msgs/TwistStamped         velocity, rate   (body where the frame is a body's, else world)
    sensor_msgs/Imu                    rate, specific force
    sensor_msgs/BatteryState           voltage
    mav_msgs/Actuators, mavros ESCStatus/ESCTelemetry, and any message of `motor`s or `rpm`   rotor speeds or commands

ROS is ENU and FLU already (REP 103). Several topics of one kind: estimate before reference, most messages first.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, QuadexpError
from quadexp.log.declared import allowed_bytes
from quadexp.log.extras import missing_package
from quadexp.log.importers.mapped import with_attitude
from quadexp.log.importers.raw import RawLog, clean_stream
from quadexp.log.signal import Stream, increasing
from quadexp.log.store import first_line
from quadexp.log.units import UNITS

MOST_MESSAGES = 20_000_000
PER_MESSAGE = 400  # bytes that a message takes once it is read
MOST_ROTORS = 16
NOT_MEASURED = re.compile(r"setpoint|reference|desired|target|command/pose|cmd_vel|goal|raw_odom|waypoint")
BODY_FRAME = re.compile(r"base_link|body|imu|fcu|drone|quad|child")
RPM = UNITS["rotor_speed"]["rpm"]
LEAST_MESSAGES = 10


@dataclass
class _Rows:
    """What one topic gave for one quantity. in_body: whether vectors are in the body frame."""

    topic: str
    t: list[float] = field(default_factory=list)
    values: list[list[float]] = field(default_factory=list)
    in_body: bool = False


ABOUT = "ROS 1 and ROS 2; needs [logs]"
MAGIC = (b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3\x00")


def recognises(path: Path, head: bytes | None) -> int:
    """A file of ROS 1 or of ROS 2; a folder of ROS 2. An MCAP of our own is surer to be that (quadexp.py)."""
    return int((path / "metadata.yaml").is_file() if head is None else head.startswith(MAGIC))


def read(path: Path, named: str) -> RawLog:
    """Streams of a bag (a file of ROS 1, a folder or MCAP of ROS 2). Raises DataError."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise missing_package(path, "rosbags", "logs") from None
    found: _Found = {}
    notes: list[str] = []
    try:
        source = path.parent if path.suffix in (".db3", ".mcap") and (path.parent / "metadata.yaml").is_file() else path
        with AnyReader([source], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            takers = {c.msgtype: taker for c in reader.connections if (taker := _taker(c.msgtype)) is not None}
            wanted = [c for c in reader.connections if c.msgtype in takers]
            if not wanted:
                there = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in reader.connections})[:8]) or "none"
                raise DataError(f"no topic of pose, motion, IMU or motors; topics: {there}")
            declared = sum(c.msgcount for c in wanted)
            if declared > MOST_MESSAGES or declared * PER_MESSAGE > allowed_bytes(source):
                raise DataError(f"declares {declared} messages: too many for its size, or for any log")
            for connection, stamp, raw in reader.messages(connections=wanted):
                message = reader.deserialize(raw, connection.msgtype)
                takers[connection.msgtype](found, connection.topic, _time(message, stamp), message)
    except QuadexpError as error:
        raise DataError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    except Exception as error:  # readers of bags, decompressors and databases raise what they like
        if not any(found.values()):
            raise DataError(f"{path}: not a bag, or damaged ({type(error).__name__}: {first_line(error)})") from None
        notes.append(f"damaged ({first_line(error)}): what could be read was")
    log = RawLog("rosbag", {}, "ros", notes=notes)
    _choose(path, log, found)
    return log


def _time(message: Any, stamp: int) -> float:
    """The header's time; the recorder's where there is none (s)."""
    header = getattr(message, "header", None)
    if header is not None and (header.stamp.sec or header.stamp.nanosec):
        return float(header.stamp.sec) + 1e-9 * float(header.stamp.nanosec)
    return 1e-9 * stamp


_Found = dict[str, dict[str, _Rows]]  # quantity -> topic -> its rows
_Taker = Callable[[_Found, str, float, Any], None]


def _put(found: _Found, quantity: str, topic: str, t: float, values: list[float], *, in_body: bool = False) -> None:
    rows = found.setdefault(quantity, {}).setdefault(topic, _Rows(topic, in_body=in_body))
    if not rows.values or len(values) == len(rows.values[0]):
        rows.t.append(t)
        rows.values.append(values)


def _xyz(v: Any) -> list[float]:
    return [float(v.x), float(v.y), float(v.z)]


def _wxyz(q: Any) -> list[float]:
    return [float(q.w), float(q.x), float(q.y), float(q.z)]


def _pose(found: _Found, topic: str, t: float, position: Any, orientation: Any) -> None:
    _put(found, "position", topic, t, _xyz(position))
    _put(found, "attitude", topic, t, _wxyz(orientation))


def _odometry(found: _Found, topic: str, t: float, m: Any) -> None:
    _pose(found, topic, t, m.pose.pose.position, m.pose.pose.orientation)
    world = m.child_frame_id == m.header.frame_id and m.child_frame_id != ""
    _put(found, "velocity", topic, t, _xyz(m.twist.twist.linear), in_body=not world)
    _put(found, "rate", topic, t, _xyz(m.twist.twist.angular))


def _pose_stamped(found: _Found, topic: str, t: float, m: Any) -> None:
    pose = m.pose.pose if hasattr(m.pose, "pose") else m.pose
    _pose(found, topic, t, pose.position, pose.orientation)


def _transform(found: _Found, topic: str, t: float, m: Any) -> None:
    _pose(found, topic, t, m.transform.translation, m.transform.rotation)


def _twist(found: _Found, topic: str, t: float, m: Any) -> None:
    twist = m.twist.twist if hasattr(m.twist, "twist") else m.twist
    body = bool(BODY_FRAME.search(m.header.frame_id)) and "local" not in topic.rsplit("/", 1)[-1]
    _put(found, "velocity", topic, t, _xyz(twist.linear), in_body=body or "body" in topic)
    _put(found, "rate", topic, t, _xyz(twist.angular))


def _imu(found: _Found, topic: str, t: float, m: Any) -> None:
    _put(found, "rate", topic, t, _xyz(m.angular_velocity))
    _put(found, "acceleration", topic, t, _xyz(m.linear_acceleration))
    q = _wxyz(m.orientation)
    if abs(sum(x * x for x in q) - 1) < 1e-2 and m.orientation_covariance[0] >= 0:
        _put(found, "attitude", topic, t, q)


def _battery(found: _Found, topic: str, t: float, m: Any) -> None:
    _put(found, "battery_voltage", topic, t, [float(m.voltage)])


def _actuators(found: _Found, topic: str, t: float, m: Any) -> None:
    for name, quantity in (
        ("angular_velocities", "rotor_speed"),
        ("velocity", "rotor_speed"),
        ("normalized", "motor_command"),
    ):
        values = [float(v) for v in getattr(m, name, [])]
        if 3 <= len(values) <= MOST_ROTORS:
            _put(found, quantity, topic, t, values)


def _esc(found: _Found, topic: str, t: float, m: Any) -> None:
    items = getattr(m, "esc_status", None) or getattr(m, "esc_telemetry", None) or []
    if 3 <= len(items) <= MOST_ROTORS:
        _put(found, "rotor_speed", topic, t, [RPM * abs(float(item.rpm)) for item in items])


def _state(found: _Found, topic: str, t: float, m: Any) -> None:
    """A quadrotor's state in one message (agilicopter and the like): pose, velocity (twist in the world), motors."""
    _pose(found, topic, t, m.pose.position, m.pose.orientation)
    twist = getattr(m, "velocity", None)
    if twist is not None and hasattr(twist, "linear"):
        _put(found, "velocity", topic, t, _xyz(twist.linear))
        _put(found, "rate", topic, t, _xyz(twist.angular))
    motors = [float(v) for v in getattr(m, "motors", [])]
    if 3 <= len(motors) <= MOST_ROTORS:
        _put(found, "rotor_speed", topic, t, motors)


def _speeds(found: _Found, topic: str, t: float, m: Any) -> None:
    """Any message of rotor speeds: an array called rpm, motor_rpm, speeds, ..."""
    for name in ("rpm", "motor_rpm", "rpms", "motor_speeds", "rotor_speeds", "speeds", "motors", "motor_speed"):
        values = np.atleast_1d(np.asarray(getattr(m, name, []))).ravel()
        if 3 <= len(values) <= MOST_ROTORS and values.dtype.kind in "fiu":
            factor = RPM if "rpm" in name else 1.0
            _put(found, "rotor_speed", topic, t, (factor * np.abs(values.astype(float))).tolist())
            return


_TAKERS: list[tuple[re.Pattern[str], _Taker]] = [
    (re.compile(r".*/Odometry"), _odometry),
    (re.compile(r"geometry_msgs/(msg/)?Pose(WithCovariance)?Stamped"), _pose_stamped),
    (re.compile(r"geometry_msgs/(msg/)?TransformStamped"), _transform),
    (re.compile(r"geometry_msgs/(msg/)?Twist(WithCovariance)?Stamped"), _twist),
    (re.compile(r"sensor_msgs/(msg/)?Imu"), _imu),
    (re.compile(r"sensor_msgs/(msg/)?BatteryState"), _battery),
    (re.compile(r".*/Actuators"), _actuators),
    (re.compile(r".*/(ESCStatus|ESCTelemetry)"), _esc),
    (re.compile(r".*/(QuadState|QuadStateEstimate|QuadrotorState)"), _state),
    (re.compile(r".*/\w*(RPM|Rpm|MotorSpeed|RotorSpeed|MotorSpeeds|EscFeedback)s?"), _speeds),
]


def _taker(kind: str) -> _Taker | None:
    return next((taker for pattern, taker in _TAKERS if pattern.fullmatch(kind)), None)


def _choose(path: Path, log: RawLog, found: _Found) -> None:
    """Of every quantity the topic to take, then everything into ENU and FLU."""
    chosen: dict[str, _Rows] = {}
    pose = None
    for quantity in ("position", "attitude", "velocity", "rate", "acceleration", *sorted(found)):
        topics = [rows for rows in found.get(quantity, {}).values() if len(rows.t) >= LEAST_MESSAGES]
        if quantity in chosen or not topics:
            continue
        chosen[quantity] = max(topics, key=lambda rows: _rank(rows, quantity, pose))
        pose = chosen["position"].topic if "position" in chosen else None
        others = [rows.topic for rows in topics if rows is not chosen[quantity]]
        if others:
            log.notes.append(f"{quantity}: {chosen[quantity].topic} taken, not {', '.join(others[:4])}")
    if not chosen:
        raise DataError(f"{path}: no topic has {LEAST_MESSAGES} messages of use")
    for quantity, rows in chosen.items():
        t, values = np.array(rows.t), np.array(rows.values)
        order = np.argsort(t, kind="stable")
        later = increasing(t[order])
        log.streams[quantity] = clean_stream(
            path, f"{quantity} ({rows.topic})", t[order][later], values[order][later], log.notes
        )
    if "velocity" in chosen and chosen["velocity"].in_body and "attitude" in log.streams:
        stream, R = with_attitude(log.streams, "velocity")
        log.streams["velocity"] = Stream(stream.t, R.apply(stream.values))
    log.about["topics"] = {quantity: rows.topic for quantity, rows in chosen.items()}


def _rank(rows: _Rows, quantity: str, pose: str | None) -> tuple[bool, bool, bool, int]:
    """Measured before wanted; rates of an IMU before others; what comes with the pose; most messages."""
    imu = quantity in ("rate", "acceleration") and "imu" in rows.topic.lower()
    return (not NOT_MEASURED.search(rows.topic.lower()), imu, rows.topic == pose, len(rows.t))
