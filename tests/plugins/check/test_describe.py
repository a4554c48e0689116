"""Mappings proposed from the data: what is proposed has to give the flight back that was logged."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.plugins.check.describe import describe_log
from quadexp.plugins.logs.importers import Options, import_log
from quadexp.plugins.logs.importers.mapping import load_mapping
from tests.plugins.logs.importers import logs
from tests.plugins.logs.importers.logs import G, quad_x


@pytest.fixture(scope="module")
def truth():
    return logs.truth(20.0, 100.0)


def imported(path, tmp_path):
    found = describe_log(path)
    file = tmp_path / "proposed.yaml"
    file.write_text(found.yaml())
    flight, _ = import_log(path, quad_x(), Options(mapping=file), load_mapping(file))
    return found, flight


@pytest.mark.parametrize("logger", ["rotorpy", "euroc", "ulog2csv", "neurobem"])
def test_the_proposal_gives_the_flight_back(truth, tmp_path, logger):
    """Whatever the units, frames, order and direction of the log."""
    found, flight = imported(getattr(logs, logger)(tmp_path / "a.csv", truth), tmp_path)
    f = truth
    assert len(flight) == len(f.t)
    for prefix, values in (("p", f.p), ("v", f.v), ("w", f.w), ("acc", f.acc)):
        if f"{prefix}_x" in flight.columns:
            got = flight.stack([f"{prefix}_{axis}" for axis in "xyz"])
            np.testing.assert_allclose(got, values, atol=2e-5, err_msg=prefix)
        else:
            assert (logger, prefix) == ("rotorpy", "acc")  # it logs none
    got = Rotation.from_quat(flight.stack([f"q_{axis}" for axis in "wxyz"]), scalar_first=True)
    assert (f.R.inv() * got).magnitude().max() < 1e-5
    assert found.fields["attitude"].sureness == "sure"
    motors = [name for name in flight.columns if name.startswith(("motor_command_", "rotor_speed_"))]
    if logger != "euroc":
        ratio = np.sort(flight.stack(motors), axis=1) / np.sort(f.command, axis=1)  # in whatever order
        assert len(motors) == 4 and np.ptp(ratio) < 1e-3 * ratio.mean()


def test_betaflight_has_units_and_counts(truth, tmp_path):
    """No attitude: what can be had is rates, specific force and commands, and that is said."""
    found, flight = imported(logs.betaflight(tmp_path / "a.csv", truth), tmp_path)
    np.testing.assert_allclose(flight.stack(["w_x", "w_y", "w_z"]), truth.w, atol=1e-5)
    np.testing.assert_allclose(flight["acc_z"], truth.acc[:, 2] * 9.80665 / 9.81, atol=1e-4)
    np.testing.assert_allclose(flight["motor_command_1"], truth.command[:, 0], atol=1e-5)  # front right is the second
    assert any("attitude" in text for text in found.warnings)


def test_a_table_whose_names_say_nothing_needs_a_mapping_by_hand(truth, tmp_path):
    found = describe_log(logs.unnamed(tmp_path / "a.csv", truth))
    assert set(found.fields) == {"time", "crop"}
    assert any("no column was recognised" in text for text in found.warnings)


def test_what_needs_no_mapping_says_so(truth, tmp_path):
    with pytest.raises(DataError, match="needs no mapping"):
        describe_log(logs.ulog(tmp_path / "a.ulg", truth))


def test_no_clock_is_said(rng, tmp_path):
    columns = dict(zip("abcd", rng.normal(size=(4, 100)), strict=True))
    with pytest.raises(DataError, match="no clock"):
        describe_log(logs.write_csv(tmp_path / "a.csv", columns))


def test_a_time_in_words_is_named(tmp_path):
    rows = [f"2026-01-01T00:00:{second:02d},0,1" for second in range(60)]
    (tmp_path / "a.csv").write_text("\n".join(["when,x,y", *rows, ""]))
    with pytest.raises(DataError, match="not columns of numbers: when"):
        describe_log(tmp_path / "a.csv")


def test_a_clock_that_jumps_is_said(truth, tmp_path):
    """Between its two parts nothing was flown: what is interpolated there says nothing of the columns."""
    columns = _table(truth, truth.p, truth.v, truth.q) | {"t": truth.t + 3600.0 * (truth.t > 10.0)}
    with pytest.raises(DataError, match=r"3600.01 s of it after row 1000: its clock jumps"):
        describe_log(logs.write_csv(tmp_path / "a.csv", columns))


@pytest.mark.parametrize("rows", [1, 5, 49])
def test_too_few_rows_are_counted(truth, tmp_path, rows):
    columns = {"t": truth.t[:rows], "x": truth.p[:rows, 0]}
    with pytest.raises(DataError, match=f"{rows} rows: too few"):
        describe_log(logs.write_csv(tmp_path / "a.csv", columns))


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize(
    ("name", "factor", "quantity"),
    [
        ("rotor_speed_{}", 700.0, "rotor_speed"),
        ("motor_speed[{}]", 700.0, "rotor_speed"),
        ("rotor_omega_{}", 700.0, "rotor_speed"),
        ("motor_{}_speed", 700.0, "rotor_speed"),
        ("motor_command_{}", 1.0, "motor_command"),
        ("motor_thrust_{} [N]", 20.0, "rotor_thrust"),
        ("u_{}", 4.0, "rotor_thrust"),
    ],
)
def test_numbered_rotors_are_no_vector(truth, tmp_path, first, name, factor, quantity):
    """rotor_speed_0, 1, 2 are no velocity; newtons are no percent."""
    columns = {name.format(first + i): factor * truth.command[:, i] for i in range(4)}
    found = describe_log(logs.write_csv(tmp_path / "a.csv", _table(truth, truth.p, q=truth.q, **columns)))
    assert found.fields[quantity].value["columns"] == list(columns)
    assert not any("motor command" in text for text in found.warnings)
    assert "velocity" not in found.fields


def test_no_rotors_are_said(truth, tmp_path):
    found = describe_log(logs.write_csv(tmp_path / "a.csv", _table(truth, truth.p, q=truth.q)))
    assert any("no motor command" in text for text in found.warnings)


def _table(f, p=None, v=None, q=None, **more):
    columns = {"t": f.t}
    columns |= {} if p is None else logs._named("x|y|z", p)
    columns |= {} if v is None else logs._named("vx|vy|vz", v)
    return columns | logs._named("qw|qx|qy|qz", q) | more


@pytest.mark.parametrize(
    ("frame", "known", "inverse"),
    [("ENU", "p", True), ("ENU", "v", False), ("NED", "pv", True), ("NED", "p", False), ("NED", "v", True)],
)
def test_the_thrust_says_which_way_is_up(truth, tmp_path, frame, known, inverse):
    """Poses and velocities alone, no accelerometer: the thrust keeps to one axis of the body."""
    turn = logs.NED if frame == "NED" else np.eye(3)
    q = (logs.frd_quaternion(truth) if frame == "NED" else truth.q) * ([1, -1, -1, -1] if inverse else 1)
    chosen = {name: values @ turn.T for name, values in (("p", truth.p), ("v", truth.v)) if name in known}
    found, flight = imported(logs.write_csv(tmp_path / "a.csv", _table(truth, q=q, **chosen)), tmp_path)
    assert found.fields["world"].value == frame and found.fields["world"].sureness != "guess"
    got = Rotation.from_quat(flight.stack([f"q_{axis}" for axis in "wxyz"]), scalar_first=True)
    assert (truth.R.inv() * got).magnitude().max() < 1e-5
    if "v" in known:
        np.testing.assert_allclose(flight.stack(["v_x", "v_y", "v_z"]), truth.v, atol=2e-5)


def test_names_that_say_body(truth, tmp_path):
    """acc_b_x is an acceleration in the body, b_a_x a bias; ang_acc is neither."""
    noise = logs._named("b_acc_x|b_acc_y|b_acc_z", 0.01 * truth.acc)
    columns = _table(
        truth, v=truth.v, q=truth.q, **noise, **logs._named("ang_acc_b_x|ang_acc_b_y|ang_acc_b_z", truth.w)
    )
    columns |= logs._named("acc_b_x|acc_b_y|acc_b_z", truth.acc) | logs._named("gyro_b_x|gyro_b_y|gyro_b_z", truth.w)
    found, flight = imported(logs.write_csv(tmp_path / "a.csv", columns), tmp_path)
    assert found.fields["acceleration"].value["columns"] == ["acc_b_x", "acc_b_y", "acc_b_z"]
    np.testing.assert_allclose(flight.stack(["acc_x", "acc_y", "acc_z"]), truth.acc, atol=2e-5)
    np.testing.assert_allclose(flight.stack(["w_x", "w_y", "w_z"]), truth.w, atol=2e-5)


def test_without_a_path_an_accelerometer_is_not_said_to_be_in_the_world(truth, tmp_path):
    """Of a vehicle with little drag it reads what one that hovers level reads in the world: (0, 0, thrust / mass)."""
    force = truth.acc * [0.0, 0.0, 1.0] + 0.1 * np.random.default_rng(0).standard_normal(truth.acc.shape)
    columns = _table(truth, q=truth.q, **logs._named("acc_x|acc_y|acc_z", force))
    columns |= logs._named("gyro_x|gyro_y|gyro_z", truth.w)
    found = describe_log(logs.write_csv(tmp_path / "a.csv", columns))
    assert found.fields["acceleration"].value["columns"] == ["acc_x", "acc_y", "acc_z"]
    assert "corrections" not in found.fields


@pytest.mark.parametrize("sensor", ["acc", "w"])
def test_one_sensor_is_in_frd(truth, tmp_path, sensor):
    """The other one, attitude and path are in FLU and ENU: no frame of all of them explains the log."""
    log = columns_of(truth) | logs._named("qw|qx|qy|qz", truth.q)
    log |= {f"{sensor}_{axis}": -log[f"{sensor}_{axis}"] for axis in "yz"}
    found, flight = imported(logs.write_csv(tmp_path / "a.csv", log), tmp_path)
    assert (found.fields["world"].value, found.fields["body"].value) == ("ENU", "FLU")
    np.testing.assert_allclose(flight.stack(["acc_x", "acc_y", "acc_z"]), truth.acc, atol=2e-5)
    np.testing.assert_allclose(flight.stack(["w_x", "w_y", "w_z"]), truth.w, atol=2e-5)


def test_gravity_taken_out_of_a_fast_flight(truth, tmp_path):
    """Its mean size is as large as gravity."""
    log = columns_of(truth) | logs._named("qw|qx|qy|qz", truth.q)
    motion = truth.R.apply(3 * truth.R.apply(truth.acc) - [0, 0, 3 * G], inverse=True)
    log |= {f"acc_{axis}": motion[:, i] for i, axis in enumerate("xyz")}
    log |= {f"{name}_{axis}": 3 * log[f"{name}_{axis}"] for name in "pv" for axis in "xyz"}
    found = describe_log(logs.write_csv(tmp_path / "a.csv", log))
    assert found.fields["acceleration"].value["kind"] == "coordinate"
    assert "frame" not in found.fields["acceleration"].value


def test_a_quaternion_whose_columns_are_not_what_they_are_called(truth, tmp_path):
    """qw, qx, qy, qz hold x, y, z, w."""
    log = columns_of(truth) | logs._named("qw|qx|qy|qz", truth.q[:, [1, 2, 3, 0]])
    found, flight = imported(logs.write_csv(tmp_path / "a.csv", log), tmp_path)
    assert found.fields["attitude"].value["order"] == "xyzw" and "corrections" not in found.fields
    got = Rotation.from_quat(flight.stack([f"q_{axis}" for axis in "wxyz"]), scalar_first=True)
    assert (truth.R.inv() * got).magnitude().max() < 1e-5


def test_what_nothing_explains_is_no_sure_proposal(truth, tmp_path):
    """An accelerometer of another flight."""
    log = columns_of(truth) | logs._named("qw|qx|qy|qz", truth.q)
    other = Rotation.from_euler("xyz", np.column_stack([3 * truth.t, 2 * truth.t, truth.t])).apply(truth.acc)
    log |= {f"acc_{axis}": 2 * other[:, i] for i, axis in enumerate("xyz")}
    found = describe_log(logs.write_csv(tmp_path / "a.csv", log))
    for key in ("world", "body"):
        assert found.fields[key].sureness == "guess" and "acc" in found.fields[key].why


def test_an_attitude_at_ten_hertz(tmp_path):
    """Smoothing shortens a quaternion that turns fast; it is one all the same."""
    f = logs.truth(60.0, 10.0)
    fast = Rotation.from_euler("Z", 3.0 * f.t[:, None]) * f.R
    columns = {"t": f.t, **logs._named("qw|qx|qy|qz", fast.as_quat(scalar_first=True)), **logs._named("x|y|z", f.p)}
    found = describe_log(logs.write_csv(tmp_path / "a.csv", columns))
    assert found.fields["attitude"].value["columns"] == ["qw", "qx", "qy", "qz"]


def columns_of(f):
    """Columns of the truth without attitude, in SI."""
    named = {"t": f.t}
    for name, values in (("p", f.p), ("v", f.v), ("w", f.w), ("acc", f.acc)):
        named |= {f"{name}_{axis}": values[:, i] for i, axis in enumerate("xyz")}
    return named


@pytest.mark.parametrize("signs", [(1, -1, 1), (-1, 1, 1), (1, 1, -1)])
def test_signs_of_roll_pitch_and_yaw_that_wraps(truth, tmp_path, signs):
    """As Crazyflie's stabilizer.pitch, positive nose up, with a heading that goes through 180 deg."""
    turn = Rotation.from_euler("z", 170, degrees=True)
    angles = (turn * truth.R).as_euler("ZYX", degrees=True)[:, ::-1] * signs
    log = columns_of(truth)
    for name in ("p", "v"):
        turned = turn.apply(np.column_stack([log[f"{name}_{axis}"] for axis in "xyz"]))
        log |= {f"{name}_{axis}": turned[:, i] for i, axis in enumerate("xyz")}
    log |= {name: angles[:, i] for i, name in enumerate(("roll", "pitch", "yaw"))}
    found, flight = imported(logs.write_csv(tmp_path / "a.csv", log), tmp_path)
    got = Rotation.from_quat(flight.stack([f"q_{axis}" for axis in "wxyz"]), scalar_first=True)
    assert found.fields["attitude"].sureness == "sure" and "corrections" not in found.fields
    assert ((turn * truth.R).inv() * got).magnitude().max() < 1e-5


def test_a_yaw_in_degrees_beside_roll_and_pitch_in_rad(truth, tmp_path):
    angles = truth.R.as_euler("ZYX")[:, ::-1] * [1.0, -1.0, 180 / np.pi]  # and a pitch that is positive nose up
    log = columns_of(truth) | {name: angles[:, i] for i, name in enumerate(("roll", "pitch", "yaw"))}
    found, flight = imported(logs.write_csv(tmp_path / "a.csv", log), tmp_path)
    assert found.fields["attitude"].value["unit"] == "rad"
    got = Rotation.from_quat(flight.stack([f"q_{axis}" for axis in "wxyz"]), scalar_first=True)
    assert (truth.R.inv() * got).magnitude().max() < 1e-4


@pytest.mark.parametrize("rows", [1990, 1991])
def test_a_quaternion_with_w_above_zero_is_continued(truth, tmp_path, rows):
    """Its sign jumps where the nose points west; rows: whether the samples looked at lie between those of the log."""
    turned = Rotation.from_euler("z", 180, degrees=True) * truth.R
    q = turned.as_quat(scalar_first=True)
    q *= np.sign(q[:, :1])
    assert (np.sum(q[1:] * q[:-1], axis=1) < 0).any()
    log = columns_of(truth) | {f"q_{axis}": q[:, i] for i, axis in enumerate("wxyz")}
    log |= {name: -log[name] for name in ("p_x", "p_y", "v_x", "v_y")}
    log["t"] = log["t"] + 0.003 * np.sin(np.arange(len(truth.t)))
    found = describe_log(logs.write_csv(tmp_path / "a.csv", {name: x[:rows] for name, x in log.items()}))
    assert found.fields["attitude"].value["columns"] == ["q_w", "q_x", "q_y", "q_z"]


@pytest.mark.parametrize("counts", [16.4, 32.8, 65.5, 131.0])
def test_counts_of_a_gyro_are_no_milliradians(truth, tmp_path, counts):
    log = columns_of(truth) | {f"q_{axis}": truth.q[:, i] for i, axis in enumerate("wxyz")}
    log |= {f"w_{axis}": np.round(np.degrees(truth.w[:, i]) * counts) for i, axis in enumerate("xyz")}
    found, flight = imported(logs.write_csv(tmp_path / "a.csv", log), tmp_path)
    np.testing.assert_allclose(flight.stack(["w_x", "w_y", "w_z"]), truth.w, atol=2e-3)
    assert found.fields["rate"].value["unit"] == "deg/s"


def test_electrical_turns_of_betaflight_are_hundreds(truth, tmp_path):
    log = {"loopIteration": np.arange(len(truth.t)), "time (us)": 1e6 * truth.t, "axisP[0]": 0 * truth.t}
    log |= {f"accSmooth[{i}]": 2048 * truth.acc[:, i] / G for i in range(3)}
    log |= {f"eRPM[{i}]": np.round(100 + 500 * truth.command[:, i]) for i in range(4)}
    _, flight = imported(logs.write_csv(tmp_path / "a.csv", log), tmp_path)
    expected = np.sort(log["eRPM[0]"])[-1] * 100 / 7 * 2 * np.pi / 60
    assert flight["rotor_speed_0"].max() == pytest.approx(expected)


@pytest.mark.parametrize(("factor", "unit"), [(1.0, "s"), (1e3, "ms"), (1e6, "us"), (1e9, "ns")])
@pytest.mark.parametrize("rate", [1.0, 50.0])
def test_times_since_1970_and_a_trajectory_without_header(truth, tmp_path, factor, unit, rate):
    t = (1.7e9 + np.arange(len(truth.t)) / rate) * factor
    rows = np.column_stack([t, truth.p, truth.q[:, [1, 2, 3, 0]]])
    np.savetxt(tmp_path / "a.tum", rows, fmt="%.9f")
    fields = describe_log(tmp_path / "a.tum").fields
    assert fields["time"].value == {"column": "0", "unit": unit}
    assert fields["position"].value["columns"] == ["1", "2", "3"]
    assert fields["attitude"].value["columns"] == ["7", "4", "5", "6"]


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_decimal_commas(truth, tmp_path, delimiter):
    log = columns_of(truth) | {f"q_{axis}": truth.q[:, i] for i, axis in enumerate("wxyz")}
    text = logs.write_csv(tmp_path / "a.csv", log).read_text().replace(",", delimiter).replace(".", ",")
    (tmp_path / "a.csv").write_text(text)
    _, flight = imported(tmp_path / "a.csv", tmp_path)
    np.testing.assert_allclose(flight["p_x"], truth.p[:, 0])
