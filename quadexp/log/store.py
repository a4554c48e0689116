"""Tables on disk: Parquet, with the record in the schema metadata, appearing whole or not at all.

Under the key `quadexp` the file carries JSON: {"kind": "flight" | "residuals" | "results", "schema": 2, ...}, and
under `quadexp_sha256` the hash of that text and of the columns' names; every page of data carries a checksum. The hash
of the columns' types and values stands beside it and is checked where the file is read in full, that of the file's
bytes behind it (see integrity.py). So a changed bit, an edited number and a file that another program wrote anew are
noticed.
"""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError, WrongFileError
from quadexp.log.integrity import (
    CONTENT_KEY,
    as_numpy,
    check_declared,
    check_numbers,
    content_hash,
    sealed_bytes,
    sealed_parquet,
    sealed_value,
)
from quadexp.log.schema import Flight, describe
from quadexp.names import check_names, sha256_of
from quadexp.parts.former import now
from quadexp.physics.state import STATE_COLUMNS
from quadexp.plugin import shipped_places
from quadexp.progress import set_status
from quadexp.writer import written

SCHEMA = 2
LONG = 200_000  # rows of a table that is read column by column
METADATA_KEY = b"quadexp"
HASH_KEY = b"quadexp_sha256"
MAGIC = b"PAR1"  # first bytes of a Parquet file

# What stands in the record of a file, where it does.
RECORD: dict[str, type] = {
    "kind": str, "config": dict, "row": dict, "vehicle": dict, "versions": dict, "provenance": dict, "outcome": str,
}  # fmt: skip


def read_text(path: Path) -> str | None:
    """What a text file holds; None where there is none, or no text."""
    with contextlib.suppress(OSError, UnicodeError):
        return path.read_bytes().decode("utf-8")
    return None


def write_table(
    path: str | Path, columns: Mapping[str, Any], metadata: Mapping[str, Any], kind: str, *, force: bool = True,
    durable: bool = True,
) -> Path:  # fmt: skip
    """Write columns (each (k,)) and JSON-able metadata as one Parquet file; force, durable: see `written`."""
    import pyarrow as pa

    arrays = {name: pa.chunked_array([_arrow(values)]) for name, values in columns.items()}
    record = json.dumps({**metadata, "kind": kind, "schema": SCHEMA}, sort_keys=True, default=_plain)
    schema, text = _schema(kind, tuple((name, array.type) for name, array in arrays.items()))
    content = content_hash(arrays, arrays.values())
    digest = _digest(record.encode(), list(arrays), content)
    schema = schema.with_metadata({METADATA_KEY: record, HASH_KEY: digest, CONTENT_KEY: content})
    table = pa.Table.from_arrays(list(arrays.values()), schema=schema)
    # zstd: 3 to 6 % smaller, but of 200 rows 0.6 ms more. Statistics: 0.1 ms, and no row is looked for by them.
    sealed = sealed_parquet(table, compression="snappy", use_dictionary=text, write_statistics=False)
    with written(path, force=force, durable=durable) as file:
        file.write(sealed)
    return Path(path)


@cache
def _schema(kind: str, columns: tuple[tuple[str, Any], ...]) -> tuple[Any, list[str]]:
    """Schema of a table's columns (name, type), and which of them hold text."""
    import pyarrow as pa

    about = [{key: value for key, value in describe(name, kind)._asdict().items() if value} for name, _ in columns]
    fields = [pa.field(*column, metadata=each or None) for column, each in zip(columns, about, strict=True)]
    return pa.schema(fields), [name for name, type_ in columns if pa.types.is_string(type_)]


def _digest(record: bytes, names: list[str], content: bytes) -> bytes:
    """Hash of a table's record, of its columns' names, and of the hash of its columns."""
    parts = [record, *(name.encode() for name in names), content]
    return sha256_of(b"\0".join(parts)).encode()


def _plain(value: Any) -> Any:
    """NumPy scalars and arrays, and paths, as JSON."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


def read_metadata(path: str | Path, kind: str | None = None) -> dict[str, Any]:
    """The record of a table, without its rows.

    Raises UsageError where there is no such file, WrongFileError where it is a folder, no Parquet file, or of another
    kind, DataError where it is damaged, none of ours or of another schema.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = Path(path)
    _check_kind_of_file(path, kind)
    try:
        schema = pq.read_schema(path)
    except (pa.ArrowException, OSError, MemoryError, ValueError, OverflowError) as error:
        raise DataError(f"{path}: damaged ({first_line(error)}){_remade(kind)}") from None
    raw = (schema.metadata or {}).get(METADATA_KEY, b"")
    try:
        record = json.loads(raw)
        stored_kind = record["kind"]
        version = record["schema"]
    except (TypeError, ValueError, KeyError, RecursionError):
        raise WrongFileError(f"{path}: a Parquet file, but not one that quadexp wrote") from None
    if version != SCHEMA:
        raise DataError(f"{path}: written with schema {version}, this program reads schema {SCHEMA}: make it again")
    if schema.metadata.get(HASH_KEY) != _digest(raw, schema.names, schema.metadata.get(CONTENT_KEY, b"")):
        raise DataError(f"{path}: damaged, its record does not match its hash: make it again")
    wrong = [name for name, type_ in RECORD.items() if not isinstance(record.get(name), type_ | None)]
    if wrong:
        raise DataError(f"{path}: damaged, {wrong[0]!r} of its record is {str(record[wrong[0]])[:40]!r}")
    check_names(record, str(path))
    if isinstance(record.get("config"), dict):
        record["config"] = now(record["config"])
    if kind is not None and stored_kind != kind:
        raise WrongFileError(f"{path}: is {called(stored_kind)[1]}, {_needed(kind)}")
    return record


def called(kind: str) -> tuple[str, str]:
    """The command that makes a kind of tables, and what it is called: its own name where nothing says it."""
    command, _, what = shipped_places("kinds").get(kind, f" {kind}").partition(" ")
    return command, what


def _needed(kind: str | None) -> str:
    """What is needed instead of a file of another kind, as the end of a message."""
    if kind is None:
        return "a file that quadexp wrote is needed here"
    command, what = called(kind)
    return f"{what} is needed here (made by `quadexp {command}`)"


def example_in(folder: Path) -> str:
    """A file of a folder that could be given instead of it, as the end of a message."""
    flight = next(folder.glob("cells/*/*.parquet"), None) or next(folder.glob("*.parquet"), None)
    listed = f" (`quadexp results {shlex.quote(str(folder))}` lists them)" if (folder / "cells").is_dir() else ""
    return f"; give one of its files, such as {flight}{listed}" if flight else ""


def _check_kind_of_file(path: Path, kind: str | None) -> None:
    """Raise UsageError where there is none, WrongFileError for a folder, with what to give instead, and for what is no
    Parquet file."""
    if path.is_dir():
        hint = example_in(path) if kind in ("flight", None) else ""
        raise WrongFileError(f"{path}: is a folder, {_needed(kind)}{hint}")
    if not path.is_file():
        maker = f" (made by `quadexp {called(kind)[0]}`)" if kind else ""
        raise UsageError(f"{path}: no such file{maker}")
    with contextlib.suppress(OSError), open(path, "rb") as file:  # which is said where it is read
        if (start := file.read(len(MAGIC))) != MAGIC:
            what = "is empty" if not start else "not a Parquet file, or damaged from its first byte on"
            raise WrongFileError(f"{path}: {what}; {_needed(kind)}{_remade(kind)}")


def _remade(kind: str | None) -> str:
    return "; the sweep, run again, makes it anew from its flights" if kind == "results" else ""


def read_table(
    path: str | Path, kind: str, *, required: Iterable[str] = (), finite: bool | Iterable[str] = False
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Columns and record of a table.

    required: columns that must be there. finite: True, or the columns, that may hold neither NaN nor infinity.
    Raises UsageError or DataError with one line.
    """
    set_status(path)
    import pyarrow as pa
    import pyarrow.parquet as pq

    record = read_metadata(path, kind)
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:  # pq.read_table imports pandas for it
            check_declared(path, file)
            columns, content = _read_columns(file)
            stored = (file.schema_arrow.metadata or {}).get(CONTENT_KEY)
    except (pa.ArrowException, OSError, MemoryError, ValueError, OverflowError) as error:
        raise DataError(f"{path}: damaged ({first_line(error)}){_remade(kind)}") from None
    if stored != content:
        text = "its columns do not match their hash: it was edited or damaged after it was written; make it again"
        raise DataError(f"{path}: {text}{_remade(kind)}")
    missing = [name for name in required if name not in columns]
    if missing:
        raise DataError(f"{path}: column {missing[0]!r} is missing (it has {', '.join(list(columns)[:12])}, ...)")
    check_numbers(columns, [name for name in columns if describe(name, kind).unit], str(path))
    names = list(columns) if finite is True else [name for name in finite or () if name in columns]
    check_finite(columns, names, str(path))
    return columns, record


def _read_columns(file: Any) -> tuple[dict[str, np.ndarray], bytes]:
    """All columns of an open file, and their hash. A long table is never in memory twice."""
    import pyarrow as pa

    names = file.schema_arrow.names
    columns = {}
    long = file.metadata.num_rows > LONG
    whole = None if long else file.read()

    def each() -> Iterator[Any]:
        for name in names:
            column = file.read([name]).column(0) if whole is None else whole.column(name)
            columns[name] = as_numpy(column)
            yield column

    content = content_hash(names, each())
    if long:
        pa.default_memory_pool().release_unused()
    return columns, content


def read_record(path: str | Path, kind: str) -> dict[str, Any]:
    """The record of a table that holds, byte for byte, what was written, by the hash of its bytes.

    Raises UsageError where there is no such file, DataError where it has changed or is of another kind.
    """
    path = Path(path)
    try:
        content, sealed = sealed_bytes(path)
    except OSError:
        return read_metadata(path, kind)  # says what is wrong with it
    if sealed is False:
        read_metadata(path, kind)
        raise DataError(f"{path}: its bytes do not match their hash: it was edited or damaged after it was written")
    raw = sealed_value(content, METADATA_KEY) if sealed else None
    try:
        record = json.loads(raw or b"")
        if record["kind"] == kind and record["schema"] == SCHEMA:
            return dict(record)
    except (TypeError, ValueError, KeyError):
        pass
    _, record = read_table(path, kind)
    if sealed is None:
        raise DataError(f"{path}: was written anew by another program")
    return record


def check_finite(columns: Mapping[str, np.ndarray], names: Iterable[str], where: str) -> None:
    """Raise DataError naming the first column and row that are not finite."""
    for name in names:
        values = columns[name]
        if values.dtype.kind != "f":
            continue
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            rows = f"at row {bad[0]} ({len(bad)} such rows of {len(values)})"
            raise DataError(f"{where}: column {name!r} is {values[bad[0]]} {rows}")


def check_whole(record: Mapping[str, Any], where: str) -> None:
    """Raise DataError for a flight thinned by evaluate.log_period, whose rows are not consecutive control instants."""
    if thinned := record.get("thinned"):
        raise DataError(
            f"{where}: holds a sample every {thinned['log_period']:g} s of a flight controlled every"
            f" {thinned['control_period']:g} s: fly it with evaluate.log_period=0 to have all of them"
        )


def check_order(t: np.ndarray, where: str) -> None:
    """Raise DataError naming the first row whose time is not later than that of the row before."""
    late = np.flatnonzero(~(np.diff(t) > 0))
    if len(late):
        k = int(late[0])
        rows = f"row {k} ({t[k]:.6g} s) to row {k + 1} ({t[k + 1]:.6g} s)"
        raise DataError(f"{where}: time does not go on from {rows}: sort the rows, or import the log again")


def check_attitude(columns: Mapping[str, np.ndarray], where: str) -> None:
    """Raise DataError naming the first row whose quaternion is no attitude."""
    none = np.flatnonzero(~np.any([columns[f"q_{axis}"] for axis in "wxyz"], axis=0))
    if len(none):
        raise DataError(f"{where}: the quaternion is zero at row {none[0]} ({len(none)} such rows): remove them")


def _arrow(values: Any) -> Any:
    """A column of numbers or of text as an Arrow array."""
    import pyarrow as pa

    values = np.asarray(values)
    if values.dtype.kind not in "fiu":
        encoded = [str(value).encode() for value in values.tolist()]
        offsets = np.concatenate([[0], np.cumsum([len(text) for text in encoded])]).astype(np.int32)
        return pa.StringArray.from_buffers(len(encoded), pa.py_buffer(offsets), pa.py_buffer(b"".join(encoded)))
    data = pa.py_buffer(np.ascontiguousarray(values))
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, data])


def first_line(error: BaseException) -> str:
    """The first line of an error's text, shortened."""
    text = str(error).strip().splitlines()
    return text[0][:200] if text else type(error).__name__


def write_flight(path: str | Path, flight: Flight, *, force: bool = True, durable: bool = True, **extra: Any) -> Path:
    """Write a flight; `extra` joins its metadata. force, durable: see `written`."""
    return write_table(path, flight.columns, {**flight.metadata, **extra}, "flight", force=force, durable=durable)


def read_flight(path: str | Path, *, check: bool = True, whole: bool = False, placed: bool = True) -> Flight:
    """Read a flight. placed: whether a log must have its position, which the specific force does not need.
    check: refuse NaN in time, state or input (naming column and row). whole: refuse time that does not go on, and
    flights of which some samples only are stored, as what is learned from differences must."""
    recorded = bool(read_metadata(path, "flight").get("recorded"))
    thrust = () if recorded else ("u_0",)  # a log seldom says the rotors' thrust
    state = [name for name in STATE_COLUMNS if placed or not recorded or not name.startswith("p_")]
    columns, record = read_table(path, "flight", required=("t", *state, *thrust))
    if check:
        names = ["t", *state, *(name for name in columns if name.startswith("u_"))]
        check_finite(columns, names, str(path))
        check_attitude(columns, str(path))
    if whole:
        check_whole(record, str(path))
        check_order(columns["t"], str(path))
    return Flight(columns, record)
