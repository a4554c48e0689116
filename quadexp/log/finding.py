"""One result of a check: which fault, where, how large against what is allowed, and whether it blocks."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

# What mends bad samples.
LEAVE_OUT = "`import --bad-rows drop` leaves them out, `--bad-rows gap` makes them gaps"
SEVERITIES = ("info", "warning", "blocking")


@dataclass(frozen=True)
class Finding:
    """name: of the fault . severity: "info", "warning" (use with care) or "blocking"
    (what is learned from the flight would be wrong). where: columns and time span or samples. measured, allowed: text
    with units. advice: what to do, or "". span: first and last time of `where` (s), for a stretch.
    correction: lines of the import's mapping that mend it.
    """

    name: str
    severity: str
    where: str
    measured: str
    allowed: str
    advice: str = ""
    span: tuple[float, float] | None = None
    correction: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.severity not in SEVERITIES:
            raise ValueError(f"severity {self.severity!r}: one of {', '.join(SEVERITIES)}")

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


def span(t: Any, start: int, stop: int) -> tuple[float, float]:
    """Times of samples start..stop-1."""
    return float(t[start]), float(t[min(stop, len(t)) - 1])


def place(start: int, stop: int, t: Any = None) -> str:
    """Samples start..stop-1 in words, with their times."""
    text = f"sample {start}" if stop - start <= 1 else f"samples {start}..{stop - 1}"
    if t is None:
        return text
    low, high = float(t[start]), float(t[min(stop, len(t)) - 1])
    return f"{text}, {low:.2f} s" if stop - start <= 1 else f"{text}, {low:.2f}..{high:.2f} s"
