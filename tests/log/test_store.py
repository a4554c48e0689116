"""Files: whole or not at all, units inside, one line for every way they can be wrong."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from quadexp.errors import DataError, UsageError
from quadexp.log.schema import FLIGHT_COLUMNS, Flight, describe
from quadexp.log.store import read_flight, read_metadata, read_table, write_flight, write_table
from quadexp.writer import check_output, written
from tests.log.flights import straight_flight


def test_a_flight_comes_back_to_the_last_bit(tmp_path):
    flight = straight_flight(seed=3, config={"controller": {"name": "x"}})
    path = write_flight(tmp_path / "a.parquet", flight)
    back = read_flight(path)
    assert list(back.columns) == list(flight.columns)
    for name, values in flight.columns.items():
        assert back[name].dtype == values.dtype
        np.testing.assert_array_equal(back[name], values)
    assert back.metadata["seed"] == 3 and back.metadata["config"] == {"controller": {"name": "x"}}
    np.testing.assert_array_equal(back.state, flight.state)


def test_unit_and_frame_travel_with_every_column(tmp_path):
    path = write_flight(tmp_path / "a.parquet", straight_flight())
    schema = pq.read_schema(path)
    assert schema.field("w_x").metadata == {b"unit": b"rad/s", b"frame": b"body", b"description": b"angular velocity"}
    assert schema.field("v_x").metadata[b"frame"] == b"world"
    for name in schema.names:
        assert schema.field(name).metadata[b"unit"], name
    # The same name means body velocity in a data set: features are body-frame quantities.
    assert describe("v_x", "residuals").frame == "body"


def test_columns_written_are_columns_known():
    unknown = [name for name in straight_flight().columns if describe(name).unit == ""]
    assert not unknown
    assert all(column.unit for column in FLIGHT_COLUMNS.values())


def test_nothing_is_left_behind_by_a_write_that_fails(tmp_path):
    path = write_flight(tmp_path / "a.parquet", straight_flight())
    before = path.read_bytes()

    with pytest.raises(RuntimeError), written(path) as file:
        file.write(b"half")
        raise RuntimeError("disk on fire")
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.parquet"]


def test_numpy_values_are_plain_json_in_the_record(tmp_path):
    metadata = {"a": np.float64(1.5), "b": np.arange(3), "path": tmp_path}
    path = write_table(tmp_path / "a.parquet", {"t": np.zeros(2)}, metadata, "results")
    assert read_metadata(path)["a"] == 1.5 and read_metadata(path)["b"] == [0, 1, 2]


def cut_short(path):
    path.write_bytes(path.read_bytes()[:-100])


def damage_pages(path):
    data = bytearray(path.read_bytes())
    data[200:1200] = b"\xff" * 1000
    path.write_bytes(data)


def with_columns(**changes):
    """The flight with other columns; None: without that one."""

    def write(path):
        columns = {**straight_flight().columns, **changes}
        write_flight(path, Flight({name: x for name, x in columns.items() if x is not None}, {}))

    return write


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda path: path.unlink(), r"no such file \(made by `quadexp simulate`\)"),
        (lambda path: path.write_text("a,b\n1,2\n"), "not a Parquet file, or damaged"),
        (cut_short, "damaged"),
        (damage_pages, "damaged"),
        (lambda path: pq.write_table(pa.table({"t": [1.0]}), path), "not one that quadexp wrote"),
        (lambda path: write_table(path, {"t": np.zeros(2)}, {}, "residuals"), "is a data set, a flight is needed"),
        (with_columns(q_y=None), "column 'q_y' is missing"),
        (with_columns(v_z=np.array([0, 0, 0, np.nan, 0.0])), r"column 'v_z' is nan at row 3 \(1 such rows of 5\)"),
    ],
)
def test_a_bad_file_is_one_line_that_says_what_is_wrong(tmp_path, spoil, said):
    path = write_flight(tmp_path / "a.parquet", straight_flight(2000))
    spoil(path)
    with pytest.raises((DataError, UsageError), match=said) as error:
        read_flight(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_another_schema(tmp_path, monkeypatch):
    monkeypatch.setattr("quadexp.log.store.SCHEMA", 7)
    path = write_flight(tmp_path / "a.parquet", straight_flight())
    monkeypatch.undo()
    with pytest.raises(DataError, match="written with schema 7, this program reads schema 2"):
        read_flight(path)


def test_looking_for_a_place_leaves_nothing_and_writing_makes_the_folders(tmp_path):
    path = check_output(tmp_path / "new" / "deep" / "a.parquet")
    assert check_output(tmp_path, folder=True) == tmp_path and not any(tmp_path.iterdir())
    assert write_flight(path, straight_flight()).exists() and check_output(path, force=True) == path


@pytest.mark.parametrize(
    ("place", "said"),
    [("file", "exists already; pass --force"), ("", "is a folder"), ("file/a.parquet", "cannot be written there"),
     # a read-only folder for whoever runs this, root included (root ignores permission bits)
     ("/proc/quadexp/a.parquet", "cannot be written there"), ("/dev/null/a.parquet", "cannot be written there")],
)  # fmt: skip
def test_a_place_that_will_not_do(tmp_path, place, said):
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match=said):
        check_output(tmp_path / place, force=said == "is a folder")


@pytest.mark.parametrize("dtype", ["float64", "float32", "int8", "int16", "int32", "int64", "uint8"])
def test_types_are_kept(tmp_path, dtype):
    values = np.arange(7).astype(dtype)[::2]  # not contiguous
    path = write_table(tmp_path / "a.parquet", {"t": values, "word": np.array(list("abcd"), object)}, {}, "results")
    columns, _ = read_table(path, "results")
    assert columns["t"].dtype == dtype and columns["word"].tolist() == list("abcd")
    np.testing.assert_array_equal(columns["t"], values)
    assert columns["t"].flags.writeable


def test_pandas_reads_our_files_and_is_not_needed_for_it(tmp_path):
    import subprocess
    import sys

    path = write_flight(tmp_path / "a.parquet", straight_flight())
    code = (
        "import sys; from quadexp.log.store import *; f = read_flight(sys.argv[1]); write_flight(sys.argv[2], f);"
        "print('pandas' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path), str(tmp_path / "b.parquet")], capture_output=True, text=True
    )
    assert done.stdout.strip() == "False", done.stderr
    frame = pytest.importorskip("pandas").read_parquet(tmp_path / "b.parquet")
    np.testing.assert_array_equal(frame["p_x"], straight_flight()["p_x"])
