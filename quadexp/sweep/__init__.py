"""A sweep: every cell flown once, by whatever engine, and one table of results at the end.

The package can be called: `qx.sweep(...)` is `quadexp.api.calls.sweep`, whose docstring says what it takes.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any


class _CallablePackage(ModuleType):
    """A package bears the name of a function of the Python API, and importing it sets that name."""

    def __call__(self, *settings: Any, **keywords: Any) -> Any:
        return import_module("quadexp.api.calls").sweep(*settings, **keywords)


sys.modules[__name__].__class__ = _CallablePackage
