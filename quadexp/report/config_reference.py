"""The reference of every configuration key, from the schemas and from conf/ itself.

    python -m quadexp.report.config_reference > docs/configuration.md

Type, range and unit are the schemas' own, the meaning is that of quadexp/config/meaning.py, and the value is what the
option sets that is taken by default, or else the one of the schema's own name, or the first that extends it.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from typing import Any, get_type_hints

import yaml

from quadexp.config.meaning import MEANINGS
from quadexp.config.schema import PRESETS, SCHEMAS, Config, EvaluateConfig, conf_folder

ASIDE = {"name", "kind", "sweep"}  # set by the option, not by its user
WORDS = {"float": "number", "int": "whole number", "bool": "true, false", "str": "text", "None": "null", "Any": "rows"}
HEAD = """# Configuration reference

A configuration is one option of every group (`vehicle=torrente`, `plant=simplified`, ...), each a file in
`conf/<group>/`, plus single keys. Everything can be given

- on the command line: `KEY=VALUE`, such as `trajectory.speed=8` or `controller.position_weight=[20,20,20]`;
- in a file of your own: a folder laid out as `conf/`, given with `--conf DIR` ([guide](guide.md#your-own-parts));
- several at once, in a sweep: `quadexp evaluate --sweep trajectory.speed=4,8,12`.

A group has one or more *schemas*: which keys there are and what they may be. The table of a schema shows the value
that an option sets by default. `(0, 60] m/s` is above 0, up to and including 60. A key that does not exist and a value
outside its range are refused before anything runs. Quote a value with brackets or blanks for your shell. Vectors are
(x, y, z) in body axes FLU unless another frame is named.

Groups: GROUPS.

This page is made from the schemas and from `conf/`:
`python -m quadexp.report.config_reference > docs/configuration.md`.
"""


@dataclasses.dataclass(frozen=True)
class Key:
    """One row of the reference; all fields are text."""

    name: str
    kind: str
    value: str
    allowed: str
    meaning: str


def reference() -> str:
    """The whole page, Markdown."""
    chosen = _chosen()
    groups = ", ".join(f"[{name}](#{name.lower()})" for name in ("Run", *SCHEMAS))
    parts = [HEAD.replace("GROUPS", groups), "## Run\n", _table(_root_keys())]
    for group, schemas in SCHEMAS.items():
        options = _options(group)
        listed = ", ".join(f"`{name}`" for name in options)
        parts.append(f"## {group}\n\n`{group}=` {listed}\n")
        for schema, node in schemas.items():
            title = f"### {group}: schema `{schema}`" if len(schemas) > 1 else ""
            using = [name for name, used in options.items() if used == schema]
            using.sort(key=lambda name: (name != chosen.get(group), name != schema))
            example = f" Options: {', '.join(f'`{name}`' for name in using)}." if using and len(schemas) > 1 else ""
            doc = " ".join((node.__doc__ or "").split())
            values = _values(group, using[0]) if using else {}
            parts.append("\n".join(filter(None, [title, "", f"{doc}{example}"])) + "\n")
            parts.append(_table(_keys(node, f"{group}.", values)))
        parts += [_preset(name) for name, target in PRESETS.items() if target == group]
    return "\n".join(parts)


def _preset(group: str) -> str:
    """A group of presets: what each of its options sets."""
    folder = conf_folder() / group
    lines = [f"### {group}: presets\n", f"A choice beside `{PRESETS[group]}=` that sets several of its keys at once.\n"]
    lines += ["| option | sets | meaning |", "|---|---|---|"]
    for path in sorted(folder.glob("*.yaml")):
        text = path.read_text(encoding="utf-8")
        said = [line[2:] for line in text.splitlines() if line.startswith("# ") and "@package" not in line]
        values = yaml.safe_load(text) or {}
        sets = ", ".join(f"`{PRESETS[group]}.{key}={value}`" for key, value in values.items()) or "nothing"
        lines.append(f"| `{group}={path.stem}` | {sets} | {' '.join(said)} |")
    return "\n".join(lines) + "\n"


def keys() -> list[str]:
    """Every key there is, without what options of one's own add."""
    found = [key.name for key in _root_keys()]
    for group, schemas in SCHEMAS.items():
        found += [key.name for node in schemas.values() for key in _keys(node, f"{group}.", {})]
    return sorted(set(found))


def _root_keys() -> Iterator[Key]:
    values = yaml.safe_load((conf_folder() / "config.yaml").read_text(encoding="utf-8"))
    groups = set(SCHEMAS)
    for f in dataclasses.fields(Config):
        if f.name == "evaluate":
            yield from _keys(EvaluateConfig, "evaluate.", values["evaluate"])
        elif f.name not in groups | ASIDE:
            yield _key(f, "", Config, values.get(f.name))


def _keys(node: type, prefix: str, values: Any) -> Iterator[Key]:
    """The keys of a node and of those inside it."""
    hints = get_type_hints(node)
    for f in dataclasses.fields(node):
        if f.name in ASIDE:
            continue
        inner = _node(hints[f.name])
        value = values.get(f.name) if isinstance(values, dict) else None
        if inner is not None:
            yield from _keys(inner, f"{prefix}{f.name}.", value or {})
        else:
            yield _key(f, prefix, node, value)


def _node(hint: Any) -> type | None:
    """The dataclass that a type hint names, alone or beside None."""
    parts = getattr(hint, "__args__", (hint,))
    found = [part for part in parts if isinstance(part, type) and dataclasses.is_dataclass(part)]
    return found[0] if found else None


def _key(f: Any, prefix: str, node: type, value: Any) -> Key:
    kind = _said(str(get_type_hints(node)[f.name]))
    allowed = ", ".join(f"`{word}`" for word in f.metadata.get("choices", ()))
    if f.metadata.get("interval"):
        allowed = f"{f.metadata['interval']} {f.metadata.get('unit', '')}".strip()
        if f.metadata.get("length"):
            allowed = f"{f.metadata['length']} numbers in {allowed}"
    if value is None and f.default not in (dataclasses.MISSING, "???"):
        value = f.default
    if value is None and f.default_factory is not dataclasses.MISSING:
        value = f.default_factory()
    value = _short(value)
    shown = "" if f.default == "???" and value is None else yaml.safe_dump(value, default_flow_style=True, width=1e6)
    shown = shown.replace("\n...", "").strip()
    return Key(f"{prefix}{f.name}", kind, shown, allowed, MEANINGS.get(f"{prefix}{f.name}", ""))


def _said(hint: str) -> str:
    """A type hint in words: "float | None" is "number or null", "list[float]" is "list of number"."""
    hint = re.sub(r"<class '(\w+)'>", r"\1", hint.replace("typing.", ""))
    hint = re.sub(r"dict\[.*\]", "keys and values", hint)
    hint = re.sub(r"list\[(.*)\]", r"list of \1", hint).replace(" | ", " or ")
    return re.sub(r"\w+", lambda word: WORDS.get(word[0], word[0]), hint)


def _short(value: Any) -> Any:
    """Numbers to six digits, inside lists too: what a reader needs of 0.16617009357883866."""
    if isinstance(value, list):
        return [_short(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _chosen() -> dict[str, str]:
    """The option that config.yaml takes of every group."""
    defaults = yaml.safe_load((conf_folder() / "config.yaml").read_text(encoding="utf-8"))["defaults"]
    return {group: option for entry in defaults if isinstance(entry, dict) for group, option in entry.items()}


def _options(group: str) -> dict[str, str]:
    """Options of a group, and the schema each extends in the end."""
    return {path.stem: _schema(group, path.stem) for path in sorted((conf_folder() / group).glob("*.yaml"))}


def _schema(group: str, option: str) -> str:
    schema = ""
    for default in _read(group, option).get("defaults", ()):
        if isinstance(default, str) and default.startswith(f"/schema/{group}/"):
            schema = default.removeprefix(f"/schema/{group}/").partition("@")[0]
        elif isinstance(default, str) and default != "_self_":
            schema = schema or _schema(group, default)
    return schema


def _values(group: str, option: str) -> dict[str, Any]:
    """What an option sets, with what it inherits from others."""
    values: dict[str, Any] = {}
    content = _read(group, option)
    for default in content.pop("defaults", ["_self_"]):
        if default == "_self_":
            values |= content
        elif isinstance(default, str) and not default.startswith("/"):
            values |= _values(group, default)
    return values


def _read(group: str, option: str) -> dict[str, Any]:
    return yaml.safe_load((conf_folder() / group / f"{option}.yaml").read_text(encoding="utf-8")) or {}


def _table(keys: Iterator[Key]) -> str:
    lines = ["| key | type | value | allowed | meaning |", "|---|---|---|---|---|"]
    for key in keys:
        cells = [f"`{key.name}`", key.kind, f"`{key.value}`" if key.value else "", key.allowed, key.meaning]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(reference(), end="")
