"""What can be asked of this program, a function a request: overrides and options in, records out.

The command line prints these records (quadexp/cli), the Python API makes tables of them (quadexp/api.py), so that the
same request goes the same way from both. Only light modules are imported at the top. Common arguments:

overrides: KEY=VALUE. out: where to write. conf: configuration folders of the user's own. force: replace what is there.
progress: called with (done, total). Errors are QuadexpError and its kinds with a one-line message.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from quadexp.errors import UsageError
from quadexp.names import file_name
from quadexp.plugin import advice, brought, service, shipped_places
from quadexp.writer import check_output

if TYPE_CHECKING:
    from quadexp.log.schema import Flight
    from quadexp.parts.options import Folders
    from quadexp.parts.schema import Config

Progress = Callable[[float, float], None]
Overrides = Sequence[str]
FIGURES = 5  # of a usual sweep
SAMPLED = 200  # cells that are looked at for what their flights import
DRAWING = ("matplotlib.backends.backend_svg", "matplotlib.backends.backend_agg")
FOREIGN = (".csv", ".json", ".txt", ".mcap", ".ulg", ".h5")  # formats that a flight is exported to, or imported from
RESULTS = "results.parquet"  # in a folder of results


def quiet(done: float, total: float) -> None:
    """Progress that nobody looks at."""


# ---------------------------------------------------------------------------------------------------------------- fly
class Flown(NamedTuple):
    """A flight, the file it was written to if any, and what to know of it, a line each."""

    flight: Flight
    path: Path | None
    notes: list[str]


def simulate(
    overrides: Overrides = (), out: Path | None = None, conf: Folders = None, *, force: bool = False, keep: bool = False
) -> Flown:
    """Fly one configuration. keep: write the flight, to runs/ where no `out` is given."""
    from quadexp.experiment.evaluate import fly_one
    from quadexp.log.store import write_flight
    from quadexp.parts.compose import session
    from quadexp.report.metrics import declare_parts, measured

    if out is not None and out.suffix in FOREIGN:
        parquet = out.with_suffix(".parquet")
        raise UsageError(f"--out {out}: a flight is written as Parquet; write {parquet}{advice('formats', parquet)}")
    with session(conf) as composer:
        config = composer.compose(overrides, "simulate")
        declare_parts(composer.every("metric"))
    out = Path("runs") / f"{_flight_name(config)}.parquet" if keep and out is None else out
    path = None if out is None else check_output(out, force=force)
    flight = fly_one(config)
    flight.metadata["row"] |= measured(flight)
    if path is not None:
        write_flight(path, flight, force=force)
    about = flight.metadata
    of_margins = brought("services", "margin_texts")
    notes = [about["reference_note"], of_margins.world_note(about["margins"]) if of_margins else ""]
    return Flown(flight, path, [*_of_models([config]), *filter(None, notes)])


class Swept(NamedTuple):
    """A sweep that was flown. result: rows and tables (quadexp/sweeps/sweep.py). metric: of its table. out: its folder.
    files: figures and tables by name. lines: of a paper's own table, none for that of all controllers. notes: what to
    know of it, failed: what was not flown or drawn, a line each. invalid: how many cells contradict themselves."""

    result: Any
    metric: str
    out: Path
    files: dict[str, str]
    lines: Sequence[str]
    notes: list[str]
    failed: list[str]
    invalid: str


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What is asked of `evaluate`; overrides, out, conf, force: see the module.

    sweep: every cell of a sweep, or one cell. figures: None for those of a sweep only. old: cells at `out` flown by
    other sources than these: refuse, fly again, or keep. watch: makes of `out` and of the metric of its table what
    shows the sweep while it runs, a context.
    """

    overrides: Overrides = ()
    out: Path | None = None
    conf: Folders = None
    sweep: bool = True
    figures: bool | None = None
    old: Literal["ask", "refly", "keep"] = "ask"
    force: bool = False
    watch: Callable[[Path, str], Any] | None = None


def evaluate(
    asked: Evaluation,
    progress: Callable[[Any], Any] = lambda below: contextlib.nullcontext(quiet),
    say: Callable[[str], None] = lambda text: None,
) -> Swept:
    """Fly every cell of a sweep, or one cell, and write the tables of results.

    progress: makes the context that shows how far it is; it is handed what makes the table to be shown below, or None.
    say: is given what to know before it is flown.
    """
    from quadexp.parts.compose import Cell, session
    from quadexp.sweeps.server import start_server

    sweep = asked.sweep
    with session(asked.conf) as composer:
        composer.only("evaluate --sweep" if sweep else "evaluate", asked.overrides)
        cells: Sequence[Cell]
        if sweep:
            cells = composer.expand(asked.overrides, check=False)
        else:
            cells = [Cell(composer.compose(asked.overrides), (*asked.overrides,))]
        metrics = composer.every("metric")
    first = cells[0].config
    settings = first.evaluate
    out = asked.out or Path("results") / _results_name(asked.overrides, first, sweep)
    from quadexp.report import paper as papers

    papers.check(settings.figures)
    figures = asked.figures
    if figures is None:
        figures = sweep and brought("services", "sweep_figures") is not None
    drawn_by = service("sweep_figures", "--figures") if figures else None
    sample = cells[:SAMPLED]
    preload = _preload(sample, figures)
    if sweep and first.engine.kind == "local" and not (out / RESULTS).exists():
        start_server(preload)  # which imports these while the modules that follow are imported here

    from quadexp.parts.options import given_folders
    from quadexp.report.metrics import declare_parts
    from quadexp.report.notes import invalid_text
    from quadexp.sweeps.engine import Workers
    from quadexp.sweeps.plan import too_few_seeds
    from quadexp.sweeps.sweep import SweepRequest, run_sweep

    declare_parts(metrics)
    if few := too_few_seeds(getattr(cells, "grids", ()), settings.baseline, settings.confidence):
        say(f"note: {few}")
    drawn: Any = None
    with contextlib.ExitStack() as ended:
        watching: Any = None
        if asked.watch:
            watching = ended.enter_context(asked.watch(out, settings.metric))
        workers = Workers(settings.workers, settings.memory or None, preload, calls=FIGURES if figures else 1)
        processes = ended.enter_context(workers)
        if drawn_by:
            figures_of = drawn_by(out, processes if sweep else None, settings.metric, settings.confidence)
            drawn = ended.enter_context(figures_of)
        counted = ended.enter_context(progress((lambda: watching.snapshot().table().rich()) if watching else None))
        request = SweepRequest(
            metric=settings.metric,
            baseline=settings.baseline,
            confidence=settings.confidence,
            engine=first.engine.build(settings, processes),
            force=asked.force,
            old=asked.old,
            isolate=sweep,
            progress=counted,
            conf=given_folders(asked.conf),
        )
        if watching:
            say(f"watch it in a browser: {watching.path}")
            request = replace(request, progress=watching.before(counted), on_result=watching.on_result)
        if drawn:
            request = replace(request, flown=drawn.begin)
        result = run_sweep(cells, out, request)
        files = result.files | (drawn.end() if drawn else {})
    paper = papers.paper(settings.figures)
    special = papers.write(paper, result.rows, out) if paper and figures and files else {}
    lines = paper.overview(result.rows).lines() if paper and hasattr(paper, "overview") else []
    not_drawn = drawn.failed if drawn else {}
    failed = [f"{name}: not drawn: {why}; the tables are not affected" for name, why in not_drawn.items()]
    if missing := result.not_flown:
        cause = f"{len(missing)} of {len(result.rows)} cells were not flown; the first: {missing[0]['cause']}"
        failed.append(cause)
    notes = [*_of_models([cell.config for cell in cells]), *_doubts(sample), *result.notes]
    invalid = invalid_text(result.rows) if result.invalid else ""
    return Swept(result, settings.metric, out, files | special, lines, notes, failed, invalid)


def _of_models(flown: Sequence[Config]) -> list[str]:
    """Notes on a model that is given and not flown, and on models that were edited after their fit."""
    from quadexp.experiment.identity import edited_models, unused_model

    return [note for note in (unused_model(flown), *edited_models(flown)) if note]


def _doubts(cells: Sequence[Any]) -> list[str]:
    """What references of some cells are below the ground, and drag that their vehicles cannot have."""
    from quadexp.experiment.build import build_trajectory, build_vehicle
    from quadexp.experiment.evaluate import below_ground, ground_height, heavy_drag

    nodes: dict[Any, Config] = {}
    for config in (cell.config for cell in cells if not cell.invalid):
        if config.trajectory.shipped:  # which is a program of its own: built where it is flown
            shared = (config.trajectory, config.vehicle, config.plant)  # by cells that have the same
            nodes.setdefault((*map(id, shared), ground_height(config)), config)
    low = [below_ground(c, build_trajectory(c.trajectory, build_vehicle(c.vehicle))) for c in nodes.values()]
    lines = {line: None for line in (*low, *map(heavy_drag, nodes.values())) if line}
    return [*lines][:3]


def _preload(cells: Sequence[Any], figures: bool) -> list[str]:
    """Modules that the processes of a sweep need."""
    from quadexp.sweeps.server import PRELOAD

    parts = (part for cell in cells for part in (cell.config.trajectory, cell.config.controller))
    needed = {type(part).__module__ for part in parts if part.shipped}
    drawing = [shipped_places("services")["plot_flight"].partition(":")[0], *DRAWING] if figures else []
    return [*PRELOAD, *sorted(needed), *drawing]


def _flight_name(config: Config) -> str:
    from quadexp.parts.schema import controller_name

    speed = getattr(config.trajectory, "speed", None)
    parts = [controller_name(config), config.trajectory.name, "" if speed is None else f"{speed:g}"]
    parts.append(f"seed{config.seed}" if config.seed else "")
    return file_name("_".join(part for part in parts if part))


def _results_name(overrides: Overrides, config: Config, sweep: bool) -> str:
    experiments = [text.partition("=")[2] for text in overrides if text.startswith("experiment=")]
    if experiments:
        return file_name(experiments[-1])
    return "sweep" if sweep else _flight_name(config)


# -------------------------------------------------------------------------------------------------------------- learn
def collect(
    overrides: Overrides,
    out: Path,
    conf: Folders = None,
    *,
    flights: Sequence[Path] = (),
    save_flights: Path | None = None,
    sweep: bool = False,
    force: bool = False,
    progress: Progress = quiet,
) -> dict[str, Any]:
    """Fly for data, or take recorded flights, and write what the rigid body does not explain.

    sweep: in every combination of the worlds given, one after another.
    """
    from quadexp.experiment.collect import collect_dataset
    from quadexp.parts.compose import session

    if sweep and flights:
        raise UsageError(
            "--sweep and --flight: give one of them; recorded flights are of the worlds they were flown in"
        )
    command = "collect --sweep" if sweep else "collect"
    with session(conf) as composer:
        composer.only("collect --flight" if flights else command, overrides)
        worlds = [cell.config for cell in composer.expand(overrides).all_valid_or_raise()] if sweep else []
        config = worlds[0] if worlds else composer.compose(overrides)
    path = check_output(out, force=force)
    if save_flights is not None:
        check_output(save_flights, force=force, folder=True)
    options: dict[str, Any] = {"flights": flights, "worlds": worlds, "save_flights": save_flights}
    return dict(collect_dataset(config, path, **options, force=force, progress=progress))


def fit(
    model: str,
    dataset: Path,
    overrides: Overrides,
    out: Path,
    conf: Folders = None,
    *,
    force: bool = False,
    **options: Any,
) -> dict[str, Any]:
    """Fit a model, an option of the group `model`, to a data set and write the checkpoint; options of
    quadexp/experiment/fit.py."""
    from quadexp.experiment.fit import fit_checkpoint
    from quadexp.parts.compose import session

    with session(conf) as composer:
        config, part = composer.fitted(model, overrides)
    path = check_output(out, force=force, folder=True)
    return dict(fit_checkpoint(part, config, dataset, path, force=force, **options))
