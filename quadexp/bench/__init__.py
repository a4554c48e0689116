"""A leaderboard: the same tasks, worlds and seeds for every controller, by a protocol that does not change."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from quadexp.parts.settings import Setting, Settings


@dataclass(frozen=True, kw_only=True)
class Bench(Settings):
    """What `quadexp bench` and `qx.bench` are asked."""

    size: Annotated[
        Literal["quick", "standard", "full"],
        Setting("quick: minutes; standard: an hour; full: a night, on two cores."),
    ] = "quick"
    controllers: Annotated[tuple[str, ...], Setting("Takes part too, as 'NAME observer=...'; repeatable.")] = ()
    only: Annotated[bool, Setting("Without the field of this program.")] = False
    add: Annotated[tuple[Path, ...], Setting("Rank rows of another leaderboard with these.")] = ()
    seeds: Annotated[int, Setting("Only the first seeds of the size; 0: all. A later run flies more.", "[0, inf)")] = 0
    markdown: Annotated[Path | None, Setting("Write the tables between the marks of this file.")] = None
    page: Annotated[Path | None, Setting("Where to write the page.")] = None
