"""What a search for settings is asked."""

from __future__ import annotations

from quadexp.parts.settings import SEEDS, Settings, key, keyed


@keyed
class Tune(Settings):
    """What `quadexp tune` and `qx.tune` are asked."""

    vary: tuple[str, ...] = key((), "A setting to tune, KEY=LOW..HIGH; `:log` after it for a log scale; repeatable.")
    flights: int = key(200, "Budget: flights of all trials.", "[1, inf)")
    seeds: int = key(2, "Seeds of a trial, unless seed=... is given.", "[1, inf)")
    delay_margin: float = key(0.0, "Least delay margin of the loop.", "[0, inf)", "s")
    search_seed: int = key(0, "Seed of the search's own draws.", SEEDS)
    batch: int = key(1, "Trials drawn together, to fill many workers.", "[1, inf)")
    name: str | None = key(None, "Name of the option to write; default: NAME_tuned.")
