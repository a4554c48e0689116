"""quadexp: an experiment pipeline for aerodynamics-aware quadrotor trajectory tracking.

    import quadexp as qx

The names of the Python API (docs/api.md) are imported when they are first used, so that `import quadexp` stays light.
"""

import sys
from importlib import import_module
from types import ModuleType

__version__ = "0.1.0"

_API = {
    "simulate": "api",
    "collect": "api",
    "fit": "api",
    "fit_gp": "api",
    "fit_drag": "api",
    "fit_nn": "api",
    "sweep": "api",
    "tune": "api",
    "bench": "api",
    "load": "api",
    "controller": "loop",
    "ControlLoop": "loop",
    "Flight": "frames",
    "Dataset": "frames",
    "Results": "frames",
    "Tuning": "frames",
    "Leaderboard": "frames",
    "Checkpoint": "frames",
    "Measurement": "control.base",
    "Window": "control.base",
    "QuadexpError": "errors",
    "UsageError": "errors",
    "DataError": "errors",
}
__all__ = ["__version__", *_API]  # noqa: PLE0604 - the rule cannot see that the keys of a dictionary are text


def __getattr__(name: str) -> object:
    if name not in _API:
        raise AttributeError(f"module 'quadexp' has no attribute {name!r}")
    found = globals()[name] = getattr(import_module(f"quadexp.{_API[name]}"), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_API})


class _Package(ModuleType):
    """The package, where a name of the API stays that when a room of the same name (quadexp/tune) is imported."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _API and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
