"""Options that commands on the results of a sweep share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from quadexp.errors import UsageError

if TYPE_CHECKING:
    from quadexp.report.frame import SweepFrame


def keys_of(words: Sequence[str]) -> list[str] | None:
    """Keys of an option that is repeatable, also with commas between; None if there are none."""
    return [key.strip() for text in words for key in text.split(",") if key.strip()] or None


def labels_of(words: Sequence[str]) -> dict[str, str]:
    """--label: KEY=TEXT texts as key -> text."""
    names = {}
    for text in words:
        key, _, shown = text.partition("=")
        if not shown:
            raise UsageError(f"--label {key}: give KEY=TEXT")
        names[key] = shown
    return names


def flights_of(whole: SweepFrame, where: str | None) -> SweepFrame:
    """--where: the flights that fulfil it; all without."""
    from quadexp.report.frame import chosen

    if not where:
        return whole
    frame = whole.where(chosen(whole, where))
    if not frame.rows:
        raise UsageError(f"--where {where!r}: no flight fulfils it")
    return frame
