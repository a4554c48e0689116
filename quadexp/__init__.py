"""quadexp: an experiment pipeline for aerodynamics-aware quadrotor trajectory tracking.

    import quadexp as qx

The names of the Python API (docs/api.md) are imported when they are first used, so that `import quadexp` stays light.
"""

import sys
from importlib import import_module

__version__ = "0.1.0"

_API = {
    "simulate": "api",
    "collect": "api",
    "fit": "api",
    "fit_drag": "api",
    "sweep": "api",
    "load": "api",
    "controller": "loop",
    "ControlLoop": "loop",
    "Flight": "frames",
    "Dataset": "frames",
    "Results": "frames",
    "Checkpoint": "frames",
    "Measurement": "control.base",
    "Window": "control.base",
    "QuadexpError": "errors",
    "UsageError": "errors",
    "DataError": "errors",
}


class _FormerModules:
    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> object:
        """Of a module that has another name now; asked when nothing else knows the name."""
        if not name.startswith("quadexp.") or name == "quadexp.parts.former":
            return None
        return import_module("quadexp.parts.former").find_spec(name)


sys.meta_path.append(_FormerModules)  # type: ignore[arg-type]  # a class with `find_spec` is one


def _places() -> dict[str, str]:
    """Name of the Python API -> MODULE:ATTRIBUTE, of the core and of plug-ins."""
    plugin = import_module("quadexp.plugin")
    return {name: f"quadexp.{module}:{name}" for name, module in _API.items()} | plugin.shipped_places("api")


def __getattr__(name: str) -> object:
    if name == "__all__":
        return ["__version__", *_places()]
    place = f"quadexp.{_API[name]}:{name}" if name in _API else _places().get(name)
    if place is None:
        raise AttributeError(f"module 'quadexp' has no attribute {name!r}")
    module, _, attribute = place.partition(":")
    attribute_value = globals()[name] = getattr(import_module(module), attribute)
    return attribute_value


def __dir__() -> list[str]:
    return sorted({*globals(), *_places()})
