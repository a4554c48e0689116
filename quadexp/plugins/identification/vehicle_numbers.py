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
from typing import Any

import numpy as np

from quadexp.models.regression import LEAST_FLIGHTS, half_width
from quadexp.physics.vehicle import GRAVITY, Vehicle
from quadexp.plugins.identification.thrust_curve import ThrustCurve
from quadexp.plugins.identification.torque_gain import TorqueGain
from quadexp.plugins.logs.samples import SIGNALS, Samples
from quadexp.report.table import Table

Row = dict[str, Any]
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


def numbers_of(
    curve: ThrustCurve, samples: Samples, flights: Sequence[Mapping[str, Any]], vehicle: Vehicle | None,
    torque: TorqueGain | None,
) -> Row:  # fmt: skip
    """JSON types: curve, rows (name, value, unit, low, high, next_low, next_high, note), battery, given.

    flights: of flight_by_flight. vehicle: None: thrusts are per kg.
    """
    mass = 1.0 if vehicle is None else vehicle.mass
    gravity = GRAVITY if vehicle is None else vehicle.gravity
    newton = "N" if vehicle is not None else "N/kg"
    scale = next_flight(scales_of_flights(samples, curve).tolist())
    rows = _thrust_rows(curve, samples, mass, gravity, newton, scale)
    if vehicle is not None:
        for row in rows:
            if row["name"] == "thrust at full command":
                row["note"] += f"; {curve.rotors * row['value'] / (mass * gravity):.3g} times the weight in all"
    for axis in "xyz":
        coefficients = [
            coefficient
            for flight in flights
            for coefficient in flight.get("coefficients", ())
            if coefficient["axis"] == axis
        ]
        values = [coefficient["value"] for coefficient in coefficients if coefficient["term"] == "linear"]
        rows.append({"name": f"d_{axis}", "unit": "1/s", "each": values})
    terms = zip(curve.powers.tolist(), (mass * curve.coefficients).tolist(), strict=True)
    signal = "command" if curve.signal == "motor_command" else curve.signal
    if curve.reference_voltage:
        signal += f" (V/{curve.reference_voltage:g})^{curve.voltage_exponent:.3g}"
    text = " + ".join(f"{value:.5g} s^{power:g}" if power != 1 else f"{value:.5g} s" for power, value in terms)
    text += f" + {mass * curve.intercept / curve.rotors:.4g}" if curve.intercept else ""
    unit = SIGNALS[curve.signal] if curve.signal != "motor_command" else "0 to 1"
    stated: dict[str, Any] = {"mass": None, "inertia": None}
    if vehicle is not None:
        stated = {"mass": vehicle.mass, "inertia": np.diag(vehicle.inertia_matrix).tolist(), "name": vehicle.name}
    if torque is not None and vehicle is not None:
        used = torque.used
        measured = [
            None if ratio is None else moment / ratio for moment, ratio in zip(stated["inertia"], used, strict=True)
        ]
        stated["inertia_of_torque"] = measured
    count = len(samples.names)
    return {
        "curve": f"T = {text} {newton} per rotor, s = {signal} ({unit})", "rows": rows, "flights": count,
        "battery": _battery(curve, samples, mass, gravity, newton), "given": stated,
    }  # fmt: skip


def _thrust_rows(
    curve: ThrustCurve, samples: Samples, mass: float, gravity: float, newton: str, scale: tuple[float, float] | None
) -> list[Row]:
    """Hover, slope there, and full command."""
    hover = hover_signal(curve, gravity)
    if hover is None:
        return []
    unit = {"motor_command": "1", "thrust_acceleration": "m/s^2"}.get(curve.signal, SIGNALS[curve.signal])
    slope = _slope(curve, hover)
    thrust = mass * _acceleration(curve, hover)
    name = "hover command" if curve.signal == "motor_command" else f"{curve.signal} in hover"
    rows = [_row(name, hover, unit, _error(curve, hover) / slope, curve.freedom)]
    per = f"{newton} per {unit}" if unit != "1" else f"{newton} per unit of command"
    rows.append(_row("thrust per signal in hover", mass * slope, per, mass * _slope_error(curve, hover), curve.freedom))
    if scale is not None:
        ends = [hover - (end - 1) * thrust / (mass * slope) for end in scale]
        rows[0] |= {"next_low": min(ends), "next_high": max(ends)}
        rows[1] |= {"next_low": scale[0] * mass * slope, "next_high": scale[1] * mass * slope}
    if curve.signal == "motor_command":
        full = mass * _acceleration(curve, 1.0)
        row = _row("thrust at full command", full, f"{newton} per rotor", mass * _error(curve, 1.0), curve.freedom)
        if scale is not None:
            row |= {"next_low": scale[0] * row["low"], "next_high": scale[1] * row["high"]}
        most = float(samples.signal.max())
        row["note"] = f"the flights go to {most:.2f}" if most < 0.98 else "within the flights"
        rows.append(row)
    return rows


def _row(name: str, value: float, unit: str, error: float, freedom: int) -> Row:
    half = float(half_width(error, freedom))
    return {"name": name, "value": value, "unit": unit, "low": value - half, "high": value + half, "note": ""}


def _share(curve: ThrustCurve) -> float:
    """Rotors that share one signal."""
    return float(curve.rotors) if curve.signal == "thrust_acceleration" else 1.0


def _powers(curve: ThrustCurve, signal: float) -> np.ndarray:
    return np.array([(signal / _share(curve)) ** power for power in curve.powers])


def _derivatives(curve: ThrustCurve, signal: float) -> np.ndarray:
    share = _share(curve)
    return np.array([power * (signal / share) ** (power - 1) / share for power in curve.powers])


def _acceleration(curve: ThrustCurve, signal: float) -> float:
    """Of one rotor by a scaled signal, m/s^2."""
    return float(_powers(curve, signal) @ curve.coefficients) + curve.intercept / curve.rotors


def _slope(curve: ThrustCurve, signal: float) -> float:
    return float(_derivatives(curve, signal) @ curve.coefficients)


def _error(curve: ThrustCurve, signal: float) -> float:
    """Standard error of the acceleration, m/s^2."""
    phi = _powers(curve, signal)
    covariance = np.diag(curve.errors**2) if curve.covariance is None else curve.covariance
    return float(np.sqrt(max(phi @ covariance @ phi, 0.0)))


def _slope_error(curve: ThrustCurve, signal: float) -> float:
    phi = _derivatives(curve, signal)
    covariance = np.diag(curve.errors**2) if curve.covariance is None else curve.covariance
    return float(np.sqrt(max(phi @ covariance @ phi, 0.0)))


def hover_signal(curve: ThrustCurve, gravity: float) -> float | None:
    """The scaled signal of every rotor that holds the weight; None where the curve reaches it nowhere."""
    top = 1.0 if curve.signal_range is None else float(curve.signal_range[1])
    grid = np.linspace(0.0, max(top, 1.0 if curve.signal == "motor_command" else top) * 1.5, 2000)
    held = np.array([_acceleration(curve, signal) for signal in grid]) * curve.rotors - gravity
    crossing = np.flatnonzero((held[:-1] < 0) & (held[1:] >= 0))
    if not len(crossing):
        return None
    i = crossing[0]
    return float(grid[i] - held[i] * (grid[i + 1] - grid[i]) / (held[i + 1] - held[i]))


def _battery(curve: ThrustCurve, samples: Samples, mass: float, gravity: float, newton: str) -> list[Row]:
    """Hover command and full thrust at the highest, middle and lowest voltage of the flights; [] where it is unused."""
    hover = hover_signal(curve, gravity)
    if not curve.reference_voltage or samples.voltage is None or hover is None:
        return []
    rows = []
    for voltage in np.quantile(samples.voltage, [0.99, 0.5, 0.01]).tolist():
        stretch = (voltage / curve.reference_voltage) ** curve.voltage_exponent
        full = mass * _acceleration(curve, stretch)
        rows.append({"voltage": voltage, "hover_command": hover / stretch, "full_thrust": full, "unit": newton})
    return rows


def number_lines(numbers: Row, drag: Sequence[Mapping[str, Any]]) -> list[str]:
    """The numbers in words. drag: coefficients of linear drag over all flights, as TermModel.records."""
    pooled = {f"d_{row['axis']}": row for row in drag if row["term"] == "linear"}
    cells = []
    for row in numbers["rows"]:
        shown = row if "value" in row else row | pooled.get(row["name"], {})
        if "value" not in shown:
            continue
        ahead = _ahead(row)
        span = f"[{shown['low']:.4g}, {shown['high']:.4g}]"
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


def _ahead(row: Row) -> str:
    """The interval of the next flight as text."""
    span = next_flight(row["each"]) if "each" in row else None
    if "next_low" in row:
        span = row["next_low"], row["next_high"]
    return f"[{span[0]:.4g}, {span[1]:.4g}]" if span else "-"


def _given_lines(stated: Row) -> list[str]:
    """Mass and inertia, which no log shows, and what an error of them does."""
    if stated["mass"] is None:
        return ["mass        not known, so thrusts are per kg (m/s^2): name the vehicle (--vehicle NAME), or weigh it"]
    moments = ", ".join(f"{moment:.3g}" for moment in stated["inertia"])
    mass = f"mass        {stated['mass']:g} kg, as given by {stated['name']}: weigh it ready to fly."
    lines = [f"{mass} 10 % too large makes every newton 10 % too large; commands, accelerations, drag (1/s) stay"]
    inertia = f"inertia     {moments} kg m^2, as given."
    lines.append(f"{inertia} 10 % too large makes a controller send 10 % too much torque. To measure: {PENDULUM}")
    if any(moment is not None for moment in stated.get("inertia_of_torque") or ()):
        by_torque = ", ".join("-" if moment is None else f"{moment:.3g}" for moment in stated["inertia_of_torque"])
        lines.append(
            f"            from gyro and torque of these flights {by_torque} kg m^2, where mass, arms and torque"
        )
        lines.append("            coefficient are right: a log shows torque over inertia, up to that factor")
    return lines
