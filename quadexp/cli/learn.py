"""Commands that learn from flights: `quadexp collect`, `fit`, `identify`, `validate`. Only light modules are imported
at the top."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from quadexp.cli.command import Answer, Ask, Command, Conf, Figures, Force, Out, Overrides, command, single_values
from quadexp.cli.logs import Vehicle
from quadexp.cli.terminal import say
from quadexp.errors import UsageError
from quadexp.names import SPELLINGS, without
from quadexp.progress import Progress

Flights = Annotated[tuple[Path, ...], Ask("Of `quadexp import` or `simulate`.", "FLIGHT")]


# ----------------------------------------------------------------------------------------------------------------- fits
@command
def collect(
    overrides: Overrides = (),
    out: Out = Path("data/residuals.parquet"),
    flight: Annotated[tuple[Path, ...], Ask("Use this recorded flight; repeatable.", "PATH", "--flight")] = (),
    save_flights: Annotated[Path | None, Ask("Write the flights too.", "DIR")] = None,
    sweep: Annotated[bool, Ask("Fly in every combination of the worlds given, one after another.")] = False,
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Fly random paths, or take recorded flights, and write the residual: what the rigid body does not explain.

    \b
    quadexp collect plant=simplified collect.duration=300 --out data/residuals.parquet
    quadexp collect --flight runs/a.parquet --flight runs/b.parquet --out data/mine.parquet
    quadexp collect --sweep wind=constant wind.velocity=[0,0,0],[4,0,0] truth.mass=1,1.2 --out data/worlds.parquet
    """
    from quadexp import requests

    with Progress("seconds of flight") as progress:
        report = requests.collect(
            overrides, out, conf, flights=flight, save_flights=save_flights, sweep=sweep, force=force, progress=progress
        )
    return Answer(report, [single_values(report)], [*report["lines"], out])


DataSet = Annotated[Path, Ask("Data set of `quadexp collect`.", "DATASET")]
After = Annotated[Path | None, Ask("Checkpoint that explains a part; the rest is fitted, for a sum of the two.")]


def _models(context: typer.Context, incomplete: str) -> list[str]:
    from quadexp.parts.options import groups

    options = groups(context.params.get("conf"))["model"]
    return [option for option in options if option.startswith(incomplete)]


FitFigures = Annotated[bool, Ask("Draw the fit.", flag="--figures/--no-figures")]
FIT_OUT = Ask("Where to write; models/MODEL unless given.", "PATH", "--out -o")


@command
def fit(
    model: Annotated[str, Ask("An option of the group `model`.", "MODEL", complete=_models)],
    dataset: DataSet,
    overrides: Overrides = (),
    out: Annotated[Path | None, FIT_OUT] = None,
    figures: FitFigures = True,
    after: After = None,
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Fit a model of the air to a data set and write the checkpoint.

    \b
    quadexp fit gaussian_process data/residuals.parquet --out models/gp
    quadexp fit gp_per_axis data/residuals.parquet model.inducing=40 --out models/gp40
    quadexp fit neural data/residuals.parquet model.hidden=[24,24] model.spectral=8
    """
    return _fit(model, dataset, overrides, out, figures, after, conf, force)


def _fit(
    model: str, dataset: Path, overrides: Sequence[str], out: Path | None, figures: bool, after: Path | None,
    conf: Sequence[Path], force: bool,
) -> Answer:  # fmt: skip
    from quadexp import requests

    place = out or Path("models") / model
    with Progress("fit") as progress:
        report = requests.fit(
            model, dataset, overrides, place, conf, force=force, progress=progress, figures=figures, after=after
        )
    return Answer(report, report["rows"], [*report["lines"], place])


def _spelling(word: str) -> Command:
    """`quadexp fit-WORD`, another spelling of `quadexp fit`."""

    def fit_word(
        dataset: DataSet,
        overrides: Overrides = (),
        out: Annotated[Path | None, FIT_OUT] = None,
        figures: FitFigures = True,
        after: After = None,
        conf: Conf = (),
        force: Force = False,
    ) -> Answer:
        return _fit(word, dataset, overrides, out, figures, after, conf, force)

    fit_word.__name__ = f"fit_{word}"
    fit_word.__doc__ = (
        f"Fit {SPELLINGS[word]}: `quadexp fit {SPELLINGS[word]}`.\n\n"
        f"\\b\nquadexp fit-{word} data/residuals.parquet --out models/{word}"
    )
    return command(fit_word)


fit_gp, fit_drag, fit_nn = map(_spelling, SPELLINGS)


# ------------------------------------------------------------------------------------------------------- identification
Method = Literal["rls", "regression", "delays"]
CURVES = {"auto": None, "s": (1,), "s2": (2,), "s+s2": (1, 2)}
CURVE = "Terms of the thrust curve on motor commands; auto: chosen on flights left out, with the voltage."
# Options that not every method has.
OPTIONS = {"rls": ("out", "force"), "regression": ("out", "force", "curve", "radius", "figures"), "delays": ("figure",)}


@command
def identify(
    context: typer.Context,
    flights: Flights,
    out: Annotated[Path, Ask("Where to write.", "DIR", "--out -o")] = Path("data/estimates"),
    method: Annotated[Method | None, Ask("rls where rotor speeds and geometry are known.")] = None,
    vehicle: Vehicle = None,
    curve: Annotated[Literal["auto", "s", "s2", "s+s2"], Ask(CURVE, flag="--thrust-curve")] = "auto",
    radius: Annotated[float | None, Ask("Rotor radius for the induced velocity.", "M", "--rotor-radius")] = None,
    figures: Figures = True,
    figure: Annotated[Path | None, Ask("delays: draw the search, as SVG and PNG.")] = None,
    verbose: Annotated[bool, Ask("Print all that was found, as `quadexp show` does.")] = False,
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Identify a vehicle from its flights: thrust curve, drag, blade-element coefficients, with 95 % intervals.

    --method rls: recursive least squares, flight by flight, for flights with rotor speeds of a vehicle whose rotors are
    known; gives time series of C_d0, C_la and C_D, one file a flight. --method regression: all other flights together;
    gives a vehicle model, a folder that collect, validate and evaluate read. --method delays: age of the estimate, dead
    time of the commands and lag of the motors, with the settings to give; writes nothing but --figure.

    \b
    quadexp identify flights/a.parquet flights/b.parquet --out models/crazyflie
    quadexp identify runs/a.parquet --out data/estimates        # simulated with vehicle=lei_li plant=blade_element
    quadexp identify --method delays runs/a.parquet
    """
    from quadexp import requests

    report = requests.identify(
        flights, out, conf, chosen=partial(_accepted, context), method=method, vehicle=vehicle, figures=figures,
        settings={"powers": CURVES[curve], "radius": radius}, figure=figure, force=force,
    )  # fmt: skip
    taken = report["method"]
    record = without(report, ("lines", "main"))
    if taken == "delays":
        rows = [{**flight, "overrides": " ".join(flight["overrides"])} for flight in report["flights"]]
        return Answer({"method": taken, "flights": report["flights"]}, rows, report["lines"])
    if taken == "rls":
        rows = [row for flight in report["flights"] for row in _of_flight(flight)]
        return Answer(record, rows, report["lines"])
    rows = [{"model": name, **row} for name, model_rows in report["models"].items() for row in model_rows]
    return Answer(record, rows, [*report["lines" if verbose else "main"], out])


def _accepted(context: typer.Context, method: str, reason: str) -> None:
    """Say which method is taken; UsageError for an option on the command line that it does not have."""
    for option in context.command.params:
        having = [other for other, names in OPTIONS.items() if option.name in names]
        source = context.get_parameter_source(str(option.name))
        if having and method not in having and source is not None and source.name == "COMMANDLINE":
            raise UsageError(f"identify {option.opts[0]}: is for --method {' or '.join(having)}, not {method}")
    if method != "delays":
        say(f"{method}: {reason}")


def _of_flight(record: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The coefficients identified in one flight, a row each."""
    intervals = record.get("interval_95", {})
    return [
        {
            "flight": record["flight"], "coefficient": name, "value": value,
            "low": intervals.get(name, [None, None])[0], "high": intervals.get(name, [None, None])[1],
            "recursion": record["recursion"][name], "path": record["path"],
        }
        for name, value in record["estimates"].items()
    ]  # fmt: skip


@command
def validate(
    words: Annotated[tuple[str, ...], Ask("Folders of `quadexp identify` or `fit`.", "MODEL")],
    flights: Annotated[tuple[Path, ...], Ask("Flights to predict; several may follow.", "FLIGHT", "--flights")] = (),
    horizons: Annotated[str, Ask("Horizons of the open-loop predictions (s).", "S,S,...")] = "0.1,0.5,1",
    leave_one_out: Annotated[bool, Ask("Predict each flight by models refitted to all the others.")] = False,
    out: Annotated[Path | None, Ask("Write report and figures there.", "DIR", "--out -o")] = None,
    figures: Annotated[bool, Ask("Draw figures (with --out).", flag="--figures/--no-figures")] = True,
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Compare what models predict with what flights did: sample by sample, and open loop from many start points.

    The vehicle is the flights' own unless vehicle=NAME is given.

    \b
    quadexp validate models/crazyflie models/gp --flights flights/c.parquet --out results/validation
    quadexp validate models/crazyflie --flights flights/a.parquet flights/b.parquet flights/c.parquet --leave-one-out
    """
    from quadexp.experiment import validate as validation
    from quadexp.experiment.vehicle_of import config_for

    overrides = [text for text in words if "=" in text]
    paths = [Path(text) for text in words if "=" not in text]
    tested = [*flights, *(path for path in paths if path.suffix == ".parquet")]
    models = [path for path in paths if path.suffix != ".parquet"]
    if not tested:
        raise UsageError("validate: no flight given; add --flights FLIGHT...")
    try:
        seconds = [float(text) for text in horizons.split(",")]
    except ValueError:
        raise UsageError(f"--horizons: '{horizons}' must be numbers of seconds with commas between") from None
    config = config_for(tested, overrides, conf)
    with Progress("validate") as progress:
        report = validation.validate(
            models, tested, config, horizons=seconds, leave_one_out=leave_one_out, out=out, figures=figures,
            force=force, progress=progress,
        )  # fmt: skip
    record = {key: value for key, value in report.items() if key != "lines"}
    return Answer(record, report["rows"], [*report["lines"], *([out] if out else [])])
