"""One line of a proposed mapping: its value, how sure it is, and the evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

Groups = dict[str, list[list[int]]]  # quantity -> the groups of columns whose names say so


@dataclass
class Proposal:
    """value: as it stands in the mapping. confidence: 0 to 1. why: the evidence."""

    value: Any
    confidence: float
    why: str

    @property
    def sureness(self) -> str:
        return "sure" if self.confidence >= 0.85 else "likely" if self.confidence >= 0.6 else "guess"
