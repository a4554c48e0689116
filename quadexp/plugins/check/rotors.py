"""What a flight says of its rotors and battery: commands in range, order and spin, a voltage that batteries have.

    J w' + w x J w = sum_i (r_i x e_z + c_tau s_i e_z) u_i        w: gyro; u_i: signal of rotor i as a thrust

A flight is fitted axis by axis with a gain, a lag and an offset of its own (real arms, thrust curves and motors are off
by those), so what is tested is the pattern over the rotors alone. Four rotors: every order, and every
order of the reaction torques' signs that is the vehicle's or its opposite. More rotors: a regression on every rotor,
whose coefficients are matched with the vehicle's columns (Kuhn 1955). Roll and pitch tell the order, yaw the spin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from quadexp.log.runs import longest, period_of, runs
from quadexp.log.schema import Flight
from quadexp.names import distinct
from quadexp.physics.state import finite_rows, norms, root_mean_square
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.logs.finding import Finding, of_rows
from quadexp.plugins.logs.samples import rotor_columns
from quadexp.plugins.logs.units import ELECTRICAL, UNITS

# Of commands and battery:
ROUNDING = 0.005  # of the range: what quantisation and resampling may add
SATURATED = 0.05  # share of the samples of one rotor
STANDS = 0.01  # m, m/s: what motion capture makes of a vehicle that stands
CELL = (2.5, 4.45)  # V: of a lithium cell, empty and full
MOST_CELLS = 14  # in series: 60 V
ONE_CELL_MASS = 0.25  # kg: heavier vehicles fly on two cells or more
FASTEST_ROTOR = 1e4  # rad/s: 95 000 rpm, above any propeller drive
FASTEST_MEDIAN = 4e3  # rad/s: 38 000 rpm
HOVER_RANGE = 2.5  # thrust goes with its square: a sixth of the hover's to six times
SLOW = 3.0  # times below the least median speed: certainly another unit
RADIUS = (0.35, 0.5)  # of a rotor over the distance to its neighbour
SPEED_OF_SOUND, AIR_DENSITY = 340.0, 1.2  # m/s, kg/m^3
LARGEST_THRUST_COEFFICIENT = 0.05  # of a rotor: T / (rho A (w r)^2)
# Of order and spin:
RATE = 50.0  # Hz: of the fit
BAND = 6.0  # Hz: vehicles turn up to there, vibration shakes above
SLOWEST = 0.3  # Hz: trims and drift are slower
LAGS = np.arange(0.0, 0.125, 0.01)  # s: motors and filters are late by up to this
LEAST_SECONDS = 4.0  # s of motion at least, else nothing is said
EXPLAINS = 0.3  # of an axis' variance that the best order must explain
MARGIN = 0.15  # of the variance, by which it must beat the order given, and the next best
RANK = 0.05  # of the largest singular value: directions in which the rotors did not move
MOST_ROWS = 15_000  # thinned evenly beyond, as every order of the rotors is tried on them


def command_columns(flight: Flight) -> dict[str, list[str]]:
    """Columns of rotor signals by kind, in rotor order."""
    every = {kind: rotor_columns(flight, kind) for kind in ("motor_command", "u", "rotor_speed")}
    return {kind: names for kind, names in every.items() if names}


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
    findings, impossible = [], np.zeros(len(flight), bool)
    for kind, names in command_columns(flight).items():
        allowed = limits(kind, vehicle)
        values = flight.stack(names).astype(float)
        if allowed is None or not np.isfinite(values).any():
            continue
        low, high, unit = allowed
        finite = np.where(np.isfinite(values), values, low)
        slack = ROUNDING * (high - low)
        outside = (finite < low - slack) | (finite > high + slack)
        if outside.any():
            mask, of_rotor = np.asarray(outside.any(axis=1)), np.asarray(outside.any(axis=0))
            impossible |= mask
            columns = " ".join(name for name, bad in zip(names, of_rotor, strict=True) if bad)
            text = f"{finite[outside].min():.4g} to {finite[outside].max():.4g}{unit} in {mask.sum()} samples"
            between = f"{low:g}..{high:.4g}{unit}"
            findings.append(of_rows("impossible_command", "blocking", columns, longest(mask), flight.t, text, between))
        share = (finite >= high - 2e-3 * (high - low)).mean(axis=0)
        if kind != "rotor_speed" and share.max() > 0:
            k = int(np.argmax(share))
            severity = "warning" if share[k] > SATURATED else "info"
            text = f"{share[k]:.2%} of the samples at full command"
            findings.append(Finding("saturation", severity, names[k], text, f"{SATURATED:.0%}"))
    return findings, impossible


def check_rotor_unit(flight: Flight, vehicle: Vehicle | None) -> list[Finding]:
    """Whether rotor speeds are in rad/s: against the speed at which the vehicle hovers where its thrust coefficient is
    known, else against the speed of sound and what a blade can lift, by the size that rotors beside each other leave.
    """
    names = command_columns(flight).get("rotor_speed", [])
    values = np.abs(flight.stack(names).astype(float)) if names else np.zeros((0, 1))
    turning = values[np.isfinite(values) & (values > 0.2 * np.nanmax(values, initial=0.0))]
    if not len(turning):
        return []
    speed = float(np.median(turning))
    low, high = plausible_speeds(vehicle)
    if low <= speed <= high:
        return []
    middle = np.sqrt(max(low, high / 100) * high)
    factors = {
        unit: factor for unit, factor in UNITS["rotor_speed"].items() if unit not in ("rad/s", "deg/s", ELECTRICAL)
    }
    fitting = [unit for unit, factor in factors.items() if low <= speed * factor <= high]
    unit = min(fitting, key=lambda name: abs(np.log(speed * factors[name] / middle)), default="")
    severity = "warning" if low / SLOW < speed < low else "blocking"  # a slow rotor may be larger than it is taken for
    text = f"median {speed:.4g} rad/s"
    allowed = f"{low:.3g} to {high:.3g} rad/s" + ("" if vehicle is None else f" of {vehicle.name}")
    if not unit:
        advice = "state the unit of rotor_speed (rpm, Hz, krpm, erpm with pole_pairs) in the mapping"
        return [Finding("units", severity, "rotor_speed_*", text, allowed, advice)]
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
    small, large = (share * float(apart.min()) for share in RADIUS)
    lifting = float(np.sqrt(weight / (LARGEST_THRUST_COEFFICIENT * AIR_DENSITY * np.pi * large**2))) / large
    return lifting, SPEED_OF_SOUND / small


def check_voltage(flight: Flight, vehicle: Vehicle | None) -> list[Finding]:
    """Whether the voltage is that of a lithium battery, and of one for a vehicle of this mass."""
    if "battery_voltage" not in flight.columns:
        return []
    values = flight["battery_voltage"][np.isfinite(flight["battery_voltage"])]
    middle = float(np.median(values)) if len(values) else 0.0
    least = 1 if vehicle is None or vehicle.mass < ONE_CELL_MASS else 2
    if least * CELL[0] <= middle <= MOST_CELLS * CELL[1]:
        return []
    allowed = f"{CELL[0]:g} to {CELL[1]:g} V a cell, {least} to {MOST_CELLS} cells"
    if not middle > 0:
        text = f"median {middle:.3g} V: not measured"
        return [Finding("implausible_voltage", "warning", "battery_voltage", text, allowed)]
    advice = "state the unit of battery_voltage (V, dV, cV, mV) in the mapping"
    return [Finding("implausible_voltage", "blocking", "battery_voltage", f"median {middle:.3g} V", allowed, advice)]


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
        fastest = float(np.nanquantile(norms(streams["v"]), 0.99))
        reasons.append(f"speed to {fastest:.2g} m/s")
    if spread >= 0.1 or fastest >= 0.15 or not reasons:
        return []
    if not signals and "w" in streams and float(np.nanstd(streams["w"])) > 0.02:
        return []  # a hover without motor signals: rotors shake the gyro
    text = f"{', '.join(reasons)} over {flight.t[-1] - flight.t[0]:.1f} s"
    hovers = not signals and spread > STANDS and ("v" not in streams or fastest > STANDS)
    severity = "warning" if hovers else "blocking"  # a hover seen by motion capture alone may look like that
    return [Finding("no_flight", severity, "all samples", text, "motors running or motion", "leave the file out")]


# ------------------------------------------------------------------------------------------------------ order and spin
@dataclass(frozen=True)
class Motion:
    """torque: J w' + w x J w, thrust: of every rotor (any scale) at each lag: (k, 3), (lags, k, n); no means."""

    torque: np.ndarray
    thrust: np.ndarray


@dataclass(frozen=True)
class Verdict:
    """order: rotor i of the vehicle is the log's order[i]. spin: 1, -1 or 0 (not given). given, best: explained share
    of each axis under the vehicle's own order and under the best, (3,). clear: whether the next best is far behind."""

    order: tuple[int, ...]
    spin: int
    given: np.ndarray
    best: np.ndarray
    clear: bool
    seconds: float
    flights: int = 1

    @property
    def sure(self) -> bool:
        """Whether the flights moved enough to tell the order."""
        return bool(self.best[:2].min() > EXPLAINS)

    @property
    def wrong_order(self) -> bool:
        other = self.order != tuple(range(len(self.order)))
        return bool(other and self.sure and self.best[:2].mean() - self.given[:2].mean() > MARGIN)


def signal_kind(flight: Flight) -> str:
    """Which of the flight's rotor signals is used."""
    return next((name for name in ("rotor_speed", "u", "motor_command") if name in command_columns(flight)), "")


def motion_of(
    flight: Flight, vehicle: Vehicle, w: np.ndarray | None = None, bad: np.ndarray | None = None
) -> Motion | None:
    """What one flight tells about its rotors; None where it has no gyro, no rotor signal or too little of it.

    w: (k, 3) rad/s, body FLU, in place of the flight's own. bad: samples not to be used, (k,).
    """
    kind = signal_kind(flight)
    names = command_columns(flight).get(kind, [])
    if len(names) != vehicle.n_rotors or (w is None and not {"w_x", "w_y", "w_z"} <= set(flight.columns)):
        return None
    t = np.asarray(flight.t, float)
    w = flight.stack(["w_x", "w_y", "w_z"]).astype(float) if w is None else w
    u = flight.stack(names).astype(float)
    good = np.isfinite(t) & finite_rows(w) & finite_rows(u)
    good &= True if bad is None else ~bad
    u = np.clip(u, 0.0, np.quantile(u[good], 0.999) if good.any() else 0.0) ** (1 if kind == "u" else 2)
    segment = np.asarray(flight.columns.get("segment", np.zeros(len(t))))
    parts = []
    for start, stop in runs(good):
        step = np.diff(t[start:stop])
        usual = np.median(step[step > 0]) if (step > 0).any() else 1.0
        breaks = (step <= 0) | (step > 5 * usual) | (np.diff(segment[start:stop]) != 0)
        for part in np.split(np.arange(start, stop), np.flatnonzero(breaks) + 1):
            parts.append(stretch(t[part], w[part], u[part], vehicle.inertia_matrix))
    known = [part for part in parts if part is not None]
    if sum(len(torque) for torque, _ in known) < LEAST_SECONDS * RATE:
        return None
    torques, thrusts = zip(*known, strict=True)
    return Motion(np.concatenate(torques), np.concatenate(thrusts, axis=1))


def stretch(t: np.ndarray, w: np.ndarray, u: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Torque (m, 3) and lagged thrusts (lags, m, n) on a uniform clock, in the band, means taken off.

    t: (k,) s. w: (k, 3) rad/s, body. u: (k, n), any scale. J: inertia, (3, 3). None where it is too short or slow.
    """
    from scipy.ndimage import gaussian_filter1d

    if len(t) < 20 or t[-1] - t[0] < 1 / SLOWEST or period_of(t) > 0.03:
        return None
    fine = max(RATE, min(1 / period_of(t), 500.0))
    grid = np.arange(t[0], t[-1], 1 / fine)
    scale = np.sqrt(np.log(2)) / (2 * np.pi) * fine

    def band(x: np.ndarray) -> np.ndarray:
        smooth = gaussian_filter1d(x, scale / BAND, axis=0)
        return smooth - gaussian_filter1d(smooth, scale / SLOWEST, axis=0)

    def at(x: np.ndarray, lag: float = 0.0) -> np.ndarray:
        return np.column_stack([np.interp(grid - lag, t, column) for column in x.T])

    rate = at(w)
    smooth = gaussian_filter1d(rate, scale / BAND, axis=0)
    torque = band(np.gradient(rate, grid, axis=0)) @ J + band(np.cross(smooth, smooth @ J))
    edge = int(0.2 * fine)
    kept = slice(edge, len(grid) - edge, max(1, round(fine / RATE)))
    if len(grid[kept]) < 20:
        return None
    thrust = np.stack([band(at(u, lag))[kept] for lag in LAGS])
    return torque[kept] - torque[kept].mean(axis=0), thrust - thrust.mean(axis=1, keepdims=True)


def judge(motions: Sequence[Motion], vehicle: Vehicle) -> Verdict | None:
    """The order and spin that fit flights of one vehicle best; None where they tell too little."""
    # a thrust has another scale in every flight (battery), the same for all rotors
    scales = [1 / max(root_mean_square(motion.thrust[0]), 1e-12) for motion in motions]
    torque = np.concatenate([motion.torque for motion in motions])
    thrust = np.concatenate([s * motion.thrust for s, motion in zip(scales, motions, strict=True)], axis=1)
    seconds = len(torque) / RATE
    part = slice(None, None, max(1, len(torque) // MOST_ROWS))
    if seconds < LEAST_SECONDS or not (np.mean(torque[part] ** 2, axis=0) > 0).all():
        return None
    fit, pattern, n = Fit(torque[part], thrust[:, part]), vehicle.allocation[1:], vehicle.n_rotors
    orders = list(permutations(range(n))) if n <= 4 else _matched(fit, pattern)
    shares = {order: fit.explained(_reordered(pattern, order)) for order in orders}
    tilt = {order: float(share[:2].mean()) for order, share in shares.items()}
    stated = tuple(range(n))
    order = max(orders, key=lambda each: tilt[each] + 1e-9 * (each == stated))
    rest = [value for other, value in tilt.items() if other != order]
    clear = n > 4 or not rest or tilt[order] - max(rest) > MARGIN
    against = fit.explained(-_reordered(pattern, order))[2]
    best = shares[order].copy()
    spin = int(np.sign(best[2] - against)) if abs(best[2] - against) > MARGIN else 0
    best[2] = max(best[2], against)
    return Verdict(order, spin, fit.explained(pattern), best, clear, seconds, len(motions))


def _reordered(pattern: np.ndarray, order: Sequence[int]) -> np.ndarray:
    """Columns for the log's rotors, (3, n), where the log's order[i] is rotor i."""
    columns = np.empty_like(pattern)
    columns[:, list(order)] = pattern
    return columns


class Fit:
    """Sums over the samples, of which each order of the rotors is judged at little cost."""

    def __init__(self, torque: np.ndarray, thrust: np.ndarray) -> None:
        self.power = np.sum(torque**2, axis=0)
        self.cross = np.einsum("ka,lkn->lan", torque, thrust)
        self.gram = np.einsum("lkn,lkm->lnm", thrust, thrust)

    def explained(self, pattern: np.ndarray) -> np.ndarray:
        """Share of each axis' variance, (3,), at the best lag, with a gain that is positive: 0 where it is not."""
        along = np.einsum("lan,an->la", self.cross, pattern)
        size = np.einsum("an,lnm,am->la", pattern, self.gram, pattern)
        share = np.where(along > 0, along**2 / np.maximum(size, 1e-300), 0.0) / self.power
        return share.max(axis=0)

    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        """Torque of each rotor's signal, (3, n), by regression at the lag that explains most, and the share of each
        axis' variance that it explains, (3,); directions in which the rotors hardly moved are left out."""
        fits = []
        for cross, gram in zip(self.cross, self.gram, strict=True):
            columns = cross @ np.linalg.pinv(gram, rcond=RANK**2, hermitian=True)
            fits.append((columns, np.sum(columns * cross, axis=1) / self.power))
        return max(fits, key=lambda fit: fit[1].mean())


def _matched(fit: Fit, pattern: np.ndarray) -> list[tuple[int, ...]]:
    """The order given and the one whose columns a regression comes nearest to, with either spin."""
    from scipy.optimize import linear_sum_assignment

    fitted, wanted = (
        x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300) for x in (fit.columns()[0], pattern)
    )
    orders = [tuple(range(pattern.shape[1]))]
    for yaw in (1.0, -1.0, 0.0):
        likeness = (wanted * np.array([[1.0], [1.0], [yaw]])).T @ fitted
        orders.append(tuple(int(i) for i in linear_sum_assignment(-likeness)[1]))
    return distinct(orders)


def rotor_findings(verdict: Verdict | None, kind: str, vehicle: Vehicle) -> list[Finding]:
    """A contradiction with the vehicle's layout."""
    if verdict is None or not verdict.sure:
        return []
    where = f"{kind}_* against w_*"
    over = f"over {verdict.seconds:.0f} s" + (f" of {verdict.flights} flights" if verdict.flights > 1 else "")
    findings = []
    if verdict.wrong_order:
        stated, best = ((f"roll {x[0]:.0%}, pitch {x[1]:.0%}") for x in (verdict.given, verdict.best))
        order = ", ".join(map(str, verdict.order))
        text = f"in the order of {vehicle.name} the rotors explain {stated} of the angular acceleration {over};"
        text += f" with the columns {order} as rotors 0, 1, ...: {best}"
        advice = "give the `layout` of the log's motors in the mapping"
        if verdict.clear:
            advice += f", or its columns in the order {order}"
        else:
            text += ", but others come near"
        severity = "blocking" if verdict.clear else "warning"
        findings.append(Finding("rotor_order", severity, where, text, f"{MARGIN:.0%} less than another order", advice))
    if verdict.spin < 0:
        text = f"the yaw acceleration is opposite to what {vehicle.name}'s rotors say {over}"
        text += f" ({verdict.best[2]:.0%} of it explained with every spin reversed)"
        advice = "reverse rotor_spin in the vehicle's file, or the order of the motors if that is where it comes from"
        findings.append(Finding("rotor_spin", "blocking", where, text, "the vehicle's spin directions", advice))
    return findings
