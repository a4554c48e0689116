"""`quadexp tune` and `quadexp bench` as functions; see calls.py for what all calls share."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from quadexp.api.calls import Place, Shown, conf_folder
from quadexp.api.frames import Leaderboard, Tuning
from quadexp.api.overrides import Given, overrides
from quadexp.api.scratch import Scratch
from quadexp.log.store import read_table


def tune(
    *settings: Given,
    vary: str | Sequence[str] = (),
    flights: int = 200,
    seeds: int = 2,
    delay_margin: float = 0.0,
    search_seed: int = 0,
    batch: int = 1,
    name: str | None = None,
    out: Place | None = None,
    conf: Place | None = None,
    force: bool = False,
    progress: bool = False,
    **keywords: Any,
) -> Tuning:
    """Choose settings of a controller by flights, as `quadexp tune`.

    settings, keywords: the cells of a trial, lists as in `sweep`. vary: "KEY=LOW..HIGH" for each setting to tune,
    ":log" after it for a log scale; () for its default space. flights: budget of all trials. seeds: of a trial,
    unless seed= is given. delay_margin: least one of the loop (s). search_seed: of the search's own draws. batch:
    trials drawn together. name: of the option that is found. out: a folder, where a search goes on that was
    interrupted; else the options are kept for as long as the table.
    Returns a row a trial, the first one as it was; `choice` names what was found, `settings` what it changes.
    Raises UsageError where the budget does not pay two trials, or several controllers are asked for.
    """
    from quadexp.tune.call import HISTORY
    from quadexp.tune.call import tune as search

    folder = Scratch() if out is None else Path(out)
    with Shown("flights", progress) as shown:
        found = search(
            overrides(settings, keywords, lists=True), vary=[vary] if isinstance(vary, str) else list(vary),
            flights=flights, seeds=seeds, delay_margin=delay_margin, seed=search_seed, batch=batch, name=name,
            figure=out is not None, out=Path(folder), conf=conf_folder(conf), force=force, progress=shown,
        )  # fmt: skip
    table = Tuning.of(*read_table(Path(folder) / HISTORY, "tuning"), folder)
    table.attrs |= {
        "best": found.best, "choice": found.choice, "settings": dict(found.record["settings"]),
        "lines": list(found.lines),
    }  # fmt: skip
    return table


def bench(
    *settings: Given,
    size: str = "quick",
    controllers: str | Sequence[str] = (),
    only: bool = False,
    add: Place | Sequence[Place] = (),
    seeds: int = 0,
    protocol: int | None = None,
    out: Place | None = None,
    conf: Place | None = None,
    progress: bool = False,
    **keywords: Any,
) -> Leaderboard:
    """Rank controllers by a protocol that does not change, as `quadexp bench`.

    settings: of engine and evaluate only. size: "quick", "standard" or "full". controllers: entries beside the field,
    each "NAME" or "NAME KEY=VALUE ..."; only: without the field. add: leaderboards whose rows take part. seeds: only
    the first of the size; 0: all. protocol: version, the latest by default. out: a folder, where a run goes on that
    was interrupted; else the flights are kept as long as the table.
    Returns a row a flight; `boards` has the tables of ranks by family.
    Raises UsageError before anything is flown, also for results of another protocol. A flight that failed is a row with
    its cause, and counts as lost.
    """
    from quadexp.bench.board import FILE
    from quadexp.bench.run import bench as fly

    folder = Scratch() if out is None else Path(out)
    with Shown("flights", progress) as shown:
        made = fly(
            overrides(settings, keywords, "evaluate"), size=size, only=only, seeds=seeds, out=Path(folder),
            conf=conf_folder(conf), progress=shown,
            controllers=[controllers] if isinstance(controllers, str) else list(controllers),
            add=[Path(add)] if isinstance(add, (str, os.PathLike)) else [Path(one) for one in add],
            version=protocol,
        )  # fmt: skip
    table = Leaderboard.of(*read_table(Path(folder) / FILE, "leaderboard"), folder)
    failed = [f"{len(made.failed)} flights failed; the first: {made.failed[0]['cause']}"] if made.failed else []
    table.attrs["notes"] = [*made.notes, *failed]
    return table
