"""Wind from a file: linear between the rows, held outside, from CSV and from a flight; bad files in one line."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from quadexp.errors import DataError
from quadexp.log.schema import Flight
from quadexp.log.store import write_flight
from quadexp.world.wind_record import COLUMNS, read_wind


def evaluated(record, times):
    t = ca.MX.sym("t")
    function = ca.Function("wind", [t], [record.at(t)])
    return np.array([function(when).full().ravel() for when in times])


@pytest.fixture
def rows(rng):
    t = np.cumsum(rng.uniform(0.02, 0.5, 40)) + 1.0
    return np.column_stack([t, rng.normal(size=(40, 3))])


def test_rows_are_joined_by_lines_and_held_outside(tmp_path, rows):
    file = tmp_path / "wind.csv"
    np.savetxt(file, rows, delimiter=",", header="t, wind_x, wind_y, wind_z", comments="", fmt="%.17g")
    times = np.linspace(0, rows[-1, 0] + 2, 301)
    wanted = np.stack([np.interp(times, rows[:, 0], rows[:, i]) for i in (1, 2, 3)], axis=1)
    assert evaluated(read_wind(file), times) == pytest.approx(wanted, abs=1e-12)


def test_a_flight_with_its_wind_is_a_wind_file_too(tmp_path, rows):
    """Other columns are ignored; w_x of a flight is an angular velocity and not taken for wind."""
    columns = dict(zip(COLUMNS, rows.T.copy(), strict=True)) | {"w_x": rows[:, 1] * 0 + 99}
    file = write_flight(tmp_path / "flight.parquet", Flight(columns, {}))
    assert read_wind(file).wind == pytest.approx(rows[:, 1:])


def test_one_row_is_a_constant_wind(tmp_path):
    (tmp_path / "wind.csv").write_text("# calm\nt,wind_z,wind_x,wind_y\n0,3,1,2\n")
    assert evaluated(read_wind(tmp_path / "wind.csv"), [-1.0, 0.0, 9.0]) == pytest.approx(np.array([[1, 2, 3]] * 3))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t,w_x,w_y,w_z\n0,1,2,3\n", "no column wind_x, wind_y, wind_z"),
        ("t,wind_x,wind_y,wind_z\n", "0 rows"),
        ("t,wind_x,wind_y,wind_z\n0,1,2,3\n0,1,2,3\n", "t = 0 s in row 1 is not after 0 s"),
        ("t,wind_x,wind_y,wind_z\n0,1,2,3\n1,1,nan,3\n", "column 'wind_y' holds nan in row 1"),
        ("t,wind_x,wind_y,wind_z\n0,1,2,north\n", "not a readable CSV file with numbers"),
        ("", "not a readable CSV file"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, text, said):
    (tmp_path / "wind.csv").write_text(text)
    with pytest.raises(DataError, match="wind.csv") as caught:
        read_wind(tmp_path / "wind.csv")
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_what_is_no_parquet_file_is_refused(tmp_path):
    (tmp_path / "wind.parquet").write_bytes(b"PAR1 nothing")
    with pytest.raises(DataError, match="wind.parquet: not a readable Parquet file"):
        read_wind(tmp_path / "wind.parquet")
