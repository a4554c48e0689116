"""`quadexp identify`: thrust curve and drag of a vehicle from its flights. Only light modules are imported here."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from quadexp.cli.options import Conf, Force, Format, Json
from quadexp.cli.terminal import answered, format_of, guarded, print_lines, say
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
        "out", "force", "drag", "signal", "curve", "voltage", "exponent", "intercept", "per_rotor", "radius", "loss",
        "figures",
    ),
    "delays": ("figure",),
}  # fmt: skip


def _regression(name: str, metavar: str | None, help: str) -> Any:
    """An option of --method regression."""
    return typer.Option(name, metavar=metavar, help=help, rich_help_panel="Regression")


@guarded
def identify(
    context: typer.Context,
    flights: Annotated[list[Path], typer.Argument(metavar="FLIGHT...", help="Of `quadexp import` or `simulate`.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Where to write.")] = Path("data/estimates"),
    method: Annotated[
        str | None,
        typer.Option(
            "--method", metavar="rls|regression|delays", help="rls where rotor speeds and geometry are known."
        ),
    ] = None,
    vehicle: Annotated[
        str | None,
        typer.Option("--vehicle", metavar="NAME", help="Of the configuration, instead of the flight's own."),
    ] = None,
    paper: Annotated[bool, typer.Option("--paper", help="rls: P_0 = 50 and unit noise, as Lei & Li.")] = False,
    drag: Annotated[str, _regression("--drag", "MODELS", f"Drag models to fit, of {KINDS}.")] = KINDS,
    signal: Annotated[str | None, _regression("--signal", "COLUMNS", SIGNAL)] = None,
    curve: Annotated[str, _regression("--thrust-curve", "s+s2|s|s2|auto", CURVE)] = "auto",
    voltage: Annotated[float | None, _regression("--reference-voltage", "V", VOLTAGE)] = None,
    exponent: Annotated[
        str, _regression("--voltage-exponent", "G|fit", "Exponent of the voltage; fit: estimated.")
    ] = "1",
    intercept: Annotated[
        bool | None, _regression("--thrust-intercept/--no-thrust-intercept", None, "Fit an offset along z.")
    ] = None,
    per_rotor: Annotated[bool, _regression("--per-rotor", None, "A thrust curve for each rotor.")] = False,
    radius: Annotated[
        float | None, _regression("--rotor-radius", "M", "Rotor radius for the induced velocity.")
    ] = None,
    loss: Annotated[str, _regression("--loss", "squares|huber", "Loss that is minimised.")] = "squares",
    figures: Annotated[bool, _regression("--figures/--no-figures", None, "Draw figures.")] = True,
    figure: Annotated[
        Path | None, typer.Option("--figure", metavar="FILE", help="delays: draw the search, as SVG and PNG.")
    ] = None,
    verbose: Annotated[
        bool, _regression("--verbose", None, "Print all that was found, as `quadexp show` does.")
    ] = False,
    conf: Conf = None,
    force: Force = False,
    format: Format = None,
    json: Json = False,
) -> None:
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
    from quadexp.experiment.identify import choose_method, configured_vehicle, identify_files

    form = format_of(format, json)
    named = None if vehicle is None else configured_vehicle(vehicle, conf)
    choice = choose_method(flights, method, named)
    _check_options(context, choice.method)
    if choice.method == "delays":
        from quadexp.experiment.identify_delays import identify_delays

        delays = identify_delays(flights, named, conf, figure)
        rows = [{**one, "overrides": " ".join(one["overrides"])} for one in delays["flights"]]
        if not answered(form, {"method": "delays", "flights": delays["flights"]}, lambda: rows, "identify"):
            print_lines(delays["lines"])
        return
    if choice.method == "rls":
        found = identify_files(flights, out, vehicle=vehicle, conf=conf, force=force, paper=paper)
        say(f"rls: {choice.reason}")
        each = [{"path": path, **one.metadata()} for path, one in found]
        record = {"method": "rls", "out": out, "flights": each}
        if answered(form, record, lambda: [row for flight in each for row in _of_flight(flight)], "identify"):
            return
        for path, one in found:
            print_lines([*one.lines(), path])
        return

    from quadexp.experiment.identify_vehicle import identify_flights
    from quadexp.models.vehicle_model import FitSettings

    if curve not in CURVES:
        raise UsageError(f"identify --thrust-curve: '{curve}' is none of {', '.join(CURVES)}")
    settings = FitSettings(
        signal=signal, reference_voltage=voltage, voltage_exponent=_exponent(exponent), powers=CURVES[curve],
        thrust_intercept=intercept, per_rotor=per_rotor, radius=radius, loss=loss,
        kinds=tuple(name.strip() for name in drag.split(",") if name.strip()),
    )  # fmt: skip
    say(f"regression: {choice.reason}")
    report: dict[str, Any] = identify_flights(flights, out, named, settings, force=force, figures=figures, conf=conf)
    record = {key: value for key, value in report.items() if key not in ("lines", "main")}
    models = report["models"].items()
    if answered(form, record, lambda: [{"model": name, **row} for name, rows in models for row in rows], "identify"):
        return
    print_lines([*report["lines" if verbose else "main"], out])


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
