"""Sums of products of measurements and commands over a flight, from which `timing` finds delays.

All that is compared is linear in numbers of the sample, z, with weights that depend on the delays only. So of all
samples only M = sum z z' has to be kept, and what any delays leave is b' M b: every candidate costs the same, however
long the flight. With s_j the thrust over the mass and p_j the torques of the command j + 1 periods ago, and t the time,

    thrust     z = [s_j, s_j^2, t s_j, air, f_z]          air = [1, v_b, |v_b| v_b], given velocity in body axes
    turning    z = [p_j, air, torque that the given rates need]                                    about x, about y
    velocity   z = [R_m' [change of v - g t, sums over SPAN of h R f_i and of h R e_z s_j], 1]   on each axis
    attitude   z = [turn, sums over SPAN of h R w_i, 1]                                           on each axis

R: given attitude in the middle of a period h, R_m: of a span; f_i, w_i: accelerometer and given rate i periods before
its end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg.blas import dger

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.errors import DataError
from quadexp.log.runs import period_of
from quadexp.physics.expression import named_function, named_symbols, unit
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

LARGEST_AGE, LARGEST_DEAD_TIME, LARGEST_LAG = 0.1, 0.1, 0.15  # s
SPAN = 0.12  # s, over which velocity and attitude are compared with their integrals
FELT = 4.0  # time constants for which a command is followed
BEGINS = 0.3  # s, after which the commands before the first are forgotten
CLOCK = 10.0  # s, unit of time within the products
N_AIR = 7  # of the air's columns
LEAST = 100  # samples
ROUND, ROUNDS = 25, 15  # steps of the half, in spans; twice as long from so many steps on


@dataclass(frozen=True)
class Stream:
    """What a controller was given and has sent at k instants, a period (s) apart.

    t: (k,) (s). state: given, (k, 13). specific_force: (k, 3), body (m/s^2). command: (k, n) (N), sent at t.
    """

    t: np.ndarray
    state: np.ndarray
    specific_force: np.ndarray
    command: np.ndarray


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
    """The sums of a stream of one flight. Raises DataError where it is too short.

    thrust, turning_x, turning_y: sums over `counted` samples. velocity, attitude: over `spans`, (3, ..) for the axes.
    half: spans of about the first half, and velocity and attitude over them.
    """

    def __init__(self, stream: Stream, vehicle: Vehicle) -> None:
        if len(stream.t) < LEAST:
            raise DataError(f"delays cannot be found in {len(stream.t)} samples, {LEAST} are needed")
        self.vehicle, self.sizes = vehicle, Sizes(period_of(stream.t))
        function = BufferedFunction(_row(vehicle, self.sizes.period))
        self._given, self._rows = function.arguments, function.results
        names = ("thrust", "turning_x", "turning_y")
        self.thrust, self.turning_x, self.turning_y = totals = [_zeros(self._rows[name].size) for name in names]
        products = [(self._rows[name], total) for name, total in zip(names, totals, strict=True)]
        self._begin_spans()
        self.spans = max(len(stream.t) - self.sizes.span - self.sizes.lags, 0)
        half = half_of(self.spans)
        self.half = (0, self.velocity.copy(), self.attitude.copy())
        first = round(BEGINS / self.sizes.period)
        self.counted = max(len(stream.t) - max(first, 1), 0)
        histories = self._histories(stream)
        for k in range(1, len(stream.t)):
            self._given["x_before"][...], self._given["x"][...] = stream.state[k - 1], stream.state[k]
            self._given["t"][0] = (stream.t[k] - stream.t[0]) / CLOCK
            for name, (history, length) in histories.items():
                self._given[name][...] = history[k : k + length]
            function()
            if k >= first:
                for z, total in products:
                    dger(1.0, z, z, a=total, overwrite_x=False, overwrite_y=False, overwrite_a=True)
            self._add_spans(k, stream.state[k, VELOCITY])
            if half and k + 1 - self.sizes.span - self.sizes.lags == half:
                self.half = (half, self.velocity.copy(), self.attitude.copy())

    def _histories(self, stream: Stream) -> dict[str, tuple[np.ndarray, int]]:
        """Of every vector how it was until each sample, as if it had always been the first before; and how many of
        these the sample takes: of readings until now, of commands without that of now."""
        to_thrusts = np.vstack([np.full(self.vehicle.n_rotors, 1 / self.vehicle.mass), self.vehicle.allocation[1:3]]).T
        to_thrusts = to_thrusts.copy()
        sent = np.array([command @ to_thrusts for command in stream.command])
        readings, commands = self.sizes.lags, self.sizes.all_commands

        def before(values: np.ndarray, length: int) -> np.ndarray:
            return np.vstack([np.tile(values[0], (length, 1)), values])

        return {
            "forces": (before(stream.specific_force, readings), readings + 1),
            "rates": (before(stream.state[:, RATE], readings), readings + 1),
            "thrusts": (before(sent, commands), commands),
        }

    def _begin_spans(self) -> None:
        added = [self._rows[name] for name in ("velocity", "attitude")]
        self.velocity, self.attitude = totals = [np.zeros((3, n, n)) for n in (len(column) + 4 for column in added)]
        sums = [np.zeros((self.sizes.span + 1, *column.shape)) for column in added]
        z = [np.asfortranarray(np.vstack([np.zeros((1 + len(column), 3)), np.eye(3)])) for column in added]
        self._spans = list(zip(added, sums, z, totals, strict=True))
        self._told = np.zeros((self.sizes.span + 1, 2, 3))
        self._rotations = np.zeros((self.sizes.span + 1, 3, 3))
        self._fallen = self.vehicle.gravity * self.sizes.span * self.sizes.period  # m/s in a span
        self._on_body = z[0].copy(order="F")

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


def half_of(spans: int) -> int:
    """About half of them: in steps that grow with the flight, as results of earlier versions have it."""
    apart = ROUND
    while spans >= ROUNDS * apart:
        apart *= 2
    return apart * math.ceil(spans / (2 * apart) - 0.5)


def _zeros(size: int) -> np.ndarray:
    return np.zeros((size, size), order="F")


@lru_cache(maxsize=8)
def _row(vehicle: Vehicle, period: float) -> ca.Function:
    """z of an instant, and what it adds to the sums over spans.

    Inputs: given states x_before, x (13,); forces, rates (3, lags + 1), thrusts (3, all commands), the oldest first: s
    and p, without the command of now; t. Outputs: thrust, turning_x, turning_y; velocity (3, ..) and attitude
    (3, lags + 1); turn (3,); R of x (3, 3).
    """
    sizes = Sizes(period)
    lags, m = sizes.lags, sizes.commands
    shapes = {"x_before": 13, "x": 13, "forces": (3, lags + 1), "rates": (3, lags + 1)}
    shapes |= {"thrusts": (3, sizes.all_commands), "t": 1}
    a = named_symbols(ca.SX, shapes)
    p, q = (unit(a[name][ATTITUDE]) for name in ("x_before", "x"))
    p = p * ca.sign(ca.dot(p, q))
    middle = unit(p + q)
    R = rotation_matrix(middle)
    turn = 2 * (p[0] * q[1:] - q[0] * p[1:] - ca.cross(q[1:], p[1:]))
    newest = list(range(sizes.all_commands - 1, -1, -1))
    s, *torques = (a["thrusts"][i, newest].T for i in range(3))
    v = rotation_matrix(q).T @ a["x"][VELOCITY]
    air = ca.vertcat(1, v, abs(v) * v)
    thrust = ca.vertcat(s[:m], s[:m] ** 2, a["t"] * s[:m], air, a["forces"][2, -1])
    w, J = a["x"][RATE], ca.DM(vehicle.inertia_matrix)
    needed = J @ (w - a["x_before"][RATE]) / period + ca.cross(w, J @ w)
    turning = [ca.vertcat(torques[i][:m], air, needed[i]) for i in range(2)]
    recent = list(range(lags, -1, -1))
    velocity = period * ca.horzcat(R @ a["forces"][:, recent], R[:, 2] @ s.T)
    results = {"thrust": thrust, "turning_x": turning[0], "turning_y": turning[1], "velocity": velocity}
    results |= {"attitude": period * (R @ a["rates"][:, recent]), "turn": turn}
    results["R"] = rotation_matrix(q)
    return named_function("delay_row", a, {name: ca.densify(result) for name, result in results.items()})
