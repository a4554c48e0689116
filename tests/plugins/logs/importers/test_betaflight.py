"""Betaflight's log, written here byte by byte as the firmware does: what was flown comes back."""

import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.plugins.logs.importers import Options, import_log
from quadexp.plugins.logs.importers.readers import reader_of
from tests.plugins.logs.importers import logs
from tests.plugins.logs.importers.logs import quad_x

FIELDS = [
    "loopIteration", "time", *(f"gyroADC[{i}]" for i in range(3)), *(f"accSmooth[{i}]" for i in range(3)),
    *(f"motor[{i}]" for i in range(4)), *(f"eRPM[{i}]" for i in range(4)), "vbatLatest",
    *(f"imuQuaternion[{i}]" for i in range(3)),
]  # fmt: skip
UNSIGNED = {"loopIteration", "time", "vbatLatest", *(f"eRPM[{i}]" for i in range(4))}
ACC_1G, POLES, OUTPUT = 2048, 12, (158, 2047)


def variable_bytes(value: int) -> bytes:
    """Seven bits a byte, the lowest first, the eighth where more follow."""
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def written(path, f, count=None, name="Blackbox flight data recorder by Nicholas Sherlock"):
    """A log of frames without predictors. Motors: back right, front right, back left, front left."""
    scale = struct.pack(">f", 1.0).hex()
    signed = ",".join("0" if field in UNSIGNED else "1" for field in FIELDS)
    coded = ",".join("1" if field in UNSIGNED else "0" for field in FIELDS)
    zeros = ",".join("0" for _ in FIELDS)
    header = [
        f"Product:{name}", "Data version:2", "I interval:1", "P interval:1/1", f"Field I name:{','.join(FIELDS)}",
        f"Field I signed:{signed}", f"Field I predictor:{zeros}", f"Field I encoding:{coded}",
        f"Field P predictor:{zeros}", f"Field P encoding:{coded}", "Firmware type:Cleanflight",
        "Firmware revision:Betaflight 4.5.1 (77d01ba3b) STM32F7X2", f"gyro_scale:0x{scale}", f"acc_1G:{ACC_1G}",
        f"motorOutput:{OUTPUT[0]},{OUTPUT[1]}", f"motor_poles:{POLES}",
    ]  # fmt: skip
    out = bytearray("".join(f"H {line}\n" for line in header).encode())
    q = (Rotation.from_euler("z", 90, degrees=True) * f.R).as_quat(scalar_first=True)  # x forward, y left of the start
    q = q * np.where(q[:, :1] < 0, -1, 1)
    motors = f.command[:, [1, 0, 2, 3]]  # of quad_x: front right, back right, back left, front left
    for k in range(len(f.t) if count is None else count):
        values = [
            k, 1e6 * (f.t[k] + 3), *np.degrees(f.w[k]), *(f.acc[k] / 9.80665 * ACC_1G),
            *(OUTPUT[0] + (OUTPUT[1] - OUTPUT[0]) * motors[k]), *(200 * motors[k]), 100 * f.voltage[k],
            *(32767 * q[k, 1:]),
        ]  # fmt: skip
        out += b"I"
        for field, value in zip(FIELDS, np.round(values).astype(int).tolist(), strict=True):
            zigzag = value if field in UNSIGNED else (value << 1) ^ (value >> 63)
            out += variable_bytes(zigzag)
    out += b"E\xffEnd of log\x00"
    path.write_bytes(out)
    return path


def test_its_reader_is_declared(tmp_path):
    assert reader_of(written(tmp_path / "a.bbl", logs.truth(1.0), 30)) == "betaflight"


def test_what_was_flown_comes_back(tmp_path):
    """To the counts of the firmware: 1 deg/s, 1/2048 g, 1/1889 of the command, 100 electrical turns a minute."""
    pytest.importorskip("orangebox")
    f = logs.truth(10.0)
    flight, _ = import_log(written(tmp_path / "a.bbl", f), quad_x(), Options(crop=False))
    k = slice(0, len(flight))
    assert flight.stack(["w_x", "w_y", "w_z"]) == pytest.approx(f.w[k], abs=0.51 * np.pi / 180)
    assert flight.stack(["acc_x", "acc_y", "acc_z"]) == pytest.approx(f.acc[k], abs=0.51 * 9.80665 / ACC_1G)
    assert flight.stack([f"motor_command_{i}" for i in range(4)]) == pytest.approx(f.command[k], abs=0.51 / 1889)
    expected = 200 * 100 * f.command[k] / (POLES / 2) * 2 * np.pi / 60
    assert flight.stack([f"rotor_speed_{i}" for i in range(4)]) == pytest.approx(expected, abs=0.51 * 100 / 6 * 0.1048)
    assert flight["battery_voltage"] == pytest.approx(f.voltage[k], abs=0.0051)
    got = Rotation.from_quat(flight.stack([f"q_{axis}" for axis in "wxyz"]), scalar_first=True)
    start = Rotation.from_euler("z", 90, degrees=True)
    assert ((start * f.R[k]).inv() * got).magnitude().max() < 0.02


def test_the_longest_of_several_logs_is_read(tmp_path):
    pytest.importorskip("orangebox")
    f = logs.truth(4.0)
    parts = [written(tmp_path / f"{n}.bbl", f, n).read_bytes() for n in (40, 150, 60)]
    path = tmp_path / "all.bbl"
    path.write_bytes(b"".join(parts))
    flight, notes = import_log(path, quad_x(), Options(crop=False))
    assert len(flight) == pytest.approx(150, abs=2)
    assert any("3 logs in one file: the longest, number 2" in note for note in notes)


@pytest.mark.parametrize("kept", [300, 900])
def test_a_log_without_frames_is_refused_in_one_line(tmp_path, kept):
    pytest.importorskip("orangebox")
    path = written(tmp_path / "a.bbl", logs.truth(1.0))
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(DataError, match=r"a\.bbl: ") as error:
        import_log(path, None, Options())
    assert "\n" not in str(error.value)


def test_without_the_package_the_way_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "orangebox", None)
    with pytest.raises(DataError, match=r"quadexp\[betaflight\].*blackbox_decode"):
        import_log(written(tmp_path / "a.bbl", logs.truth(1.0), 30), None, Options())
