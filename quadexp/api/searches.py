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
from quadexp.config.compose import session
from quadexp.errors import QuadexpError, UsageError
from quadexp.log.store import read_table
from quadexp.sweeps.cluster.engines import open_engine
from quadexp.sweeps.engine import Workers

OF_BENCH = ("engine", "evaluate")  # groups that a protocol leaves open


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
    ":log" after it for a log scale; () for the space of conf/tune. flights: budget of all trials. seeds: of a trial,
    unless seed= is given. delay_margin: least one of the loop (s). search_seed: of the search's own draws. batch:
    trials drawn together. name: of the option that is found. out: a folder, where a search goes on that was
    interrupted; else the options are kept for as long as the table.
    Returns a row a trial, the first one as it was; `options` has the files found, `settings` what they change.
    Raises UsageError where the budget does not pay two trials, or several controllers are asked for.
    """
    from quadexp.tune.result import HISTORY, clear, trials_of
    from quadexp.tune.result import tune as search
    from quadexp.tune.search import Request, cells_of, with_seeds
    from quadexp.tune.space import read_axes

    extra = conf_folder(conf)
    with session(extra) as composer:
        given = with_seeds(overrides(settings, keywords, lists=True), seeds)
        cells = cells_of(composer, given)
        first = cells[0].config
        trials_of(flights, len(cells))
        axes = tuple(read_axes([vary] if isinstance(vary, str) else list(vary), first, extra))
        request = Request(tuple(given), axes, first.evaluate.metric, delay_margin, search_seed, batch)
        folder = Scratch() if out is None else Path(out)
        if force:
            clear(Path(folder))
        with (
            Workers(first.evaluate.workers, first.evaluate.memory or None, calls=len(cells)) as processes,
            open_engine(first, processes) as engine,
            Shown("flights", progress) as shown,
        ):
            found = search(
                composer, request, Path(folder), flights, name=name, figure=out is not None, engine=engine,
                progress=shown,
            )  # fmt: skip
    table = Tuning.of(*read_table(Path(folder) / HISTORY, "tuning"), folder)
    table.attrs |= {
        "best": found.best, "options": {option: str(file) for option, file in found.options.items()},
        "settings": dict(found.record["settings"]), "lines": list(found.lines),
    }  # fmt: skip
    return table


def bench(
    *settings: Given,
    size: str = "quick",
    controllers: str | Sequence[str] = (),
    only: bool = False,
    add: Place | Sequence[Place] = (),
    protocol: int = 1,
    out: Place | None = None,
    conf: Place | None = None,
    progress: bool = False,
    **keywords: Any,
) -> Leaderboard:
    """Rank controllers by a protocol that does not change, as `quadexp bench`.

    settings: of engine and evaluate only. size: "quick", "standard" or "full". controllers: entries beside the field,
    each "NAME" or "NAME KEY=VALUE ..."; only: without the field. add: leaderboards whose rows take part. protocol: its
    version. out: a folder, where a run goes on that was interrupted; else the flights are kept as long as the table.
    Returns a row a flight; `boards` has the tables of ranks by family.
    Raises UsageError before anything is flown, also for results of another protocol; QuadexpError for failed flights.
    """
    from quadexp.bench.board import FILE
    from quadexp.bench.run import run_bench

    given = overrides(settings, keywords, "evaluate")
    for text in given:
        if text.partition("=")[0].partition(".")[0] not in OF_BENCH:
            raise UsageError(f"{text!r}: what is flown is the protocol's; only engine and evaluate can be set")
    extra = conf_folder(conf)
    folder = Scratch() if out is None else Path(out)
    with session(extra) as composer:
        config = composer.compose(given)
        limits = config.evaluate
        with (
            Workers(limits.workers, limits.memory or None, calls=64) as processes,
            open_engine(config, processes) as engine,
            Shown("flights", progress) as shown,
        ):
            made = run_bench(
                composer, Path(folder), size=size, only=only, version=protocol, extra=extra, engine=engine,
                progress=shown,
                controllers=[controllers] if isinstance(controllers, str) else list(controllers),
                add=[Path(add)] if isinstance(add, (str, os.PathLike)) else [Path(one) for one in add],
            )  # fmt: skip
    if made.failed:
        raise QuadexpError(f"{len(made.failed)} flights failed; the first: {made.failed[0]['cause']}")
    table = Leaderboard.of(*read_table(Path(folder) / FILE, "leaderboard"), folder)
    table.attrs["notes"] = list(made.notes)
    return table
