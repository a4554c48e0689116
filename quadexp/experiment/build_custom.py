"""From a configuration to classes and functions that are not this program's own.

The dotted name under `_target_` is imported and called, if it lies in a --conf folder or in an installed plugin package
(plugins.py); what comes back must have what its seam asks for. The source
file's hash is among the inputs of a flight, so that an edited class is flown anew and an untouched one is not.
"""

from __future__ import annotations

import hashlib
import importlib
import inspect
from collections.abc import Callable
from typing import Any

from quadexp.config.plugins import lies_outside
from quadexp.config.schema import Config
from quadexp.errors import ModuleError, QuadexpError, UsageError
from quadexp.physics.vehicle import Vehicle

# What of a seam is looked for, so that something else is refused before the flight and not in it.
SEAMS = {
    "trajectory": ("duration", "peak_speed", "flat_output"),
    "plant": ("vehicle", "reset", "advance", "residual"),
    "controller": (
        "vehicle", "control_period", "node_times", "reference_period", "residual", "backend", "name", "source",
        "forget", "reset", "step", "log",
    ),
    "residual": ("name", "function", "theta", "source"),
}  # fmt: skip


def targets(config: Config) -> dict[str, str]:
    """The dotted names that a flight uses, by group; empty for a flight of this program's own parts."""
    nodes = {"plant": config.plant, "trajectory": config.trajectory, "controller": config.controller}
    return {group: node._target_ for group, node in nodes.items() if hasattr(node, "_target_")}


def source_hashes(config: Config) -> dict[str, str]:
    """sha256 of the file that every target is written in, by "<group> source"."""
    return {f"{group} source": _source_hash(f"{group}._target_", name) for group, name in targets(config).items()}


def custom_trajectory(config: Any) -> Any:
    """The user's trajectory; UsageError where the name, its options or what it makes are wrong."""
    given = {} if config.speed is None else {"speed": config.speed}
    return _make("trajectory", config, **given)


def custom_plant(vehicle: Vehicle, config: Any) -> Any:
    """The user's plant; see custom_trajectory."""
    return _make("plant", config, vehicle, step=config.step)


def custom_controller(vehicle: Vehicle, config: Any) -> Any:
    """The user's controller; see custom_trajectory."""
    return _make("controller", config, vehicle)


def custom_residual(vehicle: Vehicle, config: Any) -> Any:
    """The user's residual for the MPC; see custom_trajectory."""
    return _make("residual", config, vehicle, group="controller")


def _make(seam: str, config: Any, *arguments: Any, group: str = "", **given: Any) -> Any:
    group = group or seam
    key = f"{group}._target_={config._target_}"
    target = _import(f"{group}._target_", config._target_)
    try:
        inspect.signature(target).bind(*arguments, **given, **config.options)
    except TypeError as error:
        passed = ", ".join([*(["vehicle"] if arguments else []), *given, *config.options])
        raise UsageError(f"{key}: cannot be called with {passed or 'nothing'} ({error})") from None
    except ValueError:  # no signature can be had
        pass
    try:
        made = target(*arguments, **given, **config.options)
    except QuadexpError:
        raise
    except Exception as error:
        raise UsageError(f"{key}: raised {type(error).__name__}: {error}") from error
    lacking = [name for name in SEAMS[seam] if not hasattr(made, name)]
    if lacking:
        raise UsageError(f"{key}: made no {seam}, a {type(made).__name__} without {', '.join(lacking)}")
    return made


def _import(key: str, name: str) -> Callable[..., Any]:
    module_name, _, attribute = name.rpartition(".")
    if not module_name:
        raise UsageError(f"{key}={name}: expected MODULE.NAME, such as my_package.helix.Helix")
    outside = lies_outside(module_name)
    if outside:
        raise ModuleError(f"{key}={name}: {outside}")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ModuleError(f"{key}={name}: {error}") from None
    except Exception as error:
        raise UsageError(f"{key}={name}: importing {module_name} raised {type(error).__name__}: {error}") from error
    target = getattr(module, attribute, None)
    if not callable(target):
        raise UsageError(f"{key}={name}: module {module_name} has no class or function {attribute!r}")
    if inspect.isclass(target) or inspect.isroutine(target):
        home = getattr(target, "__module__", None) or "builtins"
        if lies_outside(home):
            raise UsageError(
                f"{key}={name}: comes from module {home}, which is neither in the --conf folder nor in an installed"
                " plugin package: call it from a function in your module"
            )
    return target


def _source_hash(key: str, name: str) -> str:
    module = inspect.getmodule(_import(key, name))
    file = getattr(module, "__file__", None)
    if not file:
        return ""
    with open(file, "rb") as source:
        return hashlib.sha256(source.read()).hexdigest()
