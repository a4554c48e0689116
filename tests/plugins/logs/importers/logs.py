"""A flight that is known by hand, and logs of it as other programs write them.

The path is a Lissajous figure with a turning nose; attitude, rates, specific force and rotor commands follow from it by
rigid-body dynamics with linear drag, so that every column is consistent with every other.
"""

import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight
from quadexp.log.store import read_table
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.logs.import_flights import import_files
from quadexp.plugins.logs.importers import Options
from tests.log.imitated import attitude_of
from tests.models.recorded_data import FOLDER

G = 9.81
DRAG = np.array([0.4, 0.3, 0.1])  # 1/s, body axes
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD = np.diag([1.0, -1.0, -1.0])
# Rotors of vehicle=torrente and crazyflie: front right, back right, back left, front left (x, y signs, spin).
ROTORS = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], float)


@dataclass(frozen=True)
class Truth:
    """t (k,), and p, v, acc (specific force, FLU), w (FLU), each (k, 3); q (k, 4) w first; command (k, 4), 0 to 1."""

    t: np.ndarray
    p: np.ndarray
    q: np.ndarray
    v: np.ndarray
    w: np.ndarray
    acc: np.ndarray
    command: np.ndarray
    voltage: np.ndarray

    @property
    def R(self) -> Rotation:
        return Rotation.from_quat(self.q, scalar_first=True)


def truth(duration: float = 30.0, rate: float = 100.0, seed: int = 0, turning: tuple = (0.02, 0.05)) -> Truth:
    """A flight of some 5 m/s; body rate and angular acceleration by differences on a grid ten times finer.

    turning: what a rotor gives for an angular acceleration about x and y, and about z (m/s^2 of thrust a rad/s^2)."""
    rng = np.random.default_rng(seed)
    fine = 10
    t = np.arange(int(duration * rate) * fine + 1) / (rate * fine)
    amplitude, omega, phase = np.array([4.0, 3.0, 0.7]), np.array([0.9, 1.3, 1.1]), rng.uniform(0, 6, 3)
    s, c = np.sin(np.outer(t, omega) + phase), np.cos(np.outer(t, omega) + phase)
    p = amplitude * s + [0.0, 0.0, 3.0]
    v, a = amplitude * omega * c, -amplitude * omega**2 * s
    yaw = 0.6 * np.sin(0.5 * t) + 0.3
    R = attitude_of(v, a, yaw, DRAG, 30)
    force = R.apply(a + [0.0, 0.0, G], inverse=True)
    body = R.apply(v, inverse=True)
    w = (R[:-1].inv() * R[1:]).as_rotvec() * rate * fine
    w = np.concatenate([w[:1], 0.5 * (w[1:] + w[:-1]), w[-1:]])
    torque = np.gradient(w, t, axis=0)
    thrust = force[:, 2] + DRAG[2] * body[:, 2]
    x, y, spin = ROTORS.T
    mixed = thrust[:, None] / 4 + turning[0] * (np.outer(torque[:, 0], y) - np.outer(torque[:, 1], x))
    mixed += turning[1] * np.outer(torque[:, 2], spin)
    command = np.sqrt(np.clip(mixed, 0.01, None) / 6.0)
    q = R.as_quat(scalar_first=True)
    q *= np.cumprod(np.concatenate([[1.0], np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)]))[:, None]
    voltage = 16.4 - 0.02 * t
    k = slice(None, None, fine)
    return Truth(t[k], p[k], q[k], v[k], w[k], force[k], command[k], voltage[k])


def write_csv(path: Path, columns: dict[str, np.ndarray], digits: int = 15) -> Path:
    values = np.column_stack(list(columns.values()))
    np.savetxt(path, values, delimiter=",", header=",".join(columns), comments="", fmt=f"%.{digits}g")
    return path


def _named(names: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(names.split("|"), values.T, strict=True))


def frd_quaternion(f: Truth) -> np.ndarray:
    """FRD to NED, w first."""
    return (Rotation.from_matrix(NED) * f.R * Rotation.from_matrix(FRD)).as_quat(scalar_first=True)


def rotorpy(path: Path, f: Truth) -> Path:
    """As RotorPy's to_dataframe: seconds, ENU and FLU, quaternion with w last, rotor speeds."""
    return write_csv(path, {
        "time": f.t, **_named("x|y|z", f.p), **_named("xdot|ydot|zdot", f.v),
        **_named("qx|qy|qz|qw", f.q[:, [1, 2, 3, 0]]),
        **_named("wx|wy|wz", f.w), **_named("windx|windy|windz", 0 * f.v), **_named("r1|r2|r3|r4", 2500 * f.command),
        **_named("xdes|ydes|zdes", f.p + 0.01), **_named("xdotdes|ydotdes|zdotdes", f.v),
    })  # fmt: skip


def euroc(path: Path, f: Truth) -> Path:
    """As EuRoC's ground truth: nanoseconds since 1970, units in the names."""
    return write_csv(path, {
        "#timestamp [ns]": 1.4e18 + 1e9 * f.t, **_named("p_RS_R_x [m]|p_RS_R_y [m]|p_RS_R_z [m]", f.p),
        **_named("q_RS_w []|q_RS_x []|q_RS_y []|q_RS_z []", f.q),
        **_named("v_RS_R_x [m s^-1]|v_RS_R_y [m s^-1]|v_RS_R_z [m s^-1]", f.v),
        **_named("b_w_RS_S_x [rad s^-1]|b_w_RS_S_y [rad s^-1]|b_w_RS_S_z [rad s^-1]", 0 * f.w + 0.01),
        **_named("a_RS_S_x [m s^-2]|a_RS_S_y [m s^-2]|a_RS_S_z [m s^-2]", f.acc),
        **_named("w_RS_S_x [rad s^-1]|w_RS_S_y [rad s^-1]|w_RS_S_z [rad s^-1]", f.w),
    }, digits=19)  # fmt: skip


def ulog2csv(path: Path, f: Truth) -> Path:
    """One table of PX4's fields: microseconds, NED and FRD, pulse widths, motors in PX4's order."""
    return write_csv(path, {
        "timestamp": 5e6 + 1e6 * f.t, **_named("x|y|z", f.p @ NED.T), **_named("vx|vy|vz", f.v @ NED.T),
        **_named("q[0]|q[1]|q[2]|q[3]", frd_quaternion(f)), **_named("xyz[0]|xyz[1]|xyz[2]", f.w @ FRD),
        **_named("accelerometer_m_s2[0]|accelerometer_m_s2[1]|accelerometer_m_s2[2]", f.acc @ FRD),
        **_named("output[0]|output[1]|output[2]|output[3]", 1000 + 1000 * f.command[:, [0, 2, 3, 1]]),
        "voltage_v": f.voltage,
    }, digits=18)  # fmt: skip


def betaflight(path: Path, f: Truth) -> Path:
    """As blackbox_decode: microseconds, counts of 2048 a g, degrees a second, no position and no attitude."""
    names = {"loopIteration": np.arange(len(f.t)) * 4.0, "time (us)": 81e6 + 1e6 * f.t,
             **_named("axisP[0]|axisP[1]|axisP[2]", f.w * 3)}  # fmt: skip
    names |= _named("gyroADC[0] (deg/s)|gyroADC[1] (deg/s)|gyroADC[2] (deg/s)", np.degrees(f.w))
    names |= _named("accSmooth[0]|accSmooth[1]|accSmooth[2]", 2048 / G * f.acc)
    names |= _named("motor[0]|motor[1]|motor[2]|motor[3]", 48 + 1999 * f.command[:, [1, 0, 2, 3]])
    names |= {"vbatLatest (V)": f.voltage}
    write_csv(path, names)
    head, *rows = path.read_text().splitlines()
    rows = [f"{row},ANGLE_MODE|HORIZON" for row in rows]
    path.write_text("\n".join([f"{head},flightModeFlags (flags)".replace(",", ", "), *rows, ""]))
    return path


def neurobem(path: Path, f: Truth) -> Path:
    """As the NeuroBEM set: velocity in the body, rotor speeds, derivatives beside what was measured."""
    body = f.R.apply(f.v, inverse=True)
    return write_csv(path, {
        "t": f.t, **_named("ang acc x|ang acc y|ang acc z", np.gradient(f.w, f.t, axis=0)),
        **_named("ang vel x|ang vel y|ang vel z", f.w), **_named("quat x|quat y|quat z|quat w", f.q[:, [1, 2, 3, 0]]),
        **_named("acc x|acc y|acc z", f.acc), **_named("vel x|vel y|vel z", body), **_named("pos x|pos y|pos z", f.p),
        **_named("mot 1|mot 2|mot 3|mot 4", 2500 * f.command[:, [1, 2, 0, 3]]),
        **_named("dmot 1|dmot 2|dmot 3|dmot 4", np.gradient(f.command, f.t, axis=0)), "vbat": f.voltage,
    })  # fmt: skip


def unnamed(path: Path, f: Truth) -> Path:
    """No name says anything: attitude world to body with w last, degrees a second, g, milliseconds, z down."""
    q = frd_quaternion(f) * [1, -1, -1, -1]
    columns = np.column_stack([
        1e3 * f.t, f.p @ NED.T, np.degrees(f.w @ FRD), q[:, [1, 2, 3, 0]], f.v @ NED.T, f.acc @ FRD / 9.80665,
        65535 * f.command,
    ])  # fmt: skip
    return write_csv(path, {f"c{i}": column for i, column in enumerate(columns.T)})


MAPPING = """
time: {column: t, unit: s}
position: {columns: [p_x, p_y, p_z]}
attitude: {columns: [q_w, q_x, q_y, q_z]}
velocity: {columns: [v_x, v_y, v_z]}
rate: {columns: [w_x, w_y, w_z]}
acceleration: {columns: [acc_x, acc_y, acc_z]}
motor_command: {columns: [motor_command_0, motor_command_1, motor_command_2, motor_command_3]}
crop: none
"""


def imported(folder: Path, flight: Flight, mapping: str = MAPPING, *, vehicle=None, keep=False, **options):
    """(outcome, flight or None) of a flight that is written as a log under its own names and imported by a mapping."""
    lines = mapping.splitlines(keepends=True)
    (folder / "mapping.yaml").write_text("".join(x for x in lines if "w_x" in flight.columns or "rate:" not in x))
    log = write_csv(folder / "log.csv", dict(flight.columns))
    options = Options(mapping=folder / "mapping.yaml", **options)
    (outcome,) = import_files([log], folder / "out", options, vehicle=vehicle, force=True, keep=keep)
    return outcome, Flight(*read_table(outcome.path, "flight")) if outcome.path else None


class ULogWriter:
    """A small valid ULog: header, flag bits, formats, parameters, subscriptions, data in the order of time.

    See https://docs.px4.io/main/en/dev_log/ulog_file_format.html
    """

    def __init__(self, parameters: dict[str, float] | None = None) -> None:
        self.definitions = b"".join([
            b"ULog\x01\x12\x35\x01", struct.pack("<Q", 1_000_000), self._message(b"B", bytes(40)),
            *(self._parameter(key, value) for key, value in (parameters or {}).items()),
        ])  # fmt: skip
        self.formats: dict[str, str] = {}
        self.subscriptions: list[bytes] = []
        self.data: list[tuple[int, bytes]] = []

    @staticmethod
    def _message(kind: bytes, content: bytes) -> bytes:
        return struct.pack("<H", len(content)) + kind + content

    def _parameter(self, key: str, value: float) -> bytes:
        name = f"float {key}".encode()
        return self._message(b"P", struct.pack("<B", len(name)) + name + struct.pack("<f", value))

    def format(self, name: str, fields: str) -> None:
        """fields: as PX4 writes them, `uint64_t timestamp;float[4] q;`."""
        self.formats[name] = fields

    def topic(self, name: str, t: np.ndarray, values: np.ndarray, code: str, instance: int = 0) -> None:
        """t: (k,) s. values: (k, m), everything after the timestamp, packed by `code` (of struct)."""
        number = len(self.subscriptions)
        self.subscriptions.append(self._message(b"A", struct.pack("<BH", instance, number) + name.encode()))
        pack = struct.Struct(f"<HQ{code}")
        floats = [kind in "fd" for count, kind in re.findall(r"(\d*)([a-zA-Z?])", code) for _ in range(int(count or 1))]
        for stamp, row in zip((1e6 * t).round().astype(int).tolist(), values.tolist(), strict=True):
            row = [value if real else int(value) for value, real in zip(row, floats, strict=True)]
            self.data.append((stamp, self._message(b"D", pack.pack(number, stamp, *row))))

    def imu(self, t: np.ndarray, w: np.ndarray, acc: np.ndarray) -> None:
        """sensor_combined, of rates and specific force in FRD."""
        fields = "float[3] gyro_rad;uint32_t gyro_integral_dt;float[3] accelerometer_m_s2;"
        self.format("sensor_combined", f"uint64_t timestamp;{fields}")
        self.topic("sensor_combined", t, np.column_stack([w, np.full(len(t), 4000), acc]), "3fI3f")

    def write(self, path: Path) -> Path:
        formats = [self._message(b"F", f"{name}:{fields}".encode()) for name, fields in self.formats.items()]
        ordered = [message for _, message in sorted(self.data, key=lambda item: item[0])]
        path.write_bytes(b"".join([self.definitions, *formats, *self.subscriptions, *ordered]))
        return path


def ulog(path: Path, f: Truth, version: str = "new", start: float = 5.0) -> Path:
    """A log of PX4 about 1.14 ("new") or 1.8 ("old"): attitude at half the rate, motors and battery on their own."""
    t, position, velocity = f.t + start, f.p @ NED.T, f.v @ NED.T
    q, w, acc = frd_quaternion(f), f.w @ FRD, f.acc @ FRD
    motors = f.command[:, [0, 2, 3, 1]]
    name = "PWM_MAIN" if version == "new" else "PWM"
    log = ULogWriter({f"{name}_MIN": 1000.0, f"{name}_MAX": 2000.0})
    log.format("vehicle_local_position", "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;")
    log.topic("vehicle_local_position", t[::2], np.hstack([position, velocity])[::2], "6f")
    log.imu(t, w, acc)
    log.format("battery_status", "uint64_t timestamp;float voltage_v;")
    log.topic("battery_status", t[::20], f.voltage[::20, None], "f")
    if version == "new":
        log.format("vehicle_attitude", "uint64_t timestamp;uint64_t timestamp_sample;float[4] q;")
        stamps = (1e6 * t[::2]).round()[:, None]
        log.topic("vehicle_attitude", t[::2] + 0.0005, np.hstack([stamps, q[::2]]), "Q4f")
        log.format("vehicle_angular_velocity", "uint64_t timestamp;float[3] xyz;")
        log.topic("vehicle_angular_velocity", t, w, "3f")
        log.format("actuator_motors", "uint64_t timestamp;uint16_t reversible_flags;float[12] control;")
        control = np.hstack([motors, np.full((len(t), 8), np.nan)])
        log.topic("actuator_motors", t, np.column_stack([np.zeros(len(t)), control]), "H12f")
        log.format("esc_report", "uint64_t timestamp;int32_t esc_rpm;float esc_voltage;")
        log.format("esc_status", "uint64_t timestamp;uint8_t esc_count;uint8_t[7] _padding0;esc_report[4] esc;")
        rows = np.column_stack([np.full(len(t), 4), *([np.zeros(len(t))] * 7), *(
            column for m in motors.T for column in (np.zeros(len(t)), 20000 * m, f.voltage))])  # fmt: skip
        log.topic("esc_status", t[::2], rows[::2], "B7B" + "Qif" * 4)
    else:
        log.format("vehicle_attitude", "uint64_t timestamp;float rollspeed;float pitchspeed;float yawspeed;float[4] q;")
        log.topic("vehicle_attitude", t, np.hstack([w, q]), "7f")
        log.format("actuator_outputs", "uint64_t timestamp;uint32_t noutputs;float[16] output;")
        outputs = np.hstack([1000 + 1000 * motors, np.full((len(t), 4), 900.0), np.zeros((len(t), 8))])
        log.topic("actuator_outputs", t, np.column_stack([np.full(len(t), 8), outputs]), "I16f")
    return log.write(path)


# -------------------------------------------------------------------------------------------------------------- ROS
def rosbag(path: Path, f: Truth, version: int) -> Path:
    """Odometry (velocity in the body), IMU, a set-point; of ROS 1 (a file) or ROS 2 (a folder)."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    writer = rosbag1.Writer(path) if version == 1 else rosbag2.Writer(path, version=9)
    encode = store.serialize_ros1 if version == 1 else store.serialize_cdr
    make = {name.rsplit("/", 1)[-1]: kind for name, kind in store.types.items()}
    topics = {"/drone/odometry": "nav_msgs/msg/Odometry", "/drone/imu/data": "sensor_msgs/msg/Imu",
              "/drone/setpoint": "geometry_msgs/msg/PoseStamped"}  # fmt: skip

    def vector(values: np.ndarray, kind: str = "Vector3"):
        return make[kind](*map(float, values))

    def pose(position: np.ndarray, q: np.ndarray):
        return make["Pose"](vector(position, "Point"), vector(q[[1, 2, 3, 0]], "Quaternion"))

    def header(k: int, stamp: float, frame: str):
        time = store.types["builtin_interfaces/msg/Time"](int(stamp), int(round(1e9 * (stamp % 1))))
        return make["Header"](k, time, frame) if version == 1 else make["Header"](time, frame)

    body, none, zero = f.R.apply(f.v, inverse=True), np.zeros(36), np.zeros(9)
    with writer:
        to = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in topics.items()}
        for k, t in enumerate(f.t + 1.7e9):
            twist = make["TwistWithCovariance"](make["Twist"](vector(body[k]), vector(f.w[k])), none)
            where = make["PoseWithCovariance"](pose(f.p[k], f.q[k]), none)
            turn = vector(f.q[k][[1, 2, 3, 0]], "Quaternion")
            imu = header(k, t, "imu"), turn, zero, vector(f.w[k]), zero, vector(f.acc[k]), zero
            messages = (
                make["Odometry"](header(k, t, "world"), "base_link", where, twist), make["Imu"](*imu),
                make["PoseStamped"](header(k, t, "world"), pose(f.p[k] + 1, f.q[k])),
            )  # fmt: skip
            for connection, message in zip(to.values(), messages, strict=True):
                writer.write(connection, int(round(1e9 * t)), encode(message, connection.msgtype))
    return path


def recorded(name: str) -> Path:
    """A folder of recorded flights; the test is skipped where it is not there."""
    if not (FOLDER / name).is_dir():
        pytest.skip(f"the flights of {name} are not beside the repository (../shared/data/{name})")
    return FOLDER / name


def quad_x() -> Vehicle:
    """1 kg, rotors front right, back right, back left, front left."""
    return Vehicle(
        1.0, ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.02)),
        ((0.1, -0.1, 0.0), (-0.1, -0.1, 0.0), (-0.1, 0.1, 0.0), (0.1, 0.1, 0.0)),
        (-1.0, 1.0, -1.0, 1.0), 0.013, 0.0, 10.0, 20.0, name="quad_x",
    )  # fmt: skip
