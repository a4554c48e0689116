"""Commands that learn from recorded flights: `quadexp identify`, `validate`. Only light modules are imported at the
top."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from quadexp.cli.command import Answer, Ask, Conf, Figures, Force, command
from quadexp.cli.terminal import say
from quadexp.errors import UsageError
from quadexp.names import without
from quadexp.progress import Progress

HEADING = "Learn"
Flights = Annotated[tuple[Path, ...], Ask("Of `quadexp import` or `simulate`.", "FLIGHT")]

# ------------------------------------------------------------------------------------------------------- identification
Method = Literal["rls", "regression", "delays", "torque"]
CURVES = {"auto": None, "s": (1,), "s2": (2,), "s+s2": (1, 2)}
CURVE = "Terms of the thrust curve on motor commands; auto: chosen on flights left out, with the voltage."
# Options that not every method has.
OPTIONS = {"rls": ("out", "force"), "regression": ("out", "force", "curve", "radius", "figures"), "delays": ("figure",)}


@command
def identify(
    context: typer.Context,
    flights: Flights,
    out: Annotated[Path, Ask("Where to write.", "DIR", "--out -o")] = Path("data/estimates"),
    method: Annotated[Method | None, Ask("Default: rls if rotor speeds and geometry are known.")] = None,
    vehicle: Annotated[str | None, Ask("Vehicle of the configuration, instead of the flight's.", "NAME")] = None,
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
    time of the commands and lag of the motors, with the settings to give; writes nothing but --figure. --method torque:
    gain of the rotors' torque beside the vehicle file, and what it explains on flights left out; writes nothing.

    \b
    quadexp identify flights/a.parquet flights/b.parquet --out models/crazyflie
    quadexp identify runs/a.parquet --out data/estimates        # simulated with vehicle=lei_li plant=blade_element
    quadexp identify --method delays runs/a.parquet
    quadexp identify --method torque flights/a.parquet flights/b.parquet
    """
    from quadexp.plugins.identification import requests

    report = requests.identify(
        flights, out, conf, chosen=partial(_accepted, context), method=method, vehicle=vehicle, figures=figures,
        settings={"powers": CURVES[curve], "radius": radius}, figure=figure, force=force,
    )  # fmt: skip
    lines = report["main"] if "main" in report and not verbose else report["lines"]
    return Answer(without(report, ("rows", "lines", "main")), report["rows"], lines)


def _accepted(context: typer.Context, method: str, reason: str) -> None:
    """Say which method is taken; UsageError for an option on the command line that it does not have."""
    for option in context.command.params:
        having = [other for other, names in OPTIONS.items() if option.name in names]
        if not having or method in having:
            continue
        source = context.get_parameter_source(str(option.name))
        if source is not None and source.name == "COMMANDLINE":
            raise UsageError(f"identify {option.opts[0]}: is for --method {' or '.join(having)}, not {method}")
    if method not in ("delays", "torque"):
        say(f"{method}: {reason}")


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
    from quadexp.plugins.identification import validate as validation
    from quadexp.plugins.identification.config_for import config_for

    overrides = []
    models = []
    tested = list(flights)
    for text in words:
        if "=" in text:
            overrides.append(text)
        elif Path(text).suffix == ".parquet":
            tested.append(Path(text))
        else:
            models.append(Path(text))
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
    lines = report["lines"]
    if out is not None:
        lines = [*lines, out]
    return Answer(without(report, ("lines",)), report["rows"], lines)
