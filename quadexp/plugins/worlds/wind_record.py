"""Wind from a file: the velocity of the air over time, linear between the rows and held outside.

    CSV      a header with the columns t, wind_x, wind_y, wind_z (s; m/s, world ENU); lines after # are ignored
    Parquet  the same columns; a flight that was logged with its wind is such a file

Other columns are ignored. Time is that of the flight, 0 at its start.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import DataError
from quadexp.parts.settings import REQUIRED, key, keyed
from quadexp.physics.expression import Expression, limited
from quadexp.world.effect import Effect, Moment

if TYPE_CHECKING:
    import pandas as pd

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
    table = _table(path)
    missing = [name for name in COLUMNS if name not in table]
    if missing:
        present = ", ".join(table.columns) or "none"
        raise DataError(f"{path}: no column {', '.join(missing)} (found {present}; needed {', '.join(COLUMNS)})")
    values = table[[*COLUMNS]].to_numpy()
    if not 1 <= len(values) <= MAX_ROWS:
        raise DataError(f"{path}: {len(values)} rows, 1 to {MAX_ROWS} are allowed")
    for row, column in np.argwhere(~np.isfinite(values)):
        found = values[row, column]
        raise DataError(f"{path}: column {COLUMNS[column]!r} holds {found} in row {row}, not a finite number")
    t = values[:, 0]
    for row in np.flatnonzero(np.diff(t) <= 0) + 1:
        raise DataError(f"{path}: t = {t[row]:g} s in row {row} is not after {t[row - 1]:g} s, time must increase")
    return WindRecord(t, values[:, 1:])


def _table(path: Path) -> pd.DataFrame:
    """Those of COLUMNS that a file has."""
    import pandas as pd
    import pyarrow as pa

    parquet = path.suffix.lower() == ".parquet"
    try:
        if parquet:
            table = pd.read_parquet(path)
        else:
            table = pd.read_csv(path, comment="#", skipinitialspace=True, encoding="utf-8-sig")
        return table.rename(columns=str.strip).filter(items=COLUMNS).astype(float)
    except (OSError, ValueError, TypeError, pa.ArrowException) as error:
        kind = "Parquet" if parquet else "CSV"
        raise DataError(f"{path}: not a readable {kind} file with numbers ({str(error).splitlines()[0]})") from None
