"""The protocol of the leaderboard: what is flown, how often, and by what it is ranked.

protocol.yaml says it in words of the configuration; worlds that are drawn are a seed and ranges. It holds the hash of
all values that the words and the draws stand for, so that a configuration file that makes another task of the same
words is refused, and two results of one protocol are of the same flights.

    python -m quadexp.plugins.bench.protocol      prints these hashes, for a version that is being made
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from itertools import chain
from typing import Any

import numpy as np
import yaml

from quadexp.errors import DataError, UsageError
from quadexp.experiment.identity import digest
from quadexp.messages import suggestion
from quadexp.names import SPELLINGS, distinct, sha256_of
from quadexp.parts.compose import Composer, session
from quadexp.parts.schema import WORLD, Config
from quadexp.parts.settings import plain
from quadexp.report.text import count

SHORT = 12  # hex digits of a hash


@dataclass(frozen=True)
class Family:
    """Tasks of one vehicle. given: overrides of all its flights. models: {collect: overrides} of the data, and of each
    of RULES the overrides of a checkpoint, fitted to them, that controllers may use. tasks,
    worlds: name -> overrides. sizes: name -> {seeds, tasks, worlds}."""

    name: str
    what: str
    given: tuple[str, ...]
    models: Mapping[str, Sequence[str]]
    tasks: Mapping[str, Sequence[str]]
    worlds: Mapping[str, Sequence[str]]
    sizes: Mapping[str, Mapping[str, Any]]

    def chosen(self, size: str) -> tuple[int, list[str], list[str]]:
        """Seeds, tasks and worlds of a size; no seeds where the family has no part in it."""
        part = self.sizes.get(size, {"seeds": 0, "tasks": [], "worlds": []})
        return int(part["seeds"]), list(part.get("tasks", self.tasks)), list(part.get("worlds", self.worlds))

    def values(self, composer: Composer) -> dict[str, Any]:
        """What its words mean: the value of every key of tasks, worlds and data that is not the key's default, so that
        a key that comes later changes nothing."""
        first = next(iter(self.tasks.values()))

        def stated(overrides: Sequence[str], groups: Sequence[str]) -> dict[str, Any]:
            cell, *_ = composer.expand(overrides, check=False).all_valid_or_raise()  # every option is composed once
            return {group: _stated(getattr(cell.config, group)) for group in groups}

        values = {}
        for name, overrides in self.tasks.items():
            values[f"task {name}"] = stated([*self.given, *overrides], TASK)
        for name, overrides in self.worlds.items():
            values[f"world {name}"] = stated([*self.given, *first, *overrides], WORLD)
        values["collect"] = stated(self.models["collect"], COLLECTED)
        for rule, models in RULES.items():
            values[rule] = {}
            for model in models:
                _, settings = self.fitted(composer, rule, model)
                values[rule][model] = _stated(settings)
        return values

    def fitted(self, composer: Composer, rule: str, model: str) -> tuple[Config, Any]:
        """The configuration and the model of a fit by a rule of the protocol; a model that no rule names has the
        vehicle of `fit` and its own settings."""
        texts = self.models.get(rule, self.models["fit"])
        others = SPELLINGS.keys() - {model}
        of_family = [text for text in texts if re.split("[.=]", text)[0] not in others]
        return composer.fitted(model, of_family, None)


def _stated(part: Any) -> dict[str, Any]:
    """The class of a part, and its settings that are not the class's defaults, without its name."""
    usual = {**plain(type(part)), "name": part.name}
    stated = {}
    for key, value in part.recorded().items():
        if usual.get(key) != value:
            stated[key] = value
    name = type(part).__name__
    return {"kind": FROZEN_AS.get(name, name), **stated}


FROZEN_AS = {"Sensors": "AccelerometerPart"}  # classes that had another name when the protocol was frozen
TASK = ("vehicle", "plant", "sensor", "trajectory")
COLLECTED = ("vehicle", "plant", "controller", "collect")
RULES = {"fit": ("gp", "drag"), "network": ("nn",)}  # rule of the protocol -> models that its words are of


@dataclass(frozen=True)
class Protocol:
    """version: its number. sha256: of its file. metric: that ranks. baseline: an entry that others are compared with.
    first_seed: of the flights. families: by name. hashes: of the values of each family."""

    version: int
    sha256: str
    metric: str
    baseline: str
    first_seed: int
    families: Mapping[str, Family]
    hashes: Mapping[str, str]

    @property
    def name(self) -> str:
        """Such as "v1 (3f2c...)"."""
        return f"v{self.version} ({self.sha256[:SHORT]})"

    def seeds(self, count: int) -> range:
        return range(self.first_seed, self.first_seed + count)

    def check(self, size: str, composer: Composer) -> None:
        """Raise UsageError where there is no size of this name, DataError where a family's words mean other values than
        when the protocol was frozen."""
        sizes = distinct(chain(*(family.sizes for family in self.families.values())))
        if size not in sizes:
            raise UsageError(f"--size {size}: no such size{suggestion(size, sizes)}")
        for name, sha256 in self.hashes.items():
            if sha256 != digest(self.families[name].values(composer)):
                raise DataError(
                    f"protocol {self.name}: the words of {name} do not mean what they did when it was frozen: an"
                    " option that it names has changed; restore its file, or make a new version of the protocol"
                )


def read_protocol() -> Protocol:
    """The protocol of this program."""
    return protocol_of((files("quadexp.plugins.bench") / "protocol.yaml").read_bytes())


def protocol_of(text: bytes) -> Protocol:
    """The protocol that a file's text states."""
    content = yaml.safe_load(text)
    families = {}
    for name, part in content["families"].items():
        drawn = _drawn(part.get("draws", {}), **content.get("draws", {}))
        worlds = {**part["worlds"], **dict(drawn)}
        models = part["models"]
        overrides = tuple(part["given"])
        families[name] = Family(name, part["what"], overrides, models, part["tasks"], worlds, part["sizes"])
    ranked = content["metric"], content["baseline"], content["first_seed"]
    sha256 = sha256_of(text)
    return Protocol(content["version"], sha256, *ranked, families, content.get("values", {}))


def _drawn(kinds: Mapping[str, Any], seed: int = 0, each: int = 0) -> Iterable[tuple[str, list[str]]]:
    """Name and overrides of every world that is drawn: uniform between two numbers, or two lists of them."""
    random = np.random.Generator(np.random.PCG64(seed))
    for kind, rule in kinds.items():
        for i in range(1, each + 1):
            overrides = list(rule["given"])
            for key, ends in rule["between"].items():
                value = np.round(random.uniform(*ends), 3).tolist()
                overrides.append(f"{key}={value}".replace(" ", ""))
            yield f"{kind}_{i}", overrides


def with_fewer_seeds(protocol: Protocol, size: str, seeds: int) -> tuple[Protocol, str]:
    """The protocol with the first seeds only of a size, and what such a size is called; 0: with all of them.

    The flights are some of the whole size's, so that a later run with more seeds continues them.
    """
    most = max(family.chosen(size)[0] for family in protocol.families.values())
    if not 0 < seeds < most:
        return protocol, size
    families = {}
    for name, family in protocol.families.items():
        part = family.sizes.get(size)
        fewer = {size: {**part, "seeds": min(int(part["seeds"]), seeds)}} if part else {}
        families[name] = replace(family, sizes={**family.sizes, **fewer})
    return replace(protocol, families=families), f"{size}, {count(seeds, 'seed')}"


if __name__ == "__main__":
    with session() as composing:
        for each in read_protocol().families.values():
            print(f"{each.name}: {digest(each.values(composing))}")
