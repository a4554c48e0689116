"""Motor commands out of range or at their limits; the battery's voltage; whether there is a flight."""

from __future__ import annotations

import re

import numpy as np

from quadexp.log.check.finding import Finding, longest, of_rows
from quadexp.log.schema import Flight
from quadexp.physics.vehicle import Vehicle

ROUNDING = 0.005  # of the range: what quantisation and resampling may add
SATURATED = 0.05  # share of the samples of one rotor
STANDS = 0.01  # m, m/s: what motion capture makes of a vehicle that stands
CELL = (2.5, 4.45)  # V: of a lithium cell, empty and full
MOST_CELLS, USUAL_CELLS = 14, 8
ONE_CELL_MASS = 0.25  # kg: heavier vehicles fly on two cells or more
FASTEST_ROTOR = 1e4  # rad/s: 95 000 rpm, above any propeller drive


def command_columns(flight: Flight) -> dict[str, list[str]]:
    """Columns of rotor signals by kind, in rotor order."""
    signals: dict[str, list[str]] = {}
    for kind in ("motor_command", "u", "rotor_speed"):
        numbers = sorted(int(found[1]) for name in flight.columns if (found := re.fullmatch(rf"{kind}_(\d+)", name)))
        if numbers:
            signals[kind] = [f"{kind}_{number}" for number in numbers]
    return signals


def limits(kind: str, vehicle: Vehicle | None) -> tuple[float, float, str] | None:
    """Least and largest value that a rotor signal may have, and its unit; None where it is unknown."""
    if kind == "motor_command":
        return 0.0, 1.0, ""
    if kind == "rotor_speed":
        fastest = FASTEST_ROTOR
        if vehicle is not None and vehicle.thrust_coefficient:
            fastest = 1.5 * float(np.sqrt(vehicle.thrust_max / vehicle.thrust_coefficient))
        return 0.0, fastest, " rad/s"
    return None if vehicle is None else (vehicle.thrust_min, vehicle.thrust_max, " N")


def check_commands(flight: Flight, vehicle: Vehicle | None) -> tuple[list[Finding], np.ndarray]:
    """Commands out of range and saturation; and the samples with a command out of its range, (k,)."""
    found, impossible = [], np.zeros(len(flight), bool)
    for kind, names in command_columns(flight).items():
        allowed = limits(kind, vehicle)
        values = flight.stack(names).astype(float)
        if allowed is None or not np.isfinite(values).any():
            continue
        low, high, unit = allowed
        finite = np.where(np.isfinite(values), values, low)
        slack = ROUNDING * (high - low)
        outside = np.asarray((finite < low - slack) | (finite > high + slack))
        if outside.any():
            mask, of_rotor = np.asarray(outside.any(axis=1)), np.asarray(outside.any(axis=0))
            impossible |= mask
            columns = " ".join(name for name, bad in zip(names, of_rotor, strict=True) if bad)
            text = f"{finite[outside].min():.4g} to {finite[outside].max():.4g}{unit} in {mask.sum()} samples"
            between = f"{low:g}..{high:.4g}{unit}"
            found.append(of_rows("impossible_command", "blocking", columns, longest(mask), flight.t, text, between))
        share = (finite >= high - 2e-3 * (high - low)).mean(axis=0)
        if kind != "rotor_speed" and share.max() > 0:
            k = int(np.argmax(share))
            severity = "warning" if share[k] > SATURATED else "info"
            text = f"{share[k]:.2%} of the samples at full command"
            found.append(Finding("saturation", severity, names[k], text, f"{SATURATED:.0%}"))
    return found, impossible


def check_voltage(flight: Flight, vehicle: Vehicle | None) -> list[Finding]:
    """Whether the voltage is that of a lithium battery, and of one for a vehicle of this mass."""
    if "battery_voltage" not in flight.columns:
        return []
    values = flight["battery_voltage"][np.isfinite(flight["battery_voltage"])]
    middle = float(np.median(values)) if len(values) else 0.0
    allowed = f"{CELL[0]:g} to {CELL[1]:g} V a cell, 1 to {MOST_CELLS} cells"
    light = vehicle is None or vehicle.mass < ONE_CELL_MASS
    if (1 if light else 2) * CELL[0] <= middle <= MOST_CELLS * CELL[1]:
        return []
    text = f"median {middle:.3g} V"
    if not middle > 0:
        return [Finding("implausible_voltage", "warning", "battery_voltage", f"{text}: not measured", allowed)]
    if vehicle is not None and CELL[0] <= middle < 2 * CELL[0]:
        text += f" for {vehicle.mass:g} kg, which takes two cells or more"
    likely = [(factor, cells) for factor in (10.0, 100.0, 0.1, 0.01, 1e-3)
              if (1 if light else 2) <= (cells := round(factor * middle / 3.8)) <= MOST_CELLS
              and 3.2 <= factor * middle / cells <= 4.4]  # fmt: skip
    if likely:
        factor, cells = min(likely, key=lambda pair: pair[1] > USUAL_CELLS)
        text += f"; {factor:g} times as much would be {cells} {'cell' if cells == 1 else 'cells'}"
    advice = "state the unit of battery_voltage (V, dV, cV, mV) in the mapping"
    return [Finding("implausible_voltage", "blocking", "battery_voltage", text, allowed, advice)]


def check_flown(flight: Flight, streams: dict[str, np.ndarray], vehicle: Vehicle | None) -> list[Finding]:
    """Whether there is a flight in the file."""
    reasons, spread, fastest = [], 0.0, 0.0
    signals = command_columns(flight)
    for kind, names in signals.items():
        values = np.nan_to_num(flight.stack(names).astype(float))
        weight = 0.0 if vehicle is None else vehicle.mass * vehicle.gravity / len(names)
        if np.median(values) > max({"u": 0.2 * weight, "motor_command": 0.05, "rotor_speed": 1.0}[kind], 1e-6):
            return []
        reasons.append(f"{kind}_* at {np.quantile(values, 0.99):.3g}")
    if "p" in streams:
        spread = float(np.nanmax(np.ptp(np.nanquantile(streams["p"], [0.01, 0.99], axis=0), axis=0)))
        reasons.append(f"position within {spread:.2g} m")
    if "v" in streams:
        fastest = float(np.nanquantile(np.linalg.norm(streams["v"], axis=1), 0.99))
        reasons.append(f"speed to {fastest:.2g} m/s")
    if spread >= 0.1 or fastest >= 0.15 or not reasons:
        return []
    if not signals and "w" in streams and float(np.nanstd(streams["w"])) > 0.02:
        return []  # a hover without motor signals: rotors shake the gyro
    text = f"{', '.join(reasons)} over {flight.t[-1] - flight.t[0]:.1f} s"
    hovers = not signals and spread > STANDS and ("v" not in streams or fastest > STANDS)
    severity = "warning" if hovers else "blocking"  # a hover seen by motion capture alone may look like that
    return [Finding("no_flight", severity, "all samples", text, "motors running or motion", "leave the file out")]
