"""What PX4 logs of real vehicles are like: an estimator without a position, set-points for a part of the flight, low
rates, outputs that drive more than rotors. They import with what they have, and nothing sound is blocked."""

import numpy as np
import pytest

from quadexp.plugins.check.quality import check_flight
from quadexp.plugins.logs.importers import Options, import_log
from tests.plugins.logs.importers import logs

pytest.importorskip("pyulog", reason="the extra [logs] is not installed")


@pytest.fixture(scope="module")
def truth():
    return logs.truth(24.0, 250.0)


def imported(folder, f, *, xy_valid=True, setpoint=None, outputs=4):
    """Flight and notes of a log with position, set-point and outputs at 10 Hz, attitude at 50 Hz, an IMU at 250 Hz.

    f: at 250 Hz. xy_valid: of the position's rows. setpoint: from when to when there is one (s).
    """
    t, slow = f.t + 5.0, slice(None, None, 25)
    log = logs.ULogWriter({"MAV_TYPE": 2.0})
    valid = np.broadcast_to(np.asarray(xy_valid), t[slow].shape)
    position = np.where(valid[:, None], f.p[slow] @ logs.NED.T, [0, 0, -f.p[0, 2]])
    velocity = np.where(valid[:, None], f.v[slow] @ logs.NED.T, [0, 0, 0.01])
    flags = "bool xy_valid;bool z_valid;bool v_xy_valid;bool v_z_valid;uint8_t xy_reset_counter;"
    log.format(
        "vehicle_local_position", f"uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;{flags}"
    )
    ones = np.ones(len(valid))
    counter = 1.0 + np.cumsum(np.diff(valid.astype(int), prepend=valid[:1].astype(int)) != 0)
    rows = np.column_stack([position, velocity, valid, ones, valid, ones, counter])
    log.topic("vehicle_local_position", t[slow], rows, "6f????B")
    log.format("vehicle_attitude", "uint64_t timestamp;float[4] q;")
    log.topic("vehicle_attitude", t[::5], logs.frd_quaternion(f)[::5], "4f")
    log.imu(t, f.w @ logs.FRD, f.acc @ logs.FRD)
    log.format("actuator_outputs", "uint64_t timestamp;uint32_t noutputs;float[16] output;")
    others = [0.5 + 0.2 * np.sin(f.t + i) for i in range(12)]
    pulses = 1000 + 1000 * np.column_stack([f.command[:, [0, 2, 3, 1]], *others])
    pulses[:, outputs:] = 0
    log.topic("actuator_outputs", t[slow], np.column_stack([np.full(len(t), 16), pulses])[slow], "I16f")
    if setpoint is not None:
        log.format("vehicle_local_position_setpoint", "uint64_t timestamp;float x;float y;float z;")
        wanted = np.where(((f.t >= setpoint[0]) & (f.t <= setpoint[1]))[:, None], f.p @ logs.NED.T, np.nan)
        log.topic("vehicle_local_position_setpoint", t[slow], wanted[slow], "3f")
    return import_log(log.write(folder / "a.ulg"), logs.quad_x(), Options())


def sound(flight, f, start=0.0):
    """Neither unit, frame, clock nor offset is complained about, and the motion is the true one."""
    k = np.round((flight.t + start) * 250).astype(int)
    np.testing.assert_allclose(flight.stack(["p_x", "p_y", "p_z"]), f.p[k], atol=0.05)
    np.testing.assert_allclose(flight.stack(["v_x", "v_y", "v_z"]), f.v[k], atol=0.1)
    return not [one.message for one in check_flight(flight) if one.blocks]


def test_default_rates_are_sound(truth, tmp_path):
    """Gimbal and landing gear move too; the type of the vehicle says how many rotors there are."""
    flight, notes = imported(tmp_path, truth, outputs=8)
    assert sound(flight, truth) and not any("left out" in note for note in notes)
    rotors = [name for name in flight.columns if name.startswith("motor_command")]
    assert rotors == [f"motor_command_{i}" for i in range(4)]


def test_a_position_that_the_estimator_disowns_is_left_out(truth, tmp_path):
    flight, notes = imported(tmp_path, truth, xy_valid=False)
    assert not {"p_x", "v_x"} & set(flight.columns)
    assert {"q_w", "w_x", "acc_x", "motor_command_3"} <= set(flight.columns)
    assert [note for note in notes if note.startswith("position") and "xy_valid" in note]
    assert not [one.message for one in check_flight(flight) if one.blocks]


def test_a_position_valid_for_a_part_gives_that_part(truth, tmp_path):
    flight, notes = imported(tmp_path, truth, xy_valid=np.arange(len(truth.t[::25])) >= 100)  # from 10 s on
    assert flight.metadata["source"]["cropped"][0] == pytest.approx(10.0, abs=0.1)
    assert sound(flight, truth, 10.0) and any("not valid in 100 of" in note for note in notes)


def test_a_setpoint_for_a_part_does_not_cut_the_flight(truth, tmp_path):
    flight, notes = imported(tmp_path, truth, setpoint=(8.0, 14.0))
    assert flight.t[-1] > 23 and "ref_p_x" not in flight.columns
    assert any(note.startswith("reference_position") and "left out" in note for note in notes)
    assert "ref_p_x" in imported(tmp_path, truth, setpoint=(0.0, 30.0))[0].columns
