"""One module a format. It declares

    ABOUT                        for the list of formats
    recognises(path, head)       whether the file is its own, by its first bytes (None: a folder)
    read(path, named)            its RawLog; named: the --log-format that was asked for

and stands under its name in BRINGS, of quadexp/plugins/logs or of a package from outside.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Protocol

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.messages import suggestion
from quadexp.plugin import brought, places, shipped_places
from quadexp.plugins.logs.importers.quantities import QUANTITIES
from quadexp.plugins.logs.importers.raw import RawLog

HEAD = 4096  # bytes
# What files of other kinds begin with, or are named, and the way from there to one that is read.
OTHERS: tuple[tuple[str, bytes, tuple[str, ...], str], ...] = (
    ("Betaflight's log", b"H Product:Blackbox", (".bbl", ".bfl"), "make a table of it: `blackbox_decode LOG.BBL`"),
    ("a telemetry log of MAVLink", b"", (".tlog",),
     "`python -m pymavlink.tools.mavlogdump --format csv --types RAW_IMU LOG.tlog > imu.csv`"),
    ("MATLAB's format before 7.3", b"MATLAB 5.0", (), "save it with `save('log.mat', 'name', '-v7.3')`, which is HDF5"),
    ("an array of NumPy", b"\x93NUMPY", (".npy",), "`numpy.savetxt('log.csv', x, delimiter=',', header='t,..')`"),
    ("a pickle", b"\x80\x04", (".pkl", ".pickle"), "write it as a table: `pandas.DataFrame(..).to_csv('log.csv')`"),
    ("compressed by gzip", b"\x1f\x8b", (".gz",), "`gunzip` it first"),
    ("compressed by bzip2", b"BZh", (".bz2",), "`bunzip2` it first"),
    ("compressed by xz", b"\xfd7zXZ", (".xz",), "`unxz` it first"),
    ("compressed by Zstandard", b"\x28\xb5\x2f\xfd", (".zst",), "`unzstd` it first"),
    ("arrays of NumPy in one file", b"PK\x03\x04", (".npz",),
     "`pandas.DataFrame(dict(numpy.load('log.npz'))).to_csv('log.csv')`"),
    ("a spreadsheet", b"PK\x03\x04", (".xlsx", ".ods"), "save it as CSV"),
    ("an archive", b"PK\x03\x04", (".zip",), "`unzip` it first"),
    ("Arrow's format", b"ARROW1", (".feather", ".arrow"), "write Parquet: `pandas.read_feather(..).to_parquet(..)`"),
)  # fmt: skip


def way_of(path: Path, head: bytes) -> str:
    """Of a file that no reader takes: what it is, and the way to one that is read; "" where it is not known."""
    suffix = path.suffix.lower()
    fits = [row for row in OTHERS if row[1] and head.startswith(row[1])]
    fits = [row for row in fits if suffix in row[2]] or fits or [row for row in OTHERS if suffix in row[2]]
    return f"{fits[0][0]}: {fits[0][3]}" if fits else ""


class Reader(Protocol):
    ABOUT: str

    def recognises(self, path: Path, head: bytes | None) -> bool: ...

    def read(self, path: Path, named: str) -> RawLog: ...


@cache
def readers() -> dict[str, Reader]:
    """Every format, the most general last: to it any text is a table."""
    names = sorted(places("readers"), key=lambda name: name == "csv")
    modules = {name: brought("readers", name) for name in names}
    for name, reader in modules.items():
        lacking = [asked for asked in ("ABOUT", "recognises", "read") if not hasattr(reader, asked)]
        if lacking:
            raise UsageError(f"reader {name}: {places('readers')[name]} has no {', '.join(lacking)}")
    return modules


def read_by(kind: str, path: Path, named: str) -> RawLog:
    """The log, by the reader of a format. Raises UsageError where one from outside gives something else."""
    log = readers()[kind].read(path, named)
    if kind in shipped_places("readers"):
        return log
    said = f"reader {kind}"
    if not isinstance(log, RawLog):
        raise UsageError(f"{said}: read must return a RawLog, not {type(log).__name__}")
    for name, stream in log.streams.items():
        if name not in QUANTITIES:
            raise UsageError(f"{said}: a stream cannot be called {name!r}{suggestion(name, [*QUANTITIES])}")
        t = np.asarray(stream.t)
        if t.ndim != 1 or not len(t) or not np.isfinite(t).all() or (np.diff(t) <= 0).any():
            raise UsageError(f"{said}: {name}: its times must be finite numbers, (k,), each after the one before")
        if np.ndim(stream.values) != 2 or len(stream.values) != len(t):
            raise UsageError(f"{said}: {name}: values of shape {np.shape(stream.values)} for {len(t)} times: (k, n)")
    return log


def reader_of(path: Path) -> str:
    """The format that a file is in, by its content, not by its name.

    Raises UsageError where there is no such file, DataError where it is empty or in none of the formats.
    """
    head = None
    if not path.is_dir():
        try:
            with open(path, "rb") as file:
                head = file.read(HEAD)
        except FileNotFoundError:
            raise UsageError(f"{path}: no such file") from None
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror})") from None
        if not head:
            raise DataError(f"{path}: the file is empty")
    known = next((name for name, reader in readers().items() if reader.recognises(path, head)), None)
    if known is None and head and (way := way_of(path, head)):
        raise DataError(f"{path}: {way}")
    if known is None:
        what = "neither text nor" if head is not None else "a folder, but none of"
        raise DataError(f"{path}: {what} {', '.join(f'{name} ({r.ABOUT})' for name, r in readers().items())}")
    return known
