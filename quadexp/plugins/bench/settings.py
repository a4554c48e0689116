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
    controllers: tuple[str, ...] = key((), "Add this controller, such as 'NAME observer=...'; repeatable.")
    only: bool = key(False, "Leave out the controllers of the protocol.")
    add: tuple[Path, ...] = key((), "Rank rows of another leaderboard with these.")
    seeds: int = key(0, "How many seeds of the size; 0: all. A later run may add more.", "[0, inf)")
    markdown: Path | None = key(None, "Write the tables between the marks of this file.")
