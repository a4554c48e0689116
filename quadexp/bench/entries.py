"""Who takes part: a controller by name, with what is around it, such as "gp_mpc observer=wind"."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import yaml

from quadexp.bench.protocol import Family, Protocol
from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller, build_vehicle, build_world
from quadexp.experiment.checkpoints import find_model
from quadexp.parts.compose import Composer
from quadexp.parts.schema import PRESETS, REMEDIES, Config, remedies
from quadexp.tune.preset import BY_HAND, provenance_of

ALLOWED = ("controller", *PRESETS, "remedies", *REMEDIES)  # groups that an entry may set
SHIPPED = "as shipped"


@dataclass(frozen=True)
class Entry:
    """name: of its rows. overrides: what makes it. bound: whether it is told the plant's equations. settings:
    as shipped, tuned with so many flights, or set by hand, on which seeds. models: whether it may need a checkpoint.
    network: whether that is a network."""

    name: str
    overrides: tuple[str, ...]
    bound: bool
    settings: str
    models: bool
    network: bool


def field() -> list[str]:
    """The entries of this program, as texts."""
    return list(yaml.safe_load((files("quadexp.bench") / "field.yaml").read_text(encoding="utf-8")))


def read_entries(
    texts: Sequence[str], composer: Composer, protocol: Protocol, extra: Path | None = None
) -> list[Entry]:
    """The entries that some texts name; raises UsageError where one names no controller, or something else besides, or
    was tuned on the seeds of the protocol."""
    entries: dict[str, Entry] = {}
    for text in texts:
        entry = _entry(text, composer, protocol, extra)
        entries.setdefault(entry.name, entry)
    return list(entries.values())


def _entry(text: str, composer: Composer, protocol: Protocol, extra: Path | None) -> Entry:
    words = shlex.split(text)
    if not words:
        raise UsageError("--controller: is empty; give a controller's name")
    given = [word if "=" in word or i else f"controller={word}" for i, word in enumerate(words)]
    for word in given:
        if word.partition("=")[0].partition(".")[0] not in ALLOWED:
            raise UsageError(
                f"--controller {text!r}: {word}: may set {', '.join(ALLOWED)} only; the rest is the protocol's"
            )
    config = composer.compose(given)
    name = " ".join(word.removeprefix("controller=") for word in given)
    settings, needed = _settings(given, protocol, extra), may_need_model(config)
    return Entry(name, tuple(given), config.controller.knows_plant, settings, needed, needs_network(config))


def _settings(given: Sequence[str], protocol: Protocol, extra: Path | None) -> str:
    """Where its settings come from; raises UsageError where they were tuned on flights of the protocol.

    A bundle without provenance counts as set by hand, as keys do: no publication has its values.
    """
    last = max(int(one["seeds"]) for family in protocol.families.values() for one in family.sizes.values())
    flights, by_hand, watched = 0, False, set[int]()
    for word in given:
        group, _, option = word.partition("=")
        about = provenance_of(option, extra, group) if group in ("controller", "remedies", *REMEDIES) else None
        if about is None:
            by_hand |= group == "remedies"
            continue
        if BY_HAND in about:
            watched |= {*about["seeds"]}
            continue
        if common := {*about.get("seeds", [])} & {*protocol.seeds(last)}:
            raise UsageError(f"{word}: was tuned on seed {min(common)}, which the protocol flies: tune it on others")
        flights += int(about.get("flights", 0))
    own = [word for word in given if word.partition("=")[0].count(".")]
    parts = [f"tuned, {flights} flights"] if flights else []
    if own or by_hand or watched:
        parts.append("set by hand" + (f", seeds {min(watched)} to {max(watched)}" if watched else ""))
    return ", ".join(parts) or SHIPPED


def configs_of(
    entry: Entry, family: Family, protocol: Protocol, size: str, composer: Composer, model: Path | None
) -> list[tuple[str, str, tuple[str, ...], Config]]:
    """(task, world, overrides, configuration) of every flight of an entry in a family."""
    seeds, tasks, worlds = family.chosen(size)
    found = []
    for world in worlds:
        for task in tasks:
            for seed in protocol.seeds(seeds):
                given = (*family.given, *family.tasks[task], *family.worlds[world], *entry.overrides)
                texts = (*given, *([f"model={model}"] if model else []), f"seed={seed}")
                found.append((task, world, texts, composer.expand(texts, check=False).sound()[0].config))
    return found


def may_need_model(config: Config) -> bool:
    """Whether a controller, or what is around it, may read a checkpoint."""
    none = getattr(config.controller, "residual", "none") in ("none", "plant", "blade_element")
    return not none or bool(remedies(config))


def needs_network(config: Config) -> bool:
    """Whether its controller flies with a network."""
    return getattr(config.controller, "residual", "none") == "neural"


def why_not(config: Config) -> str:
    """Why a controller cannot be built for a family, in one line; "" where it can."""
    vehicle = build_vehicle(config.vehicle)
    try:
        build_controller(config, vehicle, build_world(config, vehicle), find_model(config))
    except UsageError as error:
        return str(error)
    return ""
