"""What was found, as options of the configuration: GROUP/NAME_tuned.yaml, with where it comes from as comments.

The option extends the one that was tuned and states what differs, so that `controller=gp_mpc_tuned` is chosen,
swept and printed as any other option. An option without `_tuned` flies published settings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.config.completion import folders
from quadexp.config.compose import Composer
from quadexp.config.schema import REMEDIES, Config
from quadexp.config.settings import record
from quadexp.errors import UsageError
from quadexp.log.store import write_text

SUFFIX = "_tuned"
HEAD = "# Provenance:"
_INDENT = "#   "


def options_of(composer: Composer, given: Sequence[str], config: Config) -> dict[str, str]:
    """Group -> option of what is tuned: the controller, and every remedy around it that does something."""
    chosen = {text.partition("=")[0]: text.partition("=")[2] for text in given}
    found = {"controller": chosen.get("controller", composer.compose([]).controller.name)}
    for group in REMEDIES:
        if not getattr(config, group).idle:
            found[group] = chosen.get(group, getattr(config, group).name)
    return found


def write_presets(
    out: Path,
    composer: Composer,
    options: Mapping[str, str],
    config: Config,
    about: Mapping[str, Any],
    name: str | None = None,
) -> dict[str, Path]:
    """Write an option for every group whose settings differ from its option's; returns group=NAME -> file.

    config: the settings that were found. about: the provenance. name: of the controller's option.
    """
    names = {
        group: name if name and group == "controller" else f"{option}{SUFFIX}" for group, option in options.items()
    }
    written = {}
    for group, option in options.items():
        plain = record(getattr(composer.compose([f"{group}={option}"]), group))
        tuned = record(getattr(config, group))
        changed = _changed(plain, tuned)
        if changed or group == "controller":
            text = _text(f"{option}, tuned by `quadexp tune`", about, option, {"name": names[group], **changed})
            written[f"{group}={names[group]}"] = write_text(out / group / f"{names[group]}.yaml", text)
    return written


def check_name(option: str, name: str | None) -> None:
    """Raise UsageError where the option to write would have the name of the one that it extends."""
    if (name or f"{option}{SUFFIX}") == option:
        raise UsageError(f"--name {name}: is the option that is tuned: give another name")


def _changed(plain: Mapping[str, Any], tuned: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in tuned.items():
        if key == "name" or plain.get(key) == value:
            continue
        inner = isinstance(value, dict) and isinstance(plain.get(key), dict) and set(value) == set(plain[key])
        found[key] = _changed(plain[key], value) if inner else value
    return found


def _text(title: str, about: Mapping[str, Any], option: str, content: Mapping[str, Any]) -> str:
    lines = [f"# {title}; see docs/tuning.md. Written by that command.", HEAD]
    for key, value in about.items():
        shown = _yaml(value)
        lines += [f"{_INDENT}{key}: {shown}"] if not isinstance(value, list) else [
            f"{_INDENT}{key}:", *(f"{_INDENT}  - {_yaml(item)}" for item in value)
        ]  # fmt: skip
    lines += ["defaults:", f"  - {option}", "  - _self_", ""]
    for key, value in content.items():
        lines.append(f"{key}: {_yaml(value)}")
    return "\n".join(lines) + "\n"


def _yaml(value: Any) -> str:
    import yaml

    text = yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False).strip()
    return text.removesuffix("...").strip()


def provenance_of(option: str, extra: Path | None = None, group: str = "controller") -> dict[str, Any] | None:
    """Where the settings of an option come from; None for one that was not written by `quadexp tune`."""
    for folder in reversed(folders(extra)):
        path = folder / group / f"{option}.yaml"
        if path.is_file():
            return read_provenance(path.read_text(encoding="utf-8"))
    return None


def read_provenance(text: str) -> dict[str, Any] | None:
    """The provenance in the comments of an option's file; None where there is none."""
    import yaml

    lines = text.splitlines()
    if HEAD not in lines:
        return None
    kept = []
    for line in lines[lines.index(HEAD) + 1 :]:
        if not line.startswith(_INDENT):
            break
        kept.append(line.removeprefix(_INDENT))
    try:
        found = yaml.safe_load("\n".join(kept))
    except yaml.YAMLError:
        return None
    return found if isinstance(found, dict) else None
