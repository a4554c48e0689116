"""From overrides to a configuration.

A choice of options is put together once (tree.py). Values are then set in plain dictionaries, and a node is made, and
so checked, once for every set of values. Configurations share their nodes: these cannot be changed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.files.names import is_name
from quadexp.messages import one_line, suggestion
from quadexp.parts.cells import Cell as Cell
from quadexp.parts.cells import Cells, Grid, refuse_mistakes
from quadexp.parts.option_files import OptionFiles
from quadexp.parts.override import GROUPS, Given, OverrideReader
from quadexp.parts.plugins import import_from
from quadexp.parts.schema import WORLD, Config, world_name
from quadexp.parts.settings import made
from quadexp.parts.tree import Node, Trees, check_key, resolved, set_values

KEPT = 50_000  # made nodes that are remembered at most
EACH = "each"  # of a grid under an experiment's `sweep:`, see _written_out


class Composer:
    """Composes configurations from conf/ and a user's own folder (extra); use `session`.

    options(group): names of its options. having, part: see OptionFiles.
    """

    def __init__(self, extra: Path | None = None) -> None:
        files = OptionFiles(extra)
        self.options, self.having, self.part = files.options, files.having, files.part_of
        self._overrides = OverrideReader(files)
        self._trees = Trees(files)
        self._made: dict[tuple[Any, ...], Any] = {}
        self._checked: set[tuple[Any, ...]] = set()

    def compose(self, overrides: Sequence[str] = ()) -> Config:
        """The configuration of one run.

        Raises UsageError with one line: unknown key or option, value of a wrong type or out of range, value missing,
        several values for one key.
        """
        with _one_line():
            return self._compose(self._overrides.read(overrides))

    def expand(self, overrides: Sequence[str] = (), *, check: bool = True) -> Cells:
        """Every combination of a sweep: the values on the command line, over those of the experiment's `sweep:`.

        check: compose all of them before any is returned, see `refuse_mistakes`. They are composed again when they are
        asked for, and a sweep asks for all before it flies the first, so it need not.
        """
        with _one_line():
            parsed = self._overrides.read(overrides, sweep=True)
            cells = Cells([_product(grid) for grid in self._grids(parsed)], self._cell_config)
            for _ in refuse_mistakes(cells) if check else ():
                pass
        return cells

    def _cell_config(self, overrides: Sequence[str]) -> Config:
        with _one_line():
            config = self._compose(self._overrides.read(overrides))
        return config if config.sweep is None else replace(config, sweep=None)  # a cell is one flight

    def _grids(self, parsed: list[Given]) -> Iterator[list[Given]]:
        """The overrides of every grid: one, or one for each mapping under `sweep:` of the experiments."""
        experiments = [one for one in parsed if one.key == "experiment"]
        if not experiments:
            yield parsed
            return
        given = {one.key for one in parsed}
        chosen = experiments[-1]
        values = [chosen.text.partition("=")[2]] if chosen.sweep is None else chosen.sweep
        rest = [one for one in parsed if one.key != "experiment"]
        for value in values:
            choice = self._overrides.read([f"experiment={value}"])
            sweep = self._compose(choice).sweep
            for grid in _written_out(sweep or {}, str(value)):
                # The mapping's order is kept: what stands first varies slowest.
                own = [f"{key}={_as_override(text)}" for key, text in grid.items() if key not in given]
                yield choice + self._overrides.read(own, sweep=True) + rest

    def _compose(self, parsed: Sequence[Given]) -> Config:
        chosen = [one for one in parsed if one.key in GROUPS]
        values = [one for one in parsed if one.key not in GROUPS]
        base = self._trees.tree(chosen)
        key = tuple(one.text for one in chosen)
        for one in values:
            if (key, one.key) not in self._checked:
                check_key({name: node.content for name, node in base.items()}, one.key, self.having)
                self._checked.add((key, one.key))
            if one.key in base and base[one.key].schema is not None and not isinstance(one.value, Mapping):
                first = next(iter(base[one.key].content))
                raise UsageError(f"{one.text}: holds keys; set one of them, such as {one.key}.{first}=...")
        config = Config(**self._nodes(base, values))
        config = replace(config, world=self._world_name(config, chosen, values))
        if not is_name(config.world):
            raise UsageError(f"world={config.world!r}: its name must be one printable line")
        baseline, controllers = config.evaluate.baseline, self.options("controller")
        if baseline not in controllers:
            raise UsageError(f"evaluate.baseline={baseline}: no such controller{suggestion(baseline, controllers)}")
        return config

    def _world_name(self, config: Config, chosen: Sequence[Given], values: Sequence[Given]) -> str:
        bundles = [one for one in chosen if one.key == "world"]
        bundle = str(bundles[-1].value) if bundles else "clean"
        if not {one.node for one in values}.union(one.key for one in chosen).intersection((*WORLD, "experiment")):
            return world_name(config, bundle, {group: getattr(config, group) for group in WORLD})  # nothing differs
        base = self._trees.tree(bundles[-1:])
        return world_name(config, bundle, self._nodes({group: base[group] for group in WORLD}, ()))

    def _nodes(self, base: Mapping[str, Node], values: Sequence[Given]) -> dict[str, Any]:
        """The nodes with their values set, and the values of the root."""
        of_node: dict[str, list[Given]] = {}
        for one in values:
            of_node.setdefault(one.node, []).append(one)

        def content(name: str) -> Any:
            return set_values(base[name].content, name, of_node.get(name, ()))

        if len(self._made) > KEPT:
            self._made.clear()
        nodes: dict[str, Any] = {}
        known: dict[str, Any] = {}
        for name, node in base.items():
            key = (name, node.source, *(one.text for one in of_node.get(name, ())))
            if key not in self._made:
                plain = content(name)
                refers = "${" in str(plain)
                plain = resolved(plain, name, content, known) if refers else plain
                nodes[name] = plain if node.schema is None else made(node.schema, plain, f"{name}.")
                if refers:  # what it is hangs on other nodes too
                    continue
                self._made[key] = nodes[name]
            nodes[name] = self._made[key]
        return nodes


def _written_out(grids: Any, experiment: str) -> Iterator[dict[str, Any]]:
    """The grids of an experiment's `sweep:`, a mapping or a list of them; one with a list under `each` stands for as
    many: what else it has, with each of these, which may have such lists themselves."""
    for grid in grids if isinstance(grids, list) else [grids]:
        if not isinstance(grid, dict):
            raise UsageError(f"experiment={experiment}: `sweep:` must be a mapping {{key: values}}, or a list of them")
        common = {key: values for key, values in grid.items() if key != EACH}
        within = _written_out(grid[EACH], experiment) if EACH in grid else [{}]
        yield from (common | inner for inner in within)


def _product(overrides: Sequence[Given]) -> Grid:
    """The values of every key, as overrides; of a key that is given twice the last counts."""
    grid: dict[str, tuple[str, ...]] = {}
    for one in overrides:
        if one.sweep is None:
            grid[one.key] = (one.text,)
        else:
            grid[one.key] = tuple(f"{one.key}={value}" for value in one.sweep)
    return tuple(grid.values())


def _as_override(value: Any) -> str:
    """A value of an experiment's `sweep:` as the text of an override."""
    text = ",".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
    return "null" if value is None else text


@contextlib.contextmanager
def _one_line() -> Iterator[None]:
    try:
        yield
    except UsageError:
        raise
    except ValueError as error:
        raise UsageError(one_line(error)) from error


@contextlib.contextmanager
def session(extra: Path | None = None) -> Iterator[Composer]:
    """A Composer over conf/, installed plugins and, if given, a user's own folder of the same layout.

    Modules in the user's folder can be named under `_target_`.
    """
    if extra is not None:
        if not extra.is_dir():
            raise UsageError(f"--conf {extra}: no such folder")
        import_from(extra.resolve())
    yield Composer(extra.resolve() if extra is not None else None)


def compose(overrides: Sequence[str] = (), extra: Path | None = None) -> Config:
    """One configuration; see Composer.compose."""
    with session(extra) as composer:
        return composer.compose(overrides)


def expand(overrides: Sequence[str] = (), extra: Path | None = None) -> Cells:
    """All configurations of a sweep; see Composer.expand."""
    with session(extra) as composer:
        return composer.expand(overrides)
