"""quadexp: an experiment pipeline for aerodynamics-aware quadrotor trajectory tracking.

    import quadexp as qx

The names of the Python API (docs/api.md) are imported when they are first used, so that `import quadexp` stays light.
"""

from importlib import import_module

__version__ = "0.1.0"

_API = {
    "simulate": "api",
    "collect": "api",
    "fit": "api",
    "fit_gp": "api",
    "fit_drag": "api",
    "fit_nn": "api",
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
    found = globals()[name] = getattr(import_module(module), attribute)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_places()})
