"""Completion of overrides on the command line, from conf/ and the schemas alone: Hydra is not imported.

The schemas are imported when a completion is asked for, because `quadexp --help` loads this module too.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import typer


def groups(extra: Path | None = None) -> dict[str, list[str]]:
    """Configuration groups and their options: a listing of the folders."""
    from quadexp.config.plugins import plugin_folders
    from quadexp.config.schema import conf_folder

    found: dict[str, set[str]] = {}
    for root in (conf_folder(), *plugin_folders().values(), extra):
        for folder in sorted(root.iterdir()) if root and root.is_dir() else ():
            if folder.is_dir():
                found.setdefault(folder.name, set()).update(path.stem for path in folder.glob("*.yaml"))
    return {group: sorted(options) for group, options in found.items() if options}


def keys() -> dict[str, list[str]]:
    """Every key that can be set, of whatever option, with its values where those are a few words."""
    from quadexp.config.schema import SCHEMAS, Config, EvaluateConfig, GPFeatures

    nodes: list[tuple[str, Any]] = [(f"{group}.", node) for group, made in SCHEMAS.items() for node in made.values()]
    nodes += [("evaluate.", EvaluateConfig), ("gp.features.", GPFeatures), ("", Config)]
    aside = {"kind", "evaluate", "features", "rls", "rotor", "sweep", "options", "_target_", *SCHEMAS}
    found = {}
    for prefix, node in nodes:
        for f in fields(node):
            if f.name not in aside:
                words = list(f.metadata.get("choices", ()))
                found[prefix + f.name] = words or (["true", "false"] if f.type == "bool" else [])
    return dict(sorted(found.items()))


def complete(ctx: typer.Context, incomplete: str) -> list[str]:
    """Candidates for the override being typed. Shells that split words at "=" want the value alone back."""
    words = list(ctx.params.get("overrides") or [])
    extra = ctx.params.get("conf")
    options = groups(Path(extra) if extra else None)
    values = keys() | options
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
