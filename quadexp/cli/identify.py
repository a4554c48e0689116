"""`quadexp identify`: thrust curve and drag of a vehicle from its flights. Only light modules are imported here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from quadexp.cli.options import Conf, Force, Json
from quadexp.cli.terminal import emit, guarded, print_lines, say
from quadexp.errors import UsageError

CURVES = {"auto": None, "s": (1,), "s2": (2,), "s+s2": (1, 2)}
REGRESSION = "Regression"


@guarded
def identify(
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
    drag: Annotated[
        str,
        typer.Option(
            "--drag",
            metavar="MODELS",
            help="Drag models to fit, of linear,quadratic,blade_element.",
            rich_help_panel=REGRESSION,
        ),
    ] = "linear,quadratic,blade_element",
    signal: Annotated[
        str | None,
        typer.Option(
            "--signal",
            metavar="COLUMNS",
            rich_help_panel=REGRESSION,
            help="Thrust signal: rotor_speed, motor_command, thrust_acceleration or u; default: the first in all.",
        ),
    ] = None,
    curve: Annotated[
        str,
        typer.Option(
            "--thrust-curve",
            metavar="s+s2|s|s2|auto",
            rich_help_panel=REGRESSION,
            help="Terms of the thrust curve on motor commands; auto: chosen on flights left out, with the voltage.",
        ),
    ] = "auto",
    voltage: Annotated[
        float | None,
        typer.Option(
            "--reference-voltage",
            metavar="V",
            help="Voltage the curve is stated at; 0: the voltage is not used.",
            rich_help_panel=REGRESSION,
        ),
    ] = None,
    exponent: Annotated[
        str,
        typer.Option(
            "--voltage-exponent",
            metavar="G|fit",
            help="Exponent of the voltage; fit: estimated.",
            rich_help_panel=REGRESSION,
        ),
    ] = "1",
    intercept: Annotated[
        bool | None,
        typer.Option(
            "--thrust-intercept/--no-thrust-intercept", rich_help_panel=REGRESSION, help="Fit an offset along z."
        ),
    ] = None,
    per_rotor: Annotated[
        bool, typer.Option("--per-rotor", help="A thrust curve for each rotor.", rich_help_panel=REGRESSION)
    ] = False,
    radius: Annotated[
        float | None,
        typer.Option(
            "--rotor-radius", metavar="M", help="Rotor radius for the induced velocity.", rich_help_panel=REGRESSION
        ),
    ] = None,
    loss: Annotated[
        str, typer.Option("--loss", metavar="squares|huber", rich_help_panel=REGRESSION, help="Loss that is minimised.")
    ] = "squares",
    figures: Annotated[
        bool, typer.Option("--figures/--no-figures", help="Draw figures.", rich_help_panel=REGRESSION)
    ] = True,
    figure: Annotated[
        Path | None, typer.Option("--figure", metavar="FILE", help="delays: draw the search, as SVG and PNG.")
    ] = None,
    conf: Conf = None,
    force: Force = False,
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

    named = None if vehicle is None else configured_vehicle(vehicle, conf)
    if method == "delays":
        from quadexp.experiment.identify_delays import identify_delays

        delays = identify_delays(flights, named, conf, figure)
        if json:
            emit({"method": "delays", "flights": delays["flights"]})
        else:
            print("\n".join(delays["lines"]))
        return
    if figure is not None:
        raise UsageError("identify --figure: is for --method delays")
    choice = choose_method(flights, method, named)
    if choice.method == "rls":
        found = identify_files(flights, out, vehicle=vehicle, conf=conf, force=force, paper=paper)
        say(f"rls: {choice.reason}")
        if json:
            record = {"method": "rls", "out": out, "flights": [{"path": p, **one.metadata()} for p, one in found]}
            emit(record)
            return
        for path, one in found:
            print_lines(one.lines())
            print(path)
        return

    from quadexp.experiment.identify_vehicle import identify_flights
    from quadexp.learn.vehicle_fit import FitSettings

    if paper:
        raise UsageError("identify --paper: is for --method rls")
    if curve not in CURVES:
        raise UsageError(f"identify --thrust-curve: '{curve}' is none of {', '.join(CURVES)}")
    settings = FitSettings(
        signal=signal, reference_voltage=voltage, voltage_exponent=_exponent(exponent), powers=CURVES[curve],
        thrust_intercept=intercept, per_rotor=per_rotor, radius=radius, loss=loss,
        kinds=tuple(name.strip() for name in drag.split(",") if name.strip()),
    )  # fmt: skip
    say(f"regression: {choice.reason}")
    report: dict[str, Any] = identify_flights(flights, out, named, settings, force=force, figures=figures, conf=conf)
    if json:
        emit({key: value for key, value in report.items() if key != "lines"})
        return
    print_lines(report["lines"])
    print(out)


def _exponent(text: str) -> float | None:
    if text == "fit":
        return None
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"identify --voltage-exponent: '{text}' is neither a number nor fit") from None
