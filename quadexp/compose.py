"""From overrides to typed configurations: the only module that touches Hydra.

Hydra lends its composition and its override grammar (comma lists, range, choice, glob). A full composition costs 50 ms;
here the group choices are composed once per combination, and the remaining overrides are applied by the very function
Hydra uses to a copy of the nodes they touch, which gives the same configuration in under a millisecond.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.defaults_list import create_defaults_list
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from quadexp.config import SCHEMAS, Config, conf_folder
from quadexp.errors import UsageError
from quadexp.messages import one_line, suggestion


@dataclass(frozen=True)
class Cell:
    """One configuration of a sweep. overrides: what made it. varied: the overrides that differ within the sweep and
    that no column of the result table names by itself."""

    config: Config
    overrides: tuple[str, ...]
    varied: str = ""


# Varied keys that the result table has a column for.
_COLUMN_KEYS = {"vehicle", "plant", "trajectory", "controller", "trajectory.speed", "model", "seed", "experiment"}


class Composer:
    """Composes configurations from conf/ and, before it, a user's own folder; use `session`."""

    def __init__(self, loader: ConfigLoaderImpl) -> None:
        self._loader = loader
        self._repository = _Repository(loader.repository)
        self._bases: dict[tuple[str, ...], _Base] = {}

    def compose(self, overrides: Sequence[str] = ()) -> Config:
        """The configuration of one run.

        Raises UsageError with one line: unknown key or option, value of a wrong type or out of range, value missing,
        several values for one key.
        """
        with _one_line():
            return self._compose(self._parse(overrides))

    def expand(self, overrides: Sequence[str] = ()) -> list[Cell]:
        """Every combination of a sweep: the values on the command line, over those of the experiment's `sweep:`.

        All are composed and checked before any is returned.
        """
        with _one_line():
            parsed = self._parse(overrides, sweep=True)
            batches = [BasicSweeper.split_arguments(grid, None)[0] for grid in self._grids(parsed)]
            single: dict[str, set[str]] = {}
            for override in (o for batch in batches for cell in batch for o in cell):
                single.setdefault(_key(override), set()).add(override)
            cells = [self._cell(cell, single) for batch in batches for cell in batch]
        return cells

    def options(self, group: str) -> list[str]:
        """Names of a group's options."""
        return [name for name in self._repository.get_group_options(group) if not name.startswith("_")]

    def _cell(self, overrides: list[str], values: dict[str, set[str]]) -> Cell:
        varied = [o for o in overrides if len(values[_key(o)]) > 1 and _key(o) not in _COLUMN_KEYS]
        config = self._compose(self._parse(overrides))
        config.sweep = None  # a cell is one flight
        return Cell(config, tuple(overrides), " ".join(varied))

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

    def _compose(self, parsed: list[Override]) -> Config:
        groups = [o for o in parsed if self._is_group(o)]
        key = tuple(o.input_line or "" for o in groups)
        if key not in self._bases:
            self._bases[key] = self._base(groups)
        values = [o for o in parsed if not self._is_group(o)]
        for override in values:
            self._check_key(self._bases[key].config, override)
        return self._bases[key].with_values(values)

    def _base(self, groups: list[Override]) -> _Base:
        """What Hydra's load_configuration composes, without Hydra's own settings."""
        defaults = create_defaults_list(
            self._repository, "config", overrides_list=groups, prepend_hydra=False, skip_missing=False
        )
        config = self._loader._compose_config_from_defaults_list(defaults.defaults, self._repository)
        OmegaConf.set_struct(config, True)
        return _Base(config)

    def _is_group(self, override: Override) -> bool:
        return self._repository.group_exists(override.key_or_group)

    def _parse(self, overrides: Sequence[str], *, sweep: bool = False) -> list[Override]:
        parser = OverridesParser.create(config_loader=self._loader)
        parsed = []
        for text in overrides:
            if "=" not in text:
                raise UsageError(f"{text!r}: expected KEY=VALUE, such as trajectory.speed=8")
            try:
                (override,) = parser.parse_overrides([text])
            except HydraException as error:
                hint = " (quote a value with blanks or brackets: KEY=\"'VALUE'\")"
                raise UsageError(f"{text!r}: {one_line(error)}{hint}") from None
            if override.is_add() or override.is_force_add() or override.is_delete():
                raise UsageError(f"{text!r}: keys can be set (KEY=VALUE), not added or deleted")
            if override.package or override.key_or_group.split("/")[0].split(".")[0] in ("hydra", "schema", "sweep"):
                raise UsageError(f"{text!r}: not a key of this program")
            if override.is_sweep_override() and not sweep:
                raise UsageError(f"{text!r}: several values for one key; use `quadexp evaluate --sweep` for that")
            if self._is_group(override) and not override.is_sweep_override():
                self._check_option(override)
            parsed.append(override)
        return parsed

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
                    here = everywhere = [f"{'.'.join(parts[:i])}.{name}" for name in node]
                raise UsageError(f"{key}: no such key{suggestion(key, everywhere, here)}")
            node = node._get_node(part)
            if isinstance(node, DictConfig) and node._is_missing():
                return


class _Repository(CachingConfigRepository):
    """Reads every configuration file once, and hands out copies, because composing merges in place."""

    def load_config(self, config_path: str) -> ConfigResult | None:
        return copy.deepcopy(super().load_config(config_path))


class _Base:
    """A composed configuration before its value overrides, with its untouched nodes made into objects only once."""

    def __init__(self, config: DictConfig) -> None:
        self.config = config
        self._nodes = [name for name in config if isinstance(config._get_node(name), DictConfig)]
        self._objects: dict[str, Any] = {}
        # Nodes that refer to others; a reference to a root value (${seed}) is resolved in a copy with the root values.
        self._referring = {name for name in self._nodes if "${" in str(OmegaConf.to_container(config[name]))}
        roots = [f"${{{name}}}" for name in config if name not in self._nodes]
        text = str(OmegaConf.to_container(config))
        self._separable = text.count("${") == sum(text.count(root) for root in roots)

    def with_values(self, values: list[Override]) -> Config:
        separable = self._separable and not any("${" in (o.input_line or "") for o in values)
        touched = {o.key_or_group.split(".")[0] for o in values} | self._referring
        kept = [name for name in self._nodes if separable and name not in touched and not self._missing(name)]
        part = _without(self.config, kept)
        ConfigLoaderImpl._apply_overrides_to_config(values, part)
        missing = sorted(OmegaConf.missing_keys(part))
        if missing:
            raise UsageError(f"{missing[0]}: has no value; give {missing[0]}=VALUE")
        # to_object resolves, makes the dataclasses, and so checks the ranges.
        made = {str(name): _object(part, name) for name in part}
        return Config(**made, **{name: copy.deepcopy(self._object(name)) for name in kept})

    def _missing(self, name: str) -> bool:
        return name not in self._objects and bool(OmegaConf.missing_keys(self.config[name]))

    def _object(self, name: str) -> Any:
        if name not in self._objects:
            self._objects[name] = _object(self.config, name)
        return self._objects[name]


def _without(config: DictConfig, names: Sequence[str]) -> DictConfig:
    """A copy of the configuration without some of its nodes."""
    part = OmegaConf.create({})
    for name in config:
        if name not in names:
            part._set_item_impl(name, copy.deepcopy(config._get_node(name)))
    OmegaConf.set_struct(part, True)
    return part


def _object(config: DictConfig, name: Any) -> Any:
    value = config[name]
    return OmegaConf.to_object(value) if OmegaConf.is_config(value) else value


def _key(override: str) -> str:
    return override.partition("=")[0]


def _as_override(value: Any) -> str:
    """A value of an experiment's `sweep:` as the text of an override."""
    if isinstance(value, (list, tuple)):
        return ",".join(map(str, value))
    return "null" if value is None else str(value)


def _keys(config: DictConfig, prefix: str = "") -> Iterator[str]:
    for name in config:
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
    """A Composer over conf/ and, if given, a user's own folder of the same layout, which has precedence."""
    if extra is not None and not extra.is_dir():
        raise UsageError(f"--conf {extra}: no such folder")
    _register()
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(conf_folder()), job_name="quadexp", version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        if extra is not None:
            path = loader.get_search_path()
            path.prepend("user", f"file://{extra.resolve()}", anchor=SearchPathQuery(provider="schema"))
            loader = ConfigLoaderImpl(config_search_path=path)
            GlobalHydra.instance().hydra.config_loader = loader  # type: ignore[union-attr]
        yield Composer(loader)  # type: ignore[arg-type]


def compose(overrides: Sequence[str] = (), extra: Path | None = None) -> Config:
    """One configuration; see Composer.compose."""
    with session(extra) as composer:
        return composer.compose(overrides)


def expand(overrides: Sequence[str] = (), extra: Path | None = None) -> list[Cell]:
    """All configurations of a sweep; see Composer.expand."""
    with session(extra) as composer:
        return composer.expand(overrides)
