"""The search: Optuna's tree-structured Parzen estimator, an equal number of flights for every controller.

A trial is one set of settings, flown in all cells (worlds, trajectories, speeds, seeds). The first trial is the option
as it is. The draws of a trial depend on the seed, its number and the trials before its batch, and the flights are cells
of a sweep. So a search that was interrupted, or whose budget was raised, begins anew from its first trial, and flies
only what is not there. Workers and engines have no part in it.
"""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError, UsageError, WriteError
from quadexp.experiment.build import build_trajectory, build_vehicle
from quadexp.experiment.evaluate import check_feasible, evaluate_cell
from quadexp.experiment.identity import canonical, digest
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_record, read_text
from quadexp.parts.cells import Cell
from quadexp.parts.compose import Composer
from quadexp.parts.schema import PRESETS, Config
from quadexp.plugins.tune.objective import LOST, Worth, worth
from quadexp.plugins.tune.space import TUNED, Axis, overrides
from quadexp.provenance import sources
from quadexp.sweeps.engine import CellFunction, Engine
from quadexp.sweeps.plan import plan_cells
from quadexp.sweeps.sweep import fly_cells, flying
from quadexp.writer import write_text

FIRST_SEED = 1_000_000  # of the flights that tune, far from those that evaluate
STARTUP = 10  # trials drawn at random, the first one aside
REQUEST = "search.json"  # in the folder: what decides the trials beside the flights
EXTRA = "pip install 'quadexp[tune]'"


@dataclass(frozen=True)
class Trial:
    """numbers: one for each axis. worth: see objective."""

    numbers: tuple[float, ...]
    worth: Worth


@dataclass(frozen=True)
class Request:
    """What is searched for. given: overrides of the cells. least_margin: delay margin (s), 0 for none. seed: of the
    draws. batch: trials that are drawn before their flights are known, and flown together."""

    given: tuple[str, ...]
    axes: tuple[Axis, ...]
    metric: str = "mean_error"
    least_margin: float = 0.0
    seed: int = 0
    batch: int = 1

    def record(self) -> dict[str, Any]:
        """What decides the trials beside the flights."""
        return {
            "space": [axis.text() for axis in self.axes],
            "start": [axis.start for axis in self.axes],
            "metric": self.metric,
            "least delay margin": self.least_margin,
            "seed": self.seed,
            "batch": self.batch,
            "sources": sources(),
        }


def with_seeds(overrides: Sequence[str], seeds: int) -> list[str]:
    """The overrides, with seeds that no evaluation has, where none are given."""
    if any(text.startswith("seed=") for text in overrides):
        return list(overrides)
    return [*overrides, f"seed=range({FIRST_SEED},{FIRST_SEED + seeds})"]


def cells_of(composer: Composer, overrides: Sequence[str]) -> list[Cell]:
    """The cells of a trial; raises UsageError where they are of several controllers, or cannot be flown."""
    cells = composer.expand(overrides, check=False)
    for grid in cells.grids:
        several = []
        for texts in grid:
            if len(texts) > 1:
                several.append(texts[0].partition("=")[0])
        if wrong := [key for key in several if key.partition(".")[0] in (*TUNED, *PRESETS, "remedies")]:
            raise UsageError(f"{wrong[0]}: has several values; one controller is tuned at a time")
    valid_cells = cells.all_valid_or_raise()
    nodes = {canonical([repr(getattr(cell.config, group)) for group in TUNED]) for cell in valid_cells}
    if len(nodes) > 1:
        raise UsageError("the cells are of several controllers; one is tuned at a time")
    for config in (cell.config for cell in valid_cells):
        vehicle = build_vehicle(config.vehicle)
        check_feasible(config, build_trajectory(config.trajectory, vehicle), vehicle)
    return valid_cells


class Search:
    """A search in a folder, begun or continued.

    function: flies a cell. isolate: False flies in this process. models, seeds: of its cells.
    Raises UsageError for a folder of another search.
    """

    def __init__(
        self,
        composer: Composer,
        request: Request,
        out: str | Path,
        *,
        engine: Engine | None = None,
        function: CellFunction = evaluate_cell,
        isolate: bool = True,
    ) -> None:
        self.request = request
        self.store = CellStore(out)
        self._composer = composer
        self._engine = engine
        self._function = function
        self._isolate = isolate
        jobs = plan_cells(cells_of(composer, request.given))
        self._cells = [job.cell for job in jobs.values()]
        configs = [cell.config for cell in self._cells]
        self._durations = [float(build_trajectory(c.trajectory, build_vehicle(c.vehicle)).duration) for c in configs]
        self._asked = {"cells": digest([*jobs]), **request.record()}
        models = {job.model for job in jobs.values() if job.model}
        self.models = sorted(f"{model.path}, sha256 {model.sha256[:20]}" for model in models)
        self.seeds = sorted({cell.config.seed for cell in self._cells})

    @property
    def flights(self) -> int:
        """Of a trial."""
        return len(self._cells)

    @property
    def config(self) -> Config:
        """Of the first cell, before anything is varied."""
        return self._cells[0].config

    def run(
        self, trials: int, progress: Callable[[int, int], None] = lambda done, total: None, *, anew: bool = False
    ) -> list[Trial]:
        """The first `trials` trials, those flown that are not there. progress: numbers of flights done and of all.
        anew: forget which search was begun in the folder.

        Raises QuadexpError where the option as it is cannot be flown, SweepInterrupted on Ctrl-C; what is done is kept.
        """
        done: list[Trial] = []
        with flying(self.store, lambda: f"{len(done)} of {trials} trials done"), _quiet():
            import optuna

            if not anew:
                self._check_request()
            study = optuna.create_study(direction="minimize")
            study.enqueue_trial({axis.name: axis.start for axis in self.request.axes})
            while len(done) < trials:
                # The whole batch is asked for before any of it is flown, also where the budget ends in it.
                batch = [self._ask(study, len(done) + i) for i in range(self.request.batch)]
                for asked in batch[: trials - len(done)]:
                    numbers = tuple(
                        axis.start if asked.params[axis.name] == axis.start else axis.rounded(asked.params[axis.name])
                        for axis in self.request.axes
                    )
                    result = self._fly(numbers, first=not done)
                    study.tell(asked, result.value)
                    done.append(Trial(numbers, result))
                    progress(len(done) * self.flights, trials * self.flights)
                write_text(self.store.root / REQUEST, json.dumps(self._asked, indent=1) + "\n")
        return done

    def _check_request(self) -> None:
        """Raise UsageError where another search was begun in the folder."""
        text = read_text(self.store.root / REQUEST)
        begun = self._asked if text is None else json.loads(text)
        if wrong := [name for name, value in self._asked.items() if begun.get(name) != value]:
            was = "" if wrong[0] == "cells" else f" ({begun.get(wrong[0])}, now {self._asked[wrong[0]]})"
            raise UsageError(
                f"{self.store.root}: holds a search with other {wrong[0]}{was}: choose another --out, or pass --force"
                " to begin anew"
            )

    def _ask(self, study: Any, index: int) -> Any:
        """Optuna's trial of this number, with a value for every axis."""
        from optuna.samplers import TPESampler

        draws = int(np.random.SeedSequence([self.request.seed, index]).generate_state(1)[0])
        study.sampler = TPESampler(seed=draws, multivariate=True, n_startup_trials=STARTUP)
        trial = study.ask()
        for axis in self.request.axes:
            if axis.whole:
                trial.suggest_int(axis.name, int(axis.low), int(axis.high), log=axis.log)
            else:
                trial.suggest_float(axis.name, axis.low, axis.high, log=axis.log)
        return trial

    def _fly(self, numbers: Sequence[float], first: bool) -> Worth:
        """The worth of one trial; settings that contradict each other count as flights that were lost at the start."""
        request = self.request
        least = self.request.least_margin
        texts = [*request.given, *overrides(request.axes, numbers)]
        cells = self._composer.expand(texts, check=False)
        try:
            rows = fly_cells(
                cells.all_valid_or_raise(), self.store, self._engine, function=self._function, isolate=self._isolate
            )
        except UsageError as error:
            if first or isinstance(error, WriteError):
                raise
            return Worth(2 * LOST * (2 if least else 1), np.nan, self.flights, np.nan)
        if first and (broken := [row for row in rows if row["outcome"] in ("failed", "infeasible")]):
            raise QuadexpError(f"{request.given[0]} cannot be flown as it is: {broken[0]['cause']}")
        known = []
        for row in rows:
            if least and row["outcome"] != "failed":
                margins = read_record(self.store.path(row["key"]), "flight").get("margins") or {}
                known += [float(margins["delay"])] if "delay" in margins else []
        if first and least and not known:
            raise UsageError(f"--delay-margin: none is known of {self.config.controller.name}")
        return worth(rows, self._durations, metric=request.metric, margins=known, least_margin=least)


def best_of(trials: Sequence[Trial]) -> int:
    """Place of the first of the best trials."""
    return min(range(len(trials)), key=lambda i: trials[i].worth.value)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without what Optuna says of its progress and of what is new in it."""
    try:
        import optuna
    except ImportError:
        raise UsageError(f"`quadexp tune` needs optuna, which is not installed: {EXTRA}") from None
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            yield
    finally:
        optuna.logging.set_verbosity(before)
