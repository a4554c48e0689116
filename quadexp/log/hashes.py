"""Hashes that tell whether a Parquet file still holds what was written: of its columns, and of its bytes.

The hash of the columns (names, types, values, in their order) lies in the schema metadata. It stays true when another
program writes the same table anew, and is checked where a file is read in full.

The hash of the bytes lies in the file's own key-value metadata, which no program takes over that edits the table. It
covers every byte of the file, its own 64 digits taken as zeros. It is checked where a file is recalled without being
read: a flight of 20 s (298 kB) takes .2 ms, its footer alone .3 ms, decoding it 2 ms.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

CONTENT_KEY = b"quadexp_content_sha256"  # in the schema metadata
FILE_KEY = b"quadexp_file_sha256"  # in the file's key-value metadata
_DIGITS = 64
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
    import numpy as np
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


def write_sealed(table: Any, file: BinaryIO, **options: Any) -> None:
    """Write an Arrow table as Parquet, with the hash of its own bytes, into an empty file that is open for reading and
    writing. options: of the Parquet writer."""
    import pyarrow.parquet as pq

    with pq.ParquetWriter(file, table.schema, **options) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({FILE_KEY: _NONE_YET})
    file.seek(0)
    digest = hashlib.file_digest(file, "sha256").hexdigest().encode()  # type: ignore[arg-type]  # reads as a file does
    footer = _read_footer(file)
    (found,) = _SEAL.finditer(footer)
    file.seek(-len(footer) + found.start(1), 2)
    file.write(digest)


def _read_footer(file: Any) -> bytes:
    """What stands in a Parquet file behind its data."""
    end = file.seek(0, 2)
    file.seek(max(0, end - 8))
    size = int.from_bytes(file.read(4), "little") + 8
    file.seek(max(0, end - size))
    return bytes(file.read())


def sealed_bytes(path: Path) -> tuple[bytes, bool | None]:
    """The bytes of a file, and whether they are what was written: None where it carries no hash of them.

    Raises OSError where it cannot be read.
    """
    content = path.read_bytes()
    found = _SEAL.search(content, _footer_start(content))
    if found is None:
        return content, None
    digest = hashlib.sha256(memoryview(content)[: found.start(1)])
    digest.update(_NONE_YET)
    digest.update(memoryview(content)[found.end(1) :])
    return content, digest.hexdigest().encode() == found[1]


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
