"""The bank: sufficient statistics of Kalman filters for all hypotheses of age, dead time and lag (Magill 1965).

    gyro      w+ = w + T (J^-1 (tau - w x J w) + b),   b+ = b + noise      tells age + dead time, and lag
    thrust    f_z = (1 + k) T_z / m + a_air,z + b,     b+ = b + noise      tells dead time and lag
    velocity  v+ = v + T (R (f(t - age) - beta) + g)                       tells the age
    attitude  q+ = q Exp(T (w(t - age) - beta_w))                          tells it where the gyroscope is prompt

All hypotheses share the stationary gain of a noise model, so a filter is linear, and its innovation is an affine
function of the hypothesis' impulse response h on the commands, or on the readings (responses.py):

    nu = y - h' phi        y: the filter driven by the readings;  phi_j: by the command j periods ago alone

As in a linear regression (Ljung 1999, ch. 4 and 10), the sum of squared innovations of every hypothesis follows from

    M = sum of fading z z',   z = [y, y before, phi_0 .. phi_m]            sum nu^2 = [1, -h] M [1, -h]'

z of the readings' filters: [innovation, the same of the period before]. A reading that is missing is a prediction
without an update; once there is one again, it lies on the line between its neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from quadexp.compile.memory import NEXT, NOW, Memory, connected, sizes_of
from quadexp.compile.symbolic import ca
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, InputArrays, call, copy
from quadexp.models.residual import Residual
from quadexp.physics.expression import Answers, Expression, limited, named_symbols
from quadexp.physics.rigid_body import body_features
from quadexp.physics.rotation import product, rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.auto.settings import BANK
from quadexp.plugins.remedies.sent_commands import SETTLED

GYROS, VELOCITIES, AXES = len(BANK.gyro_models), len(BANK.velocity_models), 3
CHANNELS = 2 * GYROS + 1  # filters that commands drive: two axes of each noise model, and the thrust


class Sums(Memory):
    """Memory that is added to behind all that may be refused: what it is now is never gone back from."""

    def __init__(self, owner: str, sizes: Mapping[str, int]) -> None:
        super().__init__(owner, sizes)
        self.of_next = self.of_now
        self.pairs = []


class Layout:
    """What a bank remembers. period: s. commands, readings: how many count. columns: of a reading's filter, y, phi of
    each reading and of each axis of its bias. sizes: of its memory, by name. moments: of each filter, by name: noise
    models, rows and columns of a matrix."""

    def __init__(self, period: float) -> None:
        reach = BANK.largest_age + BANK.largest_dead_time + SETTLED * BANK.largest_lag + period
        self.commands = math.ceil(reach / period - 1e-9) + 1
        self.readings = int(BANK.largest_age / period + 1e-9) + 3
        self.columns = 1 + self.readings + AXES
        velocity = VELOCITIES * self.columns
        self.sizes = {
            "count": 1,
            "weights": 3,
            "x": N_STATE,
            "missed": 1,
            "since_gap": 1,
            "forces": AXES * self.readings,
            "rates": AXES * self.readings,
            "filters": 4 * CHANNELS,
            "regressors": CHANNELS * (self.commands + 3),
            "velocity": AXES * velocity,
            "velocity_before": 2 * velocity,
            "attitude_before": AXES * self.columns,
            "lateral": 1,
            "reading": 2,
            "change": 2,
            "drift": 6,
            "noise": 3,
        }
        driven, read = self.commands + 3, 2 * self.columns
        self.moments = {
            "gyro": (GYROS, driven, driven),
            "thrust": (1, driven, driven),
            "velocity": (VELOCITIES, read, read),
            "attitude": (1, read, read),
        }


class Bank:
    """The sums of a flight; `start` begins one, and its calls stand `after` the controller's.

    theta: parameters of the residual, shared. noise: stated, of a reading of accelerometer (m/s^2), gyroscope (rad/s)
    and attitude (rad). spans: over which readings of accelerometer and gyroscope are means (s).
    period: of the bank (s), `every` control periods. moments: of gyro, thrust, velocity, attitude, (models, c, c),
    lower triangles, which are the `sums`. memory: all else that is remembered.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        residual: Residual,
        theta: np.ndarray,
        control_period: float,
        backend: str,
        noise: tuple[float, float, float],
        spans: tuple[float, float],
    ) -> None:
        self.vehicle = vehicle
        self.spans = spans
        self.every = max(1, round(BANK.period / control_period))
        self.period = self.every * control_period
        self.layout = Layout(self.period)
        of_force, of_rate, of_attitude = noise
        self.stated = np.full(1, max(of_force, BANK.least_reading))
        self.turn_noise = (BANK.least_turn + of_rate) * self.period, BANK.least_attitude + of_attitude
        turn, tilt = self.turn_noise
        attitude_gain = np.full(1, first_order_gain(turn / tilt))
        self._places = {"theta": theta, "stated": self.stated, "attitude_gain": attitude_gain}
        self._function = cached_function(backend, bank_function, vehicle, residual, self.period, self.every)
        sizes = sizes_of([self._function])
        self.memory = Memory("Bank", sizes | {"sent": vehicle.n_rotors})
        shapes = self.layout.moments
        counts = {name: math.prod(shape) for name, shape in shapes.items()}
        self.sums = Sums("BankSums", counts)
        self.moments = {name: values.reshape(shapes[name]) for name, values in self.sums.of_now.items()}

    def start(self, x: np.ndarray, thrust: np.ndarray) -> dict[str, Any]:
        """What is remembered in the state x, (13,), where this command, (n,) (N), has been sent for a long time."""
        specific = thrust.sum() / self.vehicle.mass
        readings = self.layout.readings
        filters = np.zeros((4, CHANNELS), x.dtype)
        filters[0, :-1] = np.tile(x[RATE][:2], GYROS)
        filters[:2, -1] = specific
        velocity = np.zeros((VELOCITIES * AXES, self.layout.columns), x.dtype)
        velocity[:, 0] = np.tile(x[VELOCITY], VELOCITIES)
        return {
            "x": x,
            "since_gap": readings + 1.0,
            "lateral": self.stated**2,
            "filters": filters,
            "velocity": velocity,
            "forces": np.tile([0.0, 0.0, specific], readings),
            "rates": np.tile(x[RATE], readings),
            "sent": self.every * thrust,
        }

    def after(self, inputs: InputArrays, state: np.ndarray, command: np.ndarray) -> list[Call]:
        """Takes in what is given, the state that is found there, (13,), and then the command, (n,) (N)."""
        given = {"x": state, "f": inputs.specific_force, "read": inputs.accelerometer_valid}
        update = connected(self._function, self._places | given, {}, self.memory)
        sent = self.memory.of_next["sent"]
        due = [call(update)]
        fading = math.exp(-self.period / BANK.forgetting)
        for name, moments in self.moments.items():
            models, _, columns = moments.shape
            rows = update.results[f"{name}_z"].reshape(models, -1, columns)
            due.append(Call("gather", moments, rows, factor=fading))
        due.append(copy(sent, np.zeros(self.vehicle.n_rotors)))
        calls = [operation._replace(every=self.every) for operation in due]
        return [*calls, Call("add", sent, sent, command)]


@cache
def stationary_gain(noise: float, random_walk: float, period: float) -> tuple[float, float]:
    """Gains on rate and torque of the stationary filter of the gyroscope, see BankSettings.gyro_models."""
    F = np.array([[1.0, period], [0.0, 1.0]])
    Q = np.diag([BANK.rate_walk**2, random_walk**2]) * period
    P = np.eye(2)
    for _ in range(3000):
        P = F @ P @ F.T + Q
        K = P[:, 0] / (P[0, 0] + noise**2)
        P = P - np.outer(K, P[0])
    return float(K[0]), float(K[1])


def first_order_gain(ratio: Expression) -> Any:
    """Gain of the stationary filter of a random walk, by the ratio of its walk in a step to the noise of a reading."""
    variance = ratio**2 / 2 + (ratio**4 / 4 + ratio**2) ** 0.5
    return variance / (variance + 1)


def bank_function(vehicle: Vehicle, residual: Residual, period: float, every: int) -> ca.Function:
    """A period of the bank: memory after it, and the rows z of each filter, one after another.

    Inputs: memory, see Layout, and `sent` (n,), the commands since the last period, added (N); x (13,), given; f (3,),
    reading, and whether it was `read`; stated noise (m/s^2); attitude_gain, of its filter; theta.
    """
    layout = Layout(period)
    readings, columns = layout.readings, layout.columns
    shapes = {NOW + name: size for name, size in layout.sizes.items()}
    shapes[f"{NOW}sent"] = vehicle.n_rotors
    shapes |= {"x": N_STATE, "f": 3, "read": 1, "stated": 1, "attitude_gain": 1}
    a = named_symbols(ca.SX, shapes)
    answers = Answers(residual.function)
    kept = {name: a[NOW + name] for name in layout.sizes}
    x, read, stated = a["x"], a["read"], a["stated"]
    last = kept["x"]
    count = kept["count"] + 1
    counts = count > BANK.settling / period
    time = count * period
    f = ca.if_else(read, a["f"], kept["forces"][:3])
    missed = (1 - read) * (kept["missed"] + 1)
    since_gap = (missed <= BANK.gap) * (kept["since_gap"] + 1)
    shown = counts * read * (since_gap > readings)  # whole readings alone are compared with velocities
    w = x[RATE]
    R = rotation_matrix(x[ATTITUDE])
    sent = a[f"{NOW}sent"] / every
    air, *_ = answers(body_features(x, sent))

    # gyroscope and thrust, a filter a row: y by the readings, phi by the newest command
    inertia = ca.DM(vehicle.inertia_matrix)
    inverse = ca.inv(inertia)
    middle = (w + last[RATE]) / 2
    turning = -(inverse @ ca.cross(middle, inertia @ middle))[:2]
    spin = (inverse @ ca.DM(vehicle.allocation[1:]) @ sent)[:2]
    thrust_gain = first_order_gain(BANK.thrust_walk * math.sqrt(period) / BANK.thrust_noise)
    gains = [stationary_gain(*model, period) for model in BANK.gyro_models for _ in range(2)]
    gain = ca.DM([*gains, (thrust_gain, 0.0)])
    of_rates = ca.horzcat(w[:2], ca.DM.zeros(2))
    specific = ca.sum1(sent) / vehicle.mass
    of_thrust = ca.horzcat(f[2] - air[2], specific)
    reading = ca.vertcat(ca.repmat(of_rates, GYROS, 1), of_thrust)
    of_torques = ca.horzcat(turning, -spin)
    drive = ca.repmat(of_torques, GYROS, 1)
    drive = ca.vertcat(drive, ca.DM.zeros(1, 2))
    value, bias = ca.horzsplit(ca.reshape(kept["filters"], CHANNELS, 4), 2)
    predicted = value + period * (bias + drive)
    updates = ca.vertcat(ca.DM.ones(2 * GYROS), read)
    innovation = ca.repmat(updates, 1, 2) * (reading - predicted)
    value = predicted + ca.repmat(gain[:, 0], 1, 2) * innovation
    bias = bias + ca.repmat(gain[:, 1], 1, 2) * innovation
    before = ca.reshape(kept["regressors"], layout.commands + 3, CHANNELS)
    y, phi = innovation[:, 0].T, innovation[:, 1].T
    regressors = ca.vertcat(y, before[0, :], phi, before[2:-1, :])

    # velocity: an axis of a noise model a column; what was missing lies on the line between its neighbours
    held = ca.reshape(kept["forces"], 3, readings)
    back = ca.DM(range(1, readings)).T
    share = back / (kept["missed"] + 1)
    between = f @ (1 - share) + held[:, 0] @ share
    is_missing = ca.repmat(share < 1, 3, 1)
    earlier = ca.if_else(is_missing, between, held[:, :-1])
    forces = ca.horzcat(f, earlier)  # the newest first
    q = x[ATTITUDE] + last[ATTITUDE] * ca.sign(ca.dot(x[ATTITUDE], last[ATTITUDE]))
    turned = period * rotation_matrix(q / ca.norm_2(q))
    gravity = period * vehicle.gravity * ca.DM([[0.0, 0.0, 1.0]])
    drive = ca.vertcat(gravity, (turned @ forces).T, turned.T)
    reading = ca.vertcat(x[VELOCITY].T, ca.DM.zeros(columns - 1, 3))
    before = ca.reshape(kept["velocity"], columns, -1)
    predicted = before - ca.repmat(drive, 1, VELOCITIES)
    innovation = ca.repmat(reading, 1, VELOCITIES) - predicted
    weights = [(period / noise) ** 2 for noise in BANK.velocity_models for _ in range(AXES)]
    ratio = kept["lateral"] * ca.DM(weights).T
    P = ratio / 2 + ca.sqrt(ratio**2 / 4 + ratio)
    velocity = predicted + ca.repmat(P / (P + 1), columns, 1) * innovation
    # across the thrust: along it a force jumps with each command, between two readings
    across = innovation @ ca.diagcat(*[R[:, :2]] * VELOCITIES)
    velocity_z = ca.vertcat(across, ca.reshape(kept["velocity_before"], columns, -1))

    # attitude: the same in body axes, of the rotation in a period
    held = ca.reshape(kept["rates"], 3, readings)
    rates = ca.horzcat(w, held[:, :-1])
    back = ca.vertcat(last[ATTITUDE][0], -last[ATTITUDE][1:])
    relative = product(back, x[ATTITUDE] * ca.sign(ca.dot(x[ATTITUDE], last[ATTITUDE])))
    rotated = 2 * relative[1:] * (1 + ca.sumsqr(relative[1:]) / 6)  # the arc of a sine, to third order
    flown = time > BANK.largest_age + 2 * period  # until then given attitudes may be those from before the flight
    before = flown * ca.reshape(kept["attitude_before"], columns, 3)
    attitude = ca.vertcat(rotated.T, period * rates.T, period * ca.DM.eye(3))
    attitude = attitude + (1 - a["attitude_gain"]) * (before @ rotation_matrix(relative))

    # white noise: minus the covariance of successive changes (local level model, Harvey 1989)
    expected = period * (x[VELOCITY] + last[VELOCITY]) / 2
    moved = x[POSITION] - last[POSITION] - expected
    drift = ca.vertcat(moved, rotated - period * middle)
    change = f[:2] - air[:2] - kept["reading"]
    products = -drift * kept["drift"]
    of_force = -ca.dot(change, kept["change"]) / 2
    of_position = ca.sum1(products[:3]) / 3
    of_attitude = ca.sum1(products[3:]) / 3
    measured = ca.vertcat(of_force, of_position, of_attitude)
    share = ca.fmax(1 / (count + 5), period / BANK.noise_memory)
    share = share * (count > 2) * ca.vertcat(read, 1, 1)
    noise = kept["noise"] + share * (measured - kept["noise"])
    least = (stated * BANK.sheet_factor**-1) ** 2
    most = (stated * BANK.sheet_factor) ** 2
    lateral = limited(noise[0], least, most)
    fading = math.exp(-period / BANK.forgetting)

    now = {
        "count": count,
        "x": x,
        "missed": missed,
        "since_gap": since_gap,
        "forces": ca.vec(forces),
        "rates": ca.vec(rates),
        "weights": fading * kept["weights"] + ca.vertcat(counts, shown, flown),
        "filters": ca.vec(ca.horzcat(value, bias)),
        "regressors": ca.vec(regressors),
        "velocity": ca.vec(velocity),
        "velocity_before": ca.vec(across),
        "attitude_before": ca.vec(attitude),
        "lateral": ca.if_else(time > BANK.measured_after, lateral, stated**2),
        "reading": kept["reading"] + read * change,
        "change": ca.if_else(read, change, kept["change"]),
        "drift": drift,
        "noise": noise,
    }
    results = {
        "gyro_z": counts * ca.vec(regressors[:, :-1]),
        "thrust_z": counts * regressors[:, -1],
        "velocity_z": shown * ca.vec(velocity_z),
        "attitude_z": flown * ca.vec(ca.vertcat(attitude, before)),
    }
    results |= {NEXT + name: value for name, value in now.items()}
    return answers.function_of("bank", a, results)
