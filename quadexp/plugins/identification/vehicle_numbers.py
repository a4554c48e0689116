"""Numbers of an identified vehicle that a person uses: in newtons, per command, at a voltage, for the next flight.

    T(s) = m (c_1 s' + c_2 s'^2)  per rotor (N),     s' = s (V / V_ref)^g                          (thrust_curve.py)
    hover:  n (c_1 s' + c_2 s'^2) + b = g

Interval of these flights: of the curve's covariance, to first order. Interval of the next flight: the number differs
from flight to flight by a random effect. With y_f of each of G flights alone, mean M, standard deviation S,

    M +- t S sqrt(1 + 1/G),       Student's t of G - 1 degrees of freedom,

which holds the y of one more flight in 95 %, and so its number, which scatters less (Geisser 1993, Predictive
Inference). y_f: linear drag, and the scale of the thrust, of which hover command and thrusts follow. Fewer than
LEAST_FLIGHTS do not tell how flights differ.

The mass is as given: no sensor of a log knows it. A mass too large by 10 % makes every newton too large by 10 %, and
nothing else: accelerations, drag in 1/s, commands. Inertia: the log shows torque over inertia only (torque_gain.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quadexp.models.regression import LEAST_FLIGHTS, half_width
from quadexp.physics.vehicle import GRAVITY, Vehicle
from quadexp.plugins.identification.thrust_curve import ThrustCurve
from quadexp.plugins.identification.torque_gain import TorqueGain
from quadexp.plugins.logs.samples import SIGNALS, Samples
from quadexp.report.table import Table

Row = dict[str, Any]
FULL_THRUST = "thrust at full command"
PENDULUM = "J = m g d^2 T^2 / (16 pi^2 L): hung on two strings of length L, d apart, T the period of the twist"


def next_flight(values: Sequence[float]) -> tuple[float, float] | None:
    """95 % interval of the value of one more flight, None for fewer than LEAST_FLIGHTS."""
    count = len(values)
    if count < LEAST_FLIGHTS:
        return None
    half = float(half_width(np.std(values, ddof=1) * np.sqrt(1 + 1 / count), count - 1))
    middle = float(np.mean(values))
    return middle - half, middle + half


def scales_of_flights(samples: Samples, curve: ThrustCurve) -> np.ndarray:
    """Thrust of each flight over that of the curve, (G,), beside its drag along z."""
    thrust = curve.of_signal(samples.signal, samples.voltage).sum(axis=1)
    scales = []
    for index in range(len(samples.names)):
        of_flight = samples.flight == index
        force = samples.force[of_flight, 2] + curve.drag_z * samples.velocity[of_flight, 2]
        scales.append(thrust[of_flight] @ force / (thrust[of_flight] @ thrust[of_flight]))
    return np.array(scales)


class CurvePoint(NamedTuple):
    """A rotor's thrust per mass at a signal: acceleration (m/s^2), slope (of it over the signal), standard errors."""

    acceleration: float
    acceleration_error: float
    slope: float
    slope_error: float


def point_of(curve: ThrustCurve, signal: float) -> CurvePoint:
    """signal: at the reference voltage."""
    sharing = curve.rotors if curve.signal == "thrust_acceleration" else 1  # rotors that share one signal
    share = signal / sharing
    powers = share**curve.powers
    derivatives = curve.powers * share ** (curve.powers - 1) / sharing
    covariance = np.diag(curve.errors**2) if curve.covariance is None else curve.covariance

    def error(gradient: np.ndarray) -> float:
        return float(np.sqrt(max(gradient @ covariance @ gradient, 0.0)))

    acceleration = float(powers @ curve.coefficients) + curve.intercept / curve.rotors
    return CurvePoint(acceleration, error(powers), float(derivatives @ curve.coefficients), error(derivatives))


def hover_signal(curve: ThrustCurve, gravity: float) -> float | None:
    """The signal of every rotor, at the reference voltage, that holds the weight; None where the curve reaches it
    nowhere."""
    largest = 1.0 if curve.signal_range is None else float(curve.signal_range[1])
    if curve.signal == "motor_command":
        largest = max(largest, 1.0)
    grid = np.linspace(0.0, 1.5 * largest, 2000)
    excess = curve.collective(grid) - gravity
    crossing = np.flatnonzero((excess[:-1] < 0) & (excess[1:] >= 0))
    if not len(crossing):
        return None
    beside = slice(crossing[0], crossing[0] + 2)
    return float(np.interp(0.0, excess[beside], grid[beside]))


def numbers_of(
    curve: ThrustCurve, samples: Samples, flights: Sequence[Mapping[str, Any]], vehicle: Vehicle | None,
    torque: TorqueGain | None,
) -> Row:  # fmt: skip
    """JSON types: curve, rows (name, value, unit, low, high, next_low, next_high, note), battery, given.

    flights: of flight_by_flight. vehicle: None: thrusts are per kg.
    """
    mass = 1.0
    gravity = GRAVITY
    newton = "N/kg"
    if vehicle is not None:
        mass = vehicle.mass
        gravity = vehicle.gravity
        newton = "N"
    rows = []
    battery = []
    hover = hover_signal(curve, gravity)
    if hover is not None:
        rows = _thrust_rows(curve, samples, hover, mass, newton)
        battery = _battery(curve, samples, hover, mass, newton)
    for row in rows:
        if row["name"] == FULL_THRUST and vehicle is not None:
            row["note"] += f"; {curve.rotors * row['value'] / (mass * gravity):.3g} times the weight in all"
    for axis in "xyz":
        each = []
        for flight in flights:
            for row in flight.get("coefficients", ()):
                if row["axis"] == axis and row["term"] == "linear":
                    each.append(row["value"])
        rows.append({"name": f"d_{axis}", "unit": "1/s", "each": each} | _next(next_flight(each)))
    return {
        "curve": _formula(curve, mass, newton), "rows": rows, "flights": len(samples.names), "battery": battery,
        "given": _stated(vehicle, torque),
    }  # fmt: skip


def _thrust_rows(curve: ThrustCurve, samples: Samples, hover: float, mass: float, newton: str) -> list[Row]:
    """Hover, slope there, and full command."""
    commanded = curve.signal == "motor_command"
    unit = {"motor_command": "1", "thrust_acceleration": "m/s^2"}.get(curve.signal, SIGNALS[curve.signal])
    at_hover = point_of(curve, hover)
    slope = mass * at_hover.slope

    def row(name: str, value: float, unit: str, error: float) -> Row:
        half = float(half_width(error, curve.freedom))
        return {"name": name, "value": value, "unit": unit, "low": value - half, "high": value + half, "note": ""}

    name = "hover command" if commanded else f"{curve.signal} in hover"
    per = f"{newton} per unit of command" if commanded else f"{newton} per {unit}"
    rows = [
        row(name, hover, unit, at_hover.acceleration_error / at_hover.slope),
        row("thrust per signal in hover", slope, per, mass * at_hover.slope_error),
    ]
    if commanded:
        full = point_of(curve, 1.0)
        error = mass * full.acceleration_error
        rows.append(row(FULL_THRUST, mass * full.acceleration, f"{newton} per rotor", error))
        largest = float(samples.signal.max())
        rows[-1]["note"] = f"the flights go to {largest:.2f}" if largest < 0.98 else "within the flights"
    scale = next_flight(scales_of_flights(samples, curve).tolist())
    if scale is not None:
        low, high = scale
        thrust = mass * at_hover.acceleration
        rows[0] |= _next(sorted(hover - (end - 1) * thrust / slope for end in scale))
        rows[1] |= _next((low * slope, high * slope))
        for full_row in rows[2:]:
            full_row |= _next((low * full_row["low"], high * full_row["high"]))
    return rows


def _next(interval: Sequence[float] | None) -> Row:
    """Of the next flight, where it is known."""
    return {} if interval is None else {"next_low": interval[0], "next_high": interval[1]}


def _battery(curve: ThrustCurve, samples: Samples, hover: float, mass: float, newton: str) -> list[Row]:
    """Hover command and full thrust at the highest, middle and lowest voltage of the flights; [] where it is unused."""
    if not curve.reference_voltage or samples.voltage is None:
        return []
    rows = []
    for voltage in np.quantile(samples.voltage, [0.99, 0.5, 0.01]).tolist():
        scale = (voltage / curve.reference_voltage) ** curve.voltage_exponent
        full = mass * point_of(curve, scale).acceleration
        rows.append({"voltage": voltage, "hover_command": hover / scale, "full_thrust": full, "unit": newton})
    return rows


def _formula(curve: ThrustCurve, mass: float, newton: str) -> str:
    """The thrust of a rotor as a formula of its signal."""
    terms = []
    for power, coefficient in zip(curve.powers.tolist(), curve.coefficients.tolist(), strict=True):
        symbol = "s" if power == 1 else f"s^{power:g}"
        terms.append(f"{mass * coefficient:.5g} {symbol}")
    if curve.intercept:
        terms.append(f"{mass * curve.intercept / curve.rotors:.4g}")
    signal = curve.signal
    unit = SIGNALS[curve.signal]
    if curve.signal == "motor_command":
        signal = "command"
        unit = "0 to 1"
    if curve.reference_voltage:
        signal += f" (V/{curve.reference_voltage:g})^{curve.voltage_exponent:.3g}"
    return f"T = {' + '.join(terms)} {newton} per rotor, s = {signal} ({unit})"


def _stated(vehicle: Vehicle | None, torque: TorqueGain | None) -> Row:
    """What no log shows."""
    if vehicle is None:
        return {"mass": None, "inertia": None}
    inertia = np.diag(vehicle.inertia_matrix).tolist()
    stated: Row = {"mass": vehicle.mass, "inertia": inertia, "name": vehicle.name}
    if torque is not None:
        pairs = zip(inertia, torque.used, strict=True)
        stated["inertia_of_torque"] = [None if ratio is None else moment / ratio for moment, ratio in pairs]
    return stated


def number_lines(numbers: Row, drag: Sequence[Mapping[str, Any]]) -> list[str]:
    """The numbers in words. drag: coefficients of linear drag over all flights, as TermModel.records."""
    pooled = {f"d_{row['axis']}": row for row in drag if row["term"] == "linear"}
    cells = []
    for row in numbers["rows"]:
        shown = row if "value" in row else row | pooled.get(row["name"], {})
        if "value" not in shown:
            continue
        span = f"[{shown['low']:.4g}, {shown['high']:.4g}]"
        ahead = f"[{row['next_low']:.4g}, {row['next_high']:.4g}]" if "next_low" in row else "-"
        cells.append([row["name"], f"{shown['value']:.4g}", row["unit"], span, ahead, row.get("note", "")])
    heads = ["numbers", "", "", "these flights, 95 %", "the next flight, 95 %", ""]
    lines = [f"thrust      {numbers['curve']}"]
    lines += Table(heads, cells, left=frozenset({0, 2, 3, 4, 5})).lines()
    if numbers["flights"] < LEAST_FLIGHTS:
        count = "one flight does" if numbers["flights"] == 1 else f"{numbers['flights']} flights do"
        lines.append(f"            {count} not show how flights differ ({LEAST_FLIGHTS} do): no interval of the next")
    if numbers["battery"]:
        parts = []
        for row in numbers["battery"]:
            full = f"{row['full_thrust']:.4g} {row['unit']}"
            parts.append(f"{row['voltage']:.2f} V: hover command {row['hover_command']:.3f}, full {full}")
        lines.append(f"battery     {'; '.join(parts)} per rotor")
    return lines + _given_lines(numbers["given"])


def _given_lines(stated: Row) -> list[str]:
    """Mass and inertia, which no log shows, and what an error of them does."""
    if stated["mass"] is None:
        return ["mass        not known, so thrusts are per kg (m/s^2): name the vehicle (--vehicle NAME), or weigh it"]
    moments = ", ".join(f"{moment:.3g}" for moment in stated["inertia"])
    mass = f"mass        {stated['mass']:g} kg, as given by {stated['name']}: weigh it ready to fly."
    inertia = f"inertia     {moments} kg m^2, as given."
    lines = [
        f"{mass} 10 % too large makes every newton 10 % too large; commands, accelerations, drag (1/s) stay",
        f"{inertia} 10 % too large makes a controller send 10 % too much torque. To measure: {PENDULUM}",
    ]
    by_torque = stated.get("inertia_of_torque", ())
    if any(by_torque):
        found = ", ".join("-" if moment is None else f"{moment:.3g}" for moment in by_torque)
        lines += [
            f"            from gyro and torque of these flights {found} kg m^2, where mass, arms and torque",
            "            coefficient are right: a log shows torque over inertia, up to that factor",
        ]
    return lines
