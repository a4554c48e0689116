"""What a flight says of the order and the spin of its rotors.

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

from quadexp.log.runs import period_of, runs
from quadexp.log.schema import Flight
from quadexp.physics.state import finite_rows, norms, root_mean_square
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.check.signals import command_columns, signal_kind
from quadexp.plugins.logs.finding import Finding
from quadexp.plugins.logs.signal.windows import STREAMS

RATE = 50.0  # Hz: of the fit
BAND = 6.0  # Hz: vehicles turn up to there, vibration shakes above
SLOWEST = 0.3  # Hz: trims and drift are slower
LAGS = np.arange(0.0, 0.125, 0.01)  # s: motors and filters are late by up to this
FASTEST = 500.0  # Hz: logs above are thinned
SLOWEST_LOG = 0.03  # s a sample
GAP = 5.0  # periods
LEAST_SAMPLES = 20  # of a stretch
LEAST_SECONDS = 4.0  # s of motion at least, else nothing is said
EXPLAINS = 0.3  # of an axis' variance that the best order must explain
MARGIN = 0.15  # of the variance, by which it must beat the order given, and the next best
RANK = 0.05  # of the largest singular value: directions in which the rotors did not move
MOST_ROWS = 15_000  # thinned evenly beyond, as every order of the rotors is tried on them


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


def motion_of(
    flight: Flight, vehicle: Vehicle, w: np.ndarray | None = None, bad: np.ndarray | None = None
) -> Motion | None:
    """What one flight tells about its rotors; None where it has no gyro, no rotor signal or too little of it.

    w: (k, 3) rad/s, body FLU, in place of the flight's own. bad: samples not to be used, (k,).
    """
    kind = signal_kind(flight)
    names = command_columns(flight).get(kind, [])
    if len(names) != vehicle.n_rotors or (w is None and not {*STREAMS["w"]} <= flight.columns.keys()):
        return None
    t = np.asarray(flight.t, float)
    if w is None:
        w = flight.stack(STREAMS["w"]).astype(float)
    u = flight.stack(names).astype(float)
    good = np.isfinite(t) & finite_rows(w) & finite_rows(u)
    if bad is not None:
        good &= ~bad
    if not good.any():
        return None
    thrust = np.clip(u, 0.0, np.quantile(u[good], 0.999)) ** (1 if kind == "u" else 2)
    step = np.diff(t)
    onward = good[1:] & good[:-1] & (step > 0)
    onward &= step < GAP * np.median(step[step > 0])
    if "segment" in flight.columns:
        onward &= np.diff(flight["segment"]) == 0
    torques = []
    thrusts = []
    for start, stop in runs(onward):
        part = slice(start, stop + 1)
        told = stretch(t[part], w[part], thrust[part], vehicle.inertia_matrix)
        if told is not None:
            torques.append(told[0])
            thrusts.append(told[1])
    if sum(map(len, torques)) < LEAST_SECONDS * RATE:
        return None
    return Motion(np.concatenate(torques), np.concatenate(thrusts, axis=1))


def stretch(t: np.ndarray, w: np.ndarray, u: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Torque (m, 3) and lagged thrusts (lags, m, n) on a uniform clock, in the band, means taken off.

    t: (k,) s. w: (k, 3) rad/s, body. u: (k, n), any scale. J: inertia, (3, 3). None where it is too short or slow.
    """
    from scipy.ndimage import gaussian_filter1d

    if len(t) < LEAST_SAMPLES or t[-1] - t[0] < 1 / SLOWEST or period_of(t) > SLOWEST_LOG:
        return None
    rate = np.clip(1 / period_of(t), RATE, FASTEST)
    grid = np.arange(t[0], t[-1], 1 / rate)
    scale = np.sqrt(np.log(2)) / (2 * np.pi) * rate  # over frequency: of a Gaussian 3 dB down there, in samples

    def smooth(x: np.ndarray) -> np.ndarray:
        return gaussian_filter1d(x, scale / BAND, axis=0)

    def band(x: np.ndarray) -> np.ndarray:
        return smooth(x) - gaussian_filter1d(smooth(x), scale / SLOWEST, axis=0)

    def at(times: np.ndarray, x: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(times, t, column) for column in x.T])

    turning = at(grid, w)
    slow = smooth(turning)
    torque = band(np.gradient(turning, grid, axis=0)) @ J + band(np.cross(slow, slow @ J))
    thrust = np.stack([band(at(grid - lag, u)) for lag in LAGS])
    edge = int(0.2 * rate)
    kept = slice(edge, len(grid) - edge, max(1, round(rate / RATE)))
    torque = torque[kept]
    thrust = thrust[:, kept]
    if len(torque) < LEAST_SAMPLES:
        return None
    return torque - torque.mean(axis=0), thrust - thrust.mean(axis=1, keepdims=True)


def judge(motions: Sequence[Motion], vehicle: Vehicle) -> Verdict | None:
    """The order and spin that fit flights of one vehicle best; None where they tell too little."""
    torque = np.concatenate([motion.torque for motion in motions])
    scaled = []
    for motion in motions:  # a thrust has another scale in every flight (battery), the same for all rotors
        scaled.append(motion.thrust / max(root_mean_square(motion.thrust[0]), 1e-12))
    thrust = np.concatenate(scaled, axis=1)
    seconds = len(torque) / RATE
    thinned = slice(None, None, max(1, len(torque) // MOST_ROWS))
    if seconds < LEAST_SECONDS or not torque[thinned].any(axis=0).all():
        return None
    fit = Fit(torque[thinned], thrust[:, thinned])
    pattern = vehicle.allocation[1:]
    n = vehicle.n_rotors
    stated = tuple(range(n))
    shares = {stated: fit.explained(pattern)}
    for order in permutations(range(n)) if n <= 4 else _matched(fit, pattern):
        shares[order] = fit.explained(_reordered(pattern, order))
    tilt = {order: float(share[:2].mean()) for order, share in shares.items()}
    order = max(tilt, key=tilt.__getitem__)  # of equals the one stated, which is the first
    next_best = max((value for other, value in tilt.items() if other != order), default=-np.inf)
    clear = n > 4 or tilt[order] - next_best > MARGIN
    best = shares[order].copy()
    opposite = fit.explained(-_reordered(pattern, order))[2]
    lead = best[2] - opposite
    spin = int(np.sign(lead)) if abs(lead) > MARGIN else 0
    best[2] = max(best[2], opposite)
    return Verdict(order, spin, shares[stated], best, clear, seconds, len(motions))


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

    def columns(self) -> np.ndarray:
        """Torque of each rotor's signal, (3, n), by regression at the lag that explains most; directions in which the
        rotors hardly moved are left out."""
        fits = self.cross @ np.linalg.pinv(self.gram, rcond=RANK**2, hermitian=True)
        shares = np.sum(fits * self.cross, axis=2) / self.power
        return fits[shares.mean(axis=1).argmax()]


def _matched(fit: Fit, pattern: np.ndarray) -> list[tuple[int, ...]]:
    """The orders whose columns a regression comes nearest to, with either spin, and whatever the spin."""
    from scipy.optimize import linear_sum_assignment

    fitted = _unit_rows(fit.columns())
    orders = []
    for yaw in (1.0, -1.0, 0.0):
        likeness = (_unit_rows(pattern) * np.array([[1.0], [1.0], [yaw]])).T @ fitted
        orders.append(tuple(linear_sum_assignment(likeness, maximize=True)[1].tolist()))
    return orders


def _unit_rows(x: np.ndarray) -> np.ndarray:
    return x / np.maximum(norms(x), 1e-300)[:, None]


def rotor_findings(verdict: Verdict | None, kind: str, vehicle: Vehicle) -> list[Finding]:
    """A contradiction with the vehicle's layout."""
    if verdict is None or not verdict.sure:
        return []
    where = f"{kind}_* against w_*"
    over = f"over {verdict.seconds:.0f} s"
    if verdict.flights > 1:
        over += f" of {verdict.flights} flights"
    findings = []
    if verdict.wrong_order:
        stated = f"roll {verdict.given[0]:.0%}, pitch {verdict.given[1]:.0%}"
        best = f"roll {verdict.best[0]:.0%}, pitch {verdict.best[1]:.0%}"
        order = ", ".join(map(str, verdict.order))
        text = f"in the order of {vehicle.name} the rotors explain {stated} of the angular acceleration {over};"
        text += f" with the columns {order} as rotors 0, 1, ...: {best}"
        severity = "blocking" if verdict.clear else "warning"
        advice = "give the `layout` of the log's motors in the mapping"
        if verdict.clear:
            advice += f", or its columns in the order {order}"
        else:
            text += ", but others come near"
        findings.append(Finding("rotor_order", severity, where, text, f"{MARGIN:.0%} less than another order", advice))
    if verdict.spin < 0:
        text = f"the yaw acceleration is opposite to what {vehicle.name}'s rotors say {over}"
        text += f" ({verdict.best[2]:.0%} of it explained with every spin reversed)"
        advice = "reverse rotor_spin in the vehicle's file, or the order of the motors if that is where it comes from"
        findings.append(Finding("rotor_spin", "blocking", where, text, "the vehicle's spin directions", advice))
    return findings
