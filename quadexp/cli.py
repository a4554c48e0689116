"""The command line: parse, compose the configuration, call one function, print where the result lies.

Only typer and light modules are imported here; the rest inside the commands, so that --help is there at once.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from quadexp import __version__
from quadexp.cli_check import check
from quadexp.cli_identify import identify
from quadexp.cli_import import import_flights
from quadexp.cli_results import results
from quadexp.cli_validate import validate
from quadexp.completion import complete
from quadexp.errors import QuadexpError
from quadexp.terminal import emit, guarded, print_table, say

app = typer.Typer(
    name="quadexp",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)

Overrides = Annotated[
    list[str] | None,
    typer.Argument(metavar="KEY=VALUE", help="Settings, such as trajectory.speed=8", autocompletion=complete),
]
Out = Annotated[Path | None, typer.Option("--out", "-o", metavar="PATH", help="Where to write.")]
Conf = Annotated[Path | None, typer.Option("--conf", metavar="DIR", help="A configuration folder of your own.")]
Force = Annotated[bool, typer.Option("--force", "-f", help="Replace what is there.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


def _version(wanted: bool) -> None:
    if wanted:
        print(f"quadexp {__version__}")
        raise typer.Exit()


def _debug(wanted: bool) -> None:
    if wanted:
        os.environ["QUADEXP_DEBUG"] = "1"


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", callback=_debug, help="Show where an error came from.")] = False,
) -> None:
    """Fly, learn, compare: aerodynamics-aware quadrotor control, side by side on one simulation.

    \b
    quadexp simulate    one flight                          -> runs/*.parquet
    quadexp collect     flights for learning                -> data/residuals.parquet
    quadexp fit-gp      Gaussian processes from a data set  -> models/gp
    quadexp identify    thrust, drag and air from flights   -> models/*
    quadexp evaluate    controllers compared                -> results/*
    quadexp report      results as one page                 -> report.html
    """


@app.command()
@guarded
def simulate(
    overrides: Overrides = None, out: Out = None, conf: Conf = None, force: Force = False, json: Json = False
) -> None:
    """Fly one configuration and write the flight.

    \b
    quadexp simulate controller=gp_mpc trajectory=circle trajectory.speed=8 model=models/gp seed=0 --out runs/a.parquet
    """
    from quadexp.compose import compose
    from quadexp.experiment.evaluate import fly_one
    from quadexp.flight.store import check_output, write_flight
    from quadexp.report.summary import flight_lines

    config = compose(overrides or [], conf)
    path = check_output(out or Path("runs") / f"{_flight_name(config)}.parquet", force=force)
    flight = fly_one(config)
    write_flight(path, flight)
    if json:
        emit({"path": path, **flight.metadata["row"], "residual": flight.metadata["residual"]})
        return
    if flight.metadata["reference_note"]:
        say(f"note: {flight.metadata['reference_note']}")
    print("\n".join([*flight_lines(flight.metadata), str(path)]))


@app.command()
@guarded
def collect(
    overrides: Overrides = None,
    out: Out = Path("data/residuals.parquet"),
    flight: Annotated[
        list[Path] | None, typer.Option("--flight", metavar="PATH", help="Use this recorded flight; repeatable.")
    ] = None,
    save_flights: Annotated[
        Path | None, typer.Option("--save-flights", metavar="DIR", help="Write the flights too.")
    ] = None,
    conf: Conf = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Fly for data, or take recorded flights, and write what the rigid body does not explain.

    \b
    quadexp collect plant=simplified collect.duration=300 --out data/residuals.parquet
    quadexp collect --flight runs/a.parquet --flight runs/b.parquet --out data/mine.parquet
    """
    from quadexp.compose import compose
    from quadexp.experiment.collect import collect_dataset
    from quadexp.flight.store import check_output
    from quadexp.progress import Progress

    config = compose(overrides or [], conf)
    path = check_output(out, force=force)  # type: ignore[arg-type]
    if save_flights is not None:
        check_output(save_flights, force=force, folder=True)
    with Progress("seconds of flight") as progress:
        report = collect_dataset(config, path, flights=flight or [], save_flights=save_flights, progress=progress)
    if json:
        emit(report)
        return
    print("\n".join([*report["lines"], str(path)]))


@app.command("fit-gp")
@guarded
def fit_gp(
    dataset: Annotated[Path, typer.Argument(help="Data set of `quadexp collect`.")],
    overrides: Overrides = None,
    out: Out = Path("models/gp"),
    figures: Annotated[bool, typer.Option("--figures/--no-figures", help="Draw the fit.")] = True,
    compare: Annotated[
        bool, typer.Option("--compare", help="Also compare numbers of inducing points and methods (minutes).")
    ] = False,
    conf: Conf = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Fit Gaussian processes to a data set and write the checkpoint.

    \b
    quadexp fit-gp data/residuals.parquet --out models/gp
    quadexp fit-gp data/residuals.parquet gp=per_axis gp.inducing=40 --out models/gp40
    """
    _fit("gp", dataset, overrides, out, conf, force, json, figures=figures, compare=compare)


@app.command("fit-drag")
@guarded
def fit_drag(
    dataset: Annotated[Path, typer.Argument(help="Data set of `quadexp collect`.")],
    overrides: Overrides = None,
    out: Out = Path("models/drag"),
    conf: Conf = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Fit linear rotor drag to a data set and write the checkpoint.

    \b
    quadexp fit-drag data/residuals.parquet --out models/drag
    """
    _fit("drag", dataset, overrides, out, conf, force, json)


def _fit(
    kind: str,
    dataset: Path,
    overrides: list[str] | None,
    out: Path | None,
    conf: Path | None,
    force: bool,
    json: bool,
    **options: bool,
) -> None:
    from quadexp.compose import compose
    from quadexp.experiment.fit import fit_checkpoint
    from quadexp.flight.store import check_output
    from quadexp.progress import Progress

    config = compose(overrides or [], conf)
    path = check_output(out, force=force, folder=True)  # type: ignore[arg-type]
    with Progress("fit") as progress:
        report = fit_checkpoint(kind, config, dataset, path, force=force, progress=progress, **options)
    if json:
        emit(report)
        return
    print("\n".join([*report["lines"], str(path)]))


@app.command()
@guarded
def evaluate(
    overrides: Overrides = None,
    sweep: Annotated[bool, typer.Option("--sweep", help="Fly every combination of the values given.")] = False,
    out: Out = None,
    figures: Annotated[
        bool | None, typer.Option("--figures/--no-figures", help="Draw figures (a sweep does unless told).")
    ] = None,
    conf: Conf = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Fly one cell, or every cell of a sweep, and write the table of results.

    A sweep that was interrupted goes on where it stopped; one that is done only prints its table.

    \b
    quadexp evaluate --sweep trajectory=circle,lemniscate trajectory.speed=4,8,12 \\
        controller=nominal_mpc,linear_drag_mpc,gp_mpc,perfect_mpc seed='range(3)' --out results/table1
    quadexp evaluate --sweep experiment=torrente_table1
    """
    from quadexp.compose import Cell, session
    from quadexp.errors import UsageError
    from quadexp.experiment.engines import build_engine
    from quadexp.experiment.sweep import run_sweep
    from quadexp.progress import Progress

    given = list(overrides or [])
    with session(conf) as composer:
        cells = composer.expand(given) if sweep else [Cell(composer.compose(given), tuple(given))]
    first = cells[0].config
    if not sweep and first.sweep:
        raise UsageError("this experiment is a sweep: add --sweep")
    out = out or Path("results") / _results_name(given, first, sweep)
    with Progress("flights") as progress:
        result = run_sweep(
            cells,
            out,
            metric=first.evaluate.metric,
            baseline=first.evaluate.baseline,
            confidence=first.evaluate.confidence,
            engine=build_engine(first),
            force=force,
            isolate=sweep,
            progress=progress,
        )
    files = dict(result.files)
    if sweep if figures is None else figures:
        from quadexp.report.figures import draw_results

        files |= draw_results(
            result.rows,
            out,
            metric=first.evaluate.metric,
            confidence=first.evaluate.confidence,
            redraw=result.flown > 0,
        )
        if first.evaluate.figures != "standard":
            from quadexp.report import lei_li

            files |= lei_li.draw(first.evaluate.figures, result.rows, out)
    if json:
        emit(
            {
                "out": out,
                "files": files,
                "flown": result.flown,
                "not_flown": len(result.not_flown),
                "rows": list(result.rows),
                "statistics": result.statistics.record(first.evaluate.metric),
            }
        )
    else:
        print_table(result.table)
        print(out)
    if result.not_flown:
        worst = result.not_flown[0]
        raise QuadexpError(
            f"{len(result.not_flown)} of {len(result.rows)} cells were not flown; the first: {worst['cause']}"
        )


@app.command()
@guarded
def show(
    path: Annotated[Path, typer.Argument(help="A flight, data set, checkpoint folder, or results.")],
    json: Json = False,
) -> None:
    """Say what is in a file: its kind, configuration, units, seed, versions, size.

    \b
    quadexp show runs/a.parquet
    quadexp show models/gp
    """
    from quadexp.report.summary import summarise

    summary = summarise(path)
    if json:
        emit({key: value for key, value in summary.items() if key != "lines"})
    else:
        print("\n".join(summary["lines"]))


app.command("check")(check)
app.command("identify")(identify)
app.command("import")(import_flights)
app.command("results")(results)
app.command("validate")(validate)


@app.command("compare")
@guarded
def compare_two(
    a: Annotated[Path, typer.Argument(help="A flight, results folder, or checkpoint folder.")],
    b: Annotated[Path, typer.Argument(help="Another one of the same kind.")],
    json: Json = False,
) -> None:
    """Say what differs between two flights, results or checkpoints: configuration, outcome, figures.

    \b
    quadexp compare runs/a.parquet runs/b.parquet
    quadexp compare results/table1 results/table1_again
    """
    from quadexp.report.compare import compare

    report = compare(a, b)
    if json:
        emit({key: value for key, value in report.items() if key != "lines"})
    else:
        print("\n".join(report["lines"]))


@app.command()
@guarded
def report(
    results: Annotated[Path, typer.Argument(help="Results folder of `quadexp evaluate --sweep`.")],
    out: Out = Path("report.html"),
    figures: Annotated[
        Path | None, typer.Option("--figures", metavar="DIR", help="Write the figures as PDF too, for a paper.")
    ] = None,
    baseline: Annotated[
        str | None, typer.Option("--baseline", metavar="CONTROLLER", help="Whom the others are compared with.")
    ] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Write a comparison as one page that opens without a network: answer, tables, figures, replay, provenance.

    \b
    quadexp report results/table1 --out report.html
    quadexp report results/table1 --out report.html --figures paper/figures
    """
    from quadexp.report.page import make_report

    made = make_report(results, out, figures=figures, baseline=baseline, force=force)  # type: ignore[arg-type]
    if json:
        emit(made)
        return
    print("\n".join([*made["answer"], made["note"], *map(str, made["figures"].values()), str(made["path"])]))


@app.command()
@guarded
def export(
    flight: Annotated[Path, typer.Argument(help="A flight of `quadexp simulate`, or of a sweep.")],
    to: Annotated[str, typer.Option("--to", metavar="FORMAT", help="csv, tum, px4csv, mcap or rerun.")],
    out: Out = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Write a flight for other programs; mcap and rerun need the extra [viz].

    \b
    quadexp export runs/a.parquet --to rerun --out a.rrd
    quadexp export runs/a.parquet --to px4csv --out a_px4
    """
    from quadexp.flight.exporters import export_flight

    files = export_flight(flight, to, out, force=force)
    if json:
        emit({"format": to, "files": files})
        return
    print("\n".join(map(str, files.values())))


def _flight_name(config: Any) -> str:
    speed = getattr(config.trajectory, "speed", None)
    parts = [config.controller.name, config.trajectory.name, "" if speed is None else f"{speed:g}"]
    parts.append(f"seed{config.seed}" if config.seed else "")
    return "_".join(part for part in parts if part)


def _results_name(given: list[str], config: Any, sweep: bool) -> str:
    experiments = [text.partition("=")[2] for text in given if text.startswith("experiment=")]
    return experiments[-1] if experiments else "sweep" if sweep else _flight_name(config)


def main() -> None:
    """Entry point: wrong options too are one line and exit code 2."""
    try:
        code = app(standalone_mode=False, prog_name="quadexp")
    except typer.Abort:
        code = 1
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        if type(error).__name__ == "NoArgsIsHelpError":
            error.show()  # type: ignore[attr-defined]
            code = 2
        else:
            typer.secho(f"error: {error.format_message()}", fg="red", err=True)
            code = getattr(error, "exit_code", 2)
    sys.exit(code if isinstance(code, int) else 0)


if __name__ == "__main__":
    main()
