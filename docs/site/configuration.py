"""The reference of every configuration key, from the parts and from conf/ itself.

    python docs/site/configuration.py

`make docs` puts it into the site; `quadexp options` shows the same on a terminal.

All of it is declared with the settings (quadexp/parts/settings.py). The value is the default, or what the option sets
that is taken by default, or else the first.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, get_args, get_origin

import yaml

from quadexp.parts.options import OptionFiles
from quadexp.parts.schema import CLASSES, PRESETS, WORLD, Config, conf_folder
from quadexp.parts.settings import REQUIRED, Declared, declared, lists

ASIDE = {"name", "sweep"}  # set by the option, not by its user
WORDS = {float: "number", int: "whole number", bool: "true, false"}
HEAD = """# Configuration reference

A configuration is one option of every group (`vehicle=torrente`, `plant=simplified`, ...), each a file in
`conf/<group>/` or an entry of an option file `conf/options/<name>.yaml`, plus single keys. Everything can be given

- on the command line: `KEY=VALUE`, such as `trajectory.speed=8` or `controller.position_weight=[20,20,20]`;
- in a file of your own: a folder laid out as `conf/`, given with `--conf DIR` ([guide](guide.md#your-own-parts));
- several at once, in a sweep: `quadexp evaluate --sweep trajectory.speed=4,8,12`.

An option names the class of its part by `_target_`, whose fields are the keys. A table shows the value that its first
option sets. `(0, 60] m/s` is above 0, up to and including 60. A key that does not exist and a value
outside its range are refused before anything runs. Quote a value with brackets or blanks for your shell. Vectors are
(x, y, z) in body axes FLU unless another frame is named.

Groups: GROUPS.
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
    groups = ", ".join(f"[{name}](#{name.lower()})" for name in ("Run", *CLASSES, "world"))
    parts = [HEAD.replace("GROUPS", groups), "## Run\n", _table(_keys(Config, "", {}))]
    for group in CLASSES:
        options = OptionFiles().parts(group)
        parts.append(f"## {group}\n\n`{group}=` {', '.join(f'`{name}`' for name in options)}\n")
        several = len(set(options.values())) > 1
        for part in dict.fromkeys(options[name] for name in sorted(options, key=lambda n: n != chosen.get(group))):
            using = [name for name, used in options.items() if used is part]
            using.sort(key=lambda name: name != chosen.get(group))
            title = f"### {group}: {', '.join(f'`{name}`' for name in using)}\n\n" if several else ""
            parts.append(f"{title}{_first_sentences(part)}\n")
            parts.append(_table(_keys(part, f"{group}.", _values(group, using[0]))))
        parts += [_preset(name) for name, target in PRESETS.items() if target == group]
    parts.append(_bundles())
    return "\n".join(parts)


def _preset(group: str) -> str:
    """A group of presets: what each of its options sets."""
    lines = [f"### {group}: presets\n", f"A choice beside `{PRESETS[group]}=` that sets several of its keys at once.\n"]
    lines += ["| option | sets | meaning |", "|---|---|---|"]
    files = OptionFiles()
    for name in files.options(group):
        values = files.option(group, name).values
        sets = ", ".join(f"`{PRESETS[group]}.{key}={value}`" for key, value in values.items()) or "nothing"
        lines.append(f"| `{group}={name}` | {sets} | {files.meaning(group, name)} |")
    return "\n".join(lines) + "\n"


def _bundles() -> str:
    """The group `world`: what each of its options chooses."""
    lines = [f"## world\n\nA choice of several parts at once: {', '.join(f'`{group}`' for group in WORLD)}; see"]
    lines += ["[worlds](worlds.md). An option of a part that is given besides counts.\n"]
    lines += ["| option | chooses | meaning |", "|---|---|---|"]
    files = OptionFiles()
    for name in files.options("world"):
        option = files.option("world", name)
        chosen = [f"`{group}={other}`" for group, other in option.chosen.items()]
        chosen += [f"`{key}={value}`" for key, value in stated(option.values) if not key.endswith(".name")]
        lines.append(f"| `world={name}` | {', '.join(chosen) or 'nothing'} | {files.meaning('world', name)} |")
    return "\n".join(lines) + "\n"


def stated(content: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key and value of all that an option sets."""
    for key, value in content.items():
        if isinstance(value, dict):
            yield from stated(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _keys(node: type, prefix: str, values: Any) -> Iterator[Key]:
    """The keys of a node and of those inside it. values: what the option's file sets."""
    for name, one in declared(node).items():
        if name in ASIDE:
            continue
        value = values.get(name, one.default)
        if one.node is not None:
            yield from _keys(one.node, f"{prefix}{name}.", values.get(name) or {})
        else:
            yield _key(f"{prefix}{name}", one, value)


def _key(name: str, one: Declared, value: Any) -> Key:
    allowed = ", ".join(f"`{word}`" for word in one.words)
    if one.setting.interval:
        allowed = f"{one.setting.interval} {one.setting.unit}".strip()
        if one.length:
            allowed = f"{one.length} numbers in {allowed}"
    value = _short(lists(value))
    shown = "" if value == REQUIRED else yaml.safe_dump(value, default_flow_style=True, width=1e6)
    return Key(name, _type(one), shown.replace("\n...", "").strip(), allowed, one.setting.meaning)


def _type(one: Declared) -> str:
    """A type in words, such as "number or null" or "list of text"."""
    kind = get_args(one.type)[0] if get_origin(one.type) is tuple else one.type
    if kind is Any or get_origin(kind) is tuple:
        words = "rows"
    else:
        words = "keys and values" if get_origin(kind) is dict else WORDS.get(kind, "text")
        words = f"list of {words}" if kind is not one.type else words
    return f"{words} or null" if one.optional else words


def _short(value: Any) -> Any:
    """Numbers to six digits, inside lists too: what a reader needs of 0.16617009357883866."""
    if isinstance(value, list):
        return [_short(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _chosen() -> dict[str, str]:
    """The option that config.yaml takes of every group."""
    defaults = yaml.safe_load((conf_folder() / "config.yaml").read_text(encoding="utf-8"))["defaults"]
    return {group: option for entry in defaults if isinstance(entry, dict) for group, option in entry.items()}


def _first_sentences(part: type) -> str:
    """What a part is, without how it is used as an object."""
    said = " ".join((part.__doc__ or "").split("\n\n")[0].split())
    return said.partition(" Raises ")[0].partition(" parameters: ")[0]


def _values(group: str, option: str) -> dict[str, Any]:
    """What an option sets, with what it inherits from others."""
    return {key: value for key, value in OptionFiles().option(group, option).values.items() if key != "_target_"}


def _table(keys: Iterator[Key]) -> str:
    lines = ["| key | type | value | allowed | meaning |", "|---|---|---|---|---|"]
    for key in keys:
        cells = [f"`{key.name}`", key.kind, f"`{key.value}`" if key.value else "", key.allowed, key.meaning]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n" if len(lines) > 2 else "It has no keys.\n"


if __name__ == "__main__":
    print(reference(), end="")
