"""Settings of a controller by flights: the same budget for every controller."""

from dataclasses import dataclass
from typing import Annotated

from quadexp.parts.settings import SEEDS, Setting, Settings


@dataclass(frozen=True, kw_only=True)
class Tune(Settings):
    """What `quadexp tune` and `qx.tune` are asked."""

    vary: Annotated[
        tuple[str, ...], Setting("A setting to tune, KEY=LOW..HIGH; `:log` after it for a log scale; repeatable.")
    ] = ()
    flights: Annotated[int, Setting("Budget: flights of all trials.", "[1, inf)")] = 200
    seeds: Annotated[int, Setting("Seeds of a trial, unless seed=... is given.", "[1, inf)")] = 2
    delay_margin: Annotated[float, Setting("Least delay margin of the loop, for an MPC.", "[0, inf)", "s")] = 0.0
    search_seed: Annotated[int, Setting("Seed of the search's own draws.", SEEDS)] = 0
    batch: Annotated[int, Setting("Trials drawn together, to fill many workers.", "[1, inf)")] = 1
    name: Annotated[str | None, Setting("Of the option to write; default: NAME_tuned.")] = None
