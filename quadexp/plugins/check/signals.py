"""What a flight says of its rotor signals and battery: commands in range, speeds in rad/s, a voltage that batteries
have, and whether it flew at all."""

from __future__ import annotations

import numpy as np

from quadexp.log.runs import longest
from quadexp.log.schema import Flight
from quadexp.physics.state import norms
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.logs.finding import Finding, of_rows
from quadexp.plugins.logs.samples import rotor_columns
from quadexp.plugins.logs.units import ELECTRICAL, UNITS

ROUNDING = 0.005  # of the range: what quantisation and resampling may add
SATURATED = 0.05  # share of the samples of one rotor
STANDS = 0.01  # m, m/s: what motion capture makes of a vehicle that stands
# A vehicle that flies has one of them.
SPREAD = 0.1  # m
SPEED = 0.15  # m/s
SHAKES = 0.02  # rad/s
CELL = (2.5, 4.45)  # V: of a lithium cell, empty and full
MOST_CELLS = 14  # in series: 60 V
ONE_CELL_MASS = 0.25  # kg: heavier vehicles fly on two cells or more
FASTEST_ROTOR = 1e4  # rad/s: 95 000 rpm, above any propeller drive
FASTEST_MEDIAN = 4e3  # rad/s: 38 000 rpm
HOVER_RANGE = 2.5  # thrust goes with its square: a sixth of the hover's to six times
SLOW = 3.0  # times below the least median speed: certainly another unit
RADIUS = (0.35, 0.5)  # of a rotor over the distance to its neighbour
SPEED_OF_SOUND = 340.0  # m/s
AIR_DENSITY = 1.2  # kg/m^3
LARGEST_THRUST_COEFFICIENT = 0.05  # of a rotor: T / (rho A (w r)^2)


def command_columns(flight: Flight) -> dict[str, list[str]]:
    """Columns of rotor signals by kind, in rotor order."""
    every = {kind: rotor_columns(flight, kind) for kind in ("motor_command", "u", "rotor_speed")}
    return {kind: names for kind, names in every.items() if names}


def signal_kind(flight: Flight) -> str:
    """Which of the flight's rotor signals is used."""
    known = command_columns(flight)
    return next((kind for kind in ("rotor_speed", "u", "motor_command") if kind in known), "")


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


def check_signals(flight: Flight, vehicle: Vehicle | None) -> tuple[list[Finding], np.ndarray]:
    """Commands, the unit of rotor speeds, and voltage; and the samples with a command out of its range, (k,)."""
    unit = check_rotor_unit(flight, vehicle)
    findings = []
    impossible = np.zeros(len(flight), bool)
    for kind, names in command_columns(flight).items():
        if not (unit and kind == "rotor_speed"):  # else its symptom
            more, bad = _check_range(flight, kind, names, vehicle)
            findings += more
            impossible |= bad
    return findings + unit + check_voltage(flight, vehicle), impossible


def _check_range(
    flight: Flight, kind: str, names: list[str], vehicle: Vehicle | None
) -> tuple[list[Finding], np.ndarray]:
    """Commands of one kind that are out of range or saturated; and those samples that are out of range, (k,)."""
    allowed = limits(kind, vehicle)
    values = flight.stack(names).astype(float)
    if allowed is None or not np.isfinite(values).any():
        return [], np.zeros(len(flight), bool)
    findings = []
    low, high, unit = allowed
    finite = np.where(np.isfinite(values), values, low)
    slack = ROUNDING * (high - low)
    outside = (finite < low - slack) | (finite > high + slack)
    bad = np.asarray(outside.any(axis=1))
    if bad.any():
        columns = " ".join(np.array(names)[outside.any(axis=0)])
        text = f"{finite[outside].min():.4g} to {finite[outside].max():.4g}{unit} in {bad.sum()} samples"
        between = f"{low:g}..{high:.4g}{unit}"
        findings.append(of_rows("impossible_command", "blocking", columns, longest(bad), flight.t, text, between))
    share = (finite >= high - 2e-3 * (high - low)).mean(axis=0)
    if kind != "rotor_speed" and share.any():
        most = float(share.max())
        severity = "warning" if most > SATURATED else "info"
        text = f"{most:.2%} of the samples at full command"
        findings.append(Finding("saturation", severity, names[share.argmax()], text, f"{SATURATED:.0%}"))
    return findings, bad


def check_rotor_unit(flight: Flight, vehicle: Vehicle | None) -> list[Finding]:
    """Whether rotor speeds are in rad/s: against the speed at which the vehicle hovers where its thrust coefficient is
    known, else against the speed of sound and what a blade can lift, by the size that rotors beside each other leave.
    """
    names = command_columns(flight).get("rotor_speed", [])
    if not names:
        return []
    values = np.abs(flight.stack(names).astype(float))
    turning = values[values > 0.2 * np.nanmax(values, initial=0.0)]
    if not len(turning):
        return []
    speed = float(np.median(turning))
    low, high = plausible_speeds(vehicle)
    if low <= speed <= high:
        return []
    middle = np.sqrt(max(low, high / 100) * high)
    fitting = {}
    for unit, factor in UNITS["rotor_speed"].items():
        if unit not in ("rad/s", "deg/s", ELECTRICAL) and low <= speed * factor <= high:
            fitting[unit] = abs(np.log(speed * factor / middle))
    severity = "warning" if low / SLOW < speed < low else "blocking"  # a slow rotor may be larger than it is taken for
    text = f"median {speed:.4g} rad/s"
    allowed = f"{low:.3g} to {high:.3g} rad/s"
    if vehicle is not None:
        allowed += f" of {vehicle.name}"
    if not fitting:
        advice = "state the unit of rotor_speed (rpm, Hz, krpm, erpm with pole_pairs) in the mapping"
        return [Finding("units", severity, "rotor_speed_*", text, allowed, advice)]
    unit = min(fitting, key=fitting.__getitem__)
    lines = {"rotor_speed": {"unit": unit}}
    advice = f"correct the mapping of the import: `rotor_speed: {{unit: {unit}}}`"
    return [Finding("units", severity, "rotor_speed_*", f"{text}: {unit}", allowed, advice, correction=lines)]


def plausible_speeds(vehicle: Vehicle | None) -> tuple[float, float]:
    """Least and largest median speed of the rotors of a flight (rad/s).

    With a thrust coefficient k: the hover's, sqrt(m g / (n k)), over and times HOVER_RANGE. Else tips slower than
    sound, and faster than sqrt(T / (C_T rho pi r^2)) with the largest C_T of a rotor; r between RADIUS times the
    distance of neighbouring rotors.
    """
    if vehicle is None:
        return 0.0, FASTEST_MEDIAN
    weight = vehicle.mass * vehicle.gravity / vehicle.n_rotors
    if vehicle.thrust_coefficient:
        hover = float(np.sqrt(weight / vehicle.thrust_coefficient))
        return hover / HOVER_RANGE, hover * HOVER_RANGE
    places = np.array(vehicle.rotor_position, float)
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + 1e9 * np.eye(len(places))
    nearest = float(apart.min())
    small = RADIUS[0] * nearest
    large = RADIUS[1] * nearest
    lift = LARGEST_THRUST_COEFFICIENT * AIR_DENSITY * np.pi * large**2  # over the square of the tip's speed
    return float(np.sqrt(weight / lift)) / large, SPEED_OF_SOUND / small


def check_voltage(flight: Flight, vehicle: Vehicle | None) -> list[Finding]:
    """Whether the voltage is that of a lithium battery, and of one for a vehicle of this mass."""
    if "battery_voltage" not in flight.columns:
        return []
    values = flight["battery_voltage"]
    values = values[np.isfinite(values)]
    middle = float(np.median(values)) if len(values) else 0.0
    least = 1 if vehicle is None or vehicle.mass < ONE_CELL_MASS else 2
    if least * CELL[0] <= middle <= MOST_CELLS * CELL[1]:
        return []
    severity = "warning"
    text = f"median {middle:.3g} V: not measured"
    advice = ""
    if middle > 0:
        severity = "blocking"
        text = f"median {middle:.3g} V"
        advice = "state the unit of battery_voltage (V, dV, cV, mV) in the mapping"
    allowed = f"{CELL[0]:g} to {CELL[1]:g} V a cell, {least} to {MOST_CELLS} cells"
    return [Finding("implausible_voltage", severity, "battery_voltage", text, allowed, advice)]


def check_flown(flight: Flight, streams: dict[str, np.ndarray], vehicle: Vehicle | None) -> list[Finding]:
    """Whether there is a flight in the file."""
    reasons = []
    spread = fastest = 0.0
    signals = command_columns(flight)
    for kind, names in signals.items():
        values = np.nan_to_num(flight.stack(names).astype(float))
        weight = 0.0 if vehicle is None else vehicle.mass * vehicle.gravity / len(names)
        idle = {"u": max(0.2 * weight, 1e-6), "motor_command": 0.05, "rotor_speed": 1.0}
        if np.median(values) > idle[kind]:
            return []
        reasons.append(f"{kind}_* at {np.quantile(values, 0.99):.3g}")
    if "p" in streams:
        low, high = np.nanquantile(streams["p"], [0.01, 0.99], axis=0)
        spread = float(np.nanmax(high - low))
        reasons.append(f"position within {spread:.2g} m")
    if "v" in streams:
        fastest = float(np.nanquantile(norms(streams["v"]), 0.99))
        reasons.append(f"speed to {fastest:.2g} m/s")
    if spread >= SPREAD or fastest >= SPEED or not reasons:
        return []
    if not signals and "w" in streams and np.nanstd(streams["w"]) > SHAKES:
        return []  # a hover without motor signals: rotors shake the gyro
    text = f"{', '.join(reasons)} over {flight.t[-1] - flight.t[0]:.1f} s"
    hovers = not signals and spread > STANDS and ("v" not in streams or fastest > STANDS)
    severity = "warning" if hovers else "blocking"  # a hover seen by motion capture alone may look like that
    return [Finding("no_flight", severity, "all samples", text, "motors running or motion", "leave the file out")]
