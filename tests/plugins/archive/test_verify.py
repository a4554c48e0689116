"""`quadexp results --verify`, and what the next run of a sweep does about what was edited or damaged."""

import shutil

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from quadexp.errors import UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_table, write_table
from quadexp.plugins.archive.verify import verify_results
from quadexp.sweeps.results import select
from tests.cli.command import run
from tests.sweeps.quick import contents, fly


def edit(path, column, row, value):
    """Change one value with pyarrow, which keeps the metadata."""
    table = pq.read_table(path)
    values = table[column].to_pylist()
    values[row] = value
    place = table.column_names.index(column)
    pq.write_table(table.set_column(place, table.field(column), pa.array(values, table.field(column).type)), path)


def cell(folder, at=0):
    return CellStore(folder).path(select(folder).rows[at]["key"])


def untimed(folder):
    """results.csv as it is read by people."""
    return (folder / "results.csv").read_text()


def test_a_sound_folder(folder):
    found = verify_results(folder)
    assert not found.wrong
    assert found.files == sum(path.is_file() for path in folder.rglob("*"))
    code, out, _ = run("results", folder, "--verify")
    assert code == 0 and out.strip() == f"{found.files} files, 0 wrong"


def flip(path, at):
    content = bytearray(path.read_bytes())
    content[at] ^= 0x10
    path.write_bytes(content)


@pytest.mark.parametrize("where", [5, 0.6, -3])
def test_a_cell_with_a_flipped_byte_is_named_and_flown_again(folder, where):
    before, path = untimed(folder), cell(folder, 2)
    flip(path, int(where * path.stat().st_size) if isinstance(where, float) else where)
    assert list(verify_results(folder).wrong) == [str(path)]
    code, out, err = run("results", folder, "--verify")
    assert code == 1 and out.startswith(f"{path}: ") and "1 files have changed since they were written" in err
    result = fly(folder)
    assert result.flown == 1 and untimed(folder) == before
    (note,) = result.notes
    assert note.startswith("1 cells have changed since they were flown") and str(path) in note
    assert not verify_results(folder).wrong
    assert fly(folder).flown == 0


def test_a_cell_under_another_s_name(folder):
    shutil.copy(cell(folder, 0), cell(folder, 1))
    assert list(verify_results(folder).wrong) == [str(cell(folder, 1))]
    assert fly(folder).flown == 1 and not verify_results(folder).wrong


def test_edited_results_do_not_come_back(folder):
    """The rows of the next run are those of the flights."""
    before, path = untimed(folder), folder / "results.parquet"
    edit(path, "mean_error", 0, 1e-4)
    found = verify_results(folder)
    assert "do not match their hash" in found.wrong[str(path)]
    for read in ("show", "results", "report"):
        code, _, err = run(read, folder, *(["--out", folder.parent / "x.html"] if read == "report" else []))
        assert code == 1 and "edited or damaged" in err and err.count("\n") == 1
    result = fly(folder)
    assert result.flown == 0 and untimed(folder) == before
    assert [note for note in result.notes if str(path) in note and note.endswith("written anew")]
    assert not verify_results(folder).wrong


def test_results_with_a_hash_of_their_own_are_compared_with_the_flights(folder):
    """Who writes them anew with this program's own means has a right hash, and still not what was flown."""
    path = folder / "results.parquet"
    columns, record = read_table(path, "results")
    columns["rmse"] = columns["rmse"].copy()
    columns["rmse"][1] *= 0.5
    write_table(path, columns, record, "results")
    found = verify_results(folder)
    assert list(found.wrong) == [str(path)]
    assert found.wrong[str(path)] == f"1 rows are not what their flights say, the first {columns['key'][1]} (rmse)"
    cell(folder, 3).unlink()
    assert "1 rows are of flights that are not there" in verify_results(folder).wrong[str(path)]
    assert fly(folder).flown == 1 and not verify_results(folder).wrong


@pytest.mark.parametrize("name", ["results.csv", "table.md"])
def test_a_text_edited_by_hand_is_noticed_and_written_anew(folder, name):
    path = folder / name
    text = path.read_text()
    digits = [i for i, letter in enumerate(text) if letter in "12345678"]
    at = digits[len(digits) // 2]
    path.write_text(text[:at] + str(int(text[at]) + 1) + text[at + 1 :])
    assert list(verify_results(folder).wrong) == [str(path)]
    result = fly(folder)
    assert result.flown == 0 and path.read_text() == text
    (note,) = result.notes
    assert str(path) in note and "edited" in note and note.endswith("written anew")
    assert not verify_results(folder).wrong and not fly(folder).notes


@pytest.mark.parametrize("name", ["results.parquet", "table.md", "statistics.parquet"])
def test_what_is_not_there_is_written_anew(folder, name):
    before = contents(folder)
    (folder / name).unlink()
    assert list(verify_results(folder).wrong) == [str(folder / name)]
    assert fly(folder).flown == 0 and not verify_results(folder).wrong
    made_again = (folder / name).read_bytes() == before[(folder / name).relative_to(folder)]
    assert made_again or name == "results.parquet"  # whose record says when it was made


def test_a_folder_of_other_things(tmp_path):
    with pytest.raises(UsageError, match="holds no results"):
        verify_results(tmp_path)
    code, _, err = run("results", tmp_path, "seed=0", "--verify")
    assert code == 2 and "give that alone" in err
