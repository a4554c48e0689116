"""Commands that fly: `quadexp simulate`, `collect` and `evaluate`. Only light modules are imported here."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from quadexp.cli.command import Answer, Ask, command, single_values
from quadexp.cli.options import Conf, Force, OptionalOut, Out, Overrides
from quadexp.cli.terminal import say
from quadexp.errors import UsageError
from quadexp.files.names import file_name

FIGURES = 5  # of a usual sweep
SAMPLED = 200  # cells that are looked at for what their flights import
DRAWING = ("quadexp.report.flight_figures", "matplotlib.backends.backend_svg", "matplotlib.backends.backend_agg")
NEEDED = {  # kind of a trajectory or controller -> modules, beside those that every flight needs
    "random": ("quadexp.reference.random_polynomial", "quadexp.reference.minimum_snap", "quadexp.reference.time_scale"),
    "file": ("quadexp.reference.from_file",),
    "feedback": ("quadexp.control.feedback.controller",),
}
FOREIGN = (".csv", ".json", ".txt", ".mcap", ".ulg", ".h5")  # formats that a flight is exported to, or imported from


@command
def simulate(overrides: Overrides = None, out: OptionalOut = None, conf: Conf = None, force: Force = False) -> Answer:
    """Fly one configuration and write the flight.

    \b
    quadexp simulate controller=gp_mpc trajectory=circle trajectory.speed=8 model=models/gp seed=0 --out runs/a.parquet
    """
    from quadexp.experiment.checkpoints import unused_model
    from quadexp.experiment.evaluate import fly_one
    from quadexp.files.writer import check_output
    from quadexp.log.store import write_flight
    from quadexp.parts.compose import compose
    from quadexp.report.summary import delays_note, flight_lines, world_note

    if out is not None and out.suffix in FOREIGN:
        parquet = out.with_suffix(".parquet")
        raise UsageError(
            f"--out {out}: a flight is written as Parquet; write {parquet}, then quadexp export {parquet}, which makes"
            " other formats of it"
        )
    config = compose(overrides or [], conf)
    path = check_output(out or Path("runs") / f"{_flight_name(config)}.parquet", force=force)
    flight = fly_one(config)
    write_flight(path, flight, force=force)
    about = flight.metadata
    notes = [unused_model([config]), about["reference_note"], world_note(about["margins"]), delays_note(flight.columns)]
    record = {"path": path, **about["row"], "residual": about["residual"]}
    return Answer(record, [{**about["row"], "path": path}], [*flight_lines(about), path], [*filter(None, notes)])


@command
def collect(
    overrides: Overrides = None,
    out: Out = Path("data/residuals.parquet"),
    flight: Annotated[list[Path] | None, Ask("Use this recorded flight; repeatable.", "PATH")] = None,
    save_flights: Annotated[Path | None, Ask("Write the flights too.", "DIR")] = None,
    sweep: Annotated[bool, Ask("Fly in every combination of the worlds given, one after another.")] = False,
    conf: Conf = None,
    force: Force = False,
) -> Answer:
    """Fly random paths, or take recorded flights, and write the residual: what the rigid body does not explain.

    \b
    quadexp collect plant=simplified collect.duration=300 --out data/residuals.parquet
    quadexp collect --flight runs/a.parquet --flight runs/b.parquet --out data/mine.parquet
    quadexp collect --sweep wind=constant wind.velocity=[0,0,0],[4,0,0] plant.payload=0,0.2 --out data/worlds.parquet
    """
    from quadexp.experiment.collect import collect_dataset
    from quadexp.files.writer import check_output
    from quadexp.parts.compose import session
    from quadexp.progress import Progress

    if sweep and flight:
        raise UsageError(
            "--sweep and --flight: give one of them; recorded flights are of the worlds they were flown in"
        )
    with session(conf) as composer:
        worlds = [cell.config for cell in composer.expand(overrides or []).sound()] if sweep else []
        config = worlds[0] if worlds else composer.compose(overrides or [])
    path = check_output(out, force=force)
    if save_flights is not None:
        check_output(save_flights, force=force, folder=True)
    options: dict[str, Any] = {"flights": flight or [], "worlds": worlds, "save_flights": save_flights}
    with Progress("seconds of flight") as progress:
        report = collect_dataset(config, path, **options, force=force, progress=progress)
    return Answer(report, [single_values(report)], [*report["lines"], path])


@command
def evaluate(
    overrides: Overrides = None,
    sweep: Annotated[bool, Ask("Fly every combination of the values given.", flag="--sweep --multirun -m")] = False,
    out: OptionalOut = None,
    figures: Annotated[
        bool | None, Ask("Draw figures (default: only for a sweep).", flag="--figures/--no-figures")
    ] = None,
    conf: Conf = None,
    refly: Annotated[bool, Ask("Fly cells again that another version of the sources has flown.")] = False,
    keep_old: Annotated[bool, Ask("Keep them in the table, beside new ones.")] = False,
    force: Force = False,
    watch: Annotated[bool, Ask("Show the sweep while it runs: a table here, and a page in a file.")] = False,
) -> Answer:
    """Fly one cell, or every cell of a sweep, and write the table of results.

    An interrupted sweep continues where it stopped; a finished one only prints its table. If cells were flown by
    another version of the program's sources, the command stops and asks for --keep-old or --refly.

    \b
    quadexp evaluate --sweep trajectory=circle,lemniscate trajectory.speed=4,8,12 \\
        controller=nominal_mpc,linear_drag_mpc,gp_mpc,perfect_mpc seed='range(3)' --out results/table1
    quadexp evaluate --sweep experiment=torrente_table1
    quadexp evaluate --sweep experiment=torrente_table1 --watch
    """
    from quadexp.parts.compose import Cell, session
    from quadexp.sweeps.server import start_server

    if refly and keep_old:
        raise UsageError("--refly and --keep-old: give one of them")
    if watch and not sweep:
        raise UsageError("--watch is for a sweep: add --sweep")
    given = list(overrides or [])
    with session(conf) as composer:
        cells = composer.expand(given, check=False) if sweep else [Cell(composer.compose(given), tuple(given))]
    first = cells[0].config
    if not sweep and first.sweep:
        raise UsageError("this experiment is a sweep: add --sweep")
    out = out or Path("results") / _results_name(given, first, sweep)
    figures = sweep if figures is None else figures
    preload = _preload(cells[:SAMPLED], figures)
    if sweep and first.engine.kind == "local" and not (out / "results.parquet").exists():
        start_server(preload)  # which imports these while the modules that follow are imported here

    from quadexp.experiment.checkpoints import unused_model
    from quadexp.progress import Progress
    from quadexp.report.notes import invalid_text
    from quadexp.report.statistics import statistics_csv
    from quadexp.sweeps.engine import Workers
    from quadexp.sweeps.figures import SweepFigures
    from quadexp.sweeps.plan import too_few_seeds
    from quadexp.sweeps.sweep import build_engine, run_sweep
    from quadexp.sweeps.watch import Watch

    settings = first.evaluate
    if few := too_few_seeds(getattr(cells, "grids", ()), settings.baseline, settings.confidence):
        say(f"note: {few}")
    watching = Watch(out, settings.metric) if watch else None
    with (
        watching or contextlib.nullcontext(),
        Workers(settings.workers, settings.memory or None, preload, calls=FIGURES if figures else 1) as processes,
        SweepFigures(out, processes if sweep else None, settings.metric, settings.confidence) as drawn,
        Progress("flights", (lambda: watching.shot().table().rich()) if watching else None) as progress,
    ):
        if watching:
            say(f"watch it in a browser: {watching.path}")
        result = run_sweep(
            cells,
            out,
            metric=settings.metric,
            baseline=settings.baseline,
            confidence=settings.confidence,
            engine=build_engine(first, processes),
            force=force,
            old="refly" if refly else "keep" if keep_old else "ask",
            isolate=sweep,
            progress=progress if watching is None else watching.before(progress),
            landed=watching.landed if watching else lambda row: None,
            flown=drawn.begin if figures else lambda rows, record: None,
        )
        files = dict(result.files) | drawn.end()
    special, table = _of_a_paper(settings.figures, result.rows, out, figures)
    failed = [f"{name}: not drawn: {why}; the tables are not affected" for name, why in drawn.failed.items()]
    if missing := result.not_flown:
        cause = f"{len(missing)} of {len(result.rows)} cells were not flown; the first: {missing[0]['cause']}"
        failed.append(cause)
    invalid = f"{invalid_text(result.rows)}; all of them: quadexp results {out} --failures" if result.invalid else ""
    notes = [unused_model(cell.config for cell in cells), *_doubts(cells), *result.notes, invalid]
    record = {
        "out": out,
        "files": files | special,
        "flown": result.flown,
        "notes": result.notes,
        "not_flown": len(missing),
        "rows": list(result.rows),
        "statistics": result.statistics.record(settings.metric),
    }
    texts = {
        "csv": lambda: statistics_csv(result.statistics.of(settings.metric)),
        "markdown": result.table.markdown,
        "latex": result.table.latex,
    }
    return Answer(record, [], [*table, out] if table else [result.table, out], [*filter(None, notes)], failed, texts)


def _of_a_paper(
    kind: str, rows: Sequence[Mapping[str, Any]], out: Path, figures: bool
) -> tuple[dict[str, str], Sequence[str]]:
    """Figures of an experiment of a paper, and the lines of its table, where that of all controllers has no room."""
    if kind == "ladder":
        from quadexp.report import ladder

        return ladder.draw(rows, out) if figures else {}, ladder.ladder_table(rows).lines()
    if kind == "sun":
        from quadexp.papers.sun import report as sun

        return sun.draw(rows, out) if figures else {}, sun.overview(rows).lines()
    if kind != "standard" and figures:
        from quadexp.papers.lei_li import report as lei_li

        return lei_li.draw(kind, rows, out), []
    return {}, []


def _doubts(cells: Sequence[Any]) -> list[str]:
    """What references of a sweep are below the ground, and drag that its vehicles cannot have, as far as its first
    cells show."""
    from quadexp.experiment.build import build_trajectory, build_vehicle
    from quadexp.experiment.evaluate import below_ground, heavy_drag

    nodes: dict[Any, Any] = {}
    for config in (cell.config for cell in cells[:SAMPLED] if not cell.invalid):
        if config.trajectory.shipped:  # which is a program of its own: built where it is flown
            nodes.setdefault((config.trajectory, config.ground, config.vehicle, config.plant), config)
    found = [below_ground(c, build_trajectory(c.trajectory, build_vehicle(c.vehicle))) for c in nodes.values()]
    named = {line: None for line in (*found, *map(heavy_drag, nodes.values())) if line}
    return [*named][:3]


def _preload(cells: Sequence[Any], figures: bool) -> list[str]:
    """Modules that the processes of a sweep need."""
    from quadexp.sweeps.server import PRELOAD

    kinds = {part.former_kind for cell in cells for part in (cell.config.trajectory, cell.config.controller)}
    found = [*PRELOAD, *(module for kind in sorted(kinds) for module in NEEDED.get(kind, ()))]
    return [*found, *DRAWING] if figures else found


def _flight_name(config: Any) -> str:
    from quadexp.parts.schema import controller_name

    speed = getattr(config.trajectory, "speed", None)
    parts = [controller_name(config), config.trajectory.name, "" if speed is None else f"{speed:g}"]
    parts.append(f"seed{config.seed}" if config.seed else "")
    return file_name("_".join(part for part in parts if part))


def _results_name(given: list[str], config: Any, sweep: bool) -> str:
    experiments = [text.partition("=")[2] for text in given if text.startswith("experiment=")]
    return file_name(experiments[-1] if experiments else "sweep" if sweep else _flight_name(config))
