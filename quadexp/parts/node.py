"""A node of a configuration: a group's option, or a value of the root, from its files to its values set.

Values are set in plain dictionaries, and what refers to others, such as ${seed}, is replaced.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from quadexp.errors import UsageError
from quadexp.messages import ending_in, suggestion
from quadexp.parts.former import refuse_former
from quadexp.parts.former_options import FORMER
from quadexp.parts.override import Given
from quadexp.parts.part import TARGET, part_class
from quadexp.parts.plain_data import REFERENCE, REFERENCES
from quadexp.parts.schema import BUNDLES, PRESETS, Config
from quadexp.parts.settings import declared, plain

_REFERENCE = re.compile(r"\$\{(\w+(?=\})|)")
MOST_STEPS = 16  # from reference to reference
MOST_LETTERS = 1000  # of what a reference stands for


class Node(NamedTuple):
    """A node before its values are set, or a value of the root. source: what it was composed from."""

    source: tuple[str, ...]
    content: Any
    schema: type | None
    references: tuple[str, ...]


def node_of(name: str, content: Any, option: str, source: tuple[str, ...]) -> Node:
    """A node with the defaults of its part; UsageError where its option's file names none.

    option: that is chosen of the group, "" for what is no group.
    """
    inner = declared(Config)[name].node if name in declared(Config) else None
    if inner is not None:
        return Node(source, _filled(inner, content, f"{name}."), inner, references_in(content))
    if not option or name in BUNDLES:
        return Node(source, content, None, references_in(content))
    content = dict(content or {})
    former = content.pop(FORMER, None)
    target = former or content.pop(TARGET, None)
    if target is None:
        raise UsageError(
            f"{name}={option}: its file names no class; let it begin with `{TARGET}: MODULE.CLASS`, or extend another"
            f" option of {name}: `defaults: [OPTION, _self_]`"
        )
    schema = part_class(name, target)
    return Node(source, _filled(schema, content, f"{name}."), schema, references_in(content))


def references_in(content: Any) -> tuple[str, ...]:
    """Names of the values of the root that some content refers to, such as ${seed}; of anything else as it stands."""
    return tuple(_REFERENCE.findall(str(content)))


def _filled(schema: type, content: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """A node's content over the defaults of its schema; UsageError where it has a key that the schema has not."""
    found = plain(schema)
    for key, value in content.items():
        if key not in found:
            refuse_former(f"{prefix}{key}")
            raise UsageError(f"{prefix}{key}: no such key{suggestion(str(key), list(found))}")
        inner = declared(schema)[key].node if key in declared(schema) else None
        filled = inner is not None and isinstance(value, Mapping)
        found[key] = _filled(inner, value, f"{prefix}{key}.") if inner and filled else value
    return found


def content_of(name: str, base: Mapping[str, Node], values: Sequence[Given], others: Sequence[str]) -> Any:
    """A node's content with its values set. others: names of what it refers to."""
    content = {one: copy.deepcopy(base[one].content) for one in {name, *others}}
    for one in values:
        if one.node in content:
            _set(content, one.key.split("."), one.value)
    if not others:
        return content[name]
    return _resolved(content[name], name, content, {}, ())


def _resolved(value: Any, at: str, whole: Mapping[str, Any], known: dict[str, Any], way: tuple[str, ...]) -> Any:
    """The value with its references replaced. at: its key. whole: what they refer to. known: values by key. way: keys
    that led here."""
    if isinstance(value, dict):
        return {key: _resolved(item, f"{at}.{key}", whole, known, way) for key, item in value.items()}
    if isinstance(value, list):
        return [_resolved(item, at, whole, known, way) for item in value]
    if not isinstance(value, str) or "${" not in value:
        return value

    def named(match: re.Match[str]) -> Any:
        key = match[1]
        if key in way or len(way) > MOST_STEPS:
            raise UsageError(f"{at}: refers to what cannot be read; {REFERENCES}")
        if key not in known:
            found: Any = whole
            for part in key.split("."):
                if not isinstance(found, dict) or part not in found:
                    raise UsageError(f"{at}: refers to a name that does not exist; {REFERENCES}")
                found = found[part]
            known[key] = _resolved(found, key, whole, known, (*way, key))
        if len(str(known[key])) > MOST_LETTERS:
            raise UsageError(f"{at}: refers to {key}, which is too long to be referred to")
        return known[key]

    alone = REFERENCE.fullmatch(value)
    if alone:
        return named(alone)
    if "${" in REFERENCE.sub("", value):
        raise UsageError(f"{at}: refers to what cannot be read; {REFERENCES}")
    return REFERENCE.sub(lambda match: str(named(match)), value)


def _set(content: dict[str, Any], parts: Sequence[str], value: Any) -> None:
    for part in parts[:-1]:
        content = content[part]
    old = content.get(parts[-1])
    if isinstance(old, dict) and isinstance(value, dict):
        for key, item in value.items():
            _set(old, [str(key)], item)
    else:
        content[parts[-1]] = copy.deepcopy(value)


def check_key(content: Any, key: str, having: Callable[[str], dict[str, list[str]]]) -> None:
    """UsageError where the content has no such key. having: keys of options that are not chosen; see Composer."""
    root, parts = content, key.split(".")
    for i, part in enumerate(parts):
        if not isinstance(content, dict) or part not in content:
            refuse_former(key)
            here = [*map(str, root), "experiment", *BUNDLES, *PRESETS]
            everywhere = [*_keys(root), *here]
            if isinstance(content, dict) and [*content] == ["name"] and key not in (known := having(key)):
                of_group = [text for text in known if text.startswith(f"{parts[0]}.")]
                tried = next((f": {known[text][0]} has {text}" for text in of_group), "")
                raise UsageError(
                    f"{key}: {parts[0]}={content['name']} has no settings{tried}; `quadexp options {parts[0]}` lists"
                    " what there is"
                )
            if isinstance(content, dict) and i > 0:
                here = everywhere = [f"{'.'.join(parts[:i])}.{name}" for name in map(str, content)]
            others = {} if ending_in(key, everywhere) else having(key)
            if others:
                of = " or ".join(f"{name} of {' or '.join(options)}" for name, options in others.items())
                asked = "it is a key" if key in others else "did you mean"
                what = of.removeprefix(f"{key} ") if key in others else f"{of}?"
                raise UsageError(f"{key}: no such key; {asked} {what}")
            raise UsageError(f"{key}: no such key{suggestion(key, everywhere, here)}")
        content = content[part]


def _keys(content: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from _keys(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"
