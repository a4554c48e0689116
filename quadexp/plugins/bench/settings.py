"""What a leaderboard is asked."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from quadexp.parts.settings import Settings, key, keyed


@keyed
class Bench(Settings):
    """What `quadexp bench` and `qx.bench` are asked."""

    size: Literal["quick", "standard", "full"] = key(
        "quick", "quick: minutes; standard: an hour; full: a night, on two cores."
    )
    controllers: tuple[str, ...] = key((), "Takes part too, as 'NAME observer=...'; repeatable.")
    only: bool = key(False, "Without the field of this program.")
    add: tuple[Path, ...] = key((), "Rank rows of another leaderboard with these.")
    seeds: int = key(0, "Only the first seeds of the size; 0: all. A later run flies more.", "[0, inf)")
    markdown: Path | None = key(None, "Write the tables between the marks of this file.")
