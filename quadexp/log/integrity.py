"""Whether a Parquet file can be read: it declares no more than a file of its size holds, and holds what was written.

A few kilobytes of Parquet or HDF5 can declare hundreds of millions of rows, which take gigabytes once decoded. What a
file may declare follows from what it is: a flight, in which time at least goes on, compresses some forty times where
all else stands still, and twice to eight times where it moves. Text is counted by what it has once every row has its
own.

The hash of the columns (names, types, values, in their order) lies in the schema metadata. It stays true when another
program writes the same table anew, and is checked where a file is read in full.

The hash of the bytes lies in the file's own key-value metadata, which no program takes over that edits the table. It
covers every byte of the file, its own 64 digits taken as zeros. It is checked where a file is recalled without being
read: a flight of 20 s (298 kB) takes 0.2 ms, its footer alone 0.3 ms, decoding it 2 ms.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.names import sha256_of

ALWAYS = 100_000_000  # bytes in memory that a file may declare whatever its size
EXPANSION = 60  # times its own size that a larger one may declare: an hour of hover, of which two columns move, has 40
PER_TEXT = 80  # bytes that a text takes in memory beside its letters


def allowed_bytes(path: Path) -> int:
    """Bytes in memory that a file (or all files of a folder) may declare."""
    parts = [part for part in path.rglob("*") if part.is_file()] if path.is_dir() else [path]
    return max(ALWAYS, EXPANSION * sum(part.stat().st_size for part in parts))


def check_declared(path: str | Path, file: Any) -> None:
    """Raise DataError where an open pyarrow.parquet.ParquetFile declares more than a file of its size holds, or columns
    that are neither numbers nor text. Only the footer is read, and of text that many rows share its dictionary."""
    allowed = allowed_bytes(Path(path))
    metadata = file.metadata
    names = file.schema_arrow.names
    text = _text_columns(path, file.schema_arrow)
    declared = 0
    for i in range(metadata.num_row_groups):
        for k, name in enumerate(names):
            chunk = metadata.row_group(i).column(k)
            width = PER_TEXT if name in text else 8
            declared += max(chunk.num_values * width, chunk.total_uncompressed_size)
    if text and declared <= allowed:
        declared += _letters(path, text)
    if declared > allowed:
        raise DataError(
            f"{path}: declares {metadata.num_rows} rows of {len(names)} columns, {declared / 1e6:.0f} MB, in a file of"
            f" {Path(path).stat().st_size / 1e3:.0f} kB; {allowed / 1e6:.0f} MB are allowed for it: damaged, or made to"
            " fill the memory"
        )


def _text_columns(path: str | Path, schema: Any) -> list[str]:
    """The names of the columns of text; DataError for columns that hold neither numbers nor text."""
    if len(set(schema.names)) < len(schema.names):
        raise DataError(f"{path}: damaged, two columns have one name")
    text = []
    for field in schema:
        if _is_text(field.type):
            text.append(field.name)
        elif not _is_number(field.type):
            raise DataError(f"{path}: column {field.name!r} holds {field.type}, numbers or text are needed")
    return text


def _letters(path: str | Path, names: list[str]) -> int:
    """Bytes of text columns when every row has its own copy, from the sizes of their dictionaries."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    total = 0
    with pq.ParquetFile(path, read_dictionary=names, page_checksum_verification=True) as file:
        for name in names:
            for chunk in file.read(columns=[name]).column(name).chunks:
                lengths = np.array([len(text) for text in chunk.dictionary.to_pylist()], np.int64)
                uses = np.bincount(as_numpy(pa.chunked_array([chunk.indices.drop_null()])), minlength=len(lengths))
                total += int(uses @ lengths)
    return total


def _is_number(kind: Any) -> bool:
    import pyarrow as pa

    return bool(pa.types.is_floating(kind) or pa.types.is_integer(kind))


def _is_text(kind: Any) -> bool:
    import pyarrow as pa

    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


# pyarrow's own conversions to numpy import pandas, a third of a second in every process; the buffers do not.
_FLOATS = {"double": "float64", "float": "float32", "halffloat": "float16"}


def as_numpy(column: Any) -> np.ndarray:
    """A column as an array of its own; of text, and of what lacks values, one of objects."""
    chunks = []
    for chunk in column.chunks:
        if chunk.null_count or not _is_number(chunk.type):
            chunks.append(np.array(chunk.to_pylist(), dtype=object))
            continue
        dtype = np.dtype(_FLOATS.get(str(chunk.type), str(chunk.type)))
        count = chunk.offset + len(chunk)
        values = np.frombuffer(chunk.buffers()[1], dtype, count=count) if len(chunk) else np.empty(count, dtype)
        chunks.append(values[chunk.offset :])
    return np.concatenate(chunks) if chunks else np.empty(0)


def check_numbers(columns: Any, names: Any, where: str) -> None:
    """Raise DataError naming the first of the columns that holds text, or nothing in some rows."""
    for name in names:
        if columns[name].dtype.kind not in "fiu" and len(columns[name]):
            raise DataError(f"{where}: column {name!r} holds text, or nothing in some rows; numbers are needed")


# -------------------------------------------------------------------------------------------------------------- hashes
CONTENT_KEY = b"quadexp_content_sha256"  # in the schema metadata
FILE_KEY = b"quadexp_file_sha256"  # in the file's key-value metadata
_NONE_YET = b"0" * 64  # in place of the hash itself


def content_hash(names: Iterable[str], columns: Iterable[Any]) -> bytes:
    """sha256 over the names, types, lengths and values of chunked arrays of Arrow; 64 hex digits.

    Of a text column all lengths come before all texts. Into how many pieces a column is cut takes no part; the bits of
    a NaN do.
    """
    digest = hashlib.sha256()
    for name, column in zip(names, columns, strict=True):
        digest.update(f"{name}\0{column.type}\0{len(column)}\0{column.null_count}\0".encode())
        if column.null_count:
            digest.update(repr(column.to_pylist()).encode())
        elif _is_text(column.type):
            texts = [text.encode() for text in column.to_pylist()]
            digest.update(np.array([len(text) for text in texts], np.int64).tobytes())
            digest.update(b"".join(texts))
        else:
            digest.update(as_numpy(column).tobytes())
    return digest.hexdigest().encode()


def sealed_parquet(table: Any, **options: Any) -> bytes:
    """An Arrow table as a Parquet file with checksums of its pages and its own hash. options: of the writer."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    memory = pa.BufferOutputStream()
    with pq.ParquetWriter(memory, table.schema, write_page_checksum=True, **options) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({FILE_KEY: _NONE_YET})
    content = memory.getvalue().to_pybytes()
    place = _place(content, FILE_KEY)
    assert place is not None
    return content[: place.start] + sha256_of(content).encode() + content[place.stop :]


def sealed_bytes(path: Path) -> tuple[bytes, bool | None]:
    """The bytes of a file, and whether they are what was written: None where it carries no hash of them.

    Raises OSError where it cannot be read.
    """
    content = path.read_bytes()
    place = _place(content, FILE_KEY)
    if place is None:
        return content, None
    digest = hashlib.sha256(memoryview(content)[: place.start])
    digest.update(_NONE_YET)
    digest.update(memoryview(content)[place.stop :])
    return content, digest.hexdigest().encode() == content[place]


def sealed_value(content: bytes, key: bytes) -> bytes | None:
    """What stands under a key in the metadata of a file whose hash was found right, without parsing its columns' part
    (a tenth of the time); None where it is not found."""
    place = _place(content, key)
    return None if place is None else content[place]


def _place(content: bytes, key: bytes) -> slice | None:
    """Where the value of a key stands in the footer of a Parquet file (Thrift's compact protocol: the key, 0x18, the
    value's length with seven bits a byte, the lowest first, the value); None where it is not found."""
    footer = max(0, len(content) - 8 - int.from_bytes(content[-8:-4], "little"))
    start = content.find(bytes([len(key)]) + key + b"\x18", footer)
    if start < 0:
        return None
    at = start + len(key) + 2
    size = 0
    shift = 0
    for byte in content[at:]:
        size |= (byte & 0x7F) << shift
        at = at + 1
        shift = shift + 7
        if byte < 0x80:
            break
    return slice(at, at + size)
