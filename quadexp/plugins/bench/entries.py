"""Who takes part: a controller by name, with what is around it, such as "gp_mpc observer=wind"."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any

import yaml

from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller, build_vehicle, build_world
from quadexp.experiment.collect import collect_dataset
from quadexp.experiment.fit import fit_checkpoint
from quadexp.experiment.identity import MODEL_FILE, digest, find_model, identity_with, part_identity
from quadexp.log.store import read_text
from quadexp.names import SPELLINGS
from quadexp.parts.compose import Composer
from quadexp.parts.options import Folders, OptionFiles
from quadexp.parts.schema import REMEDIES, Config, remedies
from quadexp.plugins.bench.protocol import RULES, Family, Protocol
from quadexp.plugins.tune.preset import BY_HAND, provenance_of
from quadexp.writer import write_text

SHIPPED = "as shipped"


@dataclass(frozen=True)
class Entry:
    """name: of its rows. overrides: what makes it. bound: whether it is given the plant's equations. settings:
    as shipped, tuned with so many flights, or set by hand, on which seeds. model: the protocol's rule for the
    checkpoint that it may read, "fit" or "network", or a user's own kind; "" where it reads none."""

    name: str
    overrides: tuple[str, ...]
    bound: bool
    settings: str
    model: str


def field() -> list[str]:
    """The entries of this program, as texts."""
    return list(yaml.safe_load((files("quadexp.plugins.bench") / "field.yaml").read_text(encoding="utf-8")))


def read_entries(texts: Sequence[str], composer: Composer, protocol: Protocol, extra: Folders = None) -> list[Entry]:
    """The entries that some texts name; raises UsageError where one names no controller, or something else besides, or
    was tuned on the seeds of the protocol."""
    entries: dict[str, Entry] = {}
    for text in texts:
        words = shlex.split(text)
        if not words:
            raise UsageError("--controller: is empty; give a controller's name")
        overrides = [word if "=" in word or i else f"controller={word}" for i, word in enumerate(words)]
        config = composer.compose(overrides, "bench --controller")
        name = " ".join(word.removeprefix("controller=") for word in overrides)
        settings = _settings(overrides, protocol, extra)
        entries.setdefault(name, Entry(name, tuple(overrides), config.controller.knows_plant, settings, _rule(config)))
    return list(entries.values())


def _rule(config: Config) -> str:
    """Which checkpoint the controller, or what is around it, may read; see Entry."""
    residual = getattr(config.controller, "residual", "none")
    if isinstance(residual, str) and config.controller.learned:
        rules = {}
        for rule, words in RULES.items():
            for word in words:
                rules[SPELLINGS[word]] = rule
        return rules.get(residual, residual)
    if remedies(config) or residual not in ("none", "plant", "blade_element"):
        return "fit"
    return ""


def _settings(overrides: Sequence[str], protocol: Protocol, extra: Folders) -> str:
    """Where its settings come from; raises UsageError where they were tuned on flights of the protocol.

    A bundle without provenance, and an option of a user's, count as set by hand, as keys do: no publication has their
    values.
    """
    last = max(family.chosen(size)[0] for family in protocol.families.values() for size in family.sizes)
    known = OptionFiles(extra)
    flights = 0
    by_hand = any(word.partition("=")[0].count(".") for word in overrides)
    watched = set[int]()
    for word in overrides:
        group, _, option = word.partition("=")
        about = provenance_of(option, extra, group) if group in ("controller", "remedies", *REMEDIES) else None
        if about is None:
            definitions = known.definitions.get(f"{group}/{option}", [])
            is_own = bool(definitions) and definitions[0].place < len(known.folders) - 1
            by_hand |= group == "remedies" or is_own
        elif BY_HAND in about:
            watched |= {*about["seeds"]}
        else:
            common = {*about.get("seeds", [])} & {*protocol.seeds(last)}
            if common:
                raise UsageError(
                    f"{word}: was tuned on seed {min(common)}, which the protocol flies: tune it on others"
                )
            flights += int(about.get("flights", 0))
    parts = [f"tuned, {flights} flights"] if flights else []
    if by_hand or watched:
        parts.append("set by hand" + (f", seeds {min(watched)} to {max(watched)}" if watched else ""))
    return ", ".join(parts) or SHIPPED


def configs_of(
    entry: Entry, family: Family, protocol: Protocol, size: str, composer: Composer, model: Path | None
) -> list[tuple[str, str, tuple[str, ...], Config]]:
    """(task, world, overrides, configuration) of every flight of an entry in a family."""
    seeds, tasks, worlds = family.chosen(size)
    flights = []
    for world, task, seed in product(worlds, tasks, protocol.seeds(seeds)):
        overrides = (*family.given, *family.tasks[task], *family.worlds[world], *entry.overrides)
        texts = (*overrides, *([f"model={model}"] if model else []), f"seed={seed}")
        flights.append((task, world, texts, composer.expand(texts, check=False).all_valid_or_raise()[0].config))
    return flights


def why_not(config: Config) -> str:
    """Why a controller cannot be built for a family, in one line; "" where it can."""
    vehicle = build_vehicle(config.vehicle)
    try:
        build_controller(config, vehicle, build_world(config, vehicle), find_model(config))
    except UsageError as error:
        return str(error)
    return ""


# ------------------------------------------------------------------------------------------------------------- models
def make_model(
    family: Family, rule: str, composer: Composer, folder: Path, say: Callable[[str], None] = lambda text: None
) -> Path:
    """The checkpoint that a rule makes from flights in still air, in `folder`: "fit", Gaussian processes and linear
    drag, "network", or a user's own kind, which are fitted to the same rows.

    One that is there is used again if what decides it is the same: the protocol's rules, the flights, the sources.
    """
    name = family.name if rule == "fit" else f"{family.name}_{rule}"
    out = folder / name
    data = folder / f"{family.name}.parquet"
    command = family.models["collect"]
    collect = composer.compose(command)
    config, model = family.fitted(composer, rule, RULES[rule][0] if rule in RULES else rule)
    rules = {"collect": command, rule: family.models.get(rule) or part_identity("model", model)}
    decided = identity_with(collect, find_model(collect), fitted=True).digest

    def fit() -> None:
        what = {"fit": "models", "network": "a network"}.get(rule, rule)
        say(f"{family.name}: {what} of the air, from flights in still air")
        data.parent.mkdir(parents=True, exist_ok=True)
        _once(data, digest([command, family.name, decided]), lambda: collect_dataset(collect, data))
        fit_checkpoint(model, config, data, out, force=True, figures=False)

    _once(out / MODEL_FILE, digest([rules, name, decided]), fit)
    return out


def _once(path: Path, key: str, make: Callable[[], Any]) -> None:
    """Make a file, unless one is there that was made by the same key, as a mark beside it says."""
    mark = path.with_name(f".{path.name}.made")
    if path.is_file() and (read_text(mark) or "").strip() == key:
        return
    mark.unlink(missing_ok=True)
    make()
    write_text(mark, key + "\n")
