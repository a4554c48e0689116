"""PX4's vehicle_odometry: of which axes pose and velocity are, and where the estimator was reset."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.plugins.logs.importers import Options, import_log
from tests.plugins.logs.importers import logs

pytest.importorskip("pyulog", reason="the extra [logs] is not installed")
FRAMES = [
    (1, 1, False), (1, 3, False), (2, 2, False), (2, 3, False), (0, 0, True), (1, 1, True), (1, 3, True),
]  # fmt: skip
HEADING = Rotation.from_euler("z", 70, degrees=True)  # of the odometry's axes from north


@pytest.fixture(scope="module")
def truth():
    return logs.truth(12.0, 100.0)


def imported(folder, f, pose, velocity, *, former=False, attitude=False, jump=None):
    """A log whose motion is in vehicle_odometry. pose, velocity: what its frames say, as numbers.

    former: of PX4 before 1.14. attitude: whether there is vehicle_attitude, of NED, too. jump: a row at which position
    and velocity are reset by 3 m and 1 m/s.
    """
    log, t = logs.ULogWriter(), f.t + 5.0
    ned, local, body = (0, 1, 3) if former else (1, 2, 3)
    turn = HEADING.inv() if pose == local else Rotation.identity()
    p, q = turn.apply(f.p @ logs.NED.T), turn * Rotation.from_quat(logs.frd_quaternion(f), scalar_first=True)
    v = turn.apply(f.v @ logs.NED.T) if velocity != body else f.R.inv().apply(f.v) @ logs.FRD.T
    after = np.zeros(len(t)) if jump is None else (np.arange(len(t)) >= jump).astype(float)
    p, v = p + 3.0 * after[:, None], v + after[:, None]
    names = ("x;float y;float z", "vx;float vy;float vz", "local_frame") if former else (None, None, "pose_frame")
    fields = "float[3] position;float[4] q;float[3] velocity;"
    if former:
        fields = "float x;float y;float z;float[4] q;float vx;float vy;float vz;"
    log.format("vehicle_odometry", f"uint64_t timestamp;{fields}uint8_t {names[2]};uint8_t velocity_frame;"
               "uint8_t reset_counter;")  # fmt: skip
    quaternion = q.as_quat(scalar_first=True)
    rows = np.column_stack([p, quaternion, v, np.full(len(t), pose), np.full(len(t), velocity), after])
    log.topic("vehicle_odometry", t, rows, "10fBBB")
    if attitude:
        log.format("vehicle_attitude", "uint64_t timestamp;float[4] q;")
        log.topic("vehicle_attitude", t, logs.frd_quaternion(f), "4f")
    log.imu(t, f.w @ logs.FRD, f.acc @ logs.FRD)
    return import_log(log.write(folder / "a.ulg"), None, Options(crop=False))


def expected(flight, f, local):
    """Position, velocity and attitude of the truth at the flight's times, in the axes of the log."""
    k = np.round((flight.t - flight.t[0]) * 100).astype(int) + round(100 * flight.metadata["source"]["cropped"][0])
    turn = Rotation.from_matrix(logs.NED.T) * (HEADING.inv() if local else Rotation.identity())
    turn = turn * Rotation.from_matrix(logs.NED)
    return turn.apply(f.p[k]), turn.apply(f.v[k]), turn * f.R[k]


@pytest.mark.parametrize("attitude", [False, True])
@pytest.mark.parametrize(("pose", "velocity", "former"), FRAMES)
def test_all_of_a_flight_has_the_same_axes(truth, tmp_path, pose, velocity, former, attitude):
    """What moves the vehicle, R f + g, is the derivative of its velocity, whatever the heading of the axes."""
    flight, notes = imported(tmp_path, truth, pose, velocity, former=former, attitude=attitude)
    local = pose == (1 if former else 2)
    p, v, R = expected(flight, truth, local)
    np.testing.assert_allclose(flight.stack(["p_x", "p_y", "p_z"]), p, atol=1e-3)
    np.testing.assert_allclose(flight.stack(["v_x", "v_y", "v_z"]), v, atol=1e-3)
    told = Rotation.from_quat(flight.stack(["q_w", "q_x", "q_y", "q_z"]), scalar_first=True)
    assert (told.inv() * R).magnitude().max() < 1e-3
    assert any("any heading" in note for note in notes) == local


@pytest.mark.parametrize(("pose", "velocity"), [(0, 1), (3, 1), (9, 3)])
def test_a_pose_of_unknown_axes_is_left_out(truth, tmp_path, pose, velocity):
    flight, notes = imported(tmp_path, truth, pose, velocity, attitude=True)
    assert "p_x" not in flight.columns and "q_w" in flight.columns
    assert any("does not say of which axes" in note for note in notes)


def test_a_velocity_of_other_axes_than_the_pose_is_made_from_the_position(truth, tmp_path):
    flight, notes = imported(tmp_path, truth, 2, 1)
    _, v, _ = expected(flight, truth, True)
    np.testing.assert_allclose(flight.stack(["v_x", "v_y", "v_z"])[20:-20], v[20:-20], atol=0.1)
    assert any(note.startswith("velocity: derivative of the position") for note in notes)


@pytest.mark.parametrize("velocity", [1, 3])
def test_a_reset_of_the_estimator_begins_a_segment(truth, tmp_path, velocity):
    flight, notes = imported(tmp_path, truth, 1, velocity, jump=600)
    segment = flight["segment"]
    assert segment[0] == 0 and segment[-1] == 1 and np.count_nonzero(np.diff(segment)) == 1
    steps = np.abs(np.diff(flight["p_x"]))
    assert steps[np.diff(segment) == 0].max() < 0.5 < steps[np.diff(segment) != 0].max()
    assert any("a new segment begins there" in note for note in notes)
