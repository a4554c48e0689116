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
import re
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
    allowed, metadata = allowed_bytes(Path(path)), file.metadata
    text = _text_columns(path, file.schema_arrow)
    rows = declared = 0
    for i in range(metadata.num_row_groups):
        group = metadata.row_group(i)
        rows += group.num_rows
        for k, name in enumerate(file.schema_arrow.names):
            chunk = group.column(k)
            if chunk.num_values != group.num_rows or group.num_rows < 0:
                shown = f"{chunk.num_values} of {group.num_rows} rows"
                raise DataError(f"{path}: damaged, column {name!r} declares {shown}")
            width = PER_TEXT if name in text else 8
            declared += max(chunk.num_values * width, chunk.total_uncompressed_size)
    if rows != metadata.num_rows:
        raise DataError(f"{path}: damaged, it declares {metadata.num_rows} rows and has parts of {rows}")
    if text and declared <= allowed:
        declared += _letters(path, text)
    if declared > allowed:
        raise DataError(
            f"{path}: declares {rows} rows of {metadata.num_columns} columns, {declared / 1e6:.0f} MB, in a file of"
            f" {Path(path).stat().st_size / 1e3:.0f} kB; {allowed / 1e6:.0f} MB are allowed for it: damaged, or made to"
            " fill the memory"
        )


def _text_columns(path: str | Path, schema: Any) -> list[str]:
    """The names of the columns of text; DataError for columns that hold neither numbers nor text."""
    import pyarrow as pa

    if len(set(schema.names)) < len(schema.names):
        raise DataError(f"{path}: damaged, two columns have one name")
    text = []
    for field in schema:
        kind = field.type
        if pa.types.is_string(kind) or pa.types.is_large_string(kind):
            text.append(field.name)
        elif not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
            raise DataError(f"{path}: column {field.name!r} holds {kind}, numbers or text are needed")
    return text


def _letters(path: str | Path, names: list[str]) -> int:
    """Characters of text columns when every row has its own copy, from the sizes of their dictionaries."""
    import pyarrow.parquet as pq

    total = 0
    with pq.ParquetFile(path, read_dictionary=names, page_checksum_verification=True) as file:
        for name in names:
            for chunk in file.read(columns=[name]).column(name).chunks:
                lengths = np.array([len(text or "") for text in chunk.dictionary.to_pylist()], dtype=np.int64)
                indices = np.frombuffer(chunk.indices.buffers()[1], np.int32, chunk.offset + len(chunk))[chunk.offset :]
                total += int(np.bincount(indices, minlength=len(lengths)) @ lengths) if len(lengths) else 0
    return total


def check_numbers(columns: Any, names: Any, where: str) -> None:
    """Raise DataError naming the first of the columns that holds text, or nothing in some rows."""
    for name in names:
        if columns[name].dtype.kind not in "fiu" and len(columns[name]):
            raise DataError(f"{where}: column {name!r} holds text, or nothing in some rows; numbers are needed")


# -------------------------------------------------------------------------------------------------------------- hashes
CONTENT_KEY = b"quadexp_content_sha256"  # in the schema metadata
FILE_KEY = b"quadexp_file_sha256"  # in the file's key-value metadata
_DIGITS = 64  # hexadecimal digits of SHA-256
_NONE_YET = b"0" * _DIGITS
_SEAL = re.compile(re.escape(FILE_KEY) + rb"..([0-9a-f]{%d})" % _DIGITS, re.DOTALL)  # two bytes: type and length


def content_hash(names: Iterable[str], columns: Iterable[Any]) -> bytes:
    """sha256 over the names, types, lengths and values of Arrow columns (arrays or chunked arrays); 64 hex digits.

    Into how many pieces a column is cut takes no part; the bits of a NaN do.
    """
    digest = hashlib.sha256()
    for name, column in zip(names, columns, strict=True):
        digest.update(f"{name}\0{column.type}\0{len(column)}\0{column.null_count}\0".encode())
        chunks = getattr(column, "chunks", [column])
        if column.null_count:
            digest.update(repr([value for chunk in chunks for value in chunk.to_pylist()]).encode())
            continue
        parts = [_parts(chunk) for chunk in chunks]
        for i in range(max(map(len, parts), default=0)):  # all lengths of a text column, then all texts
            for part in parts:
                digest.update(part[i])
    return digest.hexdigest().encode()


def _parts(chunk: Any) -> list[Any]:
    """The bytes of an array without nulls: its values, or of text the length of each and then all of it."""
    import pyarrow as pa

    kind, first, size = chunk.type, chunk.offset, len(chunk)
    if pa.types.is_floating(kind) or pa.types.is_integer(kind):
        width = kind.bit_width // 8
        return [memoryview(chunk.buffers()[1])[first * width : (first + size) * width] if size else b""]
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        if not size:
            return [b"", b""]
        _, offsets, data = chunk.buffers()
        dtype = np.int32 if pa.types.is_string(kind) else np.int64
        ends = np.frombuffer(offsets, dtype, count=first + size + 1)[first:].astype(np.int64)
        return [np.diff(ends).tobytes(), memoryview(data)[ends[0] : ends[-1]] if data is not None else b""]
    return [repr(chunk.to_pylist()).encode()]


def sealed_parquet(table: Any, **options: Any) -> bytes:
    """An Arrow table as a Parquet file with checksums of its pages and its own hash. options: of the writer."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    memory = pa.BufferOutputStream()
    with pq.ParquetWriter(memory, table.schema, write_page_checksum=True, **options) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({FILE_KEY: _NONE_YET})
    content = memory.getvalue().to_pybytes()
    (seal,) = _SEAL.finditer(content, _footer_start(content))
    return content[: seal.start(1)] + sha256_of(content).encode() + content[seal.end(1) :]


def sealed_bytes(path: Path) -> tuple[bytes, bool | None]:
    """The bytes of a file, and whether they are what was written: None where it carries no hash of them.

    Raises OSError where it cannot be read.
    """
    content = path.read_bytes()
    seal = _SEAL.search(content, _footer_start(content))
    if seal is None:
        return content, None
    digest = hashlib.sha256(memoryview(content)[: seal.start(1)])
    digest.update(_NONE_YET)
    digest.update(memoryview(content)[seal.end(1) :])
    return content, digest.hexdigest().encode() == seal[1]


def sealed_value(content: bytes, key: bytes) -> bytes | None:
    """What stands under a key in the metadata of a file whose hash was found right, without parsing its columns' part
    (a tenth of the time); None where it is not found."""
    start = content.find(bytes([len(key)]) + key + b"\x18", _footer_start(content))
    if start < 0:
        return None
    at, size, shift = start + len(key) + 2, 0, 0
    while content[at] & 0x80:  # the length, seven bits a byte, the lowest first
        size |= (content[at] & 0x7F) << shift
        at, shift = at + 1, shift + 7
    size |= content[at] << shift
    return content[at + 1 : at + 1 + size]


def _footer_start(content: bytes) -> int:
    return max(0, len(content) - 8 - int.from_bytes(content[-8:-4], "little"))
