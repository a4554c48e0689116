"""One call that tunes a controller and writes what was found: the option, the history as Parquet, and its figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import quadexp
from quadexp.errors import UsageError
from quadexp.experiment.evaluate import evaluate_cell
from quadexp.experiment.identity import find_model
from quadexp.log.store import write_table
from quadexp.names import sha256_of
from quadexp.parts.compose import session
from quadexp.parts.options import Folders
from quadexp.parts.override import quoted
from quadexp.parts.schema import controller_name
from quadexp.plugins.tune.flights import opened
from quadexp.plugins.tune.preset import check_name, check_place, options_of, write_preset
from quadexp.plugins.tune.search import Request, Search, Trial, best_of, cells_of, with_seeds
from quadexp.plugins.tune.settings import Tune
from quadexp.plugins.tune.space import Axis, overrides, read_axes, settings_of
from quadexp.provenance import libraries, provenance, sources
from quadexp.report.metrics import declare_parts, metric_of
from quadexp.report.text import number, shown
from quadexp.sweeps.engine import CellFunction, Progress
from quadexp.writer import check_output

HISTORY = "history.parquet"


@dataclass(frozen=True)
class Tuned:
    """trials: all, the first one as it was. best: place of the best. choice: overrides that choose what was found.
    flown: what flies it, in any folder. option: its file. record: for --json. lines: what is printed. axes: what was
    varied."""

    trials: Sequence[Trial]
    best: int
    choice: str
    flown: Sequence[str]
    option: Path
    record: Mapping[str, Any]
    lines: Sequence[str]
    axes: Sequence[Axis] = ()

    def rows(self) -> list[dict[str, Any]]:
        """A row a trial: its error (m), lost flights and settings, and whether it is the best."""
        return [
            {"trial": i, "error": trial.worth.error, "lost": trial.worth.lost, "best": i == self.best}
            | {axis.name: number for axis, number in zip(self.axes, trial.numbers, strict=True)}
            for i, trial in enumerate(self.trials)
        ]


def tune(
    seeded: Sequence[str] = (),
    asked: Tune = Tune(),  # noqa: B008 - frozen
    *,
    figure: bool = True,
    out: Path | None = None,
    conf: Folders = None,
    force: bool = False,
    function: CellFunction = evaluate_cell,
    isolate: bool = True,
    progress: Progress = lambda done, total: None,
) -> Tuned:
    """Search settings of a controller with a budget of flights, write the option that was found, and return it.

    seeded: overrides of the cells of a trial, several values as in a sweep. figure: whether to draw the search.
    out: a folder, tuned/CONTROLLER by default. conf: a configuration folder of your own. force: begin anew; the flights
    are kept, for they are named by what they are. function: flies a cell. isolate: False flies in this process.
    Raises UsageError before anything is flown; see also Search.run.
    """
    with session(conf) as composer:
        composer.only("tune", seeded)
        declare_parts(composer.every("metric"))
        seeded = with_seeds(seeded, asked.seeds)
        cells = cells_of(composer, seeded)
        first = cells[0].config
        axes = tuple(read_axes(asked.vary, first))
        request = Request(
            tuple(seeded), axes, first.evaluate.metric, asked.delay_margin, asked.search_seed, asked.batch
        )
        out = out or Path("tuned") / first.controller.name
        with opened(first, len(cells)) as engine:
            search = Search(composer, request, out, engine=engine, function=function, isolate=isolate)
            each = search.flights
            if asked.flights < 2 * each:
                raise UsageError(
                    f"--flights {asked.flights}: a trial takes {each} flights, so {2 * each} are needed at least"
                )
            options = options_of(seeded, first)
            check_name(options, asked.name)
            check_place(out, composer, options, asked.name)
            check_output(out / HISTORY, force=True)
            trials = search.run(asked.flights // each, progress, anew=force)
        best = best_of(trials)
        history = _write_history(out, request, search, trials)
        tuned = (
            composer.expand([*seeded, *overrides(axes, trials[best].numbers)], check=False)
            .all_valid_or_raise()[0]
            .config
        )
        about = _about(request, search, trials, best)
        choice, option = write_preset(out, composer, options, tuned, about, asked.name)
    if figure:
        _draw(trials, request, each, out / "history")
    before = settings_of(axes, trials[0].numbers)
    after = settings_of(axes, trials[best].numbers)
    settings = {key: (before[key], after[key]) for key in before}
    record = {"out": out, **about, "choice": choice, "option": option, "settings": settings, "history": history}
    width = max(map(len, settings))
    changes = [f"  {key:<{width}}  {_short(old)} -> {_short(new)}" for key, (old, new) in settings.items()]
    model = find_model(first)
    flown = choice.split()
    if model and not model.parts:  # those of a sum are settings, which the option holds
        flown.append(f"model={quoted(str(Path(model.path).absolute()))}")
    return Tuned(
        trials, best, choice, flown, option, record, [*_lines(search, trials, best), *changes, str(option)], axes
    )


def _draw(trials: Sequence[Trial], request: Request, flights: int, path: Path) -> None:
    """Geometric mean error of each trial over the flights spent, of `flights` each; crosses: trials with a lost flight;
    hollow: trials with too small a delay margin."""
    from matplotlib import rc_context

    from quadexp.plugins.drawing.style import STYLE, Figure, plain_log, save

    factor, unit = shown(request.metric)
    spent = flights * np.arange(1, len(trials) + 1)
    error = factor * np.array([trial.worth.error for trial in trials])
    best = [best_of(trials[: k + 1]) for k in range(len(trials))]
    completed = np.array([trial.worth.lost == 0 for trial in trials])
    short = completed & np.array([trial.worth.margin < request.least_margin for trial in trials])
    least = f"trial with a delay margin below {1e3 * request.least_margin:g} ms"
    with rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.4))
        panel = figure.subplots()
        panel.plot(spent, np.where(completed & ~short, error, np.nan), "o", ms=3.5, color="#4a6fa5", label="trial")
        if short.any():
            panel.plot(spent, np.where(short, error, np.nan), "o", color="#4a6fa5", fillstyle="none", label=least)
        panel.plot(spent, np.where(completed, np.nan, error), "x", color="#b3261e", label="trial with a lost flight")
        panel.step(spent, error[best], where="post", color="#17191d", label="best so far")
        panel.axhline(error[0], color="#8a9099", linewidth=1.0, linestyle="--", label="before")
        panel.set(yscale="log", xlabel="flights", ylabel=f"{metric_of(request.metric).title} ({unit}), geometric mean")
        plain_log(panel.yaxis)
        panel.legend()
        save(figure, path)


def _short(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(f'{x:.4g}' for x in value)}]"
    return f"{value:.4g}"


def _lines(search: Search, trials: Sequence[Trial], best: int) -> list[str]:
    spent = len(trials) * search.flights
    (factor, unit) = shown(search.request.metric)
    lines = [f"{controller_name(search.config)}: {len(trials)} trials of {search.flights} flights, {spent} in all"]
    for what, worth in (("before", trials[0].worth), ("tuned ", trials[best].worth)):
        margin = f", delay margin {1e3 * worth.margin:.0f} ms" if np.isfinite(worth.margin) else ""
        error = f"{number(factor * worth.error)} {unit}"
        lines.append(f"  {what}  {error}, {worth.lost} of {search.flights} flights lost{margin}")
    if not best:
        lines.append("  nothing better was found: the settings stay as they were")
    if none := sum(trial.worth.lost == search.flights for trial in trials):
        lines.append(f"  {none} of the trials completed no flight: lost, or of settings that contradict each other")
    if trials[best].worth.margin < search.request.least_margin:
        lines.append(f"  no trial has the delay margin of {1e3 * search.request.least_margin:g} ms that is asked for")
    return lines


def _write_history(out: Path, request: Request, search: Search, trials: Sequence[Trial]) -> Path:
    values = np.array([trial.worth.value for trial in trials])
    count = np.arange(len(trials))
    columns = {"trial": count, "flights": search.flights * (count + 1), "value": values}
    columns["best"] = np.minimum.accumulate(values)
    columns |= {
        name: np.array([getattr(trial.worth, name) for trial in trials]) for name in ("error", "lost", "margin")
    }
    for i, axis in enumerate(request.axes):
        columns[axis.name] = np.array([float(trial.numbers[i]) for trial in trials])
    record = {"request": request.record(), "cells": list(request.given), "provenance": provenance()}
    return write_table(out / HISTORY, columns, record, "tuning")


def fingerprint(trials: Sequence[Sequence[float]]) -> str:
    """Hash of the numbers and the value of every trial, 20 hex digits: what a history holds, and an option names."""
    return sha256_of(np.array(trials, float).tobytes())[:20]


def _about(request: Request, search: Search, trials: Sequence[Trial], best: int) -> dict[str, Any]:
    """The provenance of an option. Nothing in it depends on time or machine."""
    first = trials[0].worth
    last = trials[best].worth
    return {
        "cells": [text for text in request.given if not text.startswith(("engine", "evaluate."))],
        "space": [axis.text() for axis in request.axes],
        "budget": f"{len(trials) * search.flights} flights: {len(trials)} trials of {search.flights}",
        "flights": len(trials) * search.flights,
        "metric": request.metric,
        **({"least delay margin": request.least_margin} if request.least_margin else {}),
        "seeds": search.seeds,
        **({"model": search.models} if search.models else {}),
        "search": f"Optuna TPE, seed {request.seed}, batch {request.batch}",
        "before": f"{first.error:.6g} m, {first.lost} lost",
        "tuned": f"{last.error:.6g} m, {last.lost} lost, trial {best}",
        "program": f"quadexp {quadexp.__version__}, sources {sources()}",
        "libraries": libraries(),
        "trials": fingerprint([[*trial.numbers, trial.worth.value] for trial in trials]),
    }
