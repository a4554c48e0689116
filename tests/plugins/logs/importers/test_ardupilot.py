"""ArduPilot's data-flash log: what was flown comes back."""

import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.plugins.logs.importers import Options, import_log
from quadexp.plugins.logs.importers.readers import reader_of
from tests.plugins.logs.importers import logs
from tests.plugins.logs.importers.logs import FRD, NED, quad_x

CODES = {"Q": "Q", "B": "B", "f": "f", "H": "H", "N": "16s"}
MESSAGES = {
    "XKF1": (130, "QBffffff", "TimeUS,C,VN,VE,VD,PN,PE,PD"), "ATT": (131, "Qfff", "TimeUS,Roll,Pitch,Yaw"),
    "IMU": (132, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"), "RCOU": (133, "QHHHH", "TimeUS,C1,C2,C3,C4"),
    "PARM": (134, "QNf", "TimeUS,Name,Value"), "BAT": (135, "QBf", "TimeUS,Inst,Volt"),
}  # fmt: skip


def written(path, f):
    """A log of frame X: motors front right, back left, front left, back right; a second IMU that is wrong."""
    out = bytearray()

    def declare(name, number, size, codes, columns):
        out.extend(b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, size, name, codes, columns))

    declare(b"FMT", 128, 89, b"BBnNZ", b"Type,Length,Name,Format,Columns")
    for name, (number, codes, columns) in MESSAGES.items():
        size = 3 + struct.calcsize("<" + "".join(CODES[code] for code in codes))
        declare(name.encode(), number, size, codes.encode(), columns.encode())

    def put(name, *values):
        number, codes, _ = MESSAGES[name]
        out.extend(b"\xa3\x95" + bytes([number]) + struct.pack("<" + "".join(CODES[code] for code in codes), *values))

    for i in range(4):
        put("PARM", 0, f"SERVO{i + 1}_FUNCTION".encode(), 33 + i)
    angles = Rotation.from_matrix(NED.T @ f.R.as_matrix() @ FRD).as_euler("ZYX", degrees=True)[:, ::-1]
    p, v, w, acc, motors = f.p @ NED.T, f.v @ NED.T, f.w @ FRD, f.acc @ FRD, f.command[:, [0, 2, 3, 1]]
    for k, t in enumerate(f.t):
        us = int(1e6 * (t + 3))
        put("IMU", us, 0, *w[k], *acc[k])
        put("IMU", us, 1, *(w[k] + 1), *acc[k])
        put("ATT", us, *angles[k])
        put("RCOU", us, *(round(1000 + 1000 * x) for x in motors[k]))
        put("XKF1", us, 0, *v[k], *p[k])
        put("BAT", us, 0, f.voltage[k])
    path.write_bytes(out)
    return path


def test_its_reader_is_declared(tmp_path):
    """Whether or not pymavlink is installed."""
    path = written(tmp_path / "a.BIN", logs.truth(0.1))
    assert reader_of(path) == "ardupilot"


def test_what_was_flown_comes_back(tmp_path):
    pytest.importorskip("pymavlink")
    f = logs.truth(10.0)
    flight, _ = import_log(written(tmp_path / "a.BIN", f), quad_x(), Options(crop=False))
    k = slice(0, len(flight))
    for name, values in (("p", f.p), ("v", f.v), ("w", f.w), ("acc", f.acc)):
        np.testing.assert_allclose(flight.stack([f"{name}_{axis}" for axis in "xyz"]), values[k], atol=1e-4)
    got = Rotation.from_quat(flight.stack([f"q_{axis}" for axis in "wxyz"]), scalar_first=True)
    assert (f.R[k].inv() * got).magnitude().max() < 1e-5
    np.testing.assert_allclose(flight.stack([f"motor_command_{i}" for i in range(4)]), f.command[k], atol=6e-4)
    assert flight["battery_voltage"] == pytest.approx(f.voltage[k], abs=1e-4)


def test_a_truncated_log_is_refused_in_one_line(tmp_path):
    pytest.importorskip("pymavlink")
    path = written(tmp_path / "a.BIN", logs.truth(1.0))
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(DataError, match=r"a\.BIN: "):
        import_log(path, None, Options())
