"""Completion of overrides on the command line, from conf/ and the schemas alone: Hydra is not imported.

The schemas are imported when a completion is asked for, because `quadexp --help` loads this module too.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer


def keys(group: str | None = None) -> dict[str, list[str]]:
    """Every key that can be set, of whatever option, with its values where those are a few words. group: of one group
    alone; only the classes of its parts are imported."""
    from quadexp.parts.option_files import OptionFiles
    from quadexp.parts.schema import PARTS, Config
    from quadexp.parts.settings import declared

    files, asked = OptionFiles(), [name for name in PARTS if group in (None, name)]
    nodes: list[tuple[str, Any]] = [(f"{name}.", one) for name in asked for one in files.parts(name).values()]
    nodes.append(("", Config))
    found: dict[str, dict[str, None]] = {}
    while nodes:
        prefix, node = nodes.pop(0)
        for name, one in declared(node).items():
            if one.node is not None:
                nodes.append((f"{prefix}{name}.", one.node))
            elif name not in ("options", "_target_"):
                words = one.words or (("true", "false") if one.type is bool else ())
                found.setdefault(prefix + name, {}).update(dict.fromkeys(words))
    return {key: list(words) for key, words in sorted(found.items())}


def complete(ctx: typer.Context, incomplete: str) -> list[str]:
    """Candidates for the override being typed. Shells that split words at "=" want the value alone back."""
    from quadexp.parts.option_files import groups

    words = list(ctx.params.get("overrides") or [])
    extra = ctx.params.get("conf")
    options = groups(Path(extra) if extra else None)
    said = " ".join([*words[-2:], incomplete])
    values = keys(next((name for name in options if f"{name}." in said), "")) | options
    bare = False
    if not incomplete and words and words[-1] in values:
        key, value, bare = words[-1], "", True
    elif len(words) >= 2 and words[-1] == "=":
        key, value, bare = words[-2], incomplete, True
    elif "=" in incomplete:
        key, _, value = incomplete.partition("=")
    else:
        names = [name for name in values if name.startswith(incomplete) and ("." in incomplete or "." not in name)]
        # A single key brings its values along, so that the shell adds no blank after "=".
        exact = [f"{names[0]}={value}" for value in values[names[0]]] if len(names) == 1 else []
        return exact or [f"{name}=" for name in names]
    done, comma, last = value.rpartition(",")
    prefix = ("" if bare else f"{key}=") + done + comma
    return [prefix + option for option in values.get(key, []) if option.startswith(last)]
