"""Tables with named columns: delimited text, HDF5 (MATLAB's since 7.3 too) and Parquet, of which only what is asked for
is read.

Text may begin with lines of other content; the header is the last line without numbers above the rows. Units in
brackets stay part of the column's name. A file without a header has the names "0", "1", ...
"""

from __future__ import annotations

import io
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, missing_package
from quadexp.log.integrity import allowed_bytes, as_numpy
from quadexp.log.store import METADATA_KEY, first_line
from quadexp.names import distinct

HEAD = 1 << 18  # bytes looked at for header and delimiter
LONGEST_LINE = 1 << 16  # characters: 3,000 columns of 20
TEXT_SHARE = 0.97  # of the first bytes that must be printable for a file to be text
MOST_VALUES = 1 << 30  # numbers read from one file at most: 8 GB would not fit beside what is made of them
DESCRIBED_ROWS = 300_000  # 5 min at 1 kHz: what a description is made of
DESCRIBED_COLUMNS = 400  # looked at for a mapping
_DELIMITERS = ((",", "."), (";", "."), ("\t", "."), (" ", "."), (";", ","), ("\t", ","))
EMPTY = ["", "nan", "NaN", "NAN", "-nan", "NA", "N/A", "null", "None", "#N/A"]


@dataclass(frozen=True)
class Table:
    """path, and the names of its columns. format: as a mapping calls it. delimiter, skip, encoding, decimal: of text;
    skip: lines before the rows; decimal: the sign between units and tenths."""

    path: Path
    columns: tuple[str, ...]
    delimiter: str = ","
    skip: int = 0
    format: str = "text"
    encoding: str = "utf-8"
    decimal: str = "."

    def read(self, names: Sequence[str], notes: list[str], rows: int | None = None) -> dict[str, np.ndarray]:
        """Columns by name, each (k,), NaN where a cell is empty. rows: the first so many only.

        Raises DataError naming the column, where one is not there or holds no numbers.
        """
        missing = [name for name in names if name not in self.columns]
        if missing:
            close = ", ".join(self.columns[:16]) + (", ..." if len(self.columns) > 16 else "")
            raise DataError(f"{self.path}: no column {missing[0]!r} (it has {close})")
        wanted = distinct(names)
        if self.format == "parquet":
            return _read_parquet(self, wanted, rows)
        return _read_hdf5(self, wanted, rows) if self.format == "hdf5" else _read_text(self, wanted, notes, rows)


def kind_of(path: Path, head: bytes) -> str:
    """ "hdf5", "parquet", "text", or "" for what is no table, by the first bytes. Raises DataError for text that
    is none to us."""
    if head.startswith((b"\x89HDF\r\n\x1a\n", b"MATLAB 7.3")):
        return "hdf5"
    if head.startswith(b"PAR1"):
        return "parquet"
    if head.startswith(b"version https://git-lfs"):
        raise DataError(f"{path}: a pointer of Git LFS, not the log itself: fetch it with `git lfs pull`")
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise DataError(f"{path}: text in UTF-16; save it as UTF-8")
    printable = sum(byte in b"\t\n\r" or 32 <= byte < 127 or byte >= 160 for byte in head)
    return "text" if b"\x00" not in head and printable >= TEXT_SHARE * len(head) else ""


def open_table(path: Path) -> Table:
    """The table in a file. Raises DataError."""
    with open(path, "rb") as file:
        kind = kind_of(path, file.read(64))
    return {"hdf5": _open_hdf5, "parquet": _open_parquet}.get(kind, _open_text)(path)


# ------------------------------------------------------------------------------------------------------------ text
def _open_text(path: Path) -> Table:
    with open(path, "rb") as file:
        head = file.read(HEAD)
    if len(head) == HEAD:  # a line that is not whole is no row
        head = head[: head.rfind(b"\n") + 1 or HEAD]
    encoding = "utf-8"
    try:
        text = head.decode(encoding)
    except UnicodeDecodeError:  # a degree sign in a name, say
        encoding = "latin-1"
        text = head.decode(encoding)
    lines = text.removeprefix("\ufeff").splitlines()
    if not lines or max(map(len, lines)) > LONGEST_LINE:
        raise DataError(f"{path}: not a table: no line ends within {LONGEST_LINE} characters")
    row, delimiter, decimal = _first_row(path, lines)
    width = len(_cells(lines[row], delimiter))
    names = _header(path, lines, row, delimiter, width) or [str(i) for i in range(width)]
    return Table(path, _unique(names), delimiter, row, encoding=encoding, decimal=decimal)


def _header(path: Path, lines: list[str], row: int, delimiter: str, width: int) -> list[str]:
    """The names in the last line above the first row of numbers; none where it is a comment or text of its own."""
    above = next((k for k in range(row - 1, -1, -1) if lines[k].strip()), None)
    if above is None:
        return []
    text = lines[above].lstrip("#% ")
    names = _cells(text, delimiter)
    if len(names) != width and delimiter == " ":
        names = text.replace(",", " ").split()
    if len(names) == width:
        return names
    if above == row - 1 and not lines[above].lstrip().startswith(("#", "%")):
        named = f"line {above + 1} names {len(names)} columns"
        raise DataError(f"{path}: {named}, but line {row + 1} has {width} values")
    return []


def _cells(line: str, delimiter: str) -> list[str]:
    """The cells of a row, without quotes and blanks around them."""
    parts = line.split() if delimiter == " " else line.split(delimiter)
    return [part.strip().strip('"').strip() for part in parts]


def _first_row(path: Path, lines: list[str]) -> tuple[int, str, str]:
    """The first line that is a row of numbers (two at least, and most of the cells), its delimiter and decimal sign: a
    comma where it does not separate cells, which have one in numbers of later lines too."""
    text = "\n".join(lines)
    commas = re.search(r"\d,\d", text) is not None and re.search(r"\d\.\d", text) is None
    for row, line in enumerate(lines):
        if line.lstrip().startswith(("#", "%")):
            continue
        decimal_comma = commas and (";" in line or "\t" in line)
        for delimiter, decimal in _DELIMITERS:
            if (decimal == ",") != decimal_comma:
                continue
            cells = _cells(line, delimiter)
            numbers = sum(_is_number(cell.replace(decimal, ".")) for cell in cells)
            filled = sum(cell != "" for cell in cells)
            if len(cells) >= (3 if delimiter == " " else 2) and numbers >= max(2, 0.5 * filled):
                return row, delimiter, decimal
    raise DataError(f"{path}: not a table: no line of numbers in its first {len(lines)} lines")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _unique(names: Iterable[str]) -> tuple[str, ...]:
    """Names of which each is there once: others of one name are numbered."""
    seen: Counter[str] = Counter()
    unique = []
    for i, name in enumerate(names):
        name = name or f"column {i}"
        unique.append(f"{name}.{seen[name]}" if seen[name] else name)
        seen[name] += 1
    return tuple(unique)


def _read_text(table: Table, names: list[str], notes: list[str], rows: int | None) -> dict[str, np.ndarray]:
    import pyarrow as pa
    import pyarrow.compute as pc
    from pyarrow import csv

    places = {name: f"c{table.columns.index(name)}" for name in names}
    malformed: list[int] = []

    def bad_row(row: Any) -> str:
        malformed.append(row.number or 0)
        return "skip"

    read = csv.ReadOptions(
        column_names=[f"c{i}" for i in range(len(table.columns))],
        skip_rows=table.skip,
        block_size=1 << 22,
        encoding="utf8" if table.encoding == "utf-8" else table.encoding,
    )
    parse = csv.ParseOptions(delimiter=table.delimiter, invalid_row_handler=bad_row)
    convert = csv.ConvertOptions(
        include_columns=list(places.values()), column_types=dict.fromkeys(places.values(), pa.float64()),
        null_values=EMPTY, strings_can_be_null=True, decimal_point=table.decimal,
    )  # fmt: skip
    chunks: dict[str, list[np.ndarray]] = {name: [] for name in names}
    count = 0
    try:
        with csv.open_csv(_source(table), read, parse, convert) as reader:
            for batch in reader:
                for name, place in places.items():
                    filled = pc.fill_null(batch.column(place), float("nan"))
                    chunks[name].append(as_numpy(pa.chunked_array([filled])))
                count += batch.num_rows
                if count * len(names) > MOST_VALUES:
                    raise DataError(f"{table.path}: more than {MOST_VALUES} numbers: cut the log into pieces")
                if rows is not None and count >= rows:
                    break
    except (pa.ArrowInvalid, OSError) as error:
        raise DataError(f"{table.path}: {_where(first_line(error), table)}") from None
    if len(malformed) > max(2, 0.01 * count):
        lines = f"{len(malformed)} of {count + len(malformed)} lines have another number of values than the header's"
        raise DataError(f"{table.path}: {lines} {len(table.columns)}: truncated, or not one table")
    if malformed:
        notes.append(f"{len(malformed)} lines with another number of values than {len(table.columns)}: left out")
    pa.default_memory_pool().release_unused()
    # one column after the other, so that the parts of the last one are free again
    return {name: np.concatenate([np.empty(0), *chunks.pop(name)])[:rows] for name in names}


def _source(table: Table) -> Any:
    """The file; with runs of spaces made one comma where spaces separate the values."""
    if table.delimiter != " ":
        return table.path
    lines = table.path.read_text(encoding=table.encoding, errors="replace").splitlines()
    return io.BytesIO("\n".join(" ".join(line.split()) for line in lines).encode())


def _where(text: str, table: Table) -> str:
    """Arrow's message with the column's name for its number."""
    column = re.search(r"CSV column #c?(\d+)", text)
    value, row = re.search(r"invalid value '([^']*)'", text), re.search(r"Row #(\d+)", text)
    if not column or not value or int(column[1]) >= len(table.columns):
        return text
    at = f" at line {int(row[1]) + table.skip}" if row else ""
    return f"column {table.columns[int(column[1])]!r} holds {value[1][:40]!r}{at}, a number is needed"


def numbers(table: Table) -> tuple[list[str], np.ndarray]:
    """The columns that hold numbers, and their values (k, N).

    The first DESCRIBED_COLUMNS and DESCRIBED_ROWS are looked at; of datasets of several lengths, the commonest length.
    Raises DataError where no column holds numbers.
    """
    names = list(table.columns[:DESCRIBED_COLUMNS])
    while names:
        try:
            columns = table.read(names, [], DESCRIBED_ROWS)
            break
        except DataError as error:
            words = [name for name in names if f"column {name!r} holds" in str(error)]
            if not words:
                raise
            names.remove(words[0])
    else:
        raise DataError(f"{table.path}: no column of numbers")
    ((length, _),) = Counter(map(len, columns.values())).most_common(1)
    names = [name for name in names if len(columns[name]) == length]
    return names, np.column_stack([columns[name] for name in names])


# --------------------------------------------------------------------------------------------------------- Parquet
def _open_parquet(path: Path) -> Table:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        schema = pq.read_schema(path)
    except (pa.ArrowInvalid, OSError) as error:
        raise DataError(f"{path}: Parquet, but damaged or truncated ({first_line(error)})") from None
    if METADATA_KEY in (schema.metadata or {}):
        raise DataError(f"{path}: a flight of this program needs no import, use it as it is")
    return Table(path, tuple(schema.names), format="parquet")


def _read_parquet(table: Table, names: list[str], rows: int | None) -> dict[str, np.ndarray]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {}
    for name in names:
        column = pq.read_table(table.path, columns=[name]).column(0).slice(0, rows)
        try:
            columns[name] = as_numpy(column.cast(pa.float64()).fill_null(float("nan")))
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
            raise DataError(f"{table.path}: column {name!r} holds {column.type}, a number is needed") from None
    return columns


# ------------------------------------------------------------------------------------------------------------ HDF5
def _open_hdf5(path: Path) -> Table:
    h5py = _h5py(path)
    names: list[str] = []

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiu" and item.ndim in (1, 2):
            flat = item.ndim == 1 or item.shape[0] == 1
            width = 1 if flat else min(item.shape)
            if width <= 64:
                names.extend([name] if flat else [f"{name}[{i}]" for i in range(width)])

    try:
        with h5py.File(path, "r") as file:
            file.visititems(visit)
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        raise DataError(f"{path}: an HDF5 file, but damaged or truncated ({first_line(error)})") from None
    if not names:
        raise DataError(f"{path}: an HDF5 file without one data set of numbers")
    return Table(path, tuple(names), format="hdf5")


def _read_hdf5(table: Table, names: list[str], rows: int | None) -> dict[str, np.ndarray]:
    h5py = _h5py(table.path)
    columns: dict[str, np.ndarray] = {}
    try:
        with h5py.File(table.path, "r") as file:
            for name in names:
                key, _, index = name.partition("[")
                data = file[key]
                if data.ndim == 2 and data.shape[0] < data.shape[1]:  # as MATLAB lays out its columns
                    data = data[:].T
                part = slice(None, rows)
                declared = min(len(data), rows or len(data)) * len(names)
                if declared > MOST_VALUES or 8 * declared > allowed_bytes(table.path):
                    raise DataError(f"{table.path}: {key} declares {len(data)} rows: too many to be a log, or damaged")
                columns[name] = np.ravel(data[part, int(index[:-1])] if index else data[part]).astype(float)
    except (OSError, RuntimeError, ValueError, KeyError, MemoryError) as error:
        raise DataError(f"{table.path}: damaged ({first_line(error)})") from None
    return columns


def _h5py(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise missing_package(path, "h5py", "logs") from None
    return h5py
