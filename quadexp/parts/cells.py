"""The cells of a sweep, made when they are asked for: a million cells take no more memory than ten.

A combination that contradicts itself, such as `wind=none wind.onset=2`, is an invalid cell: it is
not flown, and its row of results says why. Only a request that is wrong as a whole is refused (`iterate_validated`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, overload

from quadexp.errors import ForbiddenValueError, UsageError
from quadexp.parts.override import ITEM, Override, in_grammar
from quadexp.parts.schema import PRESETS, REMEDIES, WORLD, Config, controller_name
from quadexp.parts.settings import Settings, canonical_text, flat, read_value, record
from quadexp.progress import set_status

# Groups that make who flies, and what is flown, and the columns that name each of the two.
SCOPES: tuple[tuple[Sequence[str], Callable[[Config], tuple[Any, ...]]], ...] = (
    (("controller", "remedies", *REMEDIES), lambda c: (controller_name(c), c.model)),
    (("vehicle", "plant", "world", "trajectory", *WORLD),
     lambda c: (c.vehicle.name, c.plant.name, c.world, c.trajectory.name, getattr(c.trajectory, "speed", None))),
)  # fmt: skip
# Keys that columns name, but for a sensor that is only an accelerometer.
COLUMNS = {"model", "seed", "experiment", "trajectory.speed", *(x for groups, _ in SCOPES for x in groups)} - {"sensor"}
EACH = "each"  # of a grid under an experiment's `sweep:`, see written_out
OPTION = "option"  # GROUP.option: which option of a group was chosen, where its name does not say

Grid = tuple[tuple[str, ...], ...]  # for every key its overrides; the cells are their product, the last varies fastest


@dataclass(frozen=True, slots=True)
class Cell:
    """One configuration of a sweep. overrides: what made it. error: why they contradict each other, None where they do
    not. refused: the overrides that `config` is then made without.

    Cells share the nodes of their configurations: read them, do not write them."""

    config: Config
    overrides: tuple[str, ...]
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
            return Cell(config, overrides)
        except UsageError as error:
            kept = self._consistent(overrides)
            return Cell(self._compose(kept), overrides, error, frozenset(overrides).difference(kept))

    def all_valid_or_raise(self) -> list[Cell]:
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


def iterate_validated(cells: Iterable[Cell]) -> Iterator[Cell]:
    """The cells one after the other; at their end, UsageError where the request itself is wrong: every cell is
    invalid, no cell has a key that is given, or a value is none that its key allows."""
    errors: dict[str, UsageError] = {}  # override -> why the first cell refused it
    accepted: Counter[str] = Counter()
    first = None
    valid = False
    for place, cell in enumerate(cells):
        if place % 100 == 0:
            set_status(f"composing cell {place}")
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


def varied(cells: Sequence[Cell]) -> list[str]:
    """Of every cell the settings that tell it apart where no column of the result table does, as overrides.

    These are the keys with several values among the overrides. Where two cells with the same columns still differ in
    who flies, or in the world, `GROUP.option` says which options were chosen; where that does not tell them apart, the
    first recorded settings that do. A value is spelled as in `canonical_text`.
    """
    settings, cells = _Settings(), list(cells)  # whose parts are known by what they are in memory
    texts = dict.fromkeys(text for cell in cells for text in cell.overrides)
    values: dict[str, set[str]] = {}
    for key, _, text in (text.partition("=") for text in texts):
        if key not in COLUMNS and not key.endswith(".name"):
            values.setdefault(key, set()).add(canonical_text(read_value(text)))
    keys = [key for key, several in values.items() if len(several) > 1]
    for groups, columns in SCOPES:
        different: dict[tuple[Any, ...], Cell] = {}
        for cell in cells:
            if not cell.invalid:
                different.setdefault((columns(cell.config), settings.identity(cell, groups)), cell)
        recorded = (key for cell in different.values() for group in groups for key in settings.of(cell, group))
        for key in dict.fromkeys([*(f"{group}.{OPTION}" for group in groups), *recorded]):
            alike: dict[Any, list[Cell]] = {}
            for (named, _), cell in different.items():
                alike.setdefault((named, *(settings.value(cell, known) for known in keys)), []).append(cell)
            if all(len(several) == 1 for several in alike.values()):
                break
            if any(len({settings.value(cell, key) for cell in several}) > 1 for several in alike.values()):
                keys.append(key)
    settings_of = ([(key, settings.value(cell, key)) for key in keys] for cell in cells)
    return [" ".join(f"{key}={value}" for key, value in pairs if value is not None) for pairs in settings_of]


class _Settings:
    """The settings of cells by dotted key, as canonical texts; those of a part that cells share are made once."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, int], dict[str, str]] = {}

    def of(self, cell: Cell, group: str) -> dict[str, str]:
        """Of a group of the configuration; {} where it has no such group."""
        part = getattr(cell.config, group, None)
        if not isinstance(part, Settings):
            return {}
        if (group, id(part)) not in self._known:
            dotted = flat(record(part), f"{group}.")
            self._known[group, id(part)] = {key: canonical_text(value) for key, value in dotted.items()}
        return self._known[group, id(part)]

    def identity(self, cell: Cell, groups: Sequence[str]) -> tuple[Any, ...]:
        """What decides the parts of some groups, but for the seed that a path takes over from the flight."""
        seeds = {(f"{group}.seed", str(cell.config.seed)) for group in groups}
        parts = ((getattr(cell.config, group, None), self.of(cell, group)) for group in groups)
        return tuple((type(part), *(pair for pair in values.items() if pair not in seeds)) for part, values in parts)

    def value(self, cell: Cell, key: str) -> str | None:
        """The value of a key in a cell; None where it has none."""
        stated = dict(text.split("=", 1) for text in cell.overrides)
        group, _, name = key.partition(".")
        if name == OPTION:
            option = stated.get(group)
            return None if option == getattr(getattr(cell.config, group, None), "name", None) else option
        text = stated.get(key)
        value = None if f"{key}={text}" in cell.refused else self.of(cell, group).get(key)
        return canonical_text(read_value(text)) if value is None and text is not None else value


def _key(override: str) -> str:
    return override.partition("=")[0]


# -------------------------------------------------------------------------------------------------------------- grids
def written_out(grids: Any, experiment: str) -> Iterator[dict[str, Any]]:
    """The grids of an experiment's `sweep:`, a mapping or a list of them; one with a list under `each` stands for as
    many: what else it has, with each of these, which may have such lists themselves."""
    for grid in grids if isinstance(grids, list) else [grids]:
        if not isinstance(grid, dict):
            raise UsageError(f"experiment={experiment}: `sweep:` must be a mapping {{key: values}}, or a list of them")
        common = {key: values for key, values in grid.items() if key != EACH}
        within = written_out(grid[EACH], experiment) if EACH in grid else [{}]
        yield from (common | inner for inner in within)


def product(overrides: Sequence[Override]) -> Grid:
    """The values of every key, as overrides; of a key that is given twice the last counts."""
    grid: dict[str, tuple[str, ...]] = {}
    for override in overrides:
        key = override.key
        sweep = override.sweep
        grid[key] = (override.text,) if sweep is None else tuple(f"{key}={value}" for value in sweep)
    return tuple(grid.values())


def as_override(key: str, value: Any) -> str:
    """What an experiment's `sweep:` says of a key as an override: a text as on the command line, a list several
    values, of which a text is one value whatever its commas."""
    if isinstance(value, str):
        return f"{key}={value}"
    values = value if isinstance(value, (list, tuple)) else [value]
    texts = (item if isinstance(item, str) and ITEM.fullmatch(item) else in_grammar(key, item) for item in values)
    return f"{key}={','.join(texts)}"
