"""The whole configuration: one part of every group, and single keys; which groups stand together."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from quadexp.errors import UsageError
from quadexp.parts.part import Part
from quadexp.parts.settings import SEEDS, Setting, Settings


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(Settings):
    """How a comparison is run and shown; nothing here changes a flight."""

    prefix: ClassVar[str] = "evaluate."

    metric: Annotated[
        Literal["mean_error", "rmse", "max_error"],
        Setting("error in the table: mean, root mean square, or largest distance from the reference"),
    ] = "mean_error"
    figures: Annotated[
        Literal["standard", "lei_li", "families", "adaptation", "ladder", "sun"],
        Setting("figures drawn in addition to the standard ones"),
    ] = "standard"
    baseline: Annotated[str, Setting("controller with which the others are compared, seed by seed")] = "nominal_mpc"
    confidence: Annotated[float, Setting("confidence level of every interval", "[0.5, 0.9999]")] = 0.95
    workers: Annotated[int, Setting("parallel processes; 0: one per core", "[0, 1024]", "processes")] = 0
    timeout: Annotated[
        float, Setting("time limit of a flight (wall time), after which it is tried once more", "(0, 86400]", "s")
    ] = 600.0
    memory: Annotated[float, Setting("memory limit of the process of a flight; 0: no limit", "[0, 4096]", "GB")] = 4.0
    log_period: Annotated[
        float,
        Setting(
            "time between the samples of a flight that are stored; 0: every control instant. Figures of the table are"
            " computed before",
            "[0, 3600]",
            "s",
        ),
    ] = 0.0


@dataclass(frozen=True, kw_only=True)
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
    battery: Any
    health: Any
    ground: Any
    sensor: Any
    estimator: Any
    trajectory: Any
    controller: Any
    observer: Any
    adaptive: Any
    inner: Any
    delay: Any
    collect: Any
    gp: Any
    drag: Any
    nn: Any
    engine: Any
    evaluate: Annotated[EvaluateConfig, Setting("how a comparison is run and shown")] = field(
        default_factory=EvaluateConfig
    )
    model: Annotated[
        str | None,
        Setting(
            "checkpoint folder for a controller that needs one; null: the first folder of controller.models that exists"
        ),
    ] = None
    seed: Annotated[
        int, Setting("seed of the noise and of the path of trajectory=random; the same for every controller", SEEDS)
    ] = 0
    world: str = ""
    sweep: Any = None


def conf_folder() -> Path:
    """The configuration folder: beside the package when installed, above it in a checkout."""
    here = Path(__file__).resolve().parent.parent
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise UsageError(f"no conf/config.yaml beside {here}: the installation is incomplete")


# The option that config.yaml takes of every group, in its order.
CHOSEN: dict[str, str] = dict(
    re.findall(r"^ *- (\w+): (?!null)(\w+)", (conf_folder() / "config.yaml").read_text(encoding="utf-8"), re.MULTILINE)
)
# Around an airframe, in the order in which a command meets them; see quadexp/world/effect.py.
WORLD = (
    "truth", "payload", "wind", "external", "link", "actuator", "battery", "health", "ground", "sensor", "estimator",
)  # fmt: skip
REMEDIES = ("observer", "adaptive", "inner", "delay")  # around a controller, the nearest first; quadexp/control/part.py
# Groups whose options choose those of several others, and set values of theirs.
BUNDLES = {"world": WORLD, "remedies": REMEDIES}
# Groups of presets, and the group whose values their options set.
PRESETS = {"horizon": "controller", "motor": "controller"}
PARTS = tuple(group for group in CHOSEN if group not in {*BUNDLES, *PRESETS})  # groups whose options stand for a part


def remedies(config: Config) -> dict[str, Any]:
    """The remedies that do something, by group, the one nearest to the controller first."""
    parts = {group: getattr(config, group) for group in REMEDIES}
    return {group: one for group, one in parts.items() if not one.idle}


def controller_name(config: Config) -> str:
    """What the controller is called in tables, with the remedies around it: "gp_mpc+wind+strapdown"."""
    return "+".join([config.controller.name, *(one.name for one in remedies(config).values())])


def world_parts(config: Config) -> dict[str, Part]:
    """The parts of the world that do something, by group; a sensor that is only an accelerometer is none."""
    parts = {group: getattr(config, group) for group in WORLD}
    return {group: one for group, one in parts.items() if not one.idle}


def world_name(config: Config, bundle: str, bundled: Mapping[str, Any]) -> str:
    """What the world is called, without blanks: "clean", or a bundle and the parts that differ from it, as in
    "outdoor_breeze,wind=none" and "wind=constant,link=latency".

    bundle: option of the group `world`. bundled: the parts that it chooses, by group.
    """
    if not world_parts(config):
        return "clean"
    own = [f"{group}={getattr(config, group).name}" for group in WORLD if getattr(config, group) != bundled[group]]
    return ",".join(own if bundle == "clean" else [bundle, *own])
