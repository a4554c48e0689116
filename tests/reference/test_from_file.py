"""Trajectories from files: what was written comes back; what is broken is named with its line."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.reference.circle import Circle
from quadexp.reference.from_file import FileTrajectory


def write_csv(path, t, p, yaw=None, header=None):
    columns = [t, *p.T] + ([] if yaw is None else [yaw])
    header = header or "t,p_x,p_y,p_z" + ("" if yaw is None else ",yaw")
    path.write_text(
        header + "\n" + "\n".join(",".join(repr(float(v)) for v in row) for row in zip(*columns, strict=True))
    )
    return path


@pytest.fixture
def circle_rows():
    circle = Circle(speed=4.0, acceleration=1.0)
    t = np.linspace(4.5, 7.5, 151)  # within one section: smooth
    return t, circle.flat_output(t).position


def test_csv_round_trip_up_to_snap(tmp_path, circle_rows):
    t, p = circle_rows
    yaw = np.mod(2.0 * t, 2 * np.pi) - np.pi  # turns past pi: must be unwrapped
    trajectory = FileTrajectory(path=str(write_csv(tmp_path / "c.csv", t, p[:, 0], yaw)))
    assert trajectory.duration == pytest.approx(3.0)
    flat = trajectory.flat_output(t - t[0])
    inner = slice(10, -10)
    for order, tolerance in enumerate((1e-12, 1e-9, 1e-7, 1e-5, 1e-3)):
        np.testing.assert_allclose(flat.position[inner, order], p[inner, order], atol=tolerance)
    np.testing.assert_allclose(np.unwrap(flat.yaw[:, 0]) - flat.yaw[0, 0], 2 * (t - t[0]), atol=1e-9)
    np.testing.assert_allclose(flat.yaw[:, 1], 2.0, atol=1e-7)
    assert trajectory.peak_speed == pytest.approx(np.linalg.norm(p[:, 1], axis=1).max(), abs=1e-3)


def test_tum_round_trip_with_comments_and_tilted_attitude(tmp_path, circle_rows):
    """Yaw from the quaternion of R_z(yaw) R_x(roll) R_y(pitch), whatever roll and pitch."""
    t, p = circle_rows
    yaw = 0.4 * np.sin(t)
    q = Rotation.from_euler("ZXY", np.column_stack([yaw, 0.5 * np.cos(t), 0.3 * np.sin(2 * t)])).as_quat()
    path = tmp_path / "track.tum"
    rows = "\n".join(" ".join(repr(float(v)) for v in row) for row in np.column_stack([t, p[:, 0], q]))
    path.write_text("# timestamp tx ty tz qx qy qz qw\n" + rows + "\n")
    flat = FileTrajectory(path=str(path)).flat_output(t - t[0])
    np.testing.assert_allclose(flat.position[:, 0], p[:, 0], atol=1e-12)
    np.testing.assert_allclose(flat.yaw[:, 0], yaw, atol=1e-12)
    np.testing.assert_allclose(flat.yaw[10:-10, 1], 0.4 * np.cos(t)[10:-10], atol=1e-6)


def test_other_columns_are_ignored_and_the_end_is_held(tmp_path, circle_rows):
    t, p = circle_rows
    path = tmp_path / "c.csv"
    write_csv(path, np.arange(151.0), np.column_stack([t, p[:, 0, :2]]), p[:, 0, 2], header="solve_time,t,p_x,p_y,p_z")
    trajectory = FileTrajectory(path=str(path))
    held = trajectory.flat_output(np.array([-1.0, 3.5]))
    np.testing.assert_allclose(held.position[:, 0], p[[0, -1], 0])
    assert np.all(held.position[:, 1:] == 0)
    assert np.all(held.yaw == 0)


GOOD = "\n".join(f"{0.1 * i:.1f},{i},0,1" for i in range(10))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no rows"),
        ("t,p_x,z\n" + GOOD, r"line 1: no column p_y, p_z in the header \(found t, p_x, z"),
        ("t,p_x,p_y,p_z\n" + GOOD.replace("0.3,3", "0.3,nan"), "line 5: p_x is nan"),
        ("t,p_x,p_y,p_z\n" + GOOD.replace("0.3,3", "0.3,three"), "line 5: p_x is 'three', not a number"),
        ("t,p_x,p_y,p_z\n" + GOOD.replace("0.3,3", "0.2,3"), "line 5: t = 0.2 s is not after 0.2 s"),
        ("t,p_x,p_y,p_z\n" + GOOD.replace("0.3,3,0,1", "0.3,3"), "line 5: 2 values for the 4 columns"),
        ("t,p_x,p_y,p_z\n" + "\n".join(GOOD.splitlines()[:7]), "7 rows, a track needs at least 8"),
        ("\n".join(f"{i} 0 0 1 0 0 0 0.5" for i in range(9)), "line 1: the quaternion has length 0.5"),
        ("\n".join(f"{i} 0 0 1" for i in range(9)), "line 1: 4 values for the 8 columns"),
    ],
)
def test_broken_files_are_one_line(tmp_path, text, message):
    path = tmp_path / "broken.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=message) as error:
        _ = FileTrajectory(path=str(path)).duration
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def test_binary_file_is_refused(tmp_path):
    path = tmp_path / "x.bin"
    path.write_bytes(bytes(range(256)))
    with pytest.raises(DataError, match="not a readable text file"):
        _ = FileTrajectory(path=str(path)).duration
