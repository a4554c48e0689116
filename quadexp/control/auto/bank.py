"""Innovations of Kalman filters for every age, dead time and lag at once, as sums that grow with the flight.

A hypothesis is an age a of the told state, a dead time d and a lag l of the commands. Three filters run for each:

    gyro       w+ = w + T (J^-1 (tau - w x J w) + b),  b+ = b + noise       tells a + d and l
    thrust     f_z = (1 + k) T_z / m + a_air,z + b,    b+ = b + noise       tells d and l
    velocity   v+ = v + T (R (f(t - a) - beta) + g)                         tells a
    attitude   q+ = q Exp(T (w(t - a) - beta_w))                            tells a, where the told rates are of now

f: accelerometer, beta: its bias; tau, T_z: torque and thrust of the commands after d and l. The gains are the same for
all hypotheses, and stationary, but for that of the velocity, which follows the measured noise. So a filter is linear,
and an innovation is linear in the weights W that a hypothesis gives to the last commands (control.delivered) or to the
last readings:

    nu = y - W phi            y, phi: what the filter makes of the readings, and of each of the last commands by itself
    sum nu^2 = [1, -W] G [1, -W]',      G = sum z z',      z = [y, phi]

One matrix G of each filter has the sum of squares of every hypothesis, those between the points of a grid included, and
the products of successive innovations, which say how correlated they are. phi of commands moves on by one entry each
period, so that with p = phi_0 an entry of G is the one before it on its diagonal, a period earlier:

    G_t[p_i+1, p_j+1] = G_t-1[p_i, p_j]

The rows of y and p are summed up in flight, the others follow from them where somebody asks (`products`). The noise of
the gyro and of the velocity is one of a few (SPINS, SPEEDS): the likeliest counts.

A reading along the thrust may jump within a period in which the vehicle turns. So its phi are two, of the mean of the
force and of its first moment: R f = R_m (1 + (t - t_m) w x) f, m: of the middle of the period.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import accumulate
from itertools import product as combinations

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.auto.senses import UNSURE, WARM, sense_sizes, sensed
from quadexp.control.built import built
from quadexp.control.delivered import SETTLED
from quadexp.control.instant import Operation, Told, call, copy, gather
from quadexp.models.residual import Residual
from quadexp.physics.rigid_body import body_features
from quadexp.physics.rotation import product, rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

PERIOD = 0.01  # s, about: of the bank, a whole multiple of the control period
AGE, DEAD_TIME, LAG = 0.06, 0.06, 0.064  # s, the largest hypotheses
SPINS = tuple(
    combinations((0.0003, 0.005, 0.05), (0.03, 0.3, 3.0))
)  # rad/s of a reading, rad/s^2 of b in a root of a second
SPEEDS = (0.0001, 0.003, 0.03)  # m/s, of a told velocity
THRUST = (0.28, 1.0)  # m/s^2 of a reading on z with its model, m/s^2 of b in a root of a second
SHEET = 3.0  # factor by which a data sheet may be wrong
LEAST_TURN, LEAST_ATTITUDE = 3e-4, 1e-5  # rad/s of a reading of the gyroscope, rad of a told attitude
STILL = AGE + 0.02  # s, for which told attitudes may be those from before the flight
SKIPPED = 0.1  # s, until the filters are stationary
FADING = 20.0  # s, of the sums over commands: the scale of the thrust moves with the battery


class Layout:
    """Places in a bank's memory, by name. commands: m that are kept. readings: of the accelerometer. columns: of the
    filter of the velocity: y, two phi of each reading along the thrust, phi of each across it and of each axis of beta.
    turning: of that of the attitude: y, phi of each reading, phi of each axis of beta. rows: of a sum over commands: y,
    the y before, phi of m + 1 commands. skipped: periods, until sums begin."""

    def __init__(self, period: float) -> None:
        self.skipped = round(SKIPPED / period)
        self.commands = math.ceil((AGE + DEAD_TIME + SETTLED * LAG + period) / period - 1e-9) + 1
        self.readings = int(AGE / period + 1e-9) + 3
        self.columns, self.turning, self.rows = 1 + 3 * self.readings + 3, 1 + self.readings + 3, self.commands + 3
        channels, speed = 2 * len(SPINS), 3 * self.columns * len(SPEEDS)
        sizes = {"count": 1, "x": N_STATE, "forces": 3 * self.readings, "sent": 3 * self.commands, "spin": 4 * channels}
        sizes |= {"push": 2, "speed": speed}
        sizes |= {"speed_before": 2 * self.columns * len(SPEEDS)}
        sizes |= {"lateral": 1, "rates": 3 * self.readings, "turn": 3 * self.turning}
        sizes |= sense_sizes()
        ends = [*accumulate(sizes.values())]
        self.size = ends[-1]
        self.slices = {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


class Bank:
    """The sums of a flight and what else is measured in it; `reset` begins one, and its operations stand `after` the
    controller's, at every control instant.

    theta: parameters of the residual, shared. noise: standard deviation of a reading of the accelerometer (m/s^2).
    spans: over which readings of accelerometer and gyroscope are means (s).
    period: of the bank (s), `every` control periods. memory: see Layout. lines: (rows - 1, channels), y and phi of the
    commands, the newest first; channels: two axes of each of SPINS, and the thrust. sums: (2, rows, channels), of y and
    p with the y before and lines. speed_sums: (SPEEDS, columns, 2 columns), of an innovation with
    itself and with the one before; turn_sums: of the attitude, likewise. turned_by: what gyroscope and attitude are off
    by (rad/s, rad). weights: (2, m) on the commands, the newest last, of the likeliest thrusts: now, and their mean
    over a period as old as the told rates. gains: (2,) of the torque, see senses.py. bias: of the accelerometer, (3,)
    (m/s^2).
    """

    def __init__(
        self, vehicle: Vehicle, residual: Residual, theta: np.ndarray, control_period: float, noise: float,
        backend: str, turning: tuple[float, float] = (0.0, 0.0), spans: tuple[float, float] = (0.0, 0.0),
    ) -> None:  # fmt: skip
        self.spans = spans
        self.vehicle, self.every = vehicle, max(1, round(PERIOD / control_period))
        self.period = self.every * control_period
        self.layout = Layout(self.period)
        function = built(backend, bank_function, vehicle, residual, self.period, self.every)
        self._update = BufferedFunction(function, {"theta": theta})
        given = self._update.arguments
        self.memory, self.weights, self.gains, self.bias = (given[k] for k in ("memory", "weights", "gains", "bias"))
        columns, turn = self.layout.columns, self.layout.turning
        self._lines = np.zeros((self.layout.rows, 2 * len(SPINS) + 1))
        self.lines, self.sums = self._lines[1:], np.zeros((2, *self._lines.shape))
        self._first = np.zeros(self.lines.shape)
        self.speed_sums, self.turn_sums = np.zeros((len(SPEEDS), columns, 2 * columns)), np.zeros((turn, 2 * turn))
        given["noise"][...] = self.noise = noise
        self.turned_by = LEAST_TURN * self.period + turning[0] * self.period, LEAST_ATTITUDE + turning[1]
        given["kept_turn"][...] = 1 - stationary_scalar(self.turned_by[1], self.turned_by[0])
        self._sent = given["u"]

    def part(self, name: str) -> np.ndarray:
        """What the memory has under a name."""
        return self.memory[self.layout.slices[name]]

    @property
    def count(self) -> int:
        """Innovations of an axis in the sums."""
        return max(int(self.part("count")[0]) - self.layout.skipped, 0)

    @property
    def turns(self) -> int:
        """Innovations of an axis of the attitude in its sums."""
        return max(int(self.part("count")[0] - STILL / self.period), 0)

    def follow(self, spin: int) -> None:
        """Estimate the torque by the filter of one of SPINS."""
        self.spin = spin
        *gains, self.torque_deviation = stationary(*SPINS[spin], self.period)
        self.gains[...] = gains

    @property
    def reading_noise(self) -> np.ndarray:
        """Standard deviation of readings from the model, (3,) (m/s^2)."""
        least = np.array([self.noise, self.noise, math.hypot(self.noise, UNSURE)]) ** 2
        warm = self.part("count")[0] > WARM / self.period
        return np.sqrt(np.maximum(self.part("noise"), least) if warm else least)

    @property
    def lateral_noise(self) -> float:
        """Standard deviation of readings across the thrust, see lateral_variance (m/s^2)."""
        return math.sqrt(self.part("lateral")[0])

    @property
    def pose_noise(self) -> np.ndarray:
        """Standard deviations of the told position (m) and attitude (rad)."""
        return np.sqrt(np.maximum(self.part("pose_noise"), 0.0)) * (self.part("count")[0] > WARM / self.period)

    def reset(self, x: np.ndarray, thrust: np.ndarray) -> None:
        """Begin a flight in the state x, (13,); this command, (n,) (N), has been sent for a long time."""
        sums = self.sums, self.speed_sums, self.turn_sums
        for array in (self.memory, self._lines, self._first, *sums, self.bias):
            array[...] = 0.0
        self.follow(0)
        spin, pushed = spin_of(self.vehicle) @ thrust, thrust.sum() / self.vehicle.mass
        self.part("x")[...], self.part("push")[...] = x, (pushed, pushed)
        self.part("sent")[...] = np.tile([*spin, pushed], self.layout.commands)
        self.part("rates")[...] = np.tile(x[RATE], self.layout.readings)
        self.part("forces")[...] = np.tile([0.0, 0.0, pushed], self.layout.readings)
        self.part("spin")[: 2 * len(SPINS)] = np.tile(x[RATE][:2], len(SPINS))
        self.part("torque")[:2] = x[RATE][:2]
        self.part("walk_variance")[...], self.part("lateral")[...] = 9.0, self.noise**2
        self.part("speed").reshape(len(SPEEDS), 3, self.layout.columns)[..., 0] = x[VELOCITY]
        self._sent[...] = self.every * thrust

    def after(self, told: Told, state: np.ndarray, command: np.ndarray) -> list[Operation]:
        """Takes in what is told, the state that is found there, (13,), and then the command, (n,) (N)."""
        given, left, z, read = self._update.arguments, self._update.results, self._lines, told.read
        due = [copy(given["x"], state), copy(given["f"], told.force), call(self._update, read)]
        due += [copy(self.memory, left["memory_next"], read), copy(z[3:], z[2:-1], read), copy(z[0], z[1], read)]
        due += [copy(z[1:3], left["newest"], read), copy(self._first, self.lines, left["begins"])]
        fading = math.exp(-self.period / FADING)
        due.append(Operation("fade", self.sums, left["counted"], z, fading, when=read))
        due.append(gather(self.speed_sums, left["speed_z"].reshape(len(SPEEDS), 2, -1), read))
        due.append(gather(self.turn_sums[None], left["turn_z"].reshape(1, 3, -1), read))
        due.append(copy(self._sent, np.zeros(self.vehicle.n_rotors)))
        return [*(o._replace(every=self.every) for o in due), Operation("add", self._sent, self._sent, command)]

    def products(self, spins: list[int]) -> np.ndarray:
        """G of each of these of SPINS, and of the thrust, (.., rows, rows). Along a diagonal, from one entry to the
        next, the newest product goes and the one before the sums began comes in."""
        m, fade = self.layout.commands, math.exp(-self.period / FADING)
        channels = [*(2 * i + axis for i in spins for axis in (0, 1)), 2 * len(SPINS)]

        def both_axes(of: np.ndarray) -> np.ndarray:
            return np.concatenate([of[:-1].reshape(-1, 2, *of.shape[1:]).sum(1), of[-1:]])

        now, first = (lines[:, channels].T for lines in (self.lines, self._first))
        gone = both_axes(now[:, :, None] * now[:, None] - fade**self.count * first[:, :, None] * first[:, None])
        y, p = map(both_axes, self.sums[:, [1, 0, *range(2, m + 3)]][:, :, channels].transpose(0, 2, 1))
        G = np.zeros((len(gone), m + 3, 2 * m + 4))
        G[:, 0, : m + 3], G[:, 1, 1], G[:, 1, 2] = y, (y[:, 0] - gone[:, 0, 0]) / fade, p[:, 1]
        G[:, 1, 3 : m + 3] = (y[:, 2:-1] - gone[:, 0, 1:-1]) / fade
        powers = fade ** np.arange(m + 1)
        padded = np.zeros((len(gone), m + 1, 2 * m + 2))
        padded[:, :, : m + 1] = powers[:, None] * gone[:, 1:, 1:]
        left = np.cumsum(_diagonals(padded), axis=1)
        left = np.concatenate([np.zeros_like(left[:, :1]), left[:, :-1]], axis=1)
        _diagonals(G[:, 2:, 2:])[...] = (p[:, None, 2:] - left) / powers[:, None]
        G = G[:, :, : m + 3]
        upper = np.triu(G, 1)
        return upper + upper.mT + G * np.eye(m + 3)


def _diagonals(matrices: np.ndarray) -> np.ndarray:
    """View of entries (i, i + k) of each of (f, n, 2 n), as (f, n, n)."""
    (each, row, column), n = matrices.strides, matrices.shape[1]
    return np.lib.stride_tricks.as_strided(matrices, (len(matrices), n, n), (each, row + column, column))


def lateral_variance(measured: ca.MX, count: ca.MX, stated: ca.MX, period: float) -> ca.MX:
    """Of readings across the thrust: as measured, within what a data sheet may be wrong by; as stated (a deviation)
    until then. An innovation of a filter with another gain would answer to noise that the commands answer to as well,
    which looks like another age."""
    mean = ca.fmin(ca.fmax((measured[0] + measured[1]) / 2, (stated / SHEET) ** 2), (stated * SHEET) ** 2)
    return ca.if_else(count > WARM / period, mean, stated**2)


def spin_of(vehicle: Vehicle) -> np.ndarray:
    """Angular acceleration about x and y of thrusts of 1 N, (2, n) (rad/s^2)."""
    return (np.linalg.inv(vehicle.inertia_matrix) @ vehicle.allocation[1:])[:2]


@cache
def stationary(noise: float, walk: float, period: float) -> tuple[float, float, float]:
    """Gains on w and b of the filter of the gyro, noise (rad/s) and walk as in SPINS, once it is stationary, and the
    standard deviation of b then (rad/s^2)."""
    F, H = np.array([[1.0, period], [0.0, 1.0]]), np.array([1.0, 0.0])
    P, Q = np.eye(2), np.diag([0.005**2, walk**2 * period])
    for _ in range(2000):
        P = F @ P @ F.T + Q
        K = P @ H / (P[0, 0] + noise**2)
        P = P - np.outer(K, P[0])
    return float(K[0]), float(K[1]), math.sqrt(P[1, 1])


def stationary_scalar(noise: float, walk: float) -> float:
    """Gain of the filter of one state, its walk in a period and the noise of a reading as standard deviations."""
    ratio = (walk / noise) ** 2
    P = ratio / 2 + math.sqrt(ratio**2 / 4 + ratio)  # before a reading, in units of noise^2
    return P / (P + 1)


def bank_function(vehicle: Vehicle, residual: Residual, period: float, every: int) -> ca.Function:
    """A period of the bank: memory after it; newest: y and p of each channel, counted: the same once they belong in the
    sums, begins: whether the next do first; speed_z and turn_z: what is summed up for velocity and attitude, an
    innovation and the one before, axis by axis.

    Inputs: memory, see Layout; x (13,), told; f (3,), reading; u (n,), the commands since the last period, added;
    weights (m, 2), gains (2,), bias (3,), see Bank; noise (m/s^2); kept_turn: what the filter of the attitude leaves of
    an innovation; theta.
    """
    layout, n = Layout(period), vehicle.n_rotors
    m, columns, spins = layout.commands, layout.columns, len(SPINS)
    shapes = {"memory": (layout.size, 1), "kept_turn": (1, 1), "x": (N_STATE, 1), "f": (3, 1), "u": (n, 1)}
    shapes |= {"weights": (m, 2), "gains": (2, 1), "bias": (3, 1), "noise": (1, 1)}
    shapes |= {"theta": (residual.function.size1_in(1), 1)}
    a = {name: ca.MX.sym(name, *shape) for name, shape in shapes.items()}
    kept = {name: a["memory"][place] for name, place in layout.slices.items()}
    x, f, count = a["x"], a["f"], kept["count"] + 1
    w, R = x[RATE], rotation_matrix(x[ATTITUDE])

    # what was sent, the newest last: angular accelerations about x and y, and the thrust, over the mass
    sent = ca.mtimes(ca.DM(np.vstack([spin_of(vehicle), np.full((1, n), 1 / vehicle.mass)])), a["u"]) / every
    sent = ca.horzcat(ca.reshape(kept["sent"], 3, m)[:, 1:], sent)
    likely = ca.mtimes(sent, a["weights"])  # (3, 2)
    thrust = likely[2, 0]
    y, slope = residual.function(body_features(x, thrust * vehicle.mass / n * ca.DM.ones(n)), a["theta"])
    y, slope = ca.densify(y), ca.densify(slope)
    more = 1 + vehicle.mass * ca.sum2(slope[2, 6:]) / n  # what the thrust gives with its effect on the air
    lifted = f[2] - y[2] + (more - 1) * thrust

    # gyro: y and phi of each noise and axis. Phi is kept as it is subtracted: then both are readings less predictions
    K = np.array([stationary(noise, walk, period) for noise, walk in SPINS])
    Kw, Kb = (ca.DM(np.tile(np.repeat(K[:, i], 2), 2)) for i in (0, 1))
    inertia, middle = ca.DM(vehicle.inertia_matrix), (w + kept["x"][RATE]) / 2
    turning = -ca.mtimes(ca.inv(inertia), ca.cross(middle, ca.mtimes(inertia, middle)))[:2]
    spin, walked = kept["spin"][: 4 * spins], kept["spin"][4 * spins :]
    drive = ca.vertcat(*[turning] * spins, *[-sent[:2, -1]] * spins)
    predicted = spin + period * (walked + drive)
    nu = ca.vertcat(*[w[:2]] * spins, ca.DM.zeros(2 * spins)) - predicted
    spin, walked = predicted + Kw * nu, walked + Kb * nu
    gain = stationary_scalar(THRUST[0], THRUST[1] * math.sqrt(period))
    pushed = ca.vertcat(lifted, more * sent[2, -1]) - kept["push"]
    push = kept["push"] + gain * pushed
    newest = ca.vertcat(nu[: 2 * spins], pushed[0], nu[2 * spins :], pushed[1])

    # velocity, an axis a column: y, phi of each reading along the thrust, of its moment, of each across, and of each
    # axis of beta; phi likewise
    forces = ca.horzcat(f, ca.reshape(kept["forces"], 3, layout.readings)[:, :-1])  # the newest first
    q = x[ATTITUDE]
    other = kept["x"][ATTITUDE]
    q = q + other * ca.sign(ca.dot(q, other))
    turned = -period * rotation_matrix(q / ca.norm_2(q))
    moment = ca.mtimes(turned, ca.cross(period * middle, ca.DM([0, 0, 1])))
    fx, fy, fz = ca.horzsplit(forces.T)
    drive = ca.horzcat(*(
        ca.vertcat(-period * gravity, to_z * fz, moment[i] * fz, to_x * fx + to_y * fy, to_x, to_y, to_z)
        for i, gravity in enumerate((0.0, 0.0, vehicle.gravity))
        for to_x, to_y, to_z in [ca.horzsplit(turned[i, :])]
    ))  # fmt: skip
    reading = ca.horzcat(*(ca.vertcat(v, ca.DM.zeros(columns - 1)) for v in ca.vertsplit(x[VELOCITY])))
    speed, speed_next, nus, pairs = ca.horzsplit(ca.reshape(kept["speed"], columns, -1), 3), [], [], []
    befores = ca.horzsplit(ca.reshape(kept["speed_before"], columns, -1), 2)
    for state, before, noise in zip(speed, befores, SPEEDS, strict=True):
        ratio = kept["lateral"] * (period / noise) ** 2
        P = ratio / 2 + ca.sqrt(ratio**2 / 4 + ratio)
        predicted = state + drive
        nu = reading - predicted
        speed_next.append(predicted + P / (P + 1) * nu)
        nus.append(ca.mtimes(nu, R[:, :2]))
        pairs += [z[:, i] for i in (0, 1) for z in (nus[-1], before)]

    # attitude: the same, in body axes, of the rotation in a period
    rates = ca.horzcat(w, ca.reshape(kept["rates"], 3, layout.readings)[:, :-1])
    back = ca.vertcat(other[0], -other[1:])
    sine = product(back, x[ATTITUDE] * ca.sign(ca.dot(x[ATTITUDE], other)))[1:]
    rotated = 2 * sine * (1 + ca.sumsqr(sine) / 6)  # the arc of a sine, to third order
    begun = count > STILL / period
    last = begun * ca.reshape(kept["turn"], layout.turning, 3)
    turn = [ca.vertcat(rotated[i], period * rates[i, :].T, period * ca.DM.eye(3)[:, i]) for i in range(3)]
    turn = ca.horzcat(*turn) + a["kept_turn"] * ca.mtimes(last, rotation_matrix(product(back, x[ATTITUDE])))

    senses = sensed(kept, x, f - a["bias"], lifted - more * thrust, y, turning, likely, a["gains"], a["noise"], period)
    now = {"count": count, "x": x, "forces": ca.vec(forces), "sent": ca.vec(sent), "push": push}
    now |= {"spin": ca.vertcat(spin, walked), "speed": ca.vec(ca.horzcat(*speed_next))}
    now |= {"speed_before": ca.vec(ca.horzcat(*nus))}
    now["lateral"] = lateral_variance(senses["noise"], count, a["noise"], period)
    now |= {"rates": ca.vec(rates), "turn": ca.vec(turn), **senses}
    memory = ca.vertcat(*(now[name] for name in layout.slices))
    counts = count > layout.skipped
    results = {"memory_next": memory, "begins": count == layout.skipped}
    results |= {"newest": ca.reshape(newest, -1, 2), "counted": ca.reshape(counts * newest, -1, 2)}
    results["speed_z"] = counts * ca.vertcat(*pairs)
    results["turn_z"] = begun * ca.vertcat(*(z[:, i] for i in range(3) for z in (turn, last)))
    return ca.Function("bank", [*a.values()], [*results.values()], [*a], [*results])
