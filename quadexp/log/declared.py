"""How much a file says that it holds, before it is loaded: a few kilobytes of Parquet or HDF5 can declare hundreds of
millions of rows, which take gigabytes once decoded.

What a file may declare follows from what it is: a flight, in which time at least goes on, compresses some forty times
where all else stands still, and twice to eight times where it moves. Text is counted by what it has once every row has
its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError

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
    size, allowed = Path(path).stat().st_size, allowed_bytes(Path(path))
    declared, suspected = 0, []
    widths = dict(_widths(path, file.schema_arrow))
    for group in _groups(path, file.metadata):
        for i, (name, width) in enumerate(widths.items()):
            chunk = group.column(i)
            if chunk.num_values != group.num_rows:
                raise DataError(
                    f"{path}: damaged, column {name!r} declares {chunk.num_values} of {group.num_rows} rows"
                )
            declared += max(chunk.num_values * width, chunk.total_uncompressed_size)
            if width == PER_TEXT and chunk.num_values * chunk.total_uncompressed_size > ALWAYS:
                suspected.append(name)
    _refuse(path, file, declared, allowed, size)
    if suspected:
        _refuse(path, file, declared + _letters(path, sorted(set(suspected))), allowed, size)


def _refuse(path: str | Path, file: Any, declared: int, allowed: int, size: int) -> None:
    if declared > allowed:
        raise DataError(
            f"{path}: declares {file.metadata.num_rows} rows of {file.metadata.num_columns} columns,"
            f" {declared / 1e6:.0f} MB, in a file of {size / 1e3:.0f} kB; {allowed / 1e6:.0f} MB are allowed for it:"
            " damaged, or made to fill the memory"
        )


def _widths(path: str | Path, schema: Any) -> Iterator[tuple[str, int]]:
    """Bytes that a value of each column takes."""
    import pyarrow as pa

    for field in schema:
        kind = field.type
        if pa.types.is_floating(kind) or pa.types.is_integer(kind):
            yield field.name, 8
        elif pa.types.is_string(kind) or pa.types.is_large_string(kind):
            yield field.name, PER_TEXT
        else:
            raise DataError(f"{path}: column {field.name!r} holds {kind}, numbers or text are needed")
    if len(set(schema.names)) < len(schema.names):
        raise DataError(f"{path}: damaged, two columns have one name")


def _groups(path: str | Path, metadata: Any) -> Iterator[Any]:
    rows = 0
    for i in range(metadata.num_row_groups):
        group = metadata.row_group(i)
        if group.num_rows < 0:
            raise DataError(f"{path}: damaged, it declares {group.num_rows} rows")
        rows += group.num_rows
        yield group
    if rows != metadata.num_rows:
        raise DataError(f"{path}: damaged, it declares {metadata.num_rows} rows and has parts of {rows}")


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
