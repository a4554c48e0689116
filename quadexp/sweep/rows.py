"""The rows of a sweep as columns: eight bytes a number, where a dictionary a row takes two kilobytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, overload

import numpy as np

from quadexp.report.tables import ROW_COLUMNS, to_columns

OPTIONAL = ("speed", "reference_residual", "outside_data")  # what not every flight has


class Rows(Sequence[dict[str, Any]]):
    """Result rows in settled places; each is a dictionary made when it is asked for.

    length: number of rows; `filled` says which of them were set.
    """

    def __init__(self, length: int) -> None:
        blank = to_columns([{}])  # what a table of an older version lacks stays so
        self._columns = {name: np.full(length, blank[name][0], blank[name].dtype) for name in ROW_COLUMNS}
        self._words: dict[str, str] = {}
        self.filled = np.zeros(length, bool)

    def __len__(self) -> int:
        return len(self.filled)

    @overload
    def __getitem__(self, index: int) -> dict[str, Any]: ...
    @overload
    def __getitem__(self, index: slice) -> list[dict[str, Any]]: ...
    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        row = {name: _plain(values[index]) for name, values in self._columns.items()}
        return row | {name: None for name in OPTIONAL if row[name] != row[name]}

    def __setitem__(self, index: int, row: Mapping[str, Any]) -> None:
        for name, values in to_columns([row]).items():
            value = values[0]
            self._columns[name][index] = self._words.setdefault(value, value) if isinstance(value, str) else value
        self.filled[index] = True

    @classmethod
    def of(cls, columns: Mapping[str, np.ndarray]) -> Rows:
        """All rows of a table of results."""
        everything = np.arange(len(columns["key"]))
        rows = cls(len(everything))
        rows.put(everything, columns, everything)
        return rows

    def column(self, name: str) -> np.ndarray:
        """One column of all rows, also of those that were not set."""
        return self._columns[name]

    def columns(self) -> dict[str, np.ndarray]:
        """The columns of the rows that were set."""
        return {name: values[self.filled] for name, values in self._columns.items()}

    def put(self, places: np.ndarray, columns: Mapping[str, np.ndarray], chosen: np.ndarray) -> None:
        """Set many rows at once: those `chosen` of other columns, at `places`."""
        for name, values in self._columns.items():
            if name in columns:
                values[places] = columns[name][chosen]
        self.filled[places] = True


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
