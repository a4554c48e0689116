"""From overrides to typed configurations: the only module that touches Hydra.

Hydra lends its composition and its override grammar (comma lists, range, choice, glob). A full composition costs 50 ms;
here the group choices are composed once per combination, and the remaining overrides are applied by the very function
Hydra uses to a copy of the nodes they touch, which gives the same configuration in under a millisecond.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra import initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from quadexp.config.cells import Cell as Cell
from quadexp.config.cells import Cells, Grid
from quadexp.config.compose_base import Bases, Repository
from quadexp.config.plugins import import_from, plugin_folders
from quadexp.config.schema import SCHEMAS, Config, conf_folder
from quadexp.errors import UsageError
from quadexp.messages import one_line, suggestion

_INTEGER = re.compile(r"0|-?[1-9]\d{0,17}")
# Keys that hold a path.
PATHS = {
    "model", "plant.model", "trajectory.path", "collect.identified", "engine.shared", "engine.python",
    "engine.remote_python", "engine.tls_ca", "engine.tls_cert", "engine.tls_key",
}  # fmt: skip
PARSED_KEPT = 50_000  # overrides that are remembered at most


class Composer:
    """Composes configurations from conf/ and, before it, a user's own folder; use `session`."""

    def __init__(self, loader: ConfigLoaderImpl) -> None:
        self._loader = loader
        self._repository = Repository(loader.repository)
        self._bases = Bases(loader, self._repository)
        self._parsed: dict[str, Override] = {}
        self._groups: dict[str, bool] = {}
        self._integers: dict[str, Override] = {}
        self._checked: set[tuple[Any, ...]] = set()

    def compose(self, overrides: Sequence[str] = ()) -> Config:
        """The configuration of one run.

        Raises UsageError with one line: unknown key or option, value of a wrong type or out of range, value missing,
        several values for one key.
        """
        with _one_line():
            return self._compose(self._parse(overrides))

    def expand(self, overrides: Sequence[str] = (), *, check: bool = True) -> Cells:
        """Every combination of a sweep: the values on the command line, over those of the experiment's `sweep:`.

        check: compose all of them before any is returned. They are composed again when they are asked for, and a sweep
        asks for all before it flies the first, so it need not.
        """
        with _one_line():
            parsed = self._parse(overrides, sweep=True)
            cells = Cells([_product(grid) for grid in self._grids(parsed)], self._cell_config)
            for i in range(len(cells)) if check else ():
                self._cell_config(cells.overrides(i))
        return cells

    def options(self, group: str) -> list[str]:
        """Names of a group's options."""
        return [name for name in self._repository.get_group_options(group) if not name.startswith("_")]

    @functools.cached_property
    def _controllers(self) -> list[str]:
        return self.options("controller")

    def _cell_config(self, overrides: Sequence[str]) -> Config:
        with _one_line():
            config = self._compose(self._parse(overrides), shared=True)
        config.sweep = None  # a cell is one flight
        return config

    def _grids(self, parsed: list[Override]) -> Iterator[list[Override]]:
        """The parsed overrides of every grid: one, or one for each mapping under `sweep:` of the experiments."""
        experiments = [o for o in parsed if o.key_or_group == "experiment"]
        if not experiments:
            yield parsed
            return
        given = {o.key_or_group for o in parsed}
        names = experiments[-1]
        values = (
            list(names.sweep_string_iterator()) if names.is_sweep_override() else [names.get_value_element_as_str()]
        )
        rest = [o for o in parsed if o.key_or_group != "experiment"]
        for value in values:
            choice = self._parse([f"experiment={value}"])
            sweep = self._compose(choice).sweep
            for grid in sweep if isinstance(sweep, list) else [sweep or {}]:
                if not isinstance(grid, dict):
                    raise UsageError(
                        f"experiment={value}: `sweep:` must be a mapping {{key: values}}, or a list of them"
                    )
                # The mapping's order is kept: what stands first varies slowest.
                own = [f"{key}={_as_override(text)}" for key, text in grid.items() if key not in given]
                yield choice + self._parse(own, sweep=True) + rest

    def _compose(self, parsed: list[Override], *, shared: bool = False) -> Config:
        groups = [o for o in parsed if self._is_group(o)]
        key = tuple(o.input_line or "" for o in groups)
        base = self._bases.get(key, groups)
        values = [o for o in parsed if not self._is_group(o)]
        for override in values:
            if (key, override.key_or_group) not in self._checked:
                self._check_key(base.config, override)
                self._checked.add((key, override.key_or_group))
        config = base.shared(values) if shared else base.with_values(values)
        baseline = config.evaluate.baseline
        if baseline not in self._controllers:
            hint = suggestion(baseline, self._controllers)
            raise UsageError(f"evaluate.baseline={baseline}: no such controller{hint}")
        return config

    def _is_group(self, override: Override) -> bool:
        name = override.key_or_group
        if name not in self._groups:
            self._groups[name] = self._repository.group_exists(name)
        return self._groups[name]

    def _parse(self, overrides: Sequence[str], *, sweep: bool = False) -> list[Override]:
        return [self._parse_one(text, sweep) for text in overrides]

    def _parse_one(self, text: str, sweep: bool) -> Override:
        known = self._parsed.get(text)
        if known is not None:
            return known
        key, _, value = text.partition("=")
        if _INTEGER.fullmatch(value) and key in self._integers:  # the grammar costs half a millisecond a text
            return replace(self._integers[key], _value=int(value), input_line=text)
        if "=" not in text:
            raise UsageError(f"{text!r}: expected KEY=VALUE, such as trajectory.speed=8")
        override = self._read(text)
        if override.is_add() or override.is_force_add() or override.is_delete():
            raise UsageError(f"{text!r}: keys can be set (KEY=VALUE), not added or deleted")
        if override.package or override.key_or_group.split("/")[0].split(".")[0] in ("hydra", "schema", "sweep"):
            raise UsageError(f"{text!r}: not a key of this program")
        if override.is_sweep_override():
            if not sweep:
                raise UsageError(f"{text!r}: several values for one key; use `quadexp evaluate --sweep` for that")
            return override
        if self._is_group(override):
            self._check_option(override)
        if len(self._parsed) > PARSED_KEPT:
            self._parsed.clear()
        self._parsed[text] = override
        if type(override._value) is int:
            self._integers[key] = override
        return override

    def _read(self, text: str) -> Override:
        parser = OverridesParser.create(config_loader=self._loader)
        key, _, value = text.partition("=")
        literal = f"{key}={','.join(map(quoted, value.split(',')))}"
        try:
            (override,) = parser.parse_overrides([text])
        except HydraException:
            if key in PATHS:  # most letters that a path may have mean nothing to the grammar
                return parser.parse_overrides([literal])[0]
            raise UsageError(
                f"{text!r}: cannot be read as KEY=VALUE: a bracket or quote is left open,"
                " or the value has signs that need quotes (KEY=\"'VALUE'\")"
            ) from None
        values = getattr(override._value, "list", [override._value]) if "(" not in value else []
        if key in PATHS and any(isinstance(one, (int, float)) for one in values):  # 2024_01 is not the number 202401
            return parser.parse_overrides([literal])[0]
        return override

    def _check_option(self, override: Override) -> None:
        group, value = override.key_or_group, override.value()
        options = self.options(group)
        if value is None and group == "experiment":
            return
        if value not in options:
            raise UsageError(f"{group}={value}: no such {group}{suggestion(str(value), options)}")

    def _check_key(self, config: DictConfig, override: Override) -> None:
        key = override.key_or_group
        node: Any = config
        for i, part in enumerate(parts := key.split(".")):
            if not isinstance(node, DictConfig) or part not in list(node):  # `in node` denies what has no value yet
                here = [*map(str, config), "experiment"]
                everywhere = [*_keys(config), *here]
                if isinstance(node, DictConfig) and i > 0:
                    here = everywhere = [f"{'.'.join(parts[:i])}.{name}" for name in map(str, node)]
                raise UsageError(f"{key}: no such key{suggestion(key, everywhere, here)}")
            node = node._get_node(part)
            if isinstance(node, DictConfig) and node._is_missing():
                return


def quoted(value: str) -> str:
    """A value that stands for itself in Hydra's grammar: backslashes count double before a quote only."""
    escaped = re.sub(r"(\\*)'", lambda found: f"{found[1] * 2}\\'", value)
    return "'" + re.sub(r"\\+$", lambda found: found[0] * 2, escaped) + "'"


def _product(overrides: Sequence[Override]) -> Grid:
    """The values of every key, as overrides; of a key that is given twice the last counts."""
    grid: dict[str, tuple[str, ...]] = {}
    for override in overrides:
        key = override.get_key_element()
        if not override.is_sweep_override():
            grid[key] = (f"{key}={override.get_value_element_as_str()}",)
        elif override.is_discrete_sweep():
            grid[key] = tuple(f"{key}={value}" for value in override.sweep_string_iterator())
        else:
            raise UsageError(f"{override.input_line!r}: not a list of values; use commas, range, choice or glob")
    return tuple(grid.values())


def _as_override(value: Any) -> str:
    """A value of an experiment's `sweep:` as the text of an override."""
    if isinstance(value, (list, tuple)):
        return ",".join(map(str, value))
    return "null" if value is None else str(value)


def _keys(config: DictConfig, prefix: str = "") -> Iterator[str]:
    for name in map(str, config):
        node = config._get_node(name)
        if isinstance(node, DictConfig) and not node._is_missing() and not node._is_none():
            yield from _keys(node, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"


@contextlib.contextmanager
def _one_line() -> Iterator[None]:
    try:
        yield
    except UsageError:
        raise
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise UsageError(one_line(error)) from error


def _register() -> None:
    store = ConfigStore.instance()
    store.store(group="schema", name="config", package="_global_", node=Config)
    for group, schemas in SCHEMAS.items():
        for name, node in schemas.items():
            store.store(group=f"schema/{group}", name=name, node=node)


@contextlib.contextmanager
def session(extra: Path | None = None) -> Iterator[Composer]:
    """A Composer over conf/, installed plugins and, if given, a user's own folder of the same layout.

    The user's folder goes before all others; modules in it can be named under `_target_`.
    """
    if extra is not None and not extra.is_dir():
        raise UsageError(f"--conf {extra}: no such folder")
    folders = [*plugin_folders().items(), *([("user", extra.resolve())] if extra is not None else [])]
    if extra is not None:
        import_from(extra.resolve())
    _register()
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(conf_folder()), job_name="quadexp", version_base="1.3"):
        loader, hydra = GlobalHydra.instance().config_loader(), GlobalHydra.instance().hydra
        assert isinstance(loader, ConfigLoaderImpl) and hydra is not None
        if folders:
            path = loader.get_search_path()
            for provider, folder in folders:
                path.prepend(provider, f"file://{folder}", anchor=SearchPathQuery(provider="schema"))
            loader = ConfigLoaderImpl(config_search_path=path)
            hydra.config_loader = loader
        yield Composer(loader)


def compose(overrides: Sequence[str] = (), extra: Path | None = None) -> Config:
    """One configuration; see Composer.compose."""
    with session(extra) as composer:
        return composer.compose(overrides)


def expand(overrides: Sequence[str] = (), extra: Path | None = None) -> Cells:
    """All configurations of a sweep; see Composer.expand."""
    with session(extra) as composer:
        return composer.expand(overrides)
