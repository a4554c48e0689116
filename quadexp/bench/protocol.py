"""The protocol of the leaderboard: what is flown, how often, and by what it is ranked.

A version is two files in quadexp/bench/protocols: v1.yaml says what is flown, v1.lock.json what every task and world
was made of when the version was frozen, value by value. Its hash is of both. A configuration that makes another task
of the same words is refused, so that two results of one hash are of the same flights.

    python -m quadexp.bench.protocol 1      writes the lock of a version that is being made
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml

from quadexp.errors import DataError, UsageError
from quadexp.files.writer import write_text
from quadexp.messages import suggestion
from quadexp.parts.compose import Composer, session
from quadexp.parts.schema import WORLD, Config
from quadexp.report.text import count

LATEST = 2
FORMER = {"gp=default": "gp=zero_mean"}  # what versions 1 and 2 say, and what it is called today
FOLDER = files("quadexp.bench") / "protocols"
SHORT = 12  # hex digits of a hash
GROUPS = ("vehicle", "plant", "sensor", "trajectory")


@dataclass(frozen=True)
class Family:
    """Tasks of one vehicle. given: overrides of all its flights. models: {collect: overrides, fit: overrides} of the
    checkpoint that controllers may use, with network: overrides of a network that is fitted to the same rows. tasks,
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
        one = self.sizes.get(size)
        if one is None:
            return 0, [], []
        return int(one["seeds"]), list(one.get("tasks", self.tasks)), list(one.get("worlds", self.worlds))


@dataclass(frozen=True)
class Protocol:
    """version: its number. sha256: of its files. metric: that ranks. baseline: an entry that others are compared with.
    seeds: the first one. families: by name."""

    version: int
    sha256: str
    metric: str
    baseline: str
    first_seed: int
    families: Mapping[str, Family]

    @property
    def name(self) -> str:
        """Such as "v1 (3f2c...)"."""
        return f"v{self.version} ({self.sha256[:SHORT]})"

    def sizes(self) -> list[str]:
        return list(dict.fromkeys(size for family in self.families.values() for size in family.sizes))

    def seeds(self, count: int) -> range:
        return range(self.first_seed, self.first_seed + count)


def read_protocol(version: int = LATEST) -> Protocol:
    """A version of the protocol; raises UsageError where there is none of this number."""
    try:
        text, lock = ((FOLDER / f"v{version}.{end}").read_bytes() for end in ("yaml", "lock.json"))
    except FileNotFoundError:
        raise UsageError(f"--protocol {version}: no such version; there are 1 to {LATEST}") from None
    return _protocol(version, text, hashlib.sha256(text + b"\0" + lock).hexdigest())


def _protocol(version: int, text: bytes, sha256: str) -> Protocol:
    content = yaml.safe_load(text)
    families = {}
    for name, one in content["families"].items():
        tasks, worlds = ({key: tuple(value) for key, value in one[part].items()} for part in ("tasks", "worlds"))
        models = {key: [FORMER.get(text, text) for text in given] for key, given in one["models"].items()}
        families[name] = Family(name, one["what"], tuple(one["given"]), models, tasks, worlds, one["sizes"])
    return Protocol(version, sha256, content["metric"], content["baseline"], content["first_seed"], families)


def check_size(protocol: Protocol, size: str) -> None:
    """Raise UsageError where there is no size of this name."""
    sizes = protocol.sizes()
    if size not in sizes:
        raise UsageError(f"--size {size}: no such size{suggestion(size, sizes)}")


def with_fewer_seeds(protocol: Protocol, size: str, seeds: int) -> tuple[Protocol, str]:
    """The protocol with the first seeds only of a size, and what such a size is called; 0: with all of them.

    The flights are some of the whole size's, so that a later run with more seeds continues them.
    """
    most = max(int(family.sizes[size]["seeds"]) for family in protocol.families.values() if size in family.sizes)
    if not 0 < seeds < most:
        return protocol, size
    families = {}
    for name, family in protocol.families.items():
        one = family.sizes.get(size)
        fewer = {size: {**one, "seeds": min(int(one["seeds"]), seeds)}} if one else {}
        families[name] = replace(family, sizes={**family.sizes, **fewer})
    return replace(protocol, families=families), f"{size}, {count(seeds, 'seed')}"


# -------------------------------------------------------------------------------------------------------------- lock
def resolved(protocol: Protocol, composer: Composer) -> dict[str, Any]:
    """What the words of the protocol mean: the values of every task, world and data set."""

    def composed(given: Sequence[str]) -> Config:
        return composer.expand(given, check=False).sound()[0].config  # every option is composed once

    found: dict[str, Any] = {}
    for family in protocol.families.values():
        first = next(iter(family.tasks.values()))
        found[family.name] = {
            "tasks": {name: _values(composed([*family.given, *given]), GROUPS) for name, given in family.tasks.items()},
            "worlds": {
                name: _values(composed([*family.given, *first, *given]), WORLD) for name, given in family.worlds.items()
            },
            **({"network": _values(composed(network), ("nn",))} if (network := family.models.get("network")) else {}),
            "data": _values(composed(family.models["collect"]), ("vehicle", "plant", "controller", "collect")),
            "fit": _values(composed(family.models["fit"]), ("gp", "drag")),
        }
    return found


UNNAMED = ("collect", "gp", "drag", "nn")  # groups whose option has no name of its own in a protocol


def _values(config: Config, groups: Sequence[str]) -> dict[str, Any]:
    nodes = {group: getattr(config, group) for group in groups}
    return {
        group: {key: value for key, value in node.recorded().items() if key != "name" or group not in UNNAMED}
        for group, node in nodes.items()
        if not node.idle
    }


def check_lock(protocol: Protocol, composer: Composer) -> None:
    """Raise DataError where a task or world is made of other values than when the protocol was frozen.

    Keys that came later are no fault: what they do by default is what was done before them.
    """
    locked = json.loads((FOLDER / f"v{protocol.version}.lock.json").read_text(encoding="utf-8"))
    if wrong := _difference(locked, resolved(protocol, composer)):
        raise DataError(
            f"protocol v{protocol.version}: {wrong}: a configuration file has changed what it flies; restore the file,"
            " or make a new version of the protocol"
        )


def _difference(locked: Any, found: Any, at: str = "") -> str:
    """Where two trees differ, in one line; "" where all that is locked is found."""
    if isinstance(locked, dict) and isinstance(found, dict):
        for key, value in locked.items():
            place = f"{at}.{key}" if at else str(key)
            if key not in found:
                return f"{place} is gone"
            if wrong := _difference(value, found[key], place):
                return wrong
        return ""
    return "" if locked == found else f"{at} is {found}, was {locked}"


def write_lock(version: int, folder: Path) -> Path:
    """Write the lock of a version that is being made."""
    text = (folder / f"v{version}.yaml").read_bytes()
    with session() as composer:
        values = resolved(_protocol(version, text, ""), composer)
    path = folder / f"v{version}.lock.json"
    write_text(path, json.dumps(values, indent=1, sort_keys=True) + "\n")
    return path


if __name__ == "__main__":
    print(write_lock(int(sys.argv[1]), Path(str(FOLDER))))
