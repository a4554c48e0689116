"""Settings of the engine: where the flights of a sweep run. Nothing here changes a flight."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from quadexp.parts.part import Part
from quadexp.parts.settings import keyed

if TYPE_CHECKING:
    from quadexp.sweeps.engine import Engine, Workers


@keyed
class EngineConfig(Part):
    """Where the flights run; number of workers and limits of time and memory are settings of `evaluate`."""

    prefix = "engine."

    kind: ClassVar[str] = "local"

    def build(self, settings: Any, processes: Workers | None = None) -> Engine:
        """The engine; nothing is started before the first cell is flown. settings: the group `evaluate`.

        processes: of this machine, in which it may fly; None for some of its own.
        Raises UsageError where a package that it needs is not installed.
        """
        from quadexp.sweeps.engine import LocalEngine

        return LocalEngine(settings.workers, settings.timeout, settings.memory or None, processes)
