"""A node of a configuration: a group's option, or a value of the root, from its files to its values set.

Values are set in plain dictionaries, and what refers to others, such as ${seed}, is replaced.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from quadexp.config.override import Given
from quadexp.config.schema import SCHEMA, SCHEMAS, Config
from quadexp.config.settings import declared, plain
from quadexp.errors import UsageError
from quadexp.messages import ending_in, suggestion

_REFERENCE = re.compile(r"\$\{(\w+(?=\})|)")
_WHOLE_REFERENCE = re.compile(r"\$\{(\w+)\}")


class Node(NamedTuple):
    """A node before its values are set, or a value of the root. source: what it was composed from."""

    source: tuple[str, ...]
    content: Any
    schema: type | None
    references: tuple[str, ...]


def node_of(name: str, content: Any, options: Mapping[str, Any], source: tuple[str, ...]) -> Node:
    """A node with the defaults of its schema; UsageError where its option's file names none."""
    inner = declared(Config)[name].node if name in declared(Config) else None
    if inner is not None:
        schema: type = inner
    elif name in SCHEMAS:
        known = SCHEMAS[name]
        chosen = content.pop(SCHEMA, None) if isinstance(content, dict) else None
        group, _, kind = str(chosen).partition("/")
        if group != name or kind not in known:
            option = f"{name}={options[name]}" if name in options else name
            example = f"defaults: [/schema/{name}/{next(iter(known))}@_here_, _self_]"
            others = f" (schemas of {name}: {', '.join(known)})" if len(known) > 1 else ""
            raise UsageError(f"{option}: its file names no schema of {name}; let it begin with `{example}`{others}")
        schema = known[kind]
    else:
        return Node(source, content, None, references_in(content))
    return Node(source, _filled(schema, content, f"{name}."), schema, references_in(content))


def references_in(content: Any) -> tuple[str, ...]:
    """Names of the values of the root that some content refers to, such as ${seed}; of anything else as it stands."""
    return tuple(_REFERENCE.findall(str(content)))


def _filled(schema: type, content: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """A node's content over the defaults of its schema; UsageError where it has a key that the schema has not."""
    found = plain(schema)
    for key, value in content.items():
        if key not in found:
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
    try:
        return _substituted(content[name], content)
    except LookupError:
        from quadexp.config.hydra_files import resolved

        return resolved(content)[name]


def _substituted(content: Any, others: Mapping[str, Any]) -> Any:
    """The content with its references to numbers of the root replaced; LookupError where there are other references."""
    if isinstance(content, dict):
        return {key: _substituted(value, others) for key, value in content.items()}
    if isinstance(content, list):
        return [_substituted(value, others) for value in content]
    if not isinstance(content, str) or "${" not in content:
        return content
    whole = _WHOLE_REFERENCE.fullmatch(content)
    value = others[whole[1]] if whole else content
    if not isinstance(value, (int, float)):
        raise LookupError(content)
    return value


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
            here = [*map(str, root), "experiment"]
            everywhere = [*_keys(root), *here]
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
