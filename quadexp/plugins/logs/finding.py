"""One result of a check: which fault, where, how large against what is allowed, and whether it blocks."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

# What mends bad samples.
LEAVE_OUT = "`import --bad-rows drop` leaves them out, `--bad-rows gap` makes them gaps"
SEVERITIES = ("info", "warning", "blocking")


@dataclass(frozen=True)
class Finding:
    """name: of the fault. severity: one of SEVERITIES; "blocking": what is learned from the flight would be wrong.

    where: columns and time span or samples. measured, allowed: text with units. advice: what to do, or "".
    span: first and last time of `where` (s), for a stretch. correction: lines of the import's mapping that mend it.
    """

    name: str
    severity: str
    where: str
    measured: str
    allowed: str
    advice: str = ""
    span: tuple[float, float] | None = None
    correction: dict[str, Any] = field(default_factory=dict)

    @property
    def message(self) -> str:
        """One line."""
        advice = f"; {self.advice}" if self.advice else ""
        return f"{self.severity}: {self.name}: {self.where}: {self.measured} (allowed: {self.allowed}){advice}"

    @property
    def blocks(self) -> bool:
        return self.severity == "blocking"

    def record(self) -> dict[str, Any]:
        """As it goes into JSON."""
        return {**asdict(self), "blocks": self.blocks, "message": self.message}


def worst_first(findings: list[Finding]) -> list[Finding]:
    """Blocking ones first; the order among equals is kept."""
    return sorted(findings, key=lambda finding: -SEVERITIES.index(finding.severity))


def of_rows(
    name: str, severity: str, columns: str, rows: tuple[int, int], t: np.ndarray, text: str, allowed: str,
    advice: str = LEAVE_OUT,
) -> Finding:  # fmt: skip
    """A finding about the samples rows[0]..rows[1] - 1 of some columns."""
    start, stop = rows
    low = float(t[start])
    high = float(t[min(stop, len(t)) - 1])
    place = f"sample {start}, {low:.2f} s"
    if stop - start > 1:
        place = f"samples {start}..{stop - 1}, {low:.2f}..{high:.2f} s"
    where = f"{columns}, {place}" if columns else place
    return Finding(name, severity, where, text, allowed, advice, (low, high))
