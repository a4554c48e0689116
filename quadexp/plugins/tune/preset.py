"""What was found, as an option of the configuration, with where it comes from as comments.

A controller by itself: controller/NAME_tuned.yaml extends the option that was tuned and states what differs, so that
`controller=gp_mpc_tuned` is chosen, swept and printed as any other option. A controller with remedies around it: one
bundle, remedies/NAME_REMEDY_tuned.yaml, chooses the remedies and sets what differs in them and in the controller, for
`controller=gp_mpc remedies=gp_mpc_wind_tuned`: settings that were found together are flown together. An option without
`_tuned` flies the settings that were there before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.log.store import read_text
from quadexp.messages import printable
from quadexp.names import file_name
from quadexp.parts.compose import Composer
from quadexp.parts.options import Folders, OptionFiles
from quadexp.parts.schema import REMEDIES, Config
from quadexp.parts.settings import record
from quadexp.writer import check_output, write_text

SUFFIX = "_tuned"
HEAD = "# Provenance:"
BY_HAND = "by hand"  # key of the provenance of settings that were not tuned, but chosen by flights of these seeds
_INDENT = "#   "


def options_of(words: Sequence[str], config: Config) -> dict[str, str]:
    """Group -> option of what is tuned: the controller, and every compensation around it that does something; as given,
    or as an experiment chose them."""
    chosen = {text.partition("=")[0]: text.partition("=")[2] for text in words}
    options = {"controller": chosen.get("controller", config.controller.name)}
    for group in REMEDIES:
        if not getattr(config, group).idle:
            options[group] = chosen.get(group, getattr(config, group).name)
    return options


def write_preset(
    out: Path,
    composer: Composer,
    options: Mapping[str, str],
    config: Config,
    about: Mapping[str, Any],
    name: str | None = None,
) -> tuple[str, Path]:
    """Write what was found as one option; returns what chooses it, such as "controller=gp_mpc_tuned", and its file.

    options: see options_of. config: with the settings that were found. about: the provenance. name: of the option.
    """
    controller = options["controller"]
    name = name or default_name(options)
    changed = {}
    for group, option in options.items():
        before = getattr(composer.compose([f"{group}={option}"]), group)
        changed[group] = _changed(record(before), record(getattr(config, group)))
    origin = [HEAD, *(_INDENT + line for line in _yaml(about, flow=False).splitlines())]
    title = f"{printable(controller)}, tuned by `quadexp tune`; see docs/tuning.md. Written by that command."
    if len(options) == 1:
        head = [f"# {title}", *origin]
        path = out / "controller" / f"{name}.yaml"
        content = {"defaults": [controller, "_self_"], "name": name, **changed["controller"]}
        choice = f"controller={name}"
    else:
        head = ["# @package _global_", f"# For controller={title}", *origin]
        path = out / "remedies" / f"{name}.yaml"
        around = [{f"override /{group}": options.get(group, "none")} for group in REMEDIES]
        content = {
            "defaults": [*around, "_self_"],
            **{group: settings for group, settings in changed.items() if settings},
        }
        choice = f"controller={controller} remedies={name}"
    write_text(path, "\n".join([*head, _yaml(content)]))
    return choice, path


def default_name(options: Mapping[str, str]) -> str:
    """Of the option that a tuning writes."""
    return "_".join([options["controller"], *(options[group] for group in REMEDIES if group in options)]) + SUFFIX


def check_name(options: Mapping[str, str], name: str | None) -> None:
    """Raise UsageError where the option to write has no name for a file, or the name of the one that it extends."""
    chosen = name or default_name(options)
    if file_name(chosen) != chosen:
        raise UsageError(f"--name {chosen!r}: is no name for a file: letters, digits and _.,+=@- make one")
    if chosen == options["controller"]:
        raise UsageError(f"--name {name}: is the option that is tuned: give another name")


def check_place(out: Path, composer: Composer, options: Mapping[str, str], name: str | None) -> None:
    """Raise UsageError where the name that is asked for is that of another option, or the file of the option to write
    is somebody else's, or cannot be written."""
    path = out / ("controller" if len(options) == 1 else "remedies") / f"{name or default_name(options)}.yaml"
    text = read_text(path)
    if text is None and name in composer.options(path.parent.name):
        raise UsageError(f"--name {name}: is an option already: give another name")
    if text is not None and read_provenance(text) is None:
        raise UsageError(f"{path}: was not written by `quadexp tune`: give another --name or --out")
    check_output(path, force=True)


def _changed(plain: Mapping[str, Any], tuned: Mapping[str, Any]) -> dict[str, Any]:
    changed: dict[str, Any] = {}
    for key, value in tuned.items():
        if key == "name" or plain.get(key) == value:
            continue
        inner = isinstance(value, dict) and isinstance(plain.get(key), dict) and set(value) == set(plain[key])
        changed[key] = _changed(plain[key], value) if inner else value
    return changed


def _yaml(content: Mapping[str, Any], flow: bool | None = None) -> str:
    """As YAML, a line a key. flow: False for a line an entry of a list."""
    import yaml

    return yaml.safe_dump(dict(content), default_flow_style=flow, width=10_000, sort_keys=False)


def provenance_of(option: str, extra: Folders = None, group: str = "controller") -> dict[str, Any] | None:
    """Where the settings of an option come from; None where its file does not say."""
    for first in OptionFiles(extra).definitions.get(f"{group}/{option}", ())[:1]:
        if first.entry:
            return first.entry.provenance
        return read_provenance(first.path.read_text(encoding="utf-8"))
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
        provenance = yaml.safe_load("\n".join(kept))
    except yaml.YAMLError:
        return None
    if isinstance(provenance, dict):
        return provenance
    return None
