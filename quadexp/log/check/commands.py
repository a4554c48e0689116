"""Motor commands out of range, at their limits or with spikes; the battery's voltage; whether there is a flight."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from quadexp.log.finding import LEAVE_OUT, Finding, place, span
from quadexp.log.schema import Flight
from quadexp.log.signal.crop import runs
from quadexp.physics.vehicle import Vehicle

ROUNDING = 0.005  # of the range: what quantisation and resampling may add
SATURATED = 0.05  # share of the samples of one rotor
SPIKE = 15.0
SPIKE_FLOOR = 0.5  # of the range
STANDS = 0.01  # m, m/s: what motion capture makes of a vehicle that stands
CELL = (2.5, 4.45)  # V: of a lithium cell, empty and full
MOST_CELLS, USUAL_CELLS = 14, 8
ONE_CELL_MASS = 0.25  # kg: heavier vehicles fly on two cells or more
FASTEST_ROTOR = 1e4  # rad/s: 95 000 rpm, above any propeller drive


def command_columns(flight: Flight) -> dict[str, list[str]]:
    """Columns of rotor signals by kind, in rotor order."""
    found: dict[str, list[str]] = {}
    for kind in ("motor_command", "u", "rotor_speed"):
        names = [name for name in flight.columns if re.fullmatch(rf"{kind}_\d+", name)]
        if names:
            found[kind] = sorted(names, key=lambda name: int(name.rpartition("_")[2]))
    return found


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


def check_commands(flight: Flight, vehicle: Vehicle | None) -> list[Finding]:
    """Commands out of range, spikes, saturation."""
    found = []
    for kind, names in command_columns(flight).items():
        allowed = limits(kind, vehicle)
        values = flight.stack(names).astype(float)
        if allowed is None or not np.isfinite(values).any():
            continue
        low, high, unit = allowed
        finite = np.where(np.isfinite(values), values, low)
        outside = _outside(finite, low, high)
        allowed_range = f"{low:g}..{high:.4g}{unit}"
        if outside.any():
            mask = np.asarray(outside.any(axis=1))
            start, stop = max(runs(mask), key=lambda run: run[1] - run[0])
            columns = " ".join(name for name, bad in zip(names, np.asarray(outside.any(axis=0)), strict=True) if bad)
            text = f"{finite[outside].min():.4g} to {finite[outside].max():.4g}{unit} in {mask.sum()} samples"
            first = int(np.argmax(mask))
            where = f"{columns}, {place(start, stop, flight.t)} longest, {place(first, first + 1, flight.t)} first"
            found.append(
                Finding(
                    "impossible_command", "blocking", where, text, allowed_range, LEAVE_OUT, span(flight.t, start, stop)
                )  # fmt: skip
            )
        share = (finite >= high - 2e-3 * (high - low)).mean(axis=0)
        found += _spikes(names, np.clip(finite, low, high, out=finite), outside, high - low, flight.t)
        if kind == "rotor_speed":
            continue
        if share.max() > 0:
            k = int(np.argmax(share))
            text = f"{share[k]:.2%} of the samples at full command"
            severity = "warning" if share[k] > SATURATED else "info"
            found.append(Finding("saturation", severity, names[k], text, f"{SATURATED:.0%}"))
    return found


def _outside(values: np.ndarray, low: float, high: float) -> np.ndarray:
    slack = ROUNDING * (high - low)
    return np.asarray((values < low - slack) | (values > high + slack))


def impossible_rows(flight: Flight, vehicle: Vehicle | None) -> np.ndarray:
    """Samples with a command out of its range, (k,)."""
    bad = np.zeros(len(flight), bool)
    for kind, names in command_columns(flight).items():
        allowed = limits(kind, vehicle)
        if allowed is not None:
            values = flight.stack(names).astype(float)
            bad |= _outside(np.nan_to_num(values, nan=allowed[0]), *allowed[:2]).any(axis=1)
    return bad


def check_voltage(flight: Flight, vehicle: Vehicle | None) -> list[Finding]:
    """Whether the voltage is that of a lithium battery, and of one for a vehicle of this mass."""
    if "battery_voltage" not in flight.columns:
        return []
    values = np.asarray(flight.columns["battery_voltage"], float)
    values = values[np.isfinite(values)]
    middle = float(np.median(values)) if len(values) else 0.0
    where = "battery_voltage"
    allowed = f"{CELL[0]:g} to {CELL[1]:g} V a cell, 1 to {MOST_CELLS} cells"
    if not middle > 0:
        return [Finding("implausible_voltage", "warning", where, f"median {middle:g} V: not measured", allowed)]
    light = vehicle is None or vehicle.mass < ONE_CELL_MASS
    least = CELL[0] if light else 2 * CELL[0]
    if least <= middle <= MOST_CELLS * CELL[1]:
        return []
    text = f"median {middle:.3g} V"
    if vehicle is not None and CELL[0] <= middle < least:
        text += f" for {vehicle.mass:g} kg, which takes two cells or more"
    likely = [(factor, n) for factor in (10.0, 100.0, 0.1, 0.01, 1e-3) if (n := _cells(factor * middle, least))]
    advice = "state the unit of battery_voltage (V, dV, cV, mV) in the mapping"
    if likely:
        factor, cells = min(likely, key=lambda one: one[1] > USUAL_CELLS)
        text += f"; {factor:g} times as much would be {cells} {'cell' if cells == 1 else 'cells'} of"
        text += f" {factor * middle / cells:.2f} V"
    return [Finding("implausible_voltage", "blocking", where, text, allowed, advice)]


def _cells(voltage: float, least: float) -> int:
    """How many cells of about 3.8 V a battery of this voltage has; 0 where it is none."""
    n = round(voltage / 3.8)
    return n if voltage >= least and 1 <= n <= MOST_CELLS and 3.2 <= voltage / n <= 4.4 else 0


def _spikes(
    names: Sequence[str], values: np.ndarray, outside: np.ndarray, width: float, t: np.ndarray
) -> list[Finding]:
    """Single commands far from both neighbours, within a range of the given width."""
    if len(t) < 9:
        return []
    from scipy.ndimage import median_filter

    every, worst = np.zeros(len(t), bool), (0.0, 0, 0, 0.0)
    for column, own in enumerate(values.T):
        away = np.abs(own - median_filter(own, size=5, mode="nearest"))
        limit = max(SPIKE * 1.4826 * float(np.median(away)), SPIKE_FLOOR * width)
        bad = (away > limit) & ~outside[:, column]
        every |= bad
        sample = int(np.argmax(np.where(bad, away, 0)))
        worst = max(worst, (float(away[sample]) if bad.any() else 0.0, sample, column, limit))
    if not every.any() or every.mean() > 0.02:  # so often, it is how this controller flies
        return []
    size, sample, column, limit = worst
    text = f"{values[sample, column]:.4g}, {size:.3g} from its neighbours, {every.sum()} such samples"
    allowed = f"{limit:.3g}"
    return [Finding("command_outlier", "warning", f"{names[column]}, {place(sample, sample + 1, t)}", text, allowed)]


def check_flown(flight: Flight, streams: dict[str, np.ndarray], vehicle: Vehicle | None) -> list[Finding]:
    """Whether there is a flight in the file."""
    t = flight.t
    reasons = []
    for kind, names in command_columns(flight).items():
        values = np.nan_to_num(flight.stack(names).astype(float))
        if kind == "u":
            idle = 0.2 * (vehicle.mass * vehicle.gravity / len(names) if vehicle is not None else 0.0)
        else:
            idle = 0.05 if kind == "motor_command" else 1.0
        if np.median(values) > max(idle, 1e-6):
            return []
        reasons.append(f"{kind}_* at {np.quantile(values, 0.99):.3g}")
    still = True
    if "p" in streams:
        low, high = np.nanquantile(streams["p"], [0.01, 0.99], axis=0)
        spread = float(np.nanmax(high - low))
        still &= bool(spread < 0.1)
        reasons.append(f"position within {spread:.2g} m")
    if "v" in streams:
        fastest = float(np.nanquantile(np.linalg.norm(streams["v"], axis=1), 0.99))
        still &= fastest < 0.15
        reasons.append(f"speed to {fastest:.2g} m/s")
    if not still or not reasons:
        return []
    stopped = any(reason.startswith(("motor", "u_", "rotor")) for reason in reasons)
    noise = float(np.nanstd(streams["w"])) if "w" in streams else 0.0
    if not stopped and noise > 0.02:  # a hover without motor signals: rotors shake the gyro
        return []
    text = f"{', '.join(reasons)} over {t[-1] - t[0]:.1f} s"
    hovers = not stopped and "p" in streams and spread > STANDS and ("v" not in streams or fastest > STANDS)
    severity = "warning" if hovers else "blocking"  # a hover seen by motion capture alone may look like that
    return [Finding("no_flight", severity, "all samples", text, "motors running or motion", "leave the file out")]
