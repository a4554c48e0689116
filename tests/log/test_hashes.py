"""Hashes of columns and of files: what is edited or damaged is noticed, what is only written anew is read."""

import hashlib
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from quadexp.errors import DataError, QuadexpError
from quadexp.log.integrity import CONTENT_KEY, FILE_KEY, content_hash
from quadexp.log.store import METADATA_KEY, read_record, read_table, write_flight, write_table
from tests.log.flights import straight_flight

NAMES = ("first", "count", "word")


@pytest.fixture
def table(tmp_path):
    """A small table with numbers, NaN and text, of the kind that holds any columns."""
    columns = {
        "first": np.array([0.5, np.nan, -0.0, 3.0]),
        "count": np.array([1, 2, 3, 4], np.int16),
        "word": np.array(["", "drag", "\u00e9t\u00e9", "a\0b"], object),
    }
    return write_table(tmp_path / "a.parquet", columns, {"seed": 3}, "estimates")


def by_hand():
    """The hash of that table, from the definition."""
    digest = hashlib.sha256(b"first\0double\x004\x000\0" + np.array([0.5, np.nan, -0.0, 3.0]).tobytes())
    digest.update(b"count\0int16\x004\x000\0" + np.array([1, 2, 3, 4], "<i2").tobytes())
    texts = [text.encode() for text in ("", "drag", "\u00e9t\u00e9", "a\0b")]
    lengths = np.array([len(text) for text in texts], "<i8").tobytes()
    digest.update(b"word\0string\x004\x000\0" + lengths + b"".join(texts))
    return digest.hexdigest().encode()


def test_the_hash_is_what_it_is_said_to_be(table):
    assert pq.read_schema(table).metadata[CONTENT_KEY] == by_hand()
    content = table.read_bytes()
    stored = pq.ParquetFile(table).metadata.metadata[FILE_KEY]
    assert content.count(stored) == 1
    assert hashlib.sha256(content.replace(stored, b"0" * 64)).hexdigest().encode() == stored


def test_into_how_many_pieces_a_column_is_cut_takes_no_part():
    for values in (np.arange(9.0), np.arange(9, dtype=np.int8), [f"{'x' * i}y" for i in range(9)]):
        whole = pa.array(values)
        cut = pa.chunked_array([whole[:0], whole[:4], whole[4:5], whole[5:]])
        moved = pa.concat_arrays([whole[:1], whole])[1:]  # begins inside its buffers
        hashes = {content_hash(["a"], [pa.chunked_array(pieces)]) for pieces in ([whole], cut.chunks, [moved])}
        assert len(hashes) == 1


def test_every_difference_is_one():
    base = {"a": pa.array([1.0, 2.0]), "b": pa.array(["x", "yz"])}
    numbers = [[1.0, np.nextafter(2.0, 3.0)], [2.0, 1.0], [1.0, None], [1.0, np.nan], [1.0], [0.0, 2.0], [-0.0, 2.0]]
    others = [
        {"b": base["b"], "a": base["a"]}, {"a": base["a"], "c": base["b"]}, {"a": base["a"]},
        {**base, "a": pa.array([1.0, 2.0], pa.float32())}, *({**base, "a": pa.array(x)} for x in numbers),
        {**base, "b": pa.array(["xy", "z"])}, {**base, "b": pa.array(["x", None])},
    ]  # fmt: skip
    tables = [{name: pa.chunked_array([array]) for name, array in columns.items()} for columns in (base, *others)]
    hashes = [content_hash(columns, columns.values()) for columns in tables]
    assert len(set(hashes)) == len(hashes)


def edited(name, values):
    return lambda table: table.set_column(table.column_names.index(name), table.field(name), pa.array(values))


EDITS = {
    "a number": edited("first", [0.5, np.nan, -0.0, 3.0000001]),
    "a sign of zero": edited("first", [0.5, np.nan, 0.0, 3.0]),
    "NaN to null, as pandas does": edited("first", [0.5, None, -0.0, 3.0]),
    "an integer": edited("count", np.array([1, 2, 3, 5], np.int16)),
    "a word": edited("word", ["", "drug", "\u00e9t\u00e9", "a\0b"]),
    "a type": lambda t: t.set_column(1, pa.field("count", pa.int64()), t["count"].cast(pa.int64())),
    "rows in another order": lambda t: t.take([1, 0, 2, 3]),
    "a row less": lambda t: t.slice(1),
    "rows twice": lambda t: pa.concat_tables([t, t]),
    "a column more": lambda t: t.append_column("more", pa.array([1, 2, 3, 4])),
    "a column less": lambda t: t.drop_columns(["word"]),
    "a name": lambda t: t.rename_columns(["other", "count", "word"]),
    "names changed about": lambda t: t.rename_columns(["count", "first", "word"]),
    "the record": lambda t: t.replace_schema_metadata(
        {**t.schema.metadata, METADATA_KEY: t.schema.metadata[METADATA_KEY].replace(b'"seed": 3', b'"seed": 4')}
    ),
    "the hash left out": lambda t: t.replace_schema_metadata(
        {key: value for key, value in t.schema.metadata.items() if key != CONTENT_KEY}
    ),
}


@pytest.mark.parametrize("edit", EDITS)
def test_an_edit_with_pyarrow_keeps_the_metadata_and_is_noticed(table, edit):
    metadata = pq.read_table(table).schema.metadata
    changed = EDITS[edit](pq.read_table(table))
    changed = changed.replace_schema_metadata(changed.schema.metadata or metadata)
    assert METADATA_KEY in changed.schema.metadata
    pq.write_table(changed, table)
    for read in (lambda: read_table(table, "estimates"), lambda: read_record(table, "estimates")):
        with pytest.raises(DataError, match="do(es)? not match (its|their) hash") as error:
            read()
        assert str(table) in str(error.value) and "\n" not in str(error.value)


def test_an_edit_with_pandas_is_noticed_index_and_all(table):
    schema = pq.read_schema(table).metadata
    frame = pq.read_table(table).to_pandas()
    frame.loc[3, "first"] = 4.0
    for index in (frame, frame.set_index("word"), frame[frame["count"] > 1]):
        made = pa.Table.from_pandas(index)
        pq.write_table(made.replace_schema_metadata({**made.schema.metadata, **schema}), table)
        with pytest.raises(DataError, match="not match"):
            read_table(table, "estimates")
    frame.to_parquet(table)
    with pytest.raises(DataError, match="not one that quadexp wrote"):
        read_table(table, "estimates")


def test_the_same_table_written_anew_is_read_and_not_taken_for_the_file_that_was_written(table):
    before, _ = read_table(table, "estimates")
    pq.write_table(pq.read_table(table), table, compression="gzip", row_group_size=3)
    after, record = read_table(table, "estimates")
    assert record["seed"] == 3 and before["word"].tolist() == after["word"].tolist()
    assert all(before[name].tobytes() == after[name].tobytes() for name in NAMES[:2])
    with pytest.raises(DataError, match="written anew by another program"):
        read_record(table, "estimates")


@pytest.mark.parametrize("step", [47, pytest.param(1, marks=pytest.mark.slow)])
def test_every_byte_of_a_file_is_under_its_hash(tmp_path, step):
    """step: between two bytes that are damaged; the first and the last 50 are damaged whatever it is."""
    path = write_flight(tmp_path / "a.parquet", straight_flight(3), key="k")
    content = path.read_bytes()
    assert read_record(path, "flight")["key"] == "k"
    rng = np.random.default_rng(1)
    ends = [*range(50), *range(len(content) - 50, len(content))]
    for at in sorted({*ends, *range(0, len(content), step)}):
        damaged = bytearray(content)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        with pytest.raises(QuadexpError):
            read_record(path, "flight")
    for end in rng.integers(len(content), size=20 if step > 1 else 100):
        path.write_bytes(content[:end])
        with pytest.raises(QuadexpError):
            read_record(path, "flight")


def test_the_record_is_the_one_that_arrow_reads(tmp_path):
    """It is taken from the bytes by hand, short or long, with any letters."""
    for text in ("", "x" * 90, "\u00e9" * 200, "y" * 40_000, 'quadexp"{}\\'):
        path = write_table(tmp_path / "a.parquet", {"t": np.arange(3.0)}, {"text": text, "quadexp": 1}, "estimates")
        assert read_record(path, "estimates") == json.loads(pq.read_schema(path).metadata[METADATA_KEY])
        with pytest.raises(DataError, match="is a table of estimates, a flight is needed"):
            read_record(path, "flight")
