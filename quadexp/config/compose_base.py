"""What a choice of groups composes to, and the typed configurations that value overrides make of it.

A full composition costs 50 ms. It is done once; where an option says nothing outside its own node, that node alone is
composed and put in place. The remaining overrides are applied, by the very function Hydra uses, to a copy of the nodes
they touch. The cells of a sweep differ in few nodes: there a node is made once for every set of overrides that touches
it, and shared.
"""

from __future__ import annotations

import contextlib
import copy
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository
from hydra._internal.defaults_list import create_defaults_list
from hydra.core.default_element import GroupDefault
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from quadexp.config.schema import PRESETS, SCHEMAS, Config
from quadexp.errors import UsageError

NODES_KEPT = 20_000  # made nodes that a sweep keeps at most


class Repository(CachingConfigRepository):
    """Reads every configuration file once, and hands out copies, because composing merges in place."""

    def load_config(self, config_path: str) -> ConfigResult | None:
        """UsageError where the file is no YAML."""
        try:
            return copy.deepcopy(super().load_config(config_path))
        except (YAMLError, UnicodeDecodeError) as error:
            source = next(source for source in self.get_sources() if source.is_config(config_path))
            folder = source.path.removeprefix("file://")
            mark = getattr(error, "problem_mark", None)
            place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
            reason = getattr(error, "problem", None) or str(error).splitlines()[0]
            raise UsageError(f"{folder}/{config_path}.yaml{place}: not valid YAML: {reason}") from None


class Bases:
    """Composed configurations by choice of groups."""

    def __init__(self, loader: ConfigLoaderImpl, repository: Repository) -> None:
        self._loader, self._repository = loader, repository
        self._known: dict[tuple[str, ...], Base] = {}
        self._nodes: dict[str, DictConfig] = {}
        self._root_values: dict[tuple[Any, ...], Any] = {}

    def get(self, key: tuple[str, ...], groups: Sequence[Override]) -> Base:
        """key: the text of the choices."""
        if key not in self._known:
            config = self._composed(groups)
            _refuse_untyped(config, {o.key_or_group: str(o.value()) for o in groups})
            self._known[key] = Base(config, self._root_values)
        return self._known[key]

    def _composed(self, groups: Sequence[Override]) -> DictConfig:
        experiments = [o for o in groups if o.key_or_group == "experiment"]
        options = {o.key_or_group: o for o in groups if o.key_or_group != "experiment"}
        usual = self._usual() | {name: str(o.value()) for name, o in options.items()}
        # A node that a preset writes into begins as its own option has it.
        written = {name: target for name, target in PRESETS.items() if options.keys() & {name, target}}
        presets = {name: self._alone(name, usual[name]) for name in written}
        chosen = {name for name in options if name not in PRESETS} | set(written.values())
        nodes = {name: self._alone(name, usual[name]) for name in chosen}
        settled = self._spoken_for(experiments)
        alone = [list(node) == [name] for name, node in nodes.items()]
        alone += [list(node) == [PRESETS[name]] for name, node in presets.items()]
        with _refused_by_name({name: usual[name] for name in PRESETS}, usual):
            if not options or not all(alone) or settled is None or settled & nodes.keys():
                return self._load("config", groups)
            for name, target in written.items():
                merged = OmegaConf.merge(nodes[target]._get_node(target), presets[name]._get_node(target))
                nodes[target] = OmegaConf.create({})
                nodes[target]._set_item_impl(target, merged)
        whole = self.get(tuple(o.input_line or "" for o in experiments), experiments).config
        config = _without(whole, list(nodes))
        OmegaConf.set_struct(config, False)
        for name, node in nodes.items():
            config._set_item_impl(name, copy.deepcopy(node._get_node(name)))
        OmegaConf.set_struct(config, True)
        return config

    def _usual(self) -> dict[str, str]:
        """The option of every group that config.yaml chooses."""
        loaded = self._repository.load_config("config")
        defaults = (loaded.defaults_list or []) if loaded else []
        return {d.group: str(d.value) for d in defaults if isinstance(d, GroupDefault) and d.group is not None}

    def _alone(self, group: str, option: str) -> DictConfig:
        """What an option composes to by itself."""
        name = f"{group}/{option}"
        if name not in self._nodes:
            self._nodes[name] = self._load(name, [])
        return self._nodes[name]

    def _spoken_for(self, experiments: Sequence[Override]) -> set[str] | None:
        """Nodes in which config.yaml or an experiment sets values itself; None where an experiment chooses options."""
        names = ["config", *(f"experiment/{o.value()}" for o in experiments if o.value() is not None)]
        found: set[str] = set()
        for name in names:
            loaded = self._repository.load_config(name)
            if loaded is None or (name != "config" and len(loaded.defaults_list or []) > 1):
                return None
            found |= {str(key) for key in loaded.config if key != "defaults"}
        return found

    def _load(self, name: str, groups: Sequence[Override]) -> DictConfig:
        """What Hydra's load_configuration composes, without Hydra's own settings."""
        defaults = create_defaults_list(
            self._repository, name, overrides_list=list(groups), prepend_hydra=False, skip_missing=False
        )
        config = self._loader._compose_config_from_defaults_list(defaults.defaults, self._repository)
        OmegaConf.set_struct(config, True)
        return config


class Base:
    """A composed configuration before its value overrides, with its untouched nodes made into objects only once."""

    def __init__(self, config: DictConfig, root_values: dict[tuple[Any, ...], Any]) -> None:
        self.config = config
        self._nodes = [str(name) for name in config if isinstance(config._get_node(name), DictConfig)]
        self._objects: dict[str, Any] = {}
        # Nodes that refer to others; a reference to a root value (${seed}) is resolved in a copy with the root values.
        self._referring = {name for name in self._nodes if "${" in str(OmegaConf.to_container(config[name]))}
        roots = [f"${{{name}}}" for name in map(str, config) if name not in self._nodes]
        text = str(OmegaConf.to_container(config))
        self._separable = text.count("${") == sum(text.count(root) for root in roots)
        self._shared: dict[tuple[Any, ...], Any] = {}
        self._root_values = root_values  # root values that were set, the same whatever the groups

    def with_values(self, values: Sequence[Override]) -> Config:
        """A configuration that shares nothing with any other."""
        separable = self._separable and not any("${" in (o.input_line or "") for o in values)
        touched = {first_part(o.key_or_group) for o in values} | self._referring
        kept = [name for name in self._nodes if separable and name not in touched and not self._missing(name)]
        part = _without(self.config, kept)
        ConfigLoaderImpl._apply_overrides_to_config(list(values), part)
        _refuse_missing(part)
        # to_object resolves, makes the dataclasses, and so checks the ranges.
        made = {str(name): _object(part, name) for name in part}
        return Config(**made, **{name: copy.deepcopy(self._object(name)) for name in kept})

    def shared(self, values: Sequence[Override]) -> Config:
        """The same configuration, its nodes shared with all others of the same overrides: for reading only."""
        lines = [override.input_line or "" for override in values]
        if not self._separable or any("${" in line for line in lines):
            return self.with_values(values)
        touching: dict[str, tuple[str, ...]] = {}
        whole: dict[str, int] = {}  # root values such as the seed, which Config itself checks
        for override, line in zip(values, lines, strict=True):
            name = first_part(override.key_or_group)
            touching[name] = (*touching.get(name, ()), line)
            if type(override._value) is int and name not in self._nodes and type(self.config[name]) is int:
                whole[name] = override._value
        roots = tuple(line for name, found in touching.items() if name not in self._nodes for line in found)
        keys = {
            str(name): (name, touching.get(str(name), ()), roots if name in self._referring else ())
            for name in self.config
        }
        made: dict[str, Any] = dict(whole)
        lacking = []
        for name, key in ((name, key) for name, key in keys.items() if name not in whole):
            place = self._place(name, key)
            if key in place:
                made[name] = place[key]
            else:
                lacking.append(name)
        for name, value in self._made(lacking, values).items() if lacking else ():
            place = self._place(name, keys[name])
            if len(place) > NODES_KEPT:
                place.clear()
            made[name] = place.setdefault(keys[name], value)
        return Config(**made)

    def _place(self, name: str, key: tuple[Any, ...]) -> dict[tuple[Any, ...], Any]:
        return self._root_values if key[1] and name not in self._nodes else self._shared

    def _made(self, names: Sequence[str], values: Sequence[Override]) -> dict[str, Any]:
        """Some of the nodes and root values."""
        roots = [str(name) for name in self.config if name not in self._nodes]
        needed = {*names, *(roots if self._referring.intersection(names) else ())}
        part = _without(self.config, [str(name) for name in self.config if name not in needed])
        inside = [o for o in values if first_part(o.key_or_group) in needed]
        ConfigLoaderImpl._apply_overrides_to_config(inside, part)
        _refuse_missing(part)
        return {name: _object(part, name) for name in names}

    def _missing(self, name: str) -> bool:
        return name not in self._objects and bool(OmegaConf.missing_keys(self.config[name]))

    def _object(self, name: str) -> Any:
        if name not in self._objects:
            self._objects[name] = _object(self.config, name)
        return self._objects[name]


def first_part(key: str) -> str:
    return key.partition(".")[0]


def _without(config: DictConfig, names: Sequence[str]) -> DictConfig:
    """A copy of the configuration without some of its nodes."""
    part = OmegaConf.create({})
    for name in config:
        if name not in names:
            part._set_item_impl(name, copy.deepcopy(config._get_node(name)))
    OmegaConf.set_struct(part, True)
    return part


def _refuse_missing(config: DictConfig) -> None:
    missing = sorted(OmegaConf.missing_keys(config))
    if missing:
        if len(missing) == 1:
            raise UsageError(f"{missing[0]}: has no value; give {missing[0]}=VALUE")
        raise UsageError(f"{', '.join(missing)}: have no value; give each as KEY=VALUE, or in the option's file")


@contextlib.contextmanager
def _refused_by_name(presets: Mapping[str, str], chosen: Mapping[str, str]) -> Iterator[None]:
    """UsageError in one line where a preset sets what the option that it acts on does not have."""
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        key = re.search(r"[Kk]ey '(\w+)' (?:is )?not in", str(error))
        for name, option in presets.items():
            if key and ("In '" not in str(error) or f"In '{name}/{option}'" in str(error)):
                target = PRESETS[name]
                raise UsageError(
                    f"{name}={option}: sets {target}.{key[1]}, which {target}={chosen[target]} does not have"
                ) from None
        raise


def _refuse_untyped(config: DictConfig, chosen: Mapping[str, str]) -> None:
    """UsageError where an option does not name the schema that its keys are checked against."""
    for group, schemas in SCHEMAS.items():
        kind = OmegaConf.get_type(config, group)
        if kind in schemas.values() or OmegaConf.is_missing(config, group):
            continue
        option = f"{group}={chosen[group]}" if group in chosen else group
        example = f"defaults: [/schema/{group}/{next(iter(schemas))}@_here_, _self_]"
        others = f" (schemas of {group}: {', '.join(schemas)})" if len(schemas) > 1 else ""
        raise UsageError(f"{option}: its file names no schema of {group}; let it begin with `{example}`{others}")


def _object(config: DictConfig, name: Any) -> Any:
    value = config[name]
    return OmegaConf.to_object(value) if OmegaConf.is_config(value) else value
