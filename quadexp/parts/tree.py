"""The tree of a configuration before its values are set: what a choice of options makes, and values set on it.

A node is what the files say of it that were chosen, one over the other: its option, presets, bundles, the experiment.
Each node of the same files is made once, so that a sweep over many choices of options costs little.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from quadexp.errors import UsageError
from quadexp.messages import ending_in, suggestion
from quadexp.parts.former import FORMER_TARGET, refuse_former
from quadexp.parts.option_files import GLOBAL, OptionFiles, merge
from quadexp.parts.override import Given
from quadexp.parts.part import TARGET, part_class
from quadexp.parts.plain_data import REFERENCE, REFERENCES
from quadexp.parts.schema import BUNDLES, CHOSEN, PARTS, PRESETS, Config
from quadexp.parts.settings import declared, plain

MOST_STEPS = 16  # from reference to reference
MOST_LETTERS = 1000  # of what a reference stands for


class Layer(NamedTuple):
    """What a file says of a node. option: GROUP=OPTION, by: what chose it, where that is a bundle."""

    option: str
    by: str
    values: Any


class Node(NamedTuple):
    """A node before its values are set, or a value of the root. source: the options that it was made from."""

    source: tuple[str, ...]
    content: Any
    schema: type | None


class Trees:
    """Makes the tree of every choice of options once."""

    def __init__(self, files: OptionFiles) -> None:
        self._files = files
        self._trees: dict[tuple[str, ...], dict[str, Node]] = {}
        self._nodes: dict[tuple[str, ...], Node] = {}

    def tree(self, chosen: Sequence[Given]) -> dict[str, Node]:
        """The whole configuration with some options chosen."""
        key = tuple(one.text for one in chosen)
        if key not in self._trees:
            layers = self._layers({one.key: one.value for one in chosen})
            for name in layers:
                if name not in _ROOT:
                    raise UsageError(f"{layers[name][0].option}: {name}: no such key{suggestion(name, list(_ROOT))}")
            self._trees[key] = {name: self._node(name, layers.get(name, [])) for name in _ROOT}
        return self._trees[key]

    def _layers(self, given: Mapping[str, Any]) -> dict[str, list[Layer]]:
        """What says something of each node, the first first. An option that is given counts over that of the
        experiment, this over those of bundles, the last first."""
        experiment = given.get("experiment")
        chosen_by: dict[str, str] = {}
        of_experiment = self._files.option("experiment", experiment).chosen if experiment else {}
        options = {**CHOSEN, **of_experiment, **given}
        for bundle in BUNDLES:
            for group, option in self._files.option(bundle, options[bundle]).chosen.items():
                if group not in given and group not in of_experiment:
                    options[group], chosen_by[group] = option, f"{bundle}={options[bundle]}"
        layers: dict[str, list[Layer]] = {}
        for group in (*CHOSEN, "experiment"):
            if options.get(group) is None:
                continue
            option = str(options[group])
            values, text = self._files.option(group, option).values, f"{group}={option}"
            if group in GLOBAL:
                for name, value in values.items():
                    layers.setdefault(name, []).append(Layer(text, text, value))
            else:
                layers.setdefault(PRESETS.get(group, group), []).append(Layer(text, chosen_by.get(group, text), values))
        return layers

    def _node(self, name: str, layers: Sequence[Layer]) -> Node:
        source = tuple(layer.option for layer in layers)
        if (name, *source) not in self._nodes:
            self._nodes[name, *source] = Node(source, *_joined(name, layers))
        return self._nodes[name, *source]


_ROOT = plain(Config)


def _joined(name: str, layers: Sequence[Layer]) -> tuple[Any, type | None]:
    """The content of a node with the defaults of its class, and that class, None for a value of the root.

    UsageError where the option's file names no class, or something sets a key that the class has not.
    """
    inner = declared(Config)[name].node if name in declared(Config) else None
    if inner is None and name not in PARTS:
        return (layers[-1].values if layers else _ROOT[name]), None
    content: dict[str, Any] = {}
    for layer in layers:
        if not isinstance(layer.values, Mapping):
            raise UsageError(f"{layer.option}: {name}: must hold keys and values")
        merge(content, layer.values)
    if inner is not None:
        return _filled(inner, content, f"{name}."), inner
    option = layers[0].option
    target = content.pop(FORMER_TARGET, None) or content.pop(TARGET, None)
    if target is None:
        raise UsageError(
            f"{option}: its file names no class; let it begin with `{TARGET}: MODULE.CLASS`, or extend another"
            f" option of {name}: `defaults: [OPTION, _self_]`"
        )
    schema = part_class(name, target)
    for layer in layers[1:]:
        for key in layer.values:
            if key not in declared(schema):
                refuse_former(f"{name}.{key}")
                raise UsageError(f"{layer.by}: sets {name}.{key}, which {option} does not have")
    content.setdefault("name", option.partition("=")[2])
    return _filled(schema, content, f"{name}."), schema


def _filled(schema: type, content: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """A node's content over the defaults of its class; UsageError where it has a key that the class has not."""
    filled = plain(schema)
    for key, value in content.items():
        if key not in filled:
            refuse_former(f"{prefix}{key}")
            raise UsageError(f"{prefix}{key}: no such key{suggestion(str(key), list(filled))}")
        inner = declared(schema)[key].node if key in declared(schema) else None
        filled[key] = _filled(inner, value, f"{prefix}{key}.") if inner and isinstance(value, Mapping) else value
    return filled


def set_values(content: Any, name: str, values: Sequence[Given]) -> Any:
    """A copy of a node's content with values set."""
    whole = {name: copy.deepcopy(content)}
    for given in values:
        *way, last = given.key.split(".")
        at = whole
        for part in way:
            at = at[part]
        merge(at, {last: given.value})
    return whole[name]


def resolved(
    value: Any, at: str, content: Callable[[str], Any], known: dict[str, Any], way: tuple[str, ...] = ()
) -> Any:
    """The value with its references, such as ${seed}, replaced.

    at: its key. content: the content of a node by name. known: what keys stand for, as far as it was asked. way: the
    keys that led here.
    """
    if isinstance(value, dict):
        return {key: resolved(item, f"{at}.{key}", content, known, way) for key, item in value.items()}
    if isinstance(value, list):
        return [resolved(item, at, content, known, way) for item in value]
    if not isinstance(value, str) or "${" not in value:
        return value

    def referred(match: re.Match[str]) -> Any:
        key = match[1]
        if key in way or len(way) > MOST_STEPS:
            raise UsageError(f"{at}: refers to what cannot be read; {REFERENCES}")
        if key not in known:
            name, *rest = key.split(".")
            if name not in _ROOT:
                raise UsageError(f"{at}: refers to a name that does not exist; {REFERENCES}")
            value = content(name)
            for part in rest:
                if not isinstance(value, dict) or part not in value:
                    raise UsageError(f"{at}: refers to a name that does not exist; {REFERENCES}")
                value = value[part]
            known[key] = resolved(value, key, content, known, (*way, key))
        if len(str(known[key])) > MOST_LETTERS:
            raise UsageError(f"{at}: refers to {key}, which is too long to be referred to")
        return known[key]

    if alone := REFERENCE.fullmatch(value):
        return referred(alone)
    if "${" in REFERENCE.sub("", value):
        raise UsageError(f"{at}: refers to what cannot be read; {REFERENCES}")
    return REFERENCE.sub(lambda match: str(referred(match)), value)


def check_key(content: Any, key: str, having: Callable[[str], dict[str, list[str]]]) -> None:
    """UsageError where the content has no such key. having: keys of options that are not chosen; see OptionFiles."""
    root, parts = content, key.split(".")
    for i, part in enumerate(parts):
        if not isinstance(content, dict) or part not in content:
            refuse_former(key)
            here = [*root, "experiment", *BUNDLES, *PRESETS]
            everywhere = [*_keys(root), *here]
            others = having(key)
            if isinstance(content, dict) and [*content] == ["name"] and key not in others:
                tried = [name for name in others if name.startswith(f"{parts[0]}.")]
                hint = f": {others[tried[0]][0]} has {tried[0]}" if tried else ""
                raise UsageError(
                    f"{key}: {parts[0]}={content['name']} has no settings{hint}; `quadexp options {parts[0]}` lists"
                    " what there is"
                )
            if isinstance(content, dict) and i > 0:
                here = everywhere = [f"{'.'.join(parts[:i])}.{name}" for name in content]
            if key in others:
                raise UsageError(f"{key}: no such key; it is a key of {' or '.join(others[key])}")
            if others and not ending_in(key, everywhere):
                options = " or ".join(f"{name} of {' or '.join(named)}" for name, named in others.items())
                raise UsageError(f"{key}: no such key; did you mean {options}?")
            raise UsageError(f"{key}: no such key{suggestion(key, everywhere, here)}")
        content = content[part]


def _keys(content: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from _keys(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"
