"""Files of other programs: read where they can be, else named with the way to one that is read."""

import gzip
import pickle
import zipfile

import numpy as np
import pytest

from quadexp.errors import DataError
from quadexp.plugins.logs.importers import Options, checked, import_log
from quadexp.plugins.logs.importers.readers.ulog import signal_of_thrust
from tests.plugins.logs.importers import logs
from tests.plugins.logs.importers.logs import FRD, MAPPING, NED, frd_quaternion


@pytest.fixture(scope="module")
def truth():
    return logs.truth(20.0)


FILES = {
    "a.bbl": (b"H Product:Blackbox flight data recorder\nH Data version:2\n" + bytes(200), "blackbox_decode"),
    "a.tlog": (bytes(range(256)), "mavlogdump"),
    "a.mat": (b"MATLAB 5.0 MAT-file, Platform: GLNXA64" + bytes(300), "-v7.3"),
    "a.npy": (b"\x93NUMPY\x01\x00" + bytes(200), "numpy.savetxt"),
    "a.pkl": (pickle.dumps([1.0] * 50), "to_csv"),
    "a.csv.gz": (gzip.compress(b"t,x\n1,2\n"), "gunzip"),
    "a.csv.xz": (b"\xfd7zXZ\x00" + bytes(50), "unxz"),
    "a.csv.bz2": (b"BZh91AY" + bytes(50), "bunzip2"),
}


@pytest.mark.parametrize("name", FILES)
def test_a_format_that_is_not_read_is_named_with_its_way(tmp_path, name):
    content, way = FILES[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=way):
        import_log(tmp_path / name, None, Options())


def test_archives_by_their_names(tmp_path):
    for name, way in (("a.zip", "unzip"), ("a.npz", "numpy.load"), ("a.xlsx", "as CSV")):
        with zipfile.ZipFile(tmp_path / name, "w") as file:
            file.writestr("x", "1")
        with pytest.raises(DataError, match=way):
            import_log(tmp_path / name, None, Options())


def table_of(f):
    named = {"t": f.t}
    for name, values, axes in (("p", f.p, "xyz"), ("q", f.q, "wxyz"), ("v", f.v, "xyz"), ("w", f.w, "xyz"),
                               ("acc", f.acc, "xyz"), ("motor_command", f.command, "0123")):  # fmt: skip
        named |= {f"{name}_{axis}": values[:, i] for i, axis in enumerate(axes)}
    return named


def test_parquet_of_another_program_is_read_by_a_mapping(tmp_path, truth):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    pq.write_table(pa.table(table_of(truth)), tmp_path / "a.parquet")
    (tmp_path / "m.yaml").write_text("format: parquet" + MAPPING)
    options = Options(mapping=tmp_path / "m.yaml")
    flight, _ = import_log(tmp_path / "a.parquet", None, options, checked(options))
    np.testing.assert_array_equal(flight["v_y"], truth.v[:, 1])


def test_matlab_since_7_3_is_hdf5(tmp_path, truth):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        for name, values in table_of(truth).items():
            file[name] = values[None]
        file["pos"] = truth.p.T
    with open(tmp_path / "a.mat", "r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(116))
    lines = MAPPING.replace("[p_x, p_y, p_z]", '["pos[0]", "pos[1]", "pos[2]"]')
    (tmp_path / "m.yaml").write_text("format: hdf5" + lines)
    options = Options(mapping=tmp_path / "m.yaml")
    flight, _ = import_log(tmp_path / "a.mat", None, options, checked(options))
    np.testing.assert_array_equal(flight.stack(["p_x", "p_y", "p_z"]), truth.p)


@pytest.mark.parametrize("factor", [0.3, 0.6, 1.0])
def test_the_motor_curve_of_px4_is_undone(truth, tmp_path, factor, monkeypatch):
    """actuator_motors holds the thrust u = f s^2 + (1 - f) s that the signal s shall give."""
    s = np.linspace(0, 1, 11)
    assert signal_of_thrust(factor * s**2 + (1 - factor) * s, factor) == pytest.approx(s, abs=1e-12)
    plain = logs.ULogWriter

    def with_factor(parameters):
        return plain({**parameters, "THR_MDL_FAC": factor, "MAV_TYPE": 22.0})

    monkeypatch.setattr(logs, "ULogWriter", with_factor)
    flight, notes = import_log(logs.ulog(tmp_path / "a.ulg", truth), None, Options(crop=False))
    expected = signal_of_thrust(truth.command[:, 0].clip(0, 1), factor)
    assert np.abs(flight["motor_command_0"][:500] - expected[:500]).max() < 0.1
    assert np.median(flight["motor_command_0"]) == pytest.approx(np.median(expected), abs=0.01)
    assert any("THR_MDL_FAC" in note for note in notes) and any("VTOL" in note for note in notes)


# ---------------------------------------------------------------------------------------------------------------- bags
ODOMETRY = """uint64 timestamp
uint64 timestamp_sample
uint8 pose_frame
float32[3] position
float32[4] q
uint8 velocity_frame
float32[3] velocity
float32[3] angular_velocity
"""
COMBINED = "uint64 timestamp\nfloat32[3] gyro_rad\nfloat32[3] accelerometer_m_s2\n"


def test_px4_messages_in_a_bag(tmp_path, truth):
    rosbag2, typesys = pytest.importorskip("rosbags.rosbag2"), pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    kinds = {"px4_msgs/msg/VehicleOdometry": ODOMETRY, "px4_msgs/msg/SensorCombined": COMBINED,
             "my_msgs/msg/Status": "uint8 level\n"}  # fmt: skip
    for kind, text in kinds.items():
        store.register(typesys.get_types_from_msg(text, kind))
    q, p, v = frd_quaternion(truth), truth.p @ NED.T, truth.v @ NED.T
    w, acc = truth.w @ FRD, truth.acc @ FRD
    with rosbag2.Writer(tmp_path / "bag", version=9) as bag:
        topics = {kind: bag.add_connection(f"/{i}", kind, typestore=store) for i, kind in enumerate(kinds)}
        odometry, combined, status = (store.types[kind] for kind in kinds)
        for k, t in enumerate(truth.t):
            us, f = int(1e6 * (t + 5)), np.float32
            rows = (odometry(us, us, 1, p[k].astype(f), q[k].astype(f), 1, v[k].astype(f), w[k].astype(f)),
                    combined(us, w[k].astype(f), acc[k].astype(f)), status(1))  # fmt: skip
            for (kind, topic), row in zip(topics.items(), rows, strict=True):
                bag.write(topic, 1000 * us, store.serialize_cdr(row, kind))
    flight, notes = import_log(tmp_path / "bag", None, Options(crop=False))
    np.testing.assert_allclose(flight.stack(["v_x", "v_y", "v_z"]), truth.v, atol=1e-5)
    np.testing.assert_allclose(flight.stack(["acc_x", "acc_y", "acc_z"]), truth.acc, atol=1e-4)
    assert any("/2 (my_msgs/msg/Status): not read" in note for note in notes)


@pytest.mark.parametrize("encoding", ["jsonschema", "ros2msg"])
def test_a_foreign_channel_is_skipped_and_named(tmp_path, truth, encoding):
    writer = pytest.importorskip("mcap.writer")
    support = pytest.importorskip("mcap_ros2.writer")
    header = "std_msgs/Header header\ngeometry_msgs/Vector3 angular_velocity\n"
    header += "geometry_msgs/Vector3 linear_acceleration\n"
    rest = "=" * 80 + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    rest += "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    rest += "=" * 80 + "\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
    with open(tmp_path / "a.mcap", "wb") as stream:
        bag = support.Writer(stream, compression=writer.CompressionType.NONE)
        imu = bag.register_msgdef("sensor_msgs/msg/Imu", header + rest)
        raw = bag._writer
        other = raw.register_schema("my/srv/Arm_Event", encoding, b"bool arm\n---\nbool success\n")
        channel = raw.register_channel("/mode", "json" if encoding == "jsonschema" else "cdr", other)
        for k, t in enumerate(truth.t[:500]):
            ns = int(1e9 * (t + 100))
            stamp = {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": "imu"}
            vectors = (dict(zip("xyz", map(float, x[k]), strict=True)) for x in (truth.w, truth.acc))
            named = dict(zip(("angular_velocity", "linear_acceleration"), vectors, strict=True))
            bag.write_message("/imu", imu, {"header": stamp, **named}, ns, ns)
            if k % 50 == 0:
                raw.add_message(channel, log_time=ns, data=b"{}", publish_time=ns)
        bag.finish()
    flight, notes = import_log(tmp_path / "a.mcap", None, Options(crop=False))
    assert len(flight) == 500 and any("/mode (my/srv/Arm_Event): not read" in note for note in notes)
