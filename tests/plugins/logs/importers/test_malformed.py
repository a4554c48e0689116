"""A file that is no log, or a damaged one: one line that says what was found, and no more."""

import struct
import tracemalloc

import numpy as np
import pytest

from quadexp.errors import QuadexpError, UsageError
from quadexp.plugins.logs.importers import Options, import_log
from quadexp.plugins.logs.importers.mapping import load_mapping
from tests.plugins.logs.importers import logs

HEADER = "t,px,py,pz,qx,qy,qz,qw,vx,vy,vz,imu_acc_x,imu_acc_y,imu_acc_z,imu_gyro_x,imu_gyro_y,imu_gyro_z,"
HEADER += "motor_motor_m1,motor_motor_m2,motor_motor_m3,motor_motor_m4,pwr_pm_vbat"
WIDTH = HEADER.count(",") + 1


def rows(count: int, t=None) -> str:
    t = np.arange(count) * 0.01 if t is None else t
    data = np.full((count, WIDTH), 0.25)
    data[:, 0], data[:, 7] = t, 1.0
    return "\n".join([HEADER, *(",".join(f"{x:.6g}" for x in row) for row in data)]) + "\n"


CASES = {
    "empty": (b"", "empty"),
    "garbage": (bytes(range(256)) * 20, "neither"),
    "wrong header": (b"a,b,c,d\n" + b"1,2,3,4\n" * 50, "unknown origin"),
    "one row": (rows(1).encode(), "one row|two rows"),
    "all NaN": ((HEADER + "\n" + "\n".join([",".join(["nan"] * WIDTH)] * 40)).encode(), "number"),
    "time goes back": (rows(100, np.concatenate([np.arange(50), np.arange(50)]) * 0.01).encode(), "backwards"),
    "a word": (rows(40).replace("0.25", "fast", 1).encode(), "column 'px' holds 'fast'"),
    "short lines": ((rows(40) + "1,2,3\n" * 40).encode(), "another number of values"),
    "header alone": ((HEADER + "\n").encode(), "no line of numbers"),
    "ulog header alone": (b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1), "ULog"),
    "ulog cut in its header": (b"ULog\x01\x12\x35\x01\x00", "[Hh]eader"),
    "hdf5 header alone": (b"\x89HDF\r\n\x1a\n" + bytes(100), "HDF5"),
    "parquet header alone": (b"PAR1" + bytes(50), "Parquet"),
    "mcap header alone": (b"\x89MCAP0\r\n" + bytes(50), "damaged|bag"),
    "bag header alone": (b"#ROSBAG V2.0\n" + bytes(50), "damaged|bag"),
    "UTF-16": ("t,x\n1,2\n".encode("utf-16"), "UTF-16"),
    "pointer of Git LFS": (
        b"version https://git-lfs.github.com/spec/v1\noid sha256:0a1b\nsize 4053364\n",
        "git lfs pull",
    ),
    "endless line": (b"1" * 300_000, "not a table"),
}


@pytest.mark.parametrize("case", CASES)
def test_one_clear_line(tmp_path, case):
    content, expected = CASES[case]
    path = tmp_path / "log.dat"
    path.write_bytes(content)
    with pytest.raises(QuadexpError, match=expected) as error:
        import_log(path, None, Options())
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def test_truncated_anywhere(tmp_path):
    """Cut at any place, a log gives a flight or one line."""
    f = logs.truth(3.0, 50.0)
    whole = logs.ulog(tmp_path / "a.ulg", f).read_bytes()
    for share in np.linspace(0, 0.999, 15):
        (tmp_path / "b.ulg").write_bytes(whole[: int(share * len(whole))])
        try:
            assert np.isfinite(import_log(tmp_path / "b.ulg", None, Options())[0].t).all()
        except QuadexpError as error:
            assert "\n" not in str(error)


def test_declared_length_is_not_believed(tmp_path):
    """A message format larger than a message can be, and one that contains itself."""
    for fields, said in (
        ("uint64_t timestamp;float[60000] q;", "declares"),
        ("uint64_t timestamp;vehicle_attitude a;", "itself"),
    ):
        log = logs.ULogWriter()
        log.format("vehicle_attitude", fields)
        with pytest.raises(QuadexpError, match=said):
            import_log(log.write(tmp_path / "a.ulg"), None, Options())


def test_ten_gigabytes_of_nothing(tmp_path):
    """A sparse file of 10 GB behind a true header is refused at once."""
    path = logs.ulog(tmp_path / "a.ulg", logs.truth(1.0, 50.0))
    with open(path, "r+b") as file:
        file.truncate(10 << 30)
    tracemalloc.start()
    with pytest.raises(QuadexpError, match="GB"):
        import_log(path, None, Options())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6


def test_missing_topic_is_named(tmp_path):
    log = logs.ULogWriter()
    log.format("cpuload", "uint64_t timestamp;float load;")
    log.topic("cpuload", np.arange(100) * 0.1, np.ones((100, 1)), "f")
    with pytest.raises(QuadexpError, match="no flight was logged|vehicle_attitude"):
        import_log(log.write(tmp_path / "a.ulg"), None, Options())


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("time: {column: t}\npositoin: {columns: [x, y, z]}\n", 2, "did you mean position"),
        ("world: NET\ntime: {column: t}\nposition: {columns: [x, y, z]}\n", 1, "NED"),
        ("time: {column: t}\nmotor_command:\n  columns: [a, b, c]\n  layout: [front, back, up]\n", 4, "front_right"),
        ("position: {columns: [x, y, z]}\n", 1, "time: is missing"),
        *((f"time: {{column: t}}\n{line}\n", 2, said) for line, said in (
            ("position: {columns: [x, y, z], unit: yards}", "allowed are m, cm"),
            ("attitude: {columns: [a, b, c, d], order: wxxz}", "wxyz, xyzw"),
            ("position: {columns: [x, y]}", "3 are needed"),
            ("rotor_speed: {columns: [a, b, c, d], unit: erpm}", "rotor_speed.pole_pairs: is missing"),
            ("rotor_speed: {columns: [a, b, c, d], unit: erpm, pole_pairs: 3.5}", "3.5 must be a whole number"),
            ("rotor_speed: {columns: [a, b, c, d], unit: rpm, pole_pairs: 7}", "goes with unit erpm, not rpm"),
            ("acceleration: {columns: [a, b, c], mounting: [1, 2]}", "must be \\[roll, pitch, yaw\\]"),
            ("acceleration: {columns: [a, b, c], frame: world, mounting: [1, 2, 3]}", "but `frame` says world"),
            ("acceleration: {columns: [a, b, c], mounting: [1, x, 3]}", "must be \\[roll, pitch, yaw\\]"),
            ("position: {columns: [a, b, c], mounting: [1, 2, 3]}", "unknown key"),
            ("battery_voltage: {column: a, unit: kV}", "allowed are V, mV, cV, dV"),
        )),
        *((f"time: {{column: t}}\nrate: {{columns: [a, b, c]}}\ncorrections: {lines}\n", 3, said) for lines, said in (
            ("{rate: {unit: deg/s}}", "must be a list of lines"),
            ("[{wind: {unit: m/s}}]", "'wind': allowed are world, body, time, rate"),
            ("[{rate: {unit: rpm}}]", "unit 'rpm' is not known"),
            ("[{rate: {columns: [a, b, c]}}]", "unknown key"),
            ("[{time: {scale: -1}}]", "must be one positive number"),
            ("[{time: {column: x}}]", "unknown key"),
            ("[{rate: }]", "must be a mapping"),
        )),
    ],
)  # fmt: skip
def test_mistakes_in_a_mapping_name_line_and_key(tmp_path, text, line, said):
    file = tmp_path / "m.yaml"
    file.write_text(text)
    with pytest.raises(UsageError, match=said) as error:
        load_mapping(file)
    assert str(error.value).startswith(f"{file}:{line}: ")
