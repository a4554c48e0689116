"""Wind from a file: the velocity of the air over time, linear between the rows and held outside.

    CSV      a header with the columns t, wind_x, wind_y, wind_z (s; m/s, world ENU); lines after # are ignored
    Parquet  the same columns; a flight that was logged with its wind is such a file

Other columns are ignored. Time is that of the flight, 0 at its start.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import DataError
from quadexp.parts.settings import REQUIRED, key, keyed
from quadexp.physics.expression import Expression, limited
from quadexp.world.effect import Effect, Moment

COLUMNS = ("t", "wind_x", "wind_y", "wind_z")
MAX_ROWS = 100_000  # nearly 3 h at 10 Hz


@dataclass(frozen=True, eq=False)
class WindRecord:
    """t: (k,), s, increasing. wind: (k, 3), world (m/s)."""

    t: np.ndarray
    wind: np.ndarray

    def at(self, t: Expression) -> Expression:
        """Wind (3,), world (m/s), at the time t (s), an MX expression."""
        if len(self.t) == 1:
            return ca.MX(ca.DM(self.wind[0]))
        table = ca.interpolant(
            "wind_record", "linear", [self.t.tolist()], self.wind.ravel().tolist(), {"lookup_mode": ["binary"]}
        )
        return table(limited(t, self.t[0], self.t[-1]))


@keyed
class WindFromFile(Effect):
    """A wind that was recorded.

    Raises UsageError for a missing file, DataError for one without wind.
    """

    prefix = "wind."

    path: str = key(
        REQUIRED, "CSV or Parquet file with the columns t (s), wind_x, wind_y, wind_z (m/s, world); a flight is one"
    )

    stage = "wind"
    symbols = "MX"

    @cached_property
    def record(self) -> WindRecord:
        """What the file holds."""
        return read_wind(Path(self.path))

    def wind(self, at: Moment) -> Expression:
        """That of the middle of the step."""
        return self.record.at(at.t + at.step / 2)


def read_wind(path: Path) -> WindRecord:
    """The rows of a CSV or Parquet file.

    Raises DataError, with the line or row, for a missing column, a value that is not a finite number, time that does
    not increase, no rows, or too many.
    """
    columns = _columns(path)
    missing = [name for name in COLUMNS if name not in columns]
    if missing:
        present = ", ".join(list(columns)[:20]) or "none"
        raise DataError(f"{path}: no column {', '.join(missing)} (found {present}; needed {', '.join(COLUMNS)})")
    values = [columns[name] for name in COLUMNS]
    rows = len(values[0])
    if not 1 <= rows <= MAX_ROWS:
        raise DataError(f"{path}: {rows} rows, 1 to {MAX_ROWS} are allowed")
    for name, value in zip(COLUMNS, values, strict=True):
        bad = np.flatnonzero(~np.isfinite(value))
        if len(bad):
            raise DataError(f"{path}: column {name!r} holds {value[bad[0]]} in row {bad[0]}, not a finite number")
    for row, (before, now) in enumerate(pairwise(values[0]), 1):
        if now <= before:
            raise DataError(f"{path}: t = {now:g} s in row {row} is not after {before:g} s, time must increase")
    return WindRecord(values[0], np.column_stack(values[1:]))


def _columns(path: Path) -> dict[str, np.ndarray]:
    """The columns of COLUMNS that a file has."""
    import pandas as pd
    import pyarrow as pa

    parquet = path.suffix.lower() == ".parquet"
    try:
        if parquet:
            table = pd.read_parquet(path)
        else:
            table = pd.read_csv(path, comment="#", skipinitialspace=True, encoding="utf-8-sig")
        table.columns = [str(name).strip() for name in table.columns]
        return {name: table[name].to_numpy(dtype=float) for name in table.columns if name in COLUMNS}
    except (OSError, ValueError, TypeError, pa.ArrowException) as error:
        kind = "Parquet" if parquet else "CSV"
        raise DataError(f"{path}: not a readable {kind} file with numbers ({str(error).splitlines()[0]})") from None
