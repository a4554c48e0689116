"""The cells of a sweep, made when they are asked for: a million cells take no more memory than ten."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, overload

from quadexp.config.schema import REMEDIES, WORLD, Config

# Varied keys that the result table has a column for; the plant's column names the world around it too, but not a sensor
# that is only an accelerometer.
COLUMN_KEYS = {
    "vehicle", "plant", "world", "trajectory", "controller", "trajectory.speed", "model", "seed", "experiment",
    *(group for group in WORLD if group != "sensor"), "remedies", *REMEDIES,
}  # fmt: skip

Grid = tuple[tuple[str, ...], ...]  # for every key its overrides; the cells are their product, the last varies fastest


@dataclass(frozen=True, slots=True)
class Cell:
    """One configuration of a sweep. overrides: what made it. varied: the overrides that differ within the sweep and
    that no column of the result table names by itself.

    Cells share the nodes of their configurations: read them, do not write them."""

    config: Config
    overrides: tuple[str, ...]
    varied: str = ""


class Combinations:
    """All combinations of some grids, one after the other, as overrides."""

    def __init__(self, grids: Sequence[Grid]) -> None:
        self.grids = tuple(grids)
        self._sizes = [math.prod(map(len, grid)) for grid in self.grids]

    def __len__(self) -> int:
        return sum(self._sizes)

    def overrides(self, index: int) -> tuple[str, ...]:
        """What makes the cell at `index`."""
        rest = index + len(self) if index < 0 else index
        if not 0 <= rest < len(self):
            raise IndexError(index)
        at = 0
        while rest >= self._sizes[at]:
            rest -= self._sizes[at]
            at += 1
        chosen = []
        for texts in reversed(self.grids[at]):
            rest, value = divmod(rest, len(texts))
            chosen.append(texts[value])
        return tuple(reversed(chosen))


class Cells(Combinations, Sequence[Cell]):
    """All combinations of some grids, composed when they are asked for.

    compose: from the overrides of a cell to its configuration.
    """

    def __init__(self, grids: Sequence[Grid], compose: Callable[[Sequence[str]], Config]) -> None:
        super().__init__(grids)
        self._compose = compose
        values: dict[str, set[str]] = {}
        for text in (text for grid in self.grids for texts in grid for text in texts):
            values.setdefault(_key(text), set()).add(text)
        self._varied = {key for key, texts in values.items() if len(texts) > 1 and key not in COLUMN_KEYS}

    @overload
    def __getitem__(self, index: int) -> Cell: ...
    @overload
    def __getitem__(self, index: slice) -> list[Cell]: ...
    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        overrides = self.overrides(index)
        varied = [text for text in overrides if _key(text) in self._varied]
        return Cell(self._compose(overrides), overrides, " ".join(varied))


def _key(override: str) -> str:
    return override.partition("=")[0]
