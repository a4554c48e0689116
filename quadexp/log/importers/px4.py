"""PX4's topics, of older and newer versions, as streams: NED and FRD to ENU and FLU, microseconds to seconds.

quantity        topics, best first; what they were called before
position        vehicle_local_position x y z; vehicle_odometry position (before 1.14: x y z); ..._groundtruth
attitude        vehicle_attitude q; vehicle_odometry q; vehicle_attitude_groundtruth q
rate            vehicle_angular_velocity xyz (from 1.9); vehicle_attitude rollspeed ...; sensor_combined gyro_rad
acceleration    sensor_combined accelerometer_m_s2; vehicle_acceleration xyz (from 1.9)
motor_command   actuator_motors control (from 1.13); actuator_outputs output (PWM in us, DShot, or normalised)
rotor_speed     esc_status esc[i].esc_rpm
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from quadexp.errors import DataError
from quadexp.log.importers.raw import RawLog, sorted_stream, turn_attitude, with_attitude
from quadexp.log.signal import Stream
from quadexp.log.units import axes_matrix

Topic = Mapping[str, np.ndarray]  # field -> (k,); arrays are "q[0]", ...
Topics = Mapping[str, Sequence[Topic]]  # name -> instances

NED = axes_matrix("world", "NED", "")
FRD = axes_matrix("body", "FRD", "")
RPM = 2 * np.pi / 60
MOST_ROTORS = 12
QUAD_X = ("front_right", "back_left", "front_left", "back_right")


def _array(name: str, length: int = 3) -> tuple[str, ...]:
    return tuple(f"{name}[{i}]" for i in range(length))


_XYZ, _Q = _array("xyz"), _array("q", 4)
# quantity -> [(topic, fields)], best first.
SOURCES: dict[str, list[tuple[str, tuple[str, ...]]]] = {
    "position": [
        ("vehicle_local_position", ("x", "y", "z")),
        ("vehicle_odometry", _array("position")),
        ("vehicle_odometry", ("x", "y", "z")),
        ("vehicle_local_position_groundtruth", ("x", "y", "z")),
    ],
    "velocity": [
        ("vehicle_local_position", ("vx", "vy", "vz")),
        ("vehicle_odometry", _array("velocity")),
        ("vehicle_odometry", ("vx", "vy", "vz")),
        ("vehicle_local_position_groundtruth", ("vx", "vy", "vz")),
    ],
    "attitude": [("vehicle_attitude", _Q), ("vehicle_odometry", _Q), ("vehicle_attitude_groundtruth", _Q)],
    "rate": [
        ("vehicle_angular_velocity", _XYZ),
        ("vehicle_attitude", ("rollspeed", "pitchspeed", "yawspeed")),
        ("sensor_combined", _array("gyro_rad")),
        ("vehicle_odometry", _array("angular_velocity")),
        ("vehicle_odometry", ("rollspeed", "pitchspeed", "yawspeed")),
        ("vehicle_angular_velocity_groundtruth", _XYZ),
    ],
    "acceleration": [("sensor_combined", _array("accelerometer_m_s2")), ("vehicle_acceleration", _XYZ)],
    "battery_voltage": [("battery_status", ("voltage_v",)), ("battery_status", ("voltage_filtered_v",))],
    "wind": [("wind", ("windspeed_north", "windspeed_east")), ("wind_estimate", ("windspeed_north", "windspeed_east"))],
    "reference_position": [("vehicle_local_position_setpoint", ("x", "y", "z"))],
    "reference_velocity": [("vehicle_local_position_setpoint", ("vx", "vy", "vz"))],
}
# What the estimator itself says of its horizontal and its vertical part.
VALID = {"position": ("xy_valid", "z_valid"), "velocity": ("v_xy_valid", "v_z_valid")}
RESETS = {"position": ("xy_reset_counter", "z_reset_counter"), "velocity": ("vxy_reset_counter", "vz_reset_counter")}
ROTORS_OF_TYPE = {2: 4, 13: 6, 14: 8, 15: 3}  # MAV_TYPE
# Signals of the rotors, best first: quantity, topic, field by number.
ROTOR_TOPICS = (
    ("motor_command", "actuator_motors", "control[{}]"),
    ("motor_command", "actuator_outputs", "output[{}]"),
    ("rotor_speed", "esc_status", "esc[{}].esc_rpm"),
)
TOPICS = sorted({topic for sources in SOURCES.values() for topic, _ in sources} | {row[1] for row in ROTOR_TOPICS})
_WORLD = ("position", "velocity", "wind", "reference_position", "reference_velocity")
_BODY_VELOCITY = 3  # vehicle_odometry.velocity_frame: body, FRD


def read_topics(path: Path, topics: Topics, parameters: Mapping[str, float]) -> RawLog:
    """Streams of one log. parameters: of the vehicle, as logged.

    Raises DataError where there is neither attitude nor motion.
    """
    log = RawLog("ulog", {}, "px4")
    used: dict[str, str] = {}
    refused: set[str] = set()
    for name, sources in SOURCES.items():
        for topic, fields in sources:
            found = _instance(topics, topic, fields)
            if found is None or (name in refused and not topic.endswith("groundtruth")):
                continue
            found = _valid(name, topic, found, log.notes)
            if found is None:  # then the estimator's other topics have nothing better
                refused.add(name)
                continue
            stream = _stream(path, f"{name} ({topic})", found, fields, log.notes)
            if stream is not None:
                log.streams[name] = _turned(name, stream, found)
                used[name] = topic
                break
    _motors(path, log, topics, parameters, used)
    if not {"position", "attitude", "velocity", "rate", "acceleration"} & set(log.streams):
        there = ", ".join(sorted(topics)[:10]) or "none"
        raise DataError(
            f"{path}: neither vehicle_attitude, vehicle_local_position nor sensor_combined; topics: {there}"
        )
    wanted = {"position", "attitude", "rate", "acceleration"} - used.keys() - refused
    if missing := [f"{name} ({sources[0][0]})" for name, sources in SOURCES.items() if name in wanted]:
        log.notes.append(f"topics missing: {', '.join(missing)}")
    if used.get("velocity") == "vehicle_odometry" and "attitude" in used:
        frames = topics["vehicle_odometry"][0].get("velocity_frame", ())
        if len(frames) and int(np.median(frames)) == _BODY_VELOCITY:
            # in FRD, and turned as if it were NED: turned back, into FLU, and by the attitude into the world
            stream, R = with_attitude(log.streams, "velocity")
            log.streams["velocity"] = Stream(stream.t, R.apply(stream.values @ NED @ FRD.T))
    log.about["topics"] = used
    return log


def _instance(topics: Topics, name: str, fields: tuple[str, ...]) -> Topic | None:
    """The first instance that has the fields, unless another has more than twice its rows."""
    instances = [one for one in topics.get(name, []) if all(field in one for field in fields)]
    if not instances:
        return None
    most = max(instances, key=lambda one: len(one["timestamp"]))
    return most if len(most["timestamp"]) > 2 * len(instances[0]["timestamp"]) else instances[0]


def _valid(name: str, source: str, topic: Topic, notes: list[str]) -> Topic | None:
    """The rows that the estimator holds to be valid, horizontally and vertically; None where there are none."""
    flags = [np.asarray(topic[flag]) > 0 for flag in VALID.get(name, ()) if flag in topic]
    if flags:
        good = np.logical_and.reduce(flags)
        if not good.any():
            where = " and ".join(flag for flag in VALID[name] if flag in topic and not np.any(topic[flag]))
            notes.append(f"{name} ({source}): the estimator never had a valid one ({where or 'flags'}): left out")
            return None
        if not good.all():
            notes.append(f"{name} ({source}): not valid in {int((~good).sum())} of {len(good)} rows: left out")
            topic = {field: np.asarray(values)[good] for field, values in topic.items()}
    count = sum(int(np.count_nonzero(np.diff(topic[field]))) for field in RESETS.get(name, ()) if field in topic)
    if count:
        notes.append(f"{name} ({source}): reset by the estimator {count} times: it may jump there")
    return topic


def times(topic: Topic) -> np.ndarray:
    """When the values were taken (s): the sample's own time, where there is one."""
    sample = topic.get("timestamp_sample")
    stamp = sample if sample is not None and (np.asarray(sample) > 0).all() else topic["timestamp"]
    return np.asarray(stamp).astype(np.int64) * 1e-6


def _stream(path: Path, name: str, topic: Topic, fields: tuple[str, ...], notes: list[str]) -> Stream | None:
    """The fields of a topic as one stream; None where they hold no number."""
    t, values = times(topic), np.stack([np.asarray(topic[field], float) for field in fields], axis=1)
    if not np.isfinite(values).all(axis=1).any():
        return None
    order = np.argsort(t, kind="stable")  # the sample's times of one topic may lie a little out of order
    if (np.diff(order) < 0).sum() > 0.01 * len(order):
        raise DataError(f"{path}: {name}: its times jump back ({int((np.diff(t) < 0).sum())} times in {len(t)} rows)")
    return sorted_stream(path, name, t, values, notes)


def _turned(name: str, stream: Stream, topic: Topic) -> Stream:
    """NED to ENU, FRD to FLU."""
    t, values = stream
    if name == "attitude":
        return Stream(t, turn_attitude(values, NED, FRD))
    if name == "wind":
        return Stream(t, np.column_stack([values[:, 1], values[:, 0], np.zeros(len(t))]))
    if name in _WORLD:
        return Stream(t, values @ NED.T)
    return Stream(t, values @ FRD.T if values.shape[1] == 3 else values)


def _motors(path: Path, log: RawLog, topics: Topics, parameters: Mapping[str, float], used: dict[str, str]) -> None:
    """Commands and speeds of the rotors, and where they are."""
    most = int(parameters.get("CA_ROTOR_COUNT", 0))
    if not 3 <= most <= MOST_ROTORS:
        most = ROTORS_OF_TYPE.get(int(parameters.get("MAV_TYPE", 0)), MOST_ROTORS)
    for quantity, topic, field in ROTOR_TOPICS:
        stream = None if quantity in used else _rotor_stream(path, log, topics, topic, field, most)
        if stream is not None:
            log.streams[quantity], used[quantity] = stream, topic
    if used.get("motor_command") == "actuator_outputs":
        log.streams["motor_command"] = _pwm(log.streams["motor_command"], parameters, log.notes)
    if "rotor_speed" in used:
        t, values = log.streams["rotor_speed"]
        log.streams["rotor_speed"] = Stream(t, RPM * np.abs(values))
    counts = [log.streams[name].values.shape[1] for name in ("motor_command", "rotor_speed") if name in used]
    log.layout = _layout(max(counts, default=0), parameters, log.notes)


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


def _rotor_stream(path: Path, log: RawLog, topics: Topics, name: str, field: str, most: int) -> Stream | None:
    """The motors of a topic: the leading outputs that move, at most so many, of the instance where most do."""
    best: tuple[int, Topic] = (0, {})
    for topic in topics.get(name, []):
        count = 0
        while count < most and field.format(count) in topic:
            values = np.asarray(topic[field.format(count)], float)
            values = values[np.isfinite(values)]
            if len(values) < 2 or np.ptp(values) == 0:
                break
            count += 1
        if count > best[0]:
            best = (count, topic)
    if best[0] < 3:
        return None
    quantity = next(quantity for quantity, topic, _ in ROTOR_TOPICS if topic == name)
    return _stream(path, f"{quantity} ({name})", best[1], tuple(map(field.format, range(best[0]))), log.notes)


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
