"""One call that tunes a controller and writes what was found: what `quadexp tune` does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from quadexp.config.compose import session
from quadexp.sweeps.cluster.engines import opened
from quadexp.sweeps.plan import plan_cells
from quadexp.tune.result import Tuned, clear, trials_of
from quadexp.tune.result import tune as search
from quadexp.tune.search import SEEDS, Request, cells_of, with_seeds
from quadexp.tune.space import read_axes


def tune(
    overrides: Sequence[str] = (),
    *,
    vary: Sequence[str] = (),
    flights: int = 200,
    seeds: int = SEEDS,
    delay_margin: float = 0.0,
    seed: int = 0,
    batch: int = 1,
    name: str | None = None,
    figure: bool = True,
    out: Path | None = None,
    conf: Path | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Tuned:
    """Search settings of a controller with a budget of flights, write the option that was found, and return it.

    overrides: of the cells of a trial, several values as in a sweep. vary: KEY=LOW..HIGH of each setting;
    its default space otherwise. flights: budget. seeds: of a trial, where overrides give none. delay_margin: least
    one (s), for an MPC. seed: of the search. batch: trials drawn together. name: of the option. figure: whether to draw
    the search. out: a folder, tuned/CONTROLLER by default. conf: a configuration folder of your own. force: begin anew.
    progress: numbers of flights done and of all.
    Raises UsageError before anything is flown.
    """
    with session(conf) as composer:
        given = with_seeds(overrides, seeds)
        cells = plan_cells(cells_of(composer, given))
        first = next(iter(cells.values())).cell.config
        trials_of(flights, len(cells))
        axes = tuple(read_axes(vary, first, conf))
        request = Request(tuple(given), axes, first.evaluate.metric, delay_margin, seed, batch)
        out = out or Path("tuned") / first.controller.name
        if force:
            clear(out)
        with opened(first, len(cells)) as engine:
            return search(composer, request, out, flights, name=name, figure=figure, engine=engine, progress=progress)
