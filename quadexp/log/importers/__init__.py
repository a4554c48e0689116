"""Flights from other programs' logs. One module a format reads a log into streams; assemble.py makes a flight of them.

read(path) -> RawLog (streams in SI, ENU, FLU, each on its own clock) -> assemble -> Flight -> quality check
"""

from __future__ import annotations

from quadexp.log.importers.importing import Options, checked, import_log

__all__ = ["Options", "checked", "import_log"]
