"""`quadexp identify`: thrust curve and drag of a vehicle from its flights. Only light modules are imported here."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from quadexp.cli.command import Answer, Ask, command
from quadexp.cli.options import Conf, Force
from quadexp.cli.terminal import say
from quadexp.errors import UsageError

CURVES = {"auto": None, "s": (1,), "s2": (2,), "s+s2": (1, 2)}
KINDS = "linear,quadratic,blade_element"
SIGNAL = "Thrust signal: rotor_speed, motor_command, thrust_acceleration or u; default: the first in all."
CURVE = "Terms of the thrust curve on motor commands; auto: chosen on flights left out, with the voltage."
VOLTAGE = "Voltage the curve is stated at; 0: the voltage is not used."
# Options that not every method has.
OPTIONS = {
    "rls": ("out", "force", "paper"),
    "regression": (
        "out", "force", "drag", "signal", "curve", "voltage", "exponent", "radius", "loss", "figures",
    ),
    "delays": ("figure",),
}  # fmt: skip


@command
def identify(
    context: typer.Context,
    flights: Annotated[list[Path], Ask("Of `quadexp import` or `simulate`.", "FLIGHT...")],
    out: Annotated[Path, Ask("Where to write.", "DIR", "--out -o")] = Path("data/estimates"),
    method: Annotated[
        str | None, Ask("rls where rotor speeds and geometry are known.", "rls|regression|delays")
    ] = None,
    vehicle: Annotated[str | None, Ask("Of the configuration, instead of the flight's own.", "NAME")] = None,
    paper: Annotated[bool, Ask("rls: P_0 = 50 and unit noise, as Lei & Li.")] = False,
    drag: Annotated[str, Ask(f"Drag models to fit, of {KINDS}.", "MODELS", "--drag")] = KINDS,
    signal: Annotated[str | None, Ask(SIGNAL, "COLUMNS", "--signal")] = None,
    curve: Annotated[str, Ask(CURVE, "s+s2|s|s2|auto", "--thrust-curve")] = "auto",
    voltage: Annotated[float | None, Ask(VOLTAGE, "V", "--reference-voltage")] = None,
    exponent: Annotated[str, Ask("Exponent of the voltage; fit: estimated.", "G|fit", "--voltage-exponent")] = "1",
    radius: Annotated[float | None, Ask("Rotor radius for the induced velocity.", "M", "--rotor-radius")] = None,
    loss: Annotated[str, Ask("Loss that is minimised.", "squares|huber", "--loss")] = "squares",
    figures: Annotated[bool, Ask("Draw figures.", None, "--figures/--no-figures")] = True,
    figure: Annotated[Path | None, Ask("delays: draw the search, as SVG and PNG.", "FILE")] = None,
    verbose: Annotated[bool, Ask("Print all that was found, as `quadexp show` does.", None, "--verbose")] = False,
    conf: Conf = None,
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
    from quadexp.experiment.identify import choose_method, identify_files
    from quadexp.experiment.vehicle_of import vehicle_named

    named = None if vehicle is None else vehicle_named(vehicle, conf)
    choice = choose_method(flights, method, named)
    _check_options(context, choice.method)
    if choice.method == "delays":
        from quadexp.experiment.identify import identify_delays

        delays = identify_delays(flights, named, conf, figure)
        rows = [{**flight, "overrides": " ".join(flight["overrides"])} for flight in delays["flights"]]
        return Answer({"method": "delays", "flights": delays["flights"]}, rows, delays["lines"])
    say(f"{choice.method}: {choice.reason}")
    if choice.method == "rls":
        estimates = identify_files(flights, out, vehicle=vehicle, conf=conf, force=force, paper=paper)
        each = [{"path": path, **estimate.metadata()} for path, estimate in estimates]
        lines = [line for path, estimate in estimates for line in (*estimate.lines(), path)]
        rows = [row for flight in each for row in _of_flight(flight)]
        return Answer({"method": "rls", "out": out, "flights": each}, rows, lines)

    from quadexp.experiment.identify import identify_flights
    from quadexp.models.vehicle_model import FitSettings

    if curve not in CURVES:
        raise UsageError(f"identify --thrust-curve: '{curve}' is none of {', '.join(CURVES)}")
    settings = FitSettings(
        signal=signal, reference_voltage=voltage, voltage_exponent=_exponent(exponent), powers=CURVES[curve],
        radius=radius, loss=loss, kinds=tuple(name.strip() for name in drag.split(",") if name.strip()),
    )  # fmt: skip
    report: dict[str, Any] = identify_flights(flights, out, named, settings, force=force, figures=figures, conf=conf)
    record = {key: value for key, value in report.items() if key not in ("lines", "main")}
    rows = [{"model": name, **row} for name, model_rows in report["models"].items() for row in model_rows]
    return Answer(record, rows, [*report["lines" if verbose else "main"], out])


def _check_options(context: typer.Context, method: str) -> None:
    """Raise UsageError for an option on the command line that the method does not have."""
    for option in context.command.params:
        having = [other for other, names in OPTIONS.items() if option.name in names]
        source = context.get_parameter_source(str(option.name))
        if having and method not in having and source is not None and source.name == "COMMANDLINE":
            raise UsageError(f"identify {option.opts[0]}: is for --method {' or '.join(having)}, not {method}")


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


def _exponent(text: str) -> float | None:
    if text == "fit":
        return None
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"identify --voltage-exponent: '{text}' is neither a number nor fit") from None
