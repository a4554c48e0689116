"""What is logged comes back: of an export of this program, PX4's logs, ROS bags, and a reader of one's own."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp import plugin
from quadexp.errors import DataError
from quadexp.log.schema import Flight
from quadexp.log.store import write_flight
from quadexp.plugins.exchange.flights import export_flight
from quadexp.plugins.logs.importers import Options, import_log
from tests.log.imitated import imitated
from tests.plugins.logs.importers import logs
from tests.plugins.logs.importers.logs import quad_x


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> tuple[Flight, Path]:
    f = logs.truth(6.0, 50.0)
    columns = {"t": f.t}
    for name, values in (("p", f.p), ("v", f.v), ("w", f.w), ("acc", f.acc)):
        columns |= {f"{name}_{axis}": values[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"q_{axis}": f.q[:, i] for i, axis in enumerate("wxyz")}
    columns |= {f"u_{i}": 6.0 * f.command[:, i] ** 2 for i in range(4)}
    columns |= {f"ref_{name}": columns[name] + 0.01 for name in ("p_x", "p_y", "p_z", "v_x", "v_y", "v_z")}
    columns |= {f"ref_q_{axis}": f.q[:, i] for i, axis in enumerate("wxyz")}
    columns |= {f"ref_w_{axis}": f.w[:, i] for i, axis in enumerate("xyz")}
    columns["status"] = np.zeros(len(f.t), np.int8)
    flight = Flight(columns, {"outcome": "ok", "name": "made"})
    return flight, write_flight(tmp_path_factory.mktemp("flown") / "made.parquet", flight)


def test_export_and_import_again(flown, tmp_path):
    """A csv under the names of a flight's columns is a log in their units and frames, whatever its own name is."""
    flight, path = flown
    export_flight(path, "csv", tmp_path / "made.log")
    again, _ = import_log(tmp_path / "made.log", quad_x(), Options())
    assert set(flight.columns) - set(again.columns) == {"status", "ref_w_x", "ref_w_y", "ref_w_z"}
    for name in set(flight.columns) & set(again.columns):
        np.testing.assert_array_equal(again[name], flight[name], err_msg=name)
    again, _ = import_log(tmp_path / "made.log", quad_x(), Options(rate=20.0, align=True))
    source = again.metadata["source"]
    assert again.metadata["recorded"] and source["resampled"] and source["rate"] == 20.0
    assert again.metadata["vehicle"]["fingerprint"] == quad_x().fingerprint
    assert np.allclose(np.diff(again.t), 0.05)
    with pytest.raises(DataError, match="needs no import"):
        import_log(path, None, Options())


def test_a_module_that_is_brought_is_a_format(tmp_path, monkeypatch):
    """Nothing else has to be written for a new format of logs than its name in BRINGS."""
    (tmp_path / "blackbox.py").write_text(
        "import numpy as np\n"
        "from quadexp.plugins.logs.importers.raw import RawLog\n"
        "from quadexp.plugins.logs.signal import Stream\n"
        "ABOUT = 'made up'\n"
        "def recognises(path, head): return (head or b'').startswith(b'BLACKBOX')\n"
        "def read(path, named):\n"
        "    return RawLog('blackbox', {'rate': Stream(np.arange(50) / 50, np.ones((50, 3)))})\n"
    )
    (tmp_path / "a.bin").write_bytes(b"BLACKBOX, in text")
    with pytest.raises(DataError, match="not a table"):
        import_log(tmp_path / "a.bin", None, Options())
    readers = sys.modules["quadexp.plugins.logs.importers.readers"]  # the package's function has the same name
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(plugin._shipped()["readers"], "blackbox", "blackbox")
    readers.readers.cache_clear()
    try:
        flight, _ = import_log(tmp_path / "a.bin", None, Options())
        assert flight.metadata["source"]["format"] == "blackbox" and (flight["w_z"] == 1).all()
    finally:
        readers.readers.cache_clear()
        sys.modules.pop("blackbox", None)


@pytest.mark.parametrize("version", ["new", "old"])
def test_ulog_of_old_and_new_px4(tmp_path, version):
    """NED and FRD to ENU and FLU, topics of both versions, PX4's motors in the vehicle's order; to float32."""
    f = logs.truth(10.0, 100.0)
    flight, notes = import_log(logs.ulog(tmp_path / "a.ulg", f, version), quad_x(), Options())
    k = np.round(flight.t * 100).astype(int)
    names = lambda prefix, axes="xyz": flight.stack([f"{prefix}_{a}" for a in axes])  # noqa: E731
    np.testing.assert_allclose(names("p")[::2], f.p[k][::2], atol=2e-6)
    np.testing.assert_allclose(names("v")[::2], f.v[k][::2], atol=2e-6)
    np.testing.assert_allclose(names("acc"), f.acc[k], atol=2e-6)
    np.testing.assert_allclose(names("w"), f.w[k], atol=2e-6)
    turned = f.R[k].inv() * Rotation.from_quat(names("q", "wxyz"), scalar_first=True)
    assert turned.magnitude()[::2].max() < 1e-6
    commands = flight.stack([f"motor_command_{i}" for i in range(4)])
    np.testing.assert_allclose(commands, f.command[k], atol=1e-6 if version == "new" else 1e-4)
    assert np.abs(flight["battery_voltage"] - f.voltage[k]).max() < 0.02 * 0.21
    if version == "new":
        np.testing.assert_allclose(
            flight["rotor_speed_1"][::2], 20000 * np.pi / 30 * f.command[k, 1][::2], atol=np.pi / 30
        )
    assert not any("damaged" in note for note in notes)


@pytest.mark.parametrize("version", [1, 2])
def test_rosbag(tmp_path, version):
    """Velocity of an odometry is in the child's frame; what was wanted is not taken for what was flown."""
    pytest.importorskip("rosbags", reason="the extra [logs] is not installed")
    f = logs.truth(4.0, 50.0)
    path = logs.rosbag(tmp_path / ("a.bag" if version == 1 else "bag"), f, version)
    flight, _ = import_log(path, None, Options())
    for prefix, values in (("p", f.p), ("v", f.v), ("w", f.w), ("acc", f.acc)):
        np.testing.assert_allclose(flight.stack([f"{prefix}_{a}" for a in "xyz"]), values, atol=1e-5, err_msg=prefix)
    assert flight.metadata["source"]["topics"]["position"] == "/drone/odometry"


def test_what_messages_hold():
    """Fields by the type of a message: electrical speeds, a twist in the body, an IMU that knows no attitude."""
    from types import SimpleNamespace as Message

    from quadexp.plugins.logs.importers.readers.rosbag import _fields, _take

    def taken(kind: str, message: Message) -> dict:
        found: dict = {}
        _take(found, _fields(kind), "/topic", 1.0, message)
        return {quantity: topics["/topic"] for quantity, topics in found.items()}

    x, q = Message(x=1.0, y=2.0, z=3.0), Message(w=1.0, x=0.0, y=0.0, z=0.0)
    esc = taken("mavros_msgs/msg/ESCStatus", Message(esc_status=[Message(rpm=-60)] * 4))
    assert list(esc) == ["rotor_speed"] and esc["rotor_speed"].values == [pytest.approx([2 * np.pi] * 4)]
    twist = Message(header=Message(frame_id="base_link"), twist=Message(linear=x, angular=x))
    made = taken("geometry_msgs/msg/TwistStamped", twist)
    assert made["velocity"].in_body and made["rate"].values == [[1.0, 2.0, 3.0]]
    imu = Message(angular_velocity=x, linear_acceleration=x, orientation=q, orientation_covariance=[-1.0])
    assert set(taken("sensor_msgs/msg/Imu", imu)) == {"rate", "acceleration"}
    state = Message(pose=Message(position=x, orientation=q), velocity=Message(linear=x, angular=x), motors=[1.0] * 4)
    made = taken("agiros_msgs/msg/QuadState", state)
    assert set(made) == {"position", "attitude", "velocity", "rate", "rotor_speed"} and not made["velocity"].in_body
    assert taken("std_msgs/msg/String", Message(data="")) == {}


def test_decivolts_and_electrical_turns(tmp_path):
    """168 dV, and 7 pole pairs: 70 000 electrical turns a minute are 10 000 of the rotor, 1047.2 rad/s."""
    flight = imitated(94, "torrente", duration=6, signal="rotor_speed")
    names = [f"rotor_speed_{i}" for i in range(4)]
    columns = flight.columns | {name: 7 * flight[name] * 60 / (2 * np.pi) for name in names}
    columns["battery_voltage"] = 10 * columns["battery_voltage"]
    words = "".join(line for line in logs.MAPPING.splitlines(keepends=True) if not line.startswith("motor_command"))
    words += f"rotor_speed: {{columns: [{', '.join(names)}], unit: erpm, pole_pairs: 7}}\n"
    words += "battery_voltage: {column: battery_voltage, unit: dV}\n"
    _, again = logs.imported(tmp_path, Flight(columns, {}), words)
    for name in ("battery_voltage", "rotor_speed_2"):
        assert np.allclose(again[name], flight[name])
