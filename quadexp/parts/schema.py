"""The whole configuration: one part of every group, and single keys; which groups stand together.

A plug-in brings groups of its own, as words "BUNDLE AFTER" in BRINGS["groups"] (quadexp/plugin.py): the bundle that it
is of, "world" or "remedies", and the group that it follows. A third word is the name that hashes have for it. Its
option `none` is taken. A group that is "listed" holds files of settings, and no parts of flights.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from quadexp.errors import UsageError
from quadexp.parts.former import GROUPS
from quadexp.parts.part import Part
from quadexp.parts.settings import SEEDS, Settings, key, keyed
from quadexp.plugin import shipped_places

T = TypeVar("T")
LISTED = "listed"
_WORDS = {group: words.split() for group, words in shipped_places("groups").items()}
BROUGHT = {group: words for group, words in _WORDS.items() if words != [LISTED]}  # those of flights


@keyed
class EvaluateConfig(Settings):
    """How a comparison is run and shown; nothing here changes a flight."""

    prefix = "evaluate."

    metric: str = key(
        "mean_error",
        "of the table: mean, root mean square, or largest distance from the reference, or an own metric",
        options="metric",
        also=("mean_error", "rmse", "max_error"),
    )
    figures: str = key("standard", "figures drawn in addition to the standard ones: those of a paper")
    baseline: str = key("nominal_mpc", "controller with which the others are compared, seed by seed")
    confidence: float = key(0.95, "confidence level of every interval", "[0.5, 0.9999]")
    workers: int = key(0, "parallel processes; 0: one per core", "[0, 1024]", "processes")
    timeout: float = key(
        600.0, "time limit of a flight (wall time), after which it is tried once more", "(0, 86400]", "s"
    )
    memory: float = key(4.0, "memory limit of the process of a flight; 0: no limit", "[0, 4096]", "GB")
    log_period: float = key(
        0.0, "between the stored samples of a flight; 0: every control instant; the table uses all", "[0, 3600]", "s"
    )


def with_brought(kind: type[T]) -> type[T]:
    """The class with a field for each group that plug-ins bring."""
    kind.__annotations__.update(dict.fromkeys(BROUGHT, "Any"))
    return kind


@keyed
@with_brought
class Config(Settings):
    """The whole configuration. sweep: what `evaluate --sweep` varies (experiment files). world: the name of what is
    around the plant, for tables; see `world_name`."""

    vehicle: Any
    plant: Any
    truth: Any
    payload: Any
    wind: Any
    external: Any
    link: Any
    actuator: Any
    health: Any
    sensor: Any
    estimator: Any
    trajectory: Any
    controller: Any
    timing: Any
    collect: Any
    engine: Any
    evaluate: EvaluateConfig = key(EvaluateConfig(), "how a comparison is run and shown")
    model: str | None = key(None, "checkpoint folder of a controller; null: the first of controller.models that exists")
    seed: int = key(0, "seed of the noise and of the path of trajectory=random; the same for every controller", SEEDS)
    world: str = ""
    sweep: Any = None


def conf_folder() -> Path:
    """The configuration folder: beside the package when installed, above it in a checkout."""
    here = Path(__file__).resolve().parent.parent
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise UsageError(f"no conf/config.yaml beside {here}: the installation is incomplete")


def _chosen() -> dict[str, str]:
    """The option that is taken of every group: as config.yaml says, in its order, and `none` of those of plug-ins."""
    stated = (conf_folder() / "config.yaml").read_text(encoding="utf-8")
    chosen = re.findall(r"^ *- (\w+): (?!null)(\w+)", stated, re.MULTILINE)
    for group, (bundle, after, *_) in BROUGHT.items():
        groups = [name for name, _ in chosen]
        place = groups.index(after) + 1 if after in groups else groups.index(bundle)
        chosen.insert(place, (group, "none"))
    return dict(chosen)


def _bundled(bundle: str, *of_core: str) -> tuple[str, ...]:
    return tuple(group for group in CHOSEN if group in of_core or BROUGHT.get(group, [""])[0] == bundle)


CHOSEN = _chosen()
# Around an airframe, in the order in which a command meets them; see quadexp/world/effect.py.
WORLD = _bundled(
    "world", "truth", "payload", "wind", "external", "link", "actuator", "health", "sensor", "estimator"
)  # fmt: skip
REMEDIES = _bundled("remedies")  # around a controller, the nearest first; quadexp/control/part.py
# Groups whose options choose those of several others, and set values of theirs.
BUNDLES = {"world": WORLD, "remedies": REMEDIES}
# Groups of presets, and the group whose values their options set.
PRESETS = {"horizon": "controller", "motor": "controller"}
PARTS = tuple(group for group in CHOSEN if group not in {*BUNDLES, *PRESETS})  # groups whose options stand for a part
CLASSES = (*PARTS, "model", "metric")  # and those of what is fitted and of what is measured, no parts of a flight
KNOWN = {*CHOSEN, *CLASSES, *_WORDS, "experiment"}


def lacks_plugin(group: str) -> bool:
    """Whether options of this program are of a group whose plug-in is not there."""
    return group not in KNOWN and (conf_folder() / group).is_dir()


def of_contestant(key: str) -> bool:
    """Whether a key belongs to who flies, not to what is flown: flights that differ in it have the same noise.

    "results" is the folder that a flight of several results comes from."""
    group = GROUPS.get(key.partition(".")[0], key.partition(".")[0])
    return PRESETS.get(group, group) in ("controller", "model", "timing", "remedies", *REMEDIES, "results")


def remedies(config: Config) -> dict[str, Any]:
    """The remedies that do something, by group, the one nearest to the controller first."""
    parts = {group: getattr(config, group) for group in REMEDIES}
    return {group: part for group, part in parts.items() if not part.idle}


def controller_name(config: Config) -> str:
    """What the controller is called in tables, with the remedies around it: "nominal_mpc+mine"."""
    return "+".join([config.controller.name, *(remedy.name for remedy in remedies(config).values())])


def world_parts(config: Config) -> dict[str, Part]:
    """The parts of the world that do something, by group."""
    parts = {group: getattr(config, group) for group in WORLD}
    return {group: part for group, part in parts.items() if not part.idle}


def world_name(config: Config, bundle: str, bundled: Mapping[str, Any]) -> str:
    """What the world is called, without blanks: "clean", or a bundle and the parts that differ from it, as in
    "only_latency,wind=gust" and "wind=constant,link=latency".

    bundle: option of the group `world`. bundled: the parts that it chooses, by group.
    """
    if not any(part.names_world for part in world_parts(config).values()):
        return "clean"
    differing = []
    for group in WORLD:
        part = getattr(config, group)
        covered = bundle == "clean" and part.names_world  # an own option in place of one that does nothing
        if covered or part != bundled[group]:
            differing.append(f"{group}={part.name}")
    return ",".join(differing if bundle == "clean" else [bundle, *differing])
