"""Order and spin of the rotors: their thrusts against the angular acceleration that they cause.

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

from quadexp.log.check.commands import command_columns
from quadexp.log.check.finding import Finding
from quadexp.log.schema import Flight
from quadexp.log.signal import runs
from quadexp.physics.vehicle import Vehicle

RATE = 50.0  # Hz: of the fit
BAND = 6.0  # Hz: vehicles turn up to there, vibration shakes above
SLOWEST = 0.3  # Hz: trims and drift are slower
LAGS = np.arange(0.0, 0.125, 0.01)  # s: motors and filters are late by up to this
LEAST_SECONDS = 4.0
EXPLAINS = 0.3  # of an axis' variance that the best order must explain
MARGIN = 0.15  # of the variance, by which it must beat the order given, and the next best
RANK = 0.05  # of the largest singular value: directions in which the rotors did not move
MOST_ROWS = 15_000


@dataclass(frozen=True)
class Motion:
    """torque: J w' + w x J w, thrust: of every rotor (any scale) at each lag: (k, 3), (lags, k, n); no means."""

    torque: np.ndarray
    thrust: np.ndarray


@dataclass(frozen=True)
class Verdict:
    """order: rotor i of the vehicle is the log's order[i]. spin: 1, -1 or 0 (not told). given, best: explained share
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
    signals = command_columns(flight)
    return next((name for name in ("rotor_speed", "u", "motor_command") if name in signals), "")


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
    good = np.isfinite(t) & np.isfinite(w).all(axis=1) & np.isfinite(u).all(axis=1)
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
    return Motion(np.concatenate([one for one, _ in known]), np.concatenate([one for _, one in known], axis=1))


def stretch(t: np.ndarray, w: np.ndarray, u: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Torque (m, 3) and lagged thrusts (lags, m, n) on a uniform clock, in the band, means taken off.

    t: (k,) s. w: (k, 3) rad/s, body. u: (k, n), any scale. J: inertia, (3, 3). None where it is too short or slow.
    """
    from scipy.ndimage import gaussian_filter1d

    if len(t) < 20 or t[-1] - t[0] < 1 / SLOWEST or np.median(np.diff(t)) > 0.03:
        return None
    fine = max(RATE, min(1 / np.median(np.diff(t)), 500.0))
    grid = np.arange(t[0], t[-1], 1 / fine)
    scale = np.sqrt(np.log(2)) / (2 * np.pi) * fine

    def band(x: np.ndarray) -> np.ndarray:
        smooth = gaussian_filter1d(x, scale / BAND, axis=0)
        return smooth - gaussian_filter1d(smooth, scale / SLOWEST, axis=0)

    def at(x: np.ndarray, lag: float = 0.0) -> np.ndarray:
        return np.stack([np.interp(grid - lag, t, column) for column in x.T], axis=1)

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
    scales = [1 / max(float(np.sqrt(np.mean(one.thrust[0] ** 2))), 1e-12) for one in motions]
    torque = np.concatenate([one.torque for one in motions])
    thrust = np.concatenate([s * one.thrust for s, one in zip(scales, motions, strict=True)], axis=1)
    seconds = len(torque) / RATE
    part = slice(None, None, max(1, len(torque) // MOST_ROWS))
    if seconds < LEAST_SECONDS or not (np.mean(torque[part] ** 2, axis=0) > 0).all():
        return None
    fit, pattern, n = Fit(torque[part], thrust[:, part]), vehicle.allocation[1:], vehicle.n_rotors
    orders = list(permutations(range(n))) if n <= 4 else _matched(fit, pattern)
    shares = {order: fit.explained(_reordered(pattern, order)) for order in orders}
    tilt = {order: float(share[:2].mean()) for order, share in shares.items()}
    own = tuple(range(n))
    order = max(orders, key=lambda one: tilt[one] + 1e-9 * (one == own))
    rest = [value for one, value in tilt.items() if one != order]
    clear = n > 4 or not rest or tilt[order] - max(rest) > MARGIN
    against = fit.explained(-_reordered(pattern, order))[2]
    best = shares[order].copy()
    spin = int(np.sign(best[2] - against)) if abs(best[2] - against) > MARGIN else 0
    best[2] = max(best[2], against)
    return Verdict(order, spin, fit.explained(pattern), best, clear, seconds, len(motions))


def _reordered(pattern: np.ndarray, order: Sequence[int]) -> np.ndarray:
    """Columns for the log's rotors, (3, n), where the log's order[i] is rotor i."""
    made = np.empty_like(pattern)
    made[:, list(order)] = pattern
    return made


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
        return np.asarray(share.max(axis=0))

    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        """Torque of each rotor's signal, (3, n), by regression at the lag that explains most, and the share of each
        axis' variance that it explains, (3,); directions in which the rotors hardly moved are left out."""
        fits = []
        for cross, gram in zip(self.cross, self.gram, strict=True):
            made = cross @ np.linalg.pinv(gram, rcond=RANK**2, hermitian=True)
            fits.append((made, np.sum(made * cross, axis=1) / self.power))
        return max(fits, key=lambda one: one[1].mean())


def _matched(fit: Fit, pattern: np.ndarray) -> list[tuple[int, ...]]:
    """The order given and the one whose columns a regression comes nearest to, with either spin."""
    from scipy.optimize import linear_sum_assignment

    found, wanted = (
        x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300) for x in (fit.columns()[0], pattern)
    )
    orders = [tuple(range(pattern.shape[1]))]
    for yaw in (1.0, -1.0, 0.0):
        likeness = (wanted * np.array([[1.0], [1.0], [yaw]])).T @ found
        orders.append(tuple(int(i) for i in linear_sum_assignment(-likeness)[1]))
    return list(dict.fromkeys(orders))


def rotor_findings(verdict: Verdict | None, kind: str, vehicle: Vehicle) -> list[Finding]:
    """A contradiction with the vehicle's layout."""
    if verdict is None or not verdict.sure:
        return []
    where = f"{kind}_* against w_*"
    over = f"over {verdict.seconds:.0f} s" + (f" of {verdict.flights} flights" if verdict.flights > 1 else "")
    found = []
    if verdict.wrong_order:
        given, best = ((f"roll {x[0]:.0%}, pitch {x[1]:.0%}") for x in (verdict.given, verdict.best))
        order = ", ".join(map(str, verdict.order))
        text = f"in the order of {vehicle.name} the rotors explain {given} of the angular acceleration {over};"
        text += f" with the columns {order} as rotors 0, 1, ...: {best}"
        advice = "give the `layout` of the log's motors in the mapping"
        if verdict.clear:
            advice += f", or its columns in the order {order}"
        else:
            text += ", but others come near"
        severity = "blocking" if verdict.clear else "warning"
        found.append(Finding("rotor_order", severity, where, text, f"{MARGIN:.0%} less than another order", advice))
    if verdict.spin < 0:
        text = f"the yaw acceleration is opposite to what {vehicle.name}'s rotors say {over}"
        text += f" ({verdict.best[2]:.0%} of it explained with every spin reversed)"
        advice = "reverse rotor_spin in the vehicle's file, or the order of the motors if that is where it comes from"
        found.append(Finding("rotor_spin", "blocking", where, text, "the vehicle's spin directions", advice))
    return found
