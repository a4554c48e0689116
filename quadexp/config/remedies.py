"""Settings of the remedies: what is put around a controller against errors of its model, delays and disturbances.

A remedy is one option of its group (`observer=wind`, `inner=indi`); each group has one that does nothing. `remedy`
names the function of quadexp/control that puts it around a controller, as module:function; "" where there is none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from quadexp.config.flight import Name
from quadexp.config.settings import Settings


@dataclass(frozen=True, kw_only=True)
class RemedyConfig(Settings):
    """A remedy; by itself, the option that does nothing."""

    remedy: ClassVar[str] = ""

    name: Name

    @property
    def idle(self) -> bool:
        """Whether it does nothing: the controller flies without it."""
        return not self.remedy
