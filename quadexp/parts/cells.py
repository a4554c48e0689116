"""The cells of a sweep, made when they are asked for: a million cells take no more memory than ten.

A combination that contradicts itself, such as `controller=geometric controller.nodes=20`, is an invalid cell: it is
not flown, and its row of results says why. Only a request that is wrong as a whole is refused (`refuse_mistakes`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from typing import Any, overload

from quadexp.errors import ForbiddenValueError, UsageError
from quadexp.parts.schema import PRESETS, REMEDIES, WORLD, Config
from quadexp.progress import doing

# Varied keys that the result table has a column for; the plant's column names the world around it too, but not a sensor
# that is only an accelerometer.
COLUMN_KEYS = {
    "vehicle", "plant", "world", "trajectory", "controller", "trajectory.speed", "model", "seed", "experiment",
    *(group for group in WORLD if group != "sensor"), "remedies", *REMEDIES,
}  # fmt: skip

Grid = tuple[tuple[str, ...], ...]  # for every key its overrides; the cells are their product, the last varies fastest


@dataclass(frozen=True, slots=True)
class Cell:
    """One configuration of a sweep. overrides: what made it. varied: the keys that differ within the sweep and that no
    column of the result table names by itself, as overrides, also where the cell has its default. error: why the
    overrides contradict each other, None where they do not. refused: the overrides that `config` is then made without.

    Cells share the nodes of their configurations: read them, do not write them."""

    config: Config
    overrides: tuple[str, ...]
    varied: str = ""
    error: UsageError | None = None
    refused: frozenset[str] = frozenset()

    @property
    def invalid(self) -> str:
        """Why the cell is not flown, "" for one that can be."""
        return "" if self.error is None else str(self.error)


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
        values: dict[str, dict[str, None]] = {}
        for text in (text for grid in self.grids for texts in grid for text in texts):
            values.setdefault(_key(text), {})[text] = None
        choices = [{_key(texts[0]): set(texts) for texts in grid} for grid in self.grids]
        self._varied = {
            key: list(texts)
            for key, texts in values.items()
            if key not in COLUMN_KEYS and (len(texts) > 1 or _set_in_part(key, choices))
        }

    @overload
    def __getitem__(self, index: int) -> Cell: ...
    @overload
    def __getitem__(self, index: slice) -> list[Cell]: ...
    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        overrides = self.overrides(index)
        try:
            config = self._compose(overrides)
            return Cell(config, overrides, self._differing(overrides, config))
        except UsageError as error:
            kept = self._consistent(overrides)
            config, refused = self._compose(kept), frozenset(overrides).difference(kept)
            return Cell(config, overrides, self._differing(overrides, config), error, refused)

    def _differing(self, overrides: Sequence[str], config: Config) -> str:
        """The keys that vary with their values; that of a key that is not given here is what the configuration has."""
        given = {_key(text): text for text in overrides}
        texts = (given.get(key) or _default(key, config, known) for key, known in self._varied.items())
        return " ".join(text for text in texts if text)

    def sound(self) -> list[Cell]:
        """All cells; raises the UsageError of the first that is invalid."""
        cells = list(self)
        if error := next((cell.error for cell in cells if cell.error), None):
            raise error
        return cells

    def _consistent(self, overrides: Sequence[str]) -> list[str]:
        """Those overrides that do not contradict the ones before them; options come first, each with the values that it
        has none without, presets of their values next, then values."""
        kept: list[str] = []
        for text in sorted(overrides, key=lambda text: ("." in _key(text), _key(text) in PRESETS)):
            values = [value for value in overrides if value.startswith(f"{_key(text)}.")]
            for needed in ([], *([value] for value in values), values):
                try:
                    self._compose([*kept, text, *needed])
                except UsageError:
                    continue
                kept += [text, *needed]
                break
        return kept


def refuse_mistakes(cells: Iterable[Cell]) -> Iterator[Cell]:
    """The cells one after the other; at their end, UsageError where the request itself is wrong: every cell is
    invalid, no cell has a key that is given, or a value is none that its key allows."""
    errors: dict[str, UsageError] = {}  # override -> why the first cell refused it
    accepted: Counter[str] = Counter()
    first, valid = None, False
    for place, cell in enumerate(cells):
        if place % 100 == 0:
            doing(f"composing cell {place}")
        if cell.error is None:
            valid = True
        else:
            first = first or cell.error
            for text in cell.refused:
                errors.setdefault(text, cell.error)
        accepted.update(text for text in cell.overrides if text not in cell.refused)
        yield cell
    if first is not None and not valid:
        raise first
    keys = {_key(text) for text in accepted}
    for text, error in errors.items():
        if _key(text) not in keys or (isinstance(error, ForbiddenValueError) and text not in accepted):
            raise error


def _set_in_part(key: str, grids: Sequence[Mapping[str, set[str]]]) -> bool:
    """Whether some grids give a key that another one does not, whose flights the columns do not tell apart: those of
    who flies, for a key of the controller, which all its conditions share."""
    who = {"controller", "model", "remedies", *REMEDIES}
    columns = who if key.startswith("controller.") else COLUMN_KEYS - {"seed", "experiment"}
    with_key, without = ([grid for grid in grids if (key in grid) == wanted] for wanted in (True, False))
    return any(
        all(grid[column] & other[column] for column in columns & grid.keys() & other.keys())
        for grid in with_key
        for other in without
    )


def _default(key: str, config: Config, known: Iterable[str]) -> str:
    """The value of a key in a configuration as an override, spelled as one of those known; "" without such a key."""
    value: Any = config
    for part in key.split("."):
        value = getattr(value, part, None)
    if value is None or is_dataclass(value):  # a group of options: its columns say which
        return ""
    same = (text for text in known if _same(text.partition("=")[2], value))
    return next(same, f"{key}={str(value).replace(' ', '')}")


def _same(text: str, value: Any) -> bool:
    try:
        return bool(float(text) == value)
    except ValueError:
        return text.lower() == str(value).lower()


def _key(override: str) -> str:
    return override.partition("=")[0]
