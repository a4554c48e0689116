"""Inertial sensors and their aids over a control period.

An inertial measurement unit reads mean specific force and mean rates since the last reading,

    w_m = Log(q_0* o q_1) / h + b_g + s_g / sqrt(h) n                                     body, rad/s
    a_m = R(q_0 o Exp(Log(q_0* o q_1) / 2))' ((v_1 - v_0) / h - g) + b_a + s_a / sqrt(h) n    body, m/s^2
    b(t + h) = b(t) + s_b sqrt(h) n                                                       random walk of each bias

over the interval h from (q_0, v_0) to (q_1, v_1), n standard normal. These are the coning and sculling corrected
angle and velocity increments that a flight stack's driver forms from readings at several kHz, over h and in the axes
of the middle of the interval; they contain whatever accelerated the vehicle. s are densities: white noise of density s
has the standard deviation s / sqrt(h) in a mean over h. The model of noise is that of IEEE Std 952 and of Kalibr.

It is read in step with the control loop, k = ceil(rate period) times in every control period, at the nearest
integration steps; its noise does not depend on that. The biases walk along straight lines between the points of every
20 ms.

Aids are read at those instants, each at its own rate. A fix is due whenever another 1 / rate has passed; it is taken at
the first IMU reading from then on, whose time it bears. When it arrives, its delay later, is the estimator's concern.
Outages follow a two-state Markov chain over the fixes (Gilbert 1960): an outage begins at a fix with the probability b
and ends with the probability e,

    e = 1 / m,   b = e s / (1 - s)      s: share of fixes lost;   m = max(outage rate, 1 / (1 - s)): mean length, fixes

so that with m = 1 / (1 - s) every fix is lost with probability s, by itself.

For estimators this adds to what is given, a column an IMU reading:

    imu        (7, k)         [a_m (m/s^2), w_m (rad/s), interval (s)]
    its name   (1 + size, k)  of each aid: whether there is a fix of this instant (0 or 1), and the fix
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.log.schema import BIAS_COLUMNS
from quadexp.names import named
from quadexp.parts.sensor_spec import SensorSpec, Stated
from quadexp.parts.settings import Setting, key, keyed
from quadexp.physics.expression import Expression, split, symbols
from quadexp.physics.rotation import along_z, exponential, product, rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.worlds.rotation_vector import conjugate, logarithm
from quadexp.world.effect import Clock, Effect, Measured, Readings, Sizes, Start
from quadexp.world.streams import TICK, Drawn, Held, Sampled

N_READING = 6  # [a_m, w_m]
N_BIAS = 6  # [b_a, b_g]
N_NOISE = N_READING + N_BIAS
N_DENSITIES = 4  # white noise and drift, of gyroscope and accelerometer
FORCE = slice(0, 3)
TURN = slice(3, 6)
WALK = 0.02  # s, see Held

RATE = "[0.1, 8000]"  # interval of a sensor's rate, Hz
SHARE = Setting("share of the fixes that are lost", "[0, 0.99]")
OUTAGE = Setting("mean length of an outage; 0: every fix is lost or not by itself", "[0, 3600]", "s")

N_CLOCK = 2  # [fixes since the last one was due, whether fixes are being lost]
N_SAMPLING = 3  # parameters: rate (Hz), thresholds of a standard normal number at which an outage begins, ends
FAR = 40.0  # beyond every standard normal number
EARLY = 1e-9  # of the interval between fixes; a fix that is this near to its time is due


class Innovation(NamedTuple):
    """One number of a fix less what the nominal state says of it.

    value: scalar. row: its derivative by the error state, {index: coefficient}. deviation: index into Aid.deviations.
    """

    value: Expression
    row: dict[int, Expression]
    deviation: int


@dataclass(frozen=True)
class Aid:
    """A sensor that fixes part of the state, and what a filter makes of its fixes.

    rate: Hz. delay: s. dropout: share of fixes lost. outage: mean length (s). size: numbers of a fix. noise: standard
    normal numbers for it. deviations: standard deviations, (s,).
    measure: of the true state x (13,), noise and deviations: a fix (size,). compare: of the nominal state (see
    error_state.py) and a fix: innovations, whose errors are independent of each other.
    first_guess: standard deviations of the errors that the first fixes leave, by index of the error state.
    """

    name: str
    rate: float
    delay: float
    dropout: float
    outage: float
    size: int
    noise: int
    deviations: np.ndarray
    measure: Callable[[Expression, Expression, Expression], Expression]
    compare: Callable[[Expression, Expression], list[Innovation]]
    first_guess: dict[int, float]

    def sampling(self) -> np.ndarray:
        """Parameters of `sample`, (3,)."""
        from scipy.special import ndtri

        share = self.dropout
        ends = 1 / max(self.outage * self.rate, 1 / (1 - share))
        begins = ends * share / (1 - share)
        return np.array([self.rate, *np.clip(ndtri([begins, ends]), -FAR, FAR)])


def sample(
    clock: Expression, duration: Expression, noise: Expression, parameters: Expression
) -> tuple[Expression, Expression]:
    """Whether a fix is taken and gets through (0 or 1), and the clock (2,) after another interval `duration` (s)."""
    phase = clock[0] + parameters[0] * duration
    due = phase >= 1 - EARLY
    lost = ca.if_else(clock[1] > 0, noise >= parameters[2], noise < parameters[1])
    lost = ca.if_else(due, lost, clock[1])
    return due * (1 - lost), ca.vertcat(phase - due, lost)


def means(before: Expression, after: Expression, duration: Expression, gravity: Expression) -> Expression:
    """Mean specific force (m/s^2) and mean rates (rad/s), body axes at mid-interval, (6,), between two states (13,).

    duration: s. gravity: m/s^2, downwards.
    """
    turned = logarithm(product(conjugate(before[ATTITUDE]), after[ATTITUDE]))
    middle = product(before[ATTITUDE], exponential(turned / 2))
    acceleration = (after[VELOCITY] - before[VELOCITY]) / duration + along_z(gravity)
    return ca.vertcat(rotation_matrix(middle).T @ acceleration, turned / duration)


def read(
    exact: Expression, bias: Expression, duration: Expression, noise: Expression, stated: Expression
) -> tuple[Expression, Expression]:
    """[a_m, w_m] (6,) of an interval (s), and the biases (6,) after it.

    exact: see `means`. bias: (6,). noise: standard normal, (12,). stated: see `densities`.
    """
    spread = ca.vec(ca.repmat(stated.T, 3, 1))  # each density on three axes
    reading = exact + bias + spread[:N_READING] / ca.sqrt(duration) * noise[:N_READING]
    return reading, bias + spread[N_READING:] * ca.sqrt(duration) * noise[N_READING:]


@keyed
class InertialSensors(Effect):
    """An IMU with aids; a subclass says which. Raises UsageError where an aid is asked for more often than the IMU.

    inner states: the biases (6,), a clock (2,) of each aid. parameters: gravity (m/s^2), the IMU's densities (4,), and
    of each aid when it is read (3,) and its deviations.
    """

    prefix = "sensor."

    imu_rate: float = key(200.0, "readings a second; the next whole number of them in a control period", RATE, "Hz")
    accelerometer_noise_density: float = key(2e-3, "white noise of the specific force", "[0, 10]", "m/s^2/sqrt(Hz)")
    gyroscope_noise_density: float = key(1.6968e-4, "white noise of the rates", "[0, 10]", "rad/s/sqrt(Hz)")
    accelerometer_bias_std: float = key(
        0.05, "standard deviation of the bias that is drawn for a flight, each axis", "[0, 10]", "m/s^2"
    )
    gyroscope_bias_std: float = key(
        0.005, "standard deviation of the bias that is drawn for a flight, each axis", "[0, 1]", "rad/s"
    )
    accelerometer_bias_walk: float = key(3e-3, "random walk of the bias", "[0, 10]", "m/s^3/sqrt(Hz)")
    gyroscope_bias_walk: float = key(1.9393e-5, "random walk of the bias", "[0, 1]", "rad/s^2/sqrt(Hz)")

    stage = "sensor"

    @property
    def densities(self) -> np.ndarray:
        """Noise of force and rates, walk of their biases, (4,): m/s^2, rad/s, m/s^3, rad/s^2, each per sqrt(Hz)."""
        noise = (self.accelerometer_noise_density, self.gyroscope_noise_density)
        return np.array([*noise, self.accelerometer_bias_walk, self.gyroscope_bias_walk])

    @property
    def bias_std(self) -> np.ndarray:
        """Standard deviations of [b_a, b_g] when a flight begins, (6,), m/s^2 and rad/s."""
        return np.repeat([self.accelerometer_bias_std, self.gyroscope_bias_std], 3)

    @property
    def aids(self) -> tuple[Aid, ...]:
        raise NotImplementedError

    def check_together(self) -> None:
        for aid in self.aids:
            if aid.rate > self.imu_rate:
                raise UsageError(
                    f"sensor.{aid.name}_rate={aid.rate:g}: must be at most sensor.imu_rate={self.imu_rate:g} Hz"
                )

    def readings(self, clock: Clock) -> int:
        """IMU readings in a control period. Raises UsageError where the plant makes fewer steps."""
        count = max(1, math.ceil(clock.period * self.imu_rate - 1e-9))
        if count > clock.steps:
            raise UsageError(
                f"sensor.imu_rate={self.imu_rate:g}: the plant makes {1 / clock.step:g} integration steps a second,"
                " at most so many readings; lower the rate, or plant.step"
            )
        return count

    def _instants(self, clock: Clock) -> list[int]:
        """Integration steps of a control period at which the IMU is read, and the beginning."""
        count = self.readings(clock)
        return [round(j * clock.steps / count) for j in range(count + 1)]

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        bounds = tuple(clock.step * i for i in self._instants(clock))
        drawn: list[Drawn] = [Held(N_READING, bounds, min(TICK, 1 / self.imu_rate)), Held(N_BIAS, bounds, WALK)]
        drawn += [Sampled(1 + aid.noise, bounds[1:], 1 / aid.rate) for aid in self.aids]
        return Sizes(N_BIAS + N_CLOCK * len(self.aids), sum(self._parameter_sizes()), tuple(drawn))

    def _parameter_sizes(self) -> list[int]:
        """How many parameters are gravity and densities, and how many each aid's."""
        return [1 + N_DENSITIES, *(N_SAMPLING + len(aid.deviations) for aid in self.aids)]

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        """Biases are drawn; all fixes are due their interval later."""
        bias = self.bias_std * rng.standard_normal(N_BIAS)
        parameters = [np.array([start.vehicle.gravity]), self.densities]
        parameters += [np.concatenate([aid.sampling(), aid.deviations]) for aid in self.aids]
        return np.concatenate([bias, np.zeros(N_CLOCK * len(self.aids))]), np.concatenate(parameters)

    def stated(self, sensor_spec: SensorSpec, vehicle: Vehicle) -> SensorSpec:
        force, turn, *_ = (self.densities * math.sqrt(self.imu_rate)).tolist()
        accelerometer = Stated(force, self.accelerometer_bias_std, span=1 / self.imu_rate)
        gyroscope = Stated(turn, self.gyroscope_bias_std, span=1 / self.imu_rate)
        return replace(sensor_spec, accelerometer=accelerometer, gyroscope=gyroscope)

    def columns(self, clock: Clock, vehicle: Vehicle) -> Mapping[str, int]:
        """The true biases."""
        return {name: i for i, name in enumerate(BIAS_COLUMNS)}

    def measure(self, at: Readings, measured: Measured) -> tuple[ca.MX, Measured]:
        instants = self._instants(at.clock)
        count = len(instants) - 1
        before = at.states[:, instants[:-1]]
        after = at.states[:, instants[1:]]
        durations = at.step * ca.DM(np.diff(instants)).T
        sizes = [N_READING, N_BIAS, *(1 + aid.noise for aid in self.aids)]
        drawn = split(at.draws, (size * count for size in sizes))
        noise = ca.vertcat(*(ca.reshape(sample, -1, count) for sample in drawn))
        parameters = ca.repmat(at.parameters, 1, count)
        inner, imu, *fixes = self._tick().mapaccum(count)(at.inner, before, after, durations, noise, parameters)
        measured = measured | {"specific_force": imu[FORCE, -1], "imu": ca.vertcat(imu, durations)}
        return inner[:, -1], measured | named((aid.name for aid in self.aids), fixes)

    def _tick(self) -> ca.Function:
        """(inner, state before, state after, duration, noise, parameters) -> inner, reading (6,), fixes of the aids."""
        inner_sizes = [N_BIAS, *(N_CLOCK for _ in self.aids)]
        noise_sizes = [N_NOISE, *(1 + aid.noise for aid in self.aids)]
        sizes = self._parameter_sizes()
        arguments = symbols(
            ca.SX,
            inner=sum(inner_sizes),
            before=N_STATE,
            after=N_STATE,
            duration=1,
            noise=sum(noise_sizes),
            parameters=sum(sizes),
        )
        inner, before, after, duration, noise, parameters = arguments
        bias, *clocks = split(inner, inner_sizes)
        noise, *of_aids = split(noise, noise_sizes)
        parameters, *settings = split(parameters, sizes)
        exact = means(before, after, duration, parameters[0])
        reading, bias = read(exact, bias, duration, noise, parameters[1:])
        fixes = []
        for i, aid in enumerate(self.aids):
            numbers = of_aids[i]
            taken, clocks[i] = sample(clocks[i], duration, numbers[0], settings[i][:N_SAMPLING])
            fix = aid.measure(after, numbers[1:], settings[i][N_SAMPLING:])
            fixes.append(ca.vertcat(taken, fix))
        results = [ca.densify(result) for result in (ca.vertcat(bias, *clocks), reading, *fixes)]
        return ca.Function("inertial_sensors", arguments, ca.cse(results))
