"""What the core does not need: a folder a plug-in, each of which may be deleted (quadexp/plugin.py).

A plug-in may import from others below it (tests/house.py); where one of these is not there, that is said as such.
"""

from __future__ import annotations

import sys

from quadexp.errors import UsageError


class AbsentPluginError(UsageError, ModuleNotFoundError):
    """A plug-in that another one needs is not there: its folder was deleted."""


class _Absent:
    """Asked for a module that nothing else has found."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> None:
        """Raises AbsentPluginError for a plug-in."""
        package, _, plugin = name.rpartition(".")
        if package == __name__:
            raise AbsentPluginError(f"the plug-in quadexp/plugins/{plugin} is not there")


sys.meta_path.append(_Absent)
