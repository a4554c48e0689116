"""Sums of products of what is told and sent, a sample at a time, from which delays are found (control.delay.timing).

All that is compared is linear in numbers of the sample, z, with weights that depend on the delays only. So of all
samples only M = sum z z' has to be kept, and what any delays leave is b' M b: every sample costs the same, and so does
every candidate, after any number of samples. With s_j the thrust over the mass and p_j the torques of the
command j + 1 periods ago, and t the time,

    thrust     z = [s_j, s_j^2, t s_j, air, f_z]          air = [1, v_b, |v_b| v_b], told velocity in body axes
    turning    z = [p_j, air, torque that the told rates need]                                    about x, about y
    velocity   z = [R_m' [change of v - g t, sums over SPAN of h R f_i and of h R e_z s_j], 1]   on each axis
    attitude   z = [turn, sums over SPAN of h R w_i, 1]                                           on each axis

R: told attitude in the middle of a period h, R_m: of a span; f_i, w_i: accelerometer and told rate i periods before its
end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg.blas import dger

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

LARGEST_AGE, LARGEST_DEAD_TIME, LARGEST_LAG = 0.1, 0.1, 0.15  # s
SPAN = 0.12  # s, over which velocity and attitude are compared with their integrals
FELT = 4.0  # time constants for which a command is followed
BEGINS = 0.3  # s, after which the commands before the first are forgotten
CLOCK = 10.0  # s, unit of time within the products
N_AIR = 7
KEPT = 25  # samples between two records of the sums, of which that nearest to the half is taken; twice as many when
MOST = 8  # records, none of which was made before the half, have become as many


@dataclass(frozen=True)
class Sizes:
    """How many of each there are, for a control period (s): commands, lags of readings, commands with these, span."""

    period: float

    @property
    def commands(self) -> int:
        return math.ceil((LARGEST_DEAD_TIME + LARGEST_AGE + FELT * LARGEST_LAG) / self.period - 1e-9) + 2

    @property
    def lags(self) -> int:
        return math.ceil(LARGEST_AGE / self.period - 1e-9) + 2

    @property
    def all_commands(self) -> int:
        return self.commands + self.lags

    @property
    def span(self) -> int:
        return max(round(SPAN / self.period), 2)

    @property
    def shifts(self) -> np.ndarray:
        """Candidates of an age, four in each control period (s)."""
        return self.period / 4 * np.arange(4 * math.ceil(LARGEST_AGE / self.period - 1e-9) + 1)


class Moments:
    """The sums of a flight; `add` every control instant. samples: taken so far.

    thrust, turning_x, turning_y: sums over `counted` samples. velocity, attitude: over `spans`, (3, ..) for the axes.
    halves: (spans, velocity, attitude) of earlier instants, at most MOST, one of them within an eighth of the half.
    """

    def __init__(self, vehicle: Vehicle, period: float) -> None:
        self.vehicle, self.sizes, self.samples = vehicle, Sizes(period), 0
        self._row = BufferedFunction(_row(vehicle, period))
        given, self._rows = self._row.arguments, self._row.results
        self._given = [given[name] for name in ("x_before", "x", "forces", "rates", "thrusts", "t")]
        self._history = [_History(n) for n in (self.sizes.lags + 1, self.sizes.lags + 1, self.sizes.all_commands)]
        self._to_thrusts = np.vstack([np.full(vehicle.n_rotors, 1 / vehicle.mass), vehicle.allocation[1:3]]).T.copy()
        names = ("thrust", "turning_x", "turning_y")
        self.thrust, self.turning_x, self.turning_y = totals = [_zeros(self._rows[name].size) for name in names]
        self._products = [(self._rows[name], total) for name, total in zip(names, totals, strict=True)]
        added = [self._rows[name] for name in ("velocity", "attitude")]
        self.velocity, self.attitude = totals = [np.zeros((3, n, n)) for n in (len(one) + 4 for one in added)]
        sums = [np.zeros((self.sizes.span + 1, *one.shape)) for one in added]
        z = [np.asfortranarray(np.vstack([np.zeros((1 + len(one), 3)), np.eye(3)])) for one in added]
        self._spans = list(zip(added, sums, z, totals, strict=True))
        self._told = np.zeros((self.sizes.span + 1, 2, 3))
        self._rotations = np.zeros((self.sizes.span + 1, 3, 3))
        self._fallen = vehicle.gravity * self.sizes.span * period  # m/s in a span
        self._on_body = z[0].copy(order="F")
        self._begin = round(BEGINS / period)
        self.counted = 0
        self.halves, self._apart = [(0, self.velocity.copy(), self.attitude.copy())], KEPT

    def add(self, t: float, state: np.ndarray, force: np.ndarray, command: np.ndarray) -> None:
        """Told state, (13,), and reading, (3,), at t (s), and the command that is sent then, (n,) (N)."""
        forces, rates, thrusts = self._history
        k, rate, sent = self.samples, state[RATE], command @ self._to_thrusts
        self.samples += 1
        before, now, *histories, clock = self._given
        if not k:
            before[...], self._start = state, t
            for history, value in zip(self._history, (force, rate, sent), strict=True):
                history.fill(value)
            return
        forces.add(force)
        rates.add(rate)
        now[...], clock[0] = state, (t - self._start) / CLOCK
        for given, history in zip(histories, self._history, strict=True):
            given[...] = history.values
        self._row()
        thrusts.add(sent)
        before[...] = state
        if k >= self._begin:
            self.counted += 1
            for z, total in self._products:
                dger(1.0, z, z, a=total, overwrite_x=False, overwrite_y=False, overwrite_a=True)
        self._add_spans(k, state[VELOCITY])

    def _add_spans(self, k: int, velocity: np.ndarray) -> None:
        rows, span = len(self._told), self.sizes.span
        now, before, first = k % rows, (k - 1) % rows, (k - span) % rows
        turned = self._told[before, 1] + self._rows["turn"]
        self._told[now, 0], self._told[now, 1], self._rotations[now] = velocity, turned, self._rows["R"]
        counts = k >= span + self.sizes.lags
        for i, (added, sums, z, total) in enumerate(self._spans):
            np.add(sums[before], added, out=sums[now])
            if counts:
                z[0] = self._told[now, i] - self._told[first, i]
                np.subtract(sums[now], sums[first], out=z[1:-3])
                if not i:  # velocity: without gravity, on the axes of the body in the middle of the span
                    z[0, 2] += self._fallen
                    turned = self._rotations[(k - span + span // 2) % rows].T
                    np.matmul(z[:-3], turned, out=self._on_body[:-3])
                    z = self._on_body
                for axis in range(3):
                    dger(1.0, z[:, axis], z[:, axis], a=total[axis].T, overwrite_a=True)
        if counts and self.spans % self._apart == 0:
            self._keep_halves()

    def _keep_halves(self) -> None:
        """One more record, of a number that a flight of any length has."""
        self.halves.append((self.spans, self.velocity.copy(), self.attitude.copy()))
        while 2 * self.halves[1][0] <= self.spans:  # the half only grows
            del self.halves[0]
        if len(self.halves) > MOST:
            self._apart *= 2
            self.halves = [one for one in self.halves if one[0] % self._apart == 0]

    @property
    def spans(self) -> int:
        """How many spans are in the sums of velocity and attitude."""
        return max(self.samples - self.sizes.span - self.sizes.lags, 0)


class _History:
    """The last vectors, (count, 3), the oldest first."""

    def __init__(self, count: int) -> None:
        self._count, self._end = count, count
        self._buffer = np.zeros((8 * count, 3))

    def fill(self, value: np.ndarray) -> None:
        """As if it had always been this vector."""
        self._buffer[...] = value

    def add(self, value: np.ndarray) -> None:
        """One more."""
        if self._end == len(self._buffer):
            self._buffer[: self._count] = self._buffer[-self._count :]
            self._end = self._count
        self._buffer[self._end] = value
        self._end += 1

    @property
    def values(self) -> np.ndarray:
        """All that are kept."""
        return self._buffer[self._end - self._count : self._end]


def _zeros(size: int) -> np.ndarray:
    return np.zeros((size, size), order="F")


@lru_cache(maxsize=8)
def _row(vehicle: Vehicle, period: float) -> ca.Function:
    return row_function(vehicle, period)


def row_function(vehicle: Vehicle, period: float) -> ca.Function:
    """z of an instant, and what it adds to the sums over spans.

    Inputs: told states x_before, x (13,); forces, rates (3, lags + 1), thrusts (3, all commands), the oldest first: s
    and p, without the command of now; t. Outputs: thrust, turning_x, turning_y; velocity (3, ..) and attitude
    (3, lags + 1); turn (3,); R of x (3, 3).
    """
    sizes = Sizes(period)
    lags, m = sizes.lags, sizes.commands
    shapes = {"x_before": (13, 1), "x": (13, 1), "forces": (3, lags + 1), "rates": (3, lags + 1)}
    shapes |= {"thrusts": (3, sizes.all_commands), "t": (1, 1)}
    a = {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}
    p, q = (a[name][ATTITUDE] / ca.norm_2(a[name][ATTITUDE]) for name in ("x_before", "x"))
    p = p * ca.sign(ca.dot(p, q))
    middle = (p + q) / ca.norm_2(p + q)
    R = rotation_matrix(middle)
    turn = 2 * (p[0] * q[1:] - q[0] * p[1:] - ca.cross(q[1:], p[1:]))
    newest = list(range(sizes.all_commands - 1, -1, -1))
    s, *torques = (a["thrusts"][i, newest].T for i in range(3))
    v = ca.mtimes(rotation_matrix(q).T, a["x"][VELOCITY])
    air = ca.vertcat(1, v, ca.fabs(v) * v)
    thrust = ca.vertcat(s[:m], s[:m] ** 2, a["t"] * s[:m], air, a["forces"][2, -1])
    w, J = a["x"][RATE], ca.DM(vehicle.inertia_matrix)
    needed = ca.mtimes(J, w - a["x_before"][RATE]) / period + ca.cross(w, ca.mtimes(J, w))
    turning = [ca.vertcat(torques[i][:m], air, needed[i]) for i in range(2)]
    recent = list(range(lags, -1, -1))
    velocity = period * ca.horzcat(ca.mtimes(R, a["forces"][:, recent]), ca.mtimes(R[:, 2], s.T))
    results = {"thrust": thrust, "turning_x": turning[0], "turning_y": turning[1], "velocity": velocity}
    results |= {"attitude": period * ca.mtimes(R, a["rates"][:, recent]), "turn": turn}
    results["R"] = rotation_matrix(q)
    return ca.Function("delay_row", [*a.values()], [ca.densify(r) for r in results.values()], [*a], [*results])
