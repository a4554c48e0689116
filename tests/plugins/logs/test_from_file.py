"""Trajectories from files: what was written comes back; waypoints are flown as fast as can be; errors name the line."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError, UsageError
from quadexp.experiment.build import build_trajectory, build_vehicle
from quadexp.experiment.evaluate import InfeasibleError, fly_one
from quadexp.parts.compose import compose
from quadexp.plugins.logs.from_file import FileTrajectory
from quadexp.plugins.logs.positions import read_positions
from quadexp.reference.circle import Circle
from tests.reference.test_polynomial import VEHICLES, shares

ROOT = Path(__file__).parents[3]
INTERPRETED = ["plant.backend=interpreted", "controller.backend=interpreted"]
TWO = "x,y,z\n0,0,1\n3,0,2\n"
LOOP = "x,y,z\n0,0,1\n6,0,1\n6,5,3\n-1,5,2\n0,0,1\n"


@pytest.fixture
def written(tmp_path):
    def write(text):
        (tmp_path / "points.csv").write_text(text)
        return str(tmp_path / "points.csv")

    return write


def cached_function(path, *overrides):
    config = compose(["trajectory=file", f"trajectory.path={path}", *overrides])
    return build_trajectory(config.trajectory, build_vehicle(config.vehicle))


def table(header, columns, separator=","):
    return (
        "\n".join([header, *(separator.join(repr(float(v)) for v in row) for row in np.column_stack(columns))]) + "\n"
    )


@pytest.fixture
def circle_rows():
    circle = Circle(speed=4.0, acceleration=1.0)
    t = np.linspace(4.5, 7.5, 151)  # within one section: smooth
    return t, circle.flat_output(t).position


def test_csv_round_trip_up_to_snap(written, circle_rows):
    """Other columns are ignored, the end is held."""
    t, p = circle_rows
    yaw = np.mod(2.0 * t, 2 * np.pi) - np.pi  # turns past pi: must be unwrapped
    path = FileTrajectory(path=written(table("solve_time,t,p_x,p_y,p_z,yaw", [0 * t, t, p[:, 0], yaw])))
    assert path.duration == pytest.approx(3.0)
    flat, inner = path.flat_output(t - t[0]), slice(10, -10)
    for order, tolerance in enumerate((1e-12, 1e-9, 1e-7, 1e-5, 1e-3)):
        np.testing.assert_allclose(flat.position[inner, order], p[inner, order], atol=tolerance)
    np.testing.assert_allclose(np.unwrap(flat.yaw[:, 0]) - flat.yaw[0, 0], 2 * (t - t[0]), atol=1e-9)
    np.testing.assert_allclose(flat.yaw[:, 1], 2.0, atol=1e-7)
    assert path.peak_speed == pytest.approx(np.linalg.norm(p[:, 1], axis=1).max(), abs=1e-3)
    held = path.flat_output(np.array([-1.0, 3.5]))
    np.testing.assert_allclose(held.position[:, 0], p[[0, -1], 0])
    assert np.all(held.position[:, 1:] == 0) and np.all(held.yaw[:, 1:] == 0)


def test_tum_round_trip_with_comments_and_tilted_attitude(written, circle_rows):
    """Yaw from the quaternion of R_z(yaw) R_x(roll) R_y(pitch), whatever roll and pitch."""
    t, p = circle_rows
    yaw = 0.4 * np.sin(t)
    q = Rotation.from_euler("ZXY", np.column_stack([yaw, 0.5 * np.cos(t), 0.3 * np.sin(2 * t)])).as_quat()
    file = written(table("# timestamp tx ty tz qx qy qz qw", [t, p[:, 0], q], separator=" "))
    flat = FileTrajectory(path=file).flat_output(t - t[0])
    np.testing.assert_allclose(flat.position[:, 0], p[:, 0], atol=1e-12)
    np.testing.assert_allclose(flat.yaw[:, 0], yaw, atol=1e-12)
    np.testing.assert_allclose(flat.yaw[10:-10, 1], 0.4 * np.cos(t)[10:-10], atol=1e-6)


@pytest.mark.parametrize("text", [TWO, LOOP])
@pytest.mark.parametrize("vehicle", ["torrente", "lei_li", "crazyflie"])
@pytest.mark.parametrize("speed", ["null", "2.5"])
def test_without_times_as_fast_as_speed_and_limits_allow(written, text, vehicle, speed):
    path = cached_function(written(text), f"vehicle={vehicle}", f"trajectory.speed={speed}")
    points = np.genfromtxt(text.splitlines(), delimiter=",", skip_header=1)
    t = np.linspace(0.0, path.duration, 20_001)
    position = path.flat_output(t).position
    np.testing.assert_allclose(position[[0, -1], 0], points[[0, -1]], atol=1e-9)
    assert max(np.linalg.norm(position[:, 0] - point, axis=1).min() for point in points) < 2e-3
    assert np.abs(position[[0, -1], 1:4]).max() < 1e-5
    thrust, rate = shares(path, VEHICLES[vehicle])
    used = max(thrust / 0.75, rate / 0.75, 0 if speed == "null" else path.peak_speed / 2.5)
    assert used == pytest.approx(1.0, abs=5e-3), "as fast as can be, and no faster"


def test_two_points_fly_the_known_polynomial(written):
    path = cached_function(written(TWO), "trajectory.speed=1")
    s = np.linspace(0, 1, 21)
    share = 35 * s**4 - 84 * s**5 + 70 * s**6 - 20 * s**7
    position = path.flat_output(s * path.duration).position[:, 0]
    np.testing.assert_allclose(position, [0, 0, 1] + share[:, None] * [3, 0, 1], atol=1e-9)
    assert path.duration == pytest.approx(35 / 16 * np.sqrt(10))
    assert path.flat_output(np.array([1.0])).yaw is None, "the heading is free"


def test_semicolons_part_columns_with_decimal_commas(written):
    """As a spreadsheet of half of Europe writes them."""
    text = "t,x,y,z\n0,0,0,1\n1.5,1.5,0.25,1\n3,2.5,0.5,1.5\n"
    with_points = cached_function(written(text)).flat_output(np.linspace(0, 3, 7)).position
    for other in (text.replace(",", ";").replace(".", ","), text.replace(",", ";")):
        np.testing.assert_array_equal(
            cached_function(written(other)).flat_output(np.linspace(0, 3, 7)).position, with_points
        )


def test_times_and_yaw_are_kept(written):
    """Every point at its time, from the first row's on; the yaw goes the shorter way round, with its derivatives."""
    path = cached_function(written("yaw,t,x,y,z,note\n3.0,2,0,0,1,7\n-3.0,5,3,0,2,7\n-2.5,7.5,4,4,2,7\n"))
    t = np.array([0.0, 3.0, 5.5])
    flat = path.flat_output(t)
    np.testing.assert_allclose(flat.position[:, 0], [[0, 0, 1], [3, 0, 2], [4, 4, 2]], atol=1e-9)
    np.testing.assert_allclose(flat.yaw[:, 0], [3.0, 2 * np.pi - 3.0, 2 * np.pi - 2.5], atol=1e-9)
    assert path.duration == pytest.approx(5.5)
    inner, h = np.linspace(0.5, 5.0, 40), 1e-5
    before, now, after = (path.flat_output(inner + d).yaw for d in (-h, 0, h))
    np.testing.assert_allclose((after - before)[:, 0] / (2 * h), now[:, 1], atol=1e-6)
    np.testing.assert_allclose((after - before)[:, 1] / (2 * h), now[:, 2], atol=1e-6)


def test_times_that_break_a_limit_are_named_and_can_be_flown_all_the_same(written):
    quick = written("t,x,y,z\n0,0,0,1\n1,30,0,1\n2,0,0,1\n")
    file = ["trajectory=file", f"trajectory.path={quick}", *INTERPRETED]
    with pytest.raises(InfeasibleError, match=r"file cannot be flown: it takes .* of collective thrust at t=\d\.\d+ s"):
        fly_one(compose(file))
    assert fly_one(compose([*file, "trajectory.allow_infeasible=true"])).outcome in ("ok", "lost", "solver_failed")
    with pytest.raises(UsageError, match=r"trajectory.speed=4: the times in .* take a peak speed of \d+"):
        fly_one(compose([*file, "trajectory.speed=4"]))
    tight = written("t,x,y,z\n0,0,0,1\n1.1,2.5,0,1\n2.2,0,0,1\n")
    said = fly_one(compose(file)).metadata["reference_note"]
    assert re.search(r"rotor \d thrust would be .* is beyond a limit\); stretch the times in the file$", said), tight


@pytest.mark.parametrize("name", ["torrente", "lei_li"])
def test_two_points_are_flown_from_the_command_line_configuration(written, name):
    flight = fly_one(
        compose(["trajectory=file", f"trajectory.path={written(TWO)}", f"vehicle={name}", "plant=ideal", *INTERPRETED])
    )
    assert flight.outcome == "ok" and flight.metadata["row"]["max_error"] < 0.2
    assert flight.metadata["row"]["saturated_share"] == 0 and flight.metadata["reference_note"] == ""


GOOD = "\n".join(f"{0.1 * i:.1f},{i},0,1" for i in range(10))
TRACK = "t,p_x,p_y,p_z\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no rows"),
        ("t,p_x,z\n" + GOOD, r"line 1: no column p_y, p_z in the header \(found t, p_x, z"),
        (TRACK + GOOD.replace("0.3,3", "0.3,nan"), "line 5: p_x is nan"),
        (TRACK + GOOD.replace("0.3,3", "0.3,three"), "line 5: p_x is 'three', not a number"),
        (TRACK + GOOD.replace("0.3,3", "0.2,3"), "line 5: t = 0.2 s is not after 0.2 s"),
        (TRACK + GOOD.replace("0.3,3,0,1", "0.3,3"), "line 5: 2 values for the 4 columns"),
        (TRACK + "\n".join(GOOD.splitlines()[:7]), "7 rows, .* at least 8; for waypoints name the columns x, y, z"),
        ("\n".join(f"{i} 0 0 1 0 0 0 0.5" for i in range(9)), "line 1: the quaternion has length 0.5"),
        ("\n".join(f"{i} 0 0 1" for i in range(9)), "line 1: 4 values for the 8 columns"),
        ("x,y,z\n0,0,1\n", "1 waypoints, 2 to 200 are allowed; for a sampled track name the columns t, p_x, p_y, p_z"),
        ("x,y,z\n" + "1,2,3\n2,3,4\n" * 150, "300 waypoints, 2 to 200 are allowed"),
        ("x,y,z\n0,0,1\n0,0,1\n", "line 3: the same point as in the previous row; add a column t to stay there"),
        ("x,y\n0,0\n", r"line 1: no column z in the header \(found x, y; needed x, y, z, optional t and yaw"),
        ("t,x,y,z\n0,0,0,1\n0,1,0,1\n", "line 3: t = 0 s is not after 0 s"),
        ("\0\u00e9", "not a readable text file"),
        ("\x1f\x8b\x08", "compressed by gzip: `gunzip` it first"),
    ],
)
def test_broken_files_are_one_line(tmp_path, text, message):
    path = tmp_path / "broken.csv"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(DataError, match=message) as error:
        _ = FileTrajectory(path=str(path), speed=None if text.startswith("t") else 1.0).duration
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def test_a_sampled_track_has_no_other_speed(written):
    with pytest.raises(UsageError, match=r"trajectory.speed=3: .* is a sampled track, which has its own times"):
        _ = FileTrajectory(path=written("t,p_x,p_y,p_z\n" + GOOD), speed=3.0).duration


def test_the_files_of_the_guide_are_what_the_program_reads(written):
    """Every block of docs/guide.md that is a CSV of positions."""
    blocks = re.findall(r"\n((?:    (?:t,p_x|x,y,z)[^\n]*\n)(?:    [^\n]+\n)+)", (ROOT / "docs/guide.md").read_text())
    assert {block.strip()[0] for block in blocks} == {"x"}
    for block in blocks:
        assert cached_function(written("\n".join(line.strip() for line in block.strip().splitlines()))).duration > 0


def test_the_heading_of_an_attitude_is_flown(written):
    """As in a TUM file and in a column yaw; `heading` is one too, and what is not flown is said."""
    t = np.linspace(0, 4, 101)
    yaw = 0.5 * np.pi + 0.8 * t
    p = np.column_stack([2 * np.cos(0.8 * t), 2 * np.sin(0.8 * t), 1 + 0 * t])
    q = Rotation.from_euler("z", yaw[:, None]).as_quat(scalar_first=True)
    for header, columns in (("q_w,q_x,q_y,q_z", q), ("heading", yaw), ("yaw", yaw)):
        path = FileTrajectory(path=written(table(f"t,p_x,p_y,p_z,{header},v_x", [t, p, columns, 0 * t])))
        assert np.unwrap(path.flat_output(t).yaw[:, 0]) == pytest.approx(yaw, abs=1e-6)
        assert path.note == "columns that are not flown: v_x"


def test_a_header_behind_a_hash_as_euroc_writes_it(written):
    t = np.linspace(0, 4, 101)
    p = np.column_stack([np.cos(t), np.sin(t), 1 + 0 * t])
    names = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
    q = Rotation.from_euler("z", t[:, None]).as_quat(scalar_first=True)
    path = FileTrajectory(path=written(table(names, [1.7e18 + 1e9 * t, p, q])))
    assert path.duration == pytest.approx(4.0, abs=1e-6)
    assert path.flat_output(t).position[:, 0] == pytest.approx(p, abs=1e-4)
    assert np.unwrap(path.flat_output(t).yaw[:, 0]) == pytest.approx(t, abs=1e-4)


def test_noise_is_named_and_smoothed(written):
    """A millimetre at 100 Hz takes thousands of newtons through every row."""
    t = np.linspace(0, 4, 401)
    p = np.column_stack([2 * np.cos(0.8 * t), 2 * np.sin(0.8 * t), 1 + 0 * t])
    noisy = p + 1e-3 * np.random.default_rng(0).normal(size=p.shape)
    file = written(table("t,p_x,p_y,p_z", [t, noisy]))
    with pytest.raises(InfeasibleError, match=r"rows are noisy: trajectory.smooth=0.3 \(s\)"):
        fly_one(compose(["trajectory=file", f"trajectory.path={file}", *INTERPRETED]))
    smooth = FileTrajectory(path=file, smooth=0.5).flat_output(t)
    assert np.abs(smooth.position[:, 0] - p).max() < 2e-3
    exact = -0.64 * (p - [0, 0, 1])
    assert np.abs(smooth.position[40:-40, 2] - exact[40:-40]).max() < 0.5


def test_a_row_that_is_there_twice_is_named_with_its_digits(written):
    rows = np.column_stack([1234.5678 + 0.01 * np.arange(20), *[np.arange(20.0)] * 3])
    rows = np.insert(rows, 10, rows[10], axis=0)
    with pytest.raises(DataError, match=r"line 13: t = 1234.6678 s .* is there twice: leave one of both out"):
        FileTrajectory(path=written(table("t,p_x,p_y,p_z", [rows]))).duration  # noqa: B018


def heading_track(written, name, heading, course):
    """A circle whose nose has these headings, read back."""
    t = np.arange(0, 12, 0.05)
    angle = course(t)
    columns = [t, 3 * np.sin(angle), -3 * np.cos(angle), 1 + 0 * t, heading(angle)]
    return read_positions(Path(written(table(f"t,p_x,p_y,p_z,{name}", columns)))), angle


@pytest.mark.parametrize(
    ("name", "heading"),
    [
        ("yaw", lambda a: a), ("heading", lambda a: np.angle(np.exp(1j * a))), ("yaw", np.degrees),
        ("yaw", lambda a: np.degrees(np.angle(np.exp(1j * a)))), ("yaw_deg", np.degrees),
        ("heading [deg]", np.degrees),
    ],
)  # fmt: skip
def test_degrees_of_a_heading_are_recognised(written, name, heading):
    """Along a circle the nose points where it flies: by the name, by steps of 360, by the course."""
    track, course = heading_track(written, name, heading, lambda t: 0.7 * t)
    assert np.abs(np.angle(np.exp(1j * (track.yaw - course)))).max() < 1e-9
    assert not track.ignored


def test_a_heading_that_says_no_unit_is_refused(written):
    with pytest.raises(DataError, match=r"yaw reaches 90, 14\.3 turns in rad: name the column yaw_deg"):
        heading_track(written, "yaw", lambda a: 90 * np.cos(5 * a), lambda t: 0.2 * t)
    with pytest.raises(DataError, match=r"7\.\d+ turns in rad: name the column yaw_deg"):  # or it turns by 45 degrees
        heading_track(written, "yaw", lambda a: 45 * a / a[-1], lambda t: 0.2 * t)


def arc(header, columns=None, separator=","):
    """A track over two seconds, its columns t, x, y, z or others."""
    t = np.linspace(0, 2, 41)
    return table(header, columns or [t, np.cos(t), np.sin(t), 1 + 0 * t], separator)


@pytest.mark.parametrize(
    ("header", "factors", "start"),
    [
        ("t,p_x,p_y,p_z", [1, 1], 1.7e9), ("t,p_x,p_y,p_z", [1e3, 1], 1.7e12), ("t,p_x,p_y,p_z", [1e6, 1], 1.7e15),
        ("t,p_x,p_y,p_z", [1e9, 1], 1.7e18), ("time_ms,p_x,p_y,p_z", [1e3, 1], 0), ("timestamp,p_x,p_y,p_z", [1, 1], 0),
        ("t [us],p_x [mm],p_y [mm],p_z [mm]", [1e6, 1e3], 5e6),
    ],
)  # fmt: skip
def test_units_of_a_track_are_those_of_its_names_or_of_times_since_1970(written, header, factors, start):
    t = np.linspace(0, 2, 41)
    p = np.column_stack([np.cos(t), np.sin(t), 1 + 0 * t])
    track = read_positions(Path(written(arc(header, [start + factors[0] * t, factors[1] * p]))))
    np.testing.assert_allclose(track.times - track.times[0], t, atol=1e-6)
    np.testing.assert_allclose(track.points, p, atol=1e-12)


def test_times_that_are_no_seconds_are_refused_before_anything_is_computed(written):
    """Microseconds since the start of the autopilot: a month in seconds."""
    t = np.linspace(0, 2, 41)
    file = written(arc("t,p_x,p_y,p_z", [1e6 * (12.3 + t), t, t, 1 + 0 * t]))
    with pytest.raises(
        DataError, match=r"its times span 2e\+06 s, 14400 s are allowed; .* time_ms, time_us or time_ns"
    ):
        _ = FileTrajectory(path=file).peak_speed


@pytest.mark.parametrize("separator", ["\t", " ", ";"])
def test_a_header_parts_its_columns_as_the_rows_do(written, separator):
    text = arc("t,p_x,p_y,p_z")
    expected = read_positions(Path(written(text)))
    np.testing.assert_array_equal(read_positions(Path(written(text.replace(",", separator)))).points, expected.points)


@pytest.mark.parametrize(
    ("header", "note"),
    [
        ("t,p_x,p_y,p_z,yaw,heading", "columns that are not flown: heading"),
        ("t,p_x,p_y,p_z,q_w,q_x", "columns that are not flown: q_w, q_x"),
        ("t,p_x,p_y,p_z,yaw,speed [m/s]", "columns that are not flown: speed [m/s]"),
        ("t,x,y,z,yaw_rate,q_w", "columns that are not flown: yaw_rate, q_w"),
    ],
)
def test_what_is_not_flown_is_said(written, header, note):
    rows = np.column_stack([np.arange(9.0), np.cos(np.arange(9.0)), np.zeros((9, 4))])
    assert FileTrajectory(path=written(table(header, [rows]))).note == note


def test_times_of_waypoints_have_the_names_of_those_of_a_track(written):
    assert read_positions(Path(written("time,x,y,z\n0,0,0,1\n3,4,0,1\n"))).times.tolist() == [0.0, 3.0]


def test_a_column_that_is_there_twice_is_refused(written):
    with pytest.raises(DataError, match="line 1: 2 columns p_x in the header"):
        read_positions(Path(written("t,p_x,p_x,p_y,p_z\n0,1,2,3,4\n")))


def test_missing_rows_are_said(written):
    t = np.delete(np.linspace(0, 4, 201), slice(50, 101))
    path = FileTrajectory(path=written(arc("t,p_x,p_y,p_z", [t, np.cos(t), np.sin(t), 1 + 0 * t])))
    assert path.note == "rows are missing: none for 1.04 s after 0.98 s of the track"


@pytest.mark.parametrize(
    ("text", "setting", "message"),
    [
        (TWO, {"smooth": 0.5}, r"trajectory.smooth=0.5: .* has waypoints"),
        (TRACK + GOOD, {"margin": 0.5}, r"trajectory.margin=0.5: .* has its own times"),
        ("t,x,y,z\n0,0,0,1\n3,4,0,1\n", {"margin": 0.0}, r"trajectory.margin=0: .* has its own times"),
    ],
)
def test_a_setting_that_decides_nothing_is_refused(written, text, setting, message):
    with pytest.raises(UsageError, match=message):
        _ = FileTrajectory(path=written(text), **setting).duration


def test_noise_that_only_the_rotors_feel_is_named(written):
    """Rows rounded to 0.1 mm at 50 Hz: the acceleration is hardly larger, the thrusts of single rotors are."""
    t = np.linspace(0, 4, 201)
    p = np.round(np.column_stack([2 * np.cos(0.8 * t), 2 * np.sin(0.8 * t), 1 + 0 * t]), 4)
    file = written(table("t,p_x,p_y,p_z", [t, p]))
    said = fly_one(compose(["trajectory=file", f"trajectory.path={file}", *INTERPRETED])).metadata["reference_note"]
    assert re.search(r"rotor \d thrust would be .* its rows are noisy: trajectory.smooth=0.3", said)
