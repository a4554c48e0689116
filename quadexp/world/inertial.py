"""Inertial sensors and their aids over a control period.

The IMU is read in step with the control loop, k = ceil(rate period) times in every control period, at the nearest
integration steps; its noise is given by densities and does not depend on that. The biases walk along straight lines
between the points of every 20 ms. Aids are read at those instants, each at
its own rate (see aid.py). For estimators this adds to what is told, a column an IMU reading:

    imu        (7, k)         [a_m (m/s^2), w_m (rad/s), interval (s)]
    its name   (1 + size, k)  of each aid: whether there is a fix of this instant (0 or 1), and the fix

A fix bears the time at which it was taken. When it arrives, its delay later, is the estimator's concern.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.world import imu
from quadexp.world.aid import N_CLOCK, N_SAMPLING, Aid, sample
from quadexp.world.effect import Clock, Effect, Readings, Sizes, Start, Told
from quadexp.world.gnss import GnssKeys, gnss
from quadexp.world.heading import HeadingKeys, heading
from quadexp.world.imu import FORCE, N_BIAS, N_DENSITIES, ImuKeys
from quadexp.world.motion_capture import MotionCaptureKeys, motion_capture
from quadexp.world.streams import TICK, Drawn, Held, Sampled

WALK = 0.02  # s, see Held
BIAS_COLUMNS = tuple(f"bias_{kind}_{axis}" for kind in "ag" for axis in "xyz")


@dataclass(frozen=True, kw_only=True)
class InertialSensors(ImuKeys, Effect):
    """An IMU with aids; a subclass says which. Raises UsageError where an aid is asked for more often than the IMU.

    inner states: the biases (6,), a clock (2,) of each aid. parameters: gravity (m/s^2), the IMU's densities (4,), and
    of each aid when it is read (3,) and its deviations.
    """

    stage = "sensor"

    @property
    def aids(self) -> tuple[Aid, ...]:
        """See quadexp.world.aid."""
        raise NotImplementedError

    def __post_init__(self) -> None:
        super().__post_init__()
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
        """See Effect."""
        bounds = tuple(clock.step * i for i in self._instants(clock))
        drawn: list[Drawn] = [Held(imu.N_READING, bounds, min(TICK, 1 / self.imu_rate)), Held(N_BIAS, bounds, WALK)]
        drawn += [Sampled(1 + aid.noise, bounds[1:], 1 / aid.rate) for aid in self.aids]
        return Sizes(
            inner=N_BIAS + N_CLOCK * len(self.aids),
            parameters=1 + N_DENSITIES + sum(N_SAMPLING + len(aid.deviations) for aid in self.aids),
            drawn=tuple(drawn),
        )

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        """See Effect: biases are drawn; all fixes are due their interval later."""
        bias = imu.bias_std(self) * rng.standard_normal(N_BIAS)
        parameters = [np.array([start.vehicle.gravity]), imu.densities(self)]
        parameters += [np.concatenate([aid.sampling(), aid.deviations]) for aid in self.aids]
        return np.concatenate([bias, np.zeros(N_CLOCK * len(self.aids))]), np.concatenate(parameters)

    def columns(self, clock: Clock, vehicle: Vehicle) -> Mapping[str, int]:
        """See Effect: the true biases."""
        return {name: i for i, name in enumerate(BIAS_COLUMNS)}

    def measure(self, at: Readings, told: Told) -> tuple[ca.MX, Told]:
        """See Effect."""
        instants = self._instants(at.clock)
        count = len(instants) - 1
        before, after = at.states[:, instants[:-1]], at.states[:, instants[1:]]
        durations = at.step * ca.DM(np.diff(instants)).T
        sizes = [imu.N_READING, N_BIAS, *(1 + aid.noise for aid in self.aids)]
        drawn = ca.vertsplit(at.draws, [0, *accumulate(size * count for size in sizes)])
        noise = ca.vertcat(*(ca.reshape(one, -1, count) for one in drawn))
        parameters = ca.repmat(at.parameters, 1, count)
        inner, *found = self._tick().mapaccum(count)(at.inner, before, after, durations, noise, parameters)
        told = told | {"specific_force": found[0][FORCE, -1], "imu": ca.vertcat(found[0], durations)}
        return inner[:, -1], told | {aid.name: fix for aid, fix in zip(self.aids, found[1:], strict=True)}

    def _tick(self) -> ca.Function:
        """(inner, state before, state after, duration, noise, parameters) -> inner, reading (6,), fixes of the aids."""
        sizes = [N_BIAS + N_CLOCK * len(self.aids), N_STATE, N_STATE, 1]
        sizes += [imu.N_NOISE + sum(aid.noise + 1 for aid in self.aids)]
        sizes += [1 + N_DENSITIES + sum(N_SAMPLING + len(aid.deviations) for aid in self.aids)]
        symbols = [ca.SX.sym(f"s{i}", size) for i, size in enumerate(sizes)]
        inner, before, after, duration, noise, parameters = symbols
        gravity, densities = parameters[0], parameters[1 : 1 + N_DENSITIES]
        exact = imu.means(before, after, duration, gravity)
        reading, bias = imu.read(exact, inner[:N_BIAS], duration, noise[: imu.N_NOISE], densities)
        clocks, fixes, drawn, told = [], [], imu.N_NOISE, 1 + N_DENSITIES
        for i, aid in enumerate(self.aids):
            clock = inner[N_BIAS + N_CLOCK * i : N_BIAS + N_CLOCK * (i + 1)]
            sampling, told = parameters[told : told + N_SAMPLING], told + N_SAMPLING
            deviations, told = parameters[told : told + len(aid.deviations)], told + len(aid.deviations)
            taken, clock = sample(clock, duration, noise[drawn], sampling)
            fix = aid.measure(after, noise[drawn + 1 : drawn + 1 + aid.noise], deviations)
            drawn += 1 + aid.noise
            clocks.append(clock)
            fixes.append(ca.vertcat(taken, fix))
        results = [ca.densify(one) for one in (ca.vertcat(bias, *clocks), reading, *fixes)]
        return ca.Function("inertial_sensors", symbols, ca.cse(results))


@dataclass(frozen=True, kw_only=True)
class ImuMocap(MotionCaptureKeys, InertialSensors):
    """An IMU and motion capture."""

    @property
    def aids(self) -> tuple[Aid, ...]:
        """See InertialSensors."""
        return (motion_capture(self),)


@dataclass(frozen=True, kw_only=True)
class ImuGnss(GnssKeys, HeadingKeys, InertialSensors):
    """An IMU, satellite navigation, and a magnetometer: without it nothing tells the heading of a hovering vehicle."""

    @property
    def aids(self) -> tuple[Aid, ...]:
        """See InertialSensors."""
        return gnss(self), heading(self)
