"""Navigation by an error-state Kalman filter (error_state.py), in flight on a delayed horizon, with an output for now.

Fixes come late, the IMU's readings do not. The filter
lives d IMU readings ago, d the longest delay among the aids: there every fix is at hand by its own time stamp and is
used with the state and the covariance of that time, so a delay costs no approximation (as in PX4's EKF2; Khosravian et
al. 2015). What the controller is given is the filter's state, carried on to now by the IMU readings in between:

    fixes, readings --> queue of d readings --> filter at t - d h --> output predictor over the queue --> p, q, v at t
    rates: the last gyroscope reading less its estimated bias

A fix that is lost does not come, and the filter only predicts. The filter's noise is that which the sensors state,
times two factors. When a flight begins the filter has run for a while at rest, from one fix of each aid
(Aid.first_guess), tilt levelled by an accelerometer of unknown bias, and biases assumed to be zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.log.schema import BIAS_COLUMNS
from quadexp.names import named
from quadexp.parts.sensor_spec import SensorSpec, Stated
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import split, symbols
from quadexp.physics.state import ATTITUDE, RATE, STATE_COLUMNS
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.worlds.error_state import (
    D_ATTITUDE,
    GYROSCOPE_BIAS,
    N_COVARIANCE,
    N_ERROR,
    N_KNOWN,
    N_NOMINAL,
    PLACES,
    correction,
    inject,
    packed,
    prediction,
    propagate,
    unpacked,
)
from quadexp.plugins.worlds.inertial import FORCE, N_BIAS, N_DENSITIES, N_READING, TURN, InertialSensors
from quadexp.world.effect import Clock, Effect, Measured, Readings, Sizes, Start

N_ENTRY = N_READING + 1  # of the queue, without the fixes: reading and interval
BIASES = slice(D_ATTITUDE.stop, N_ERROR)
LARGEST_WARM_UP = 2000  # predictions
VARIANCES = tuple(f"est_var_{kind}_{axis}" for kind in ("p", "v", "theta", "bias_a", "bias_g") for axis in "xyz")


@keyed
class Navigation(Effect):
    """The filter that joins the readings of a world's inertial sensors.

    inner states: nominal state (16,), upper triangle of the covariance (120,), queue (e, d): of each reading the IMU's
    and, for each aid, whether there is a fix, and the fix. Readings of before the flight have the interval zero."""

    prefix = "estimator."

    process_factor: float = key(
        1.0, "factor on the standard deviations of the IMU's noise that the filter assumes", "(0, 1000]"
    )
    measurement_factor: float = key(
        1.0, "factor on the standard deviations of the aids' noise that the filter assumes", "(0, 1000]"
    )
    warm_up: float = key(
        10.0, "how long the vehicle has stood, with the filter running, when a flight begins", "[0, 600]", "s"
    )

    stage = "estimator"

    inertial: InertialSensors | None = None

    def among(self, effects: Sequence[Effect]) -> Effect:
        """Raises UsageError where there are no inertial sensors."""
        sensors = [effect for effect in effects if isinstance(effect, InertialSensors)]
        if not sensors:
            raise UsageError("estimator=eskf: needs inertial sensors: sensor=imu_mocap or sensor=imu_gnss")
        return replace(self, inertial=sensors[0])

    @property
    def sensors(self) -> InertialSensors:
        """The sensors that it joins."""
        assert self.inertial is not None
        return self.inertial

    @property
    def entry_size(self) -> int:
        """Numbers of one reading in the queue."""
        return N_ENTRY + sum(1 + aid.size for aid in self.sensors.aids)

    def horizon(self, clock: Clock) -> int:
        """IMU readings that the filter is behind, d."""
        interval = clock.period / self.sensors.readings(clock)
        return math.ceil(max(aid.delay for aid in self.sensors.aids) / interval - 1e-9)

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        inner = N_NOMINAL + N_COVARIANCE + self.entry_size * self.horizon(clock)
        return Sizes(inner, sum(self._parameter_sizes()))

    def _parameter_sizes(self) -> list[int]:
        """How many parameters are gravity and densities, and how many each aid's deviations."""
        return [1 + N_DENSITIES, *(len(aid.deviations) for aid in self.sensors.aids)]

    def believed(self, gravity: float) -> np.ndarray:
        """Parameters: gravity, the IMU's densities, and the aids' deviations, as the filter takes them."""
        densities = self.process_factor * self.sensors.densities
        deviations = [self.measurement_factor * aid.deviations for aid in self.sensors.aids]
        return np.concatenate([[gravity], densities, *deviations])

    def first_deviations(self, gravity: float) -> np.ndarray:
        """Standard deviations of the error after one fix of each aid, (15,)."""
        bias = self.sensors.bias_std
        deviations = np.zeros(N_ERROR)
        deviations[D_ATTITUDE.start : D_ATTITUDE.stop] = bias[0] / gravity
        for aid in self.sensors.aids:
            deviations[list(aid.first_guess)] = list(aid.first_guess.values())
        deviations[D_ATTITUDE.stop :] = bias
        return deviations

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        """The error is drawn from the covariance that standing for `warm_up` leaves, given the true biases.

        b = b^ + e_b, and the estimate b^ is uncorrelated with all errors e: so cov(e, b) = cov(e, e_b).
        """
        gravity = start.vehicle.gravity
        standing = _standing(self, gravity)
        turned = Rotation.from_quat(start.x[ATTITUDE], scalar_first=True).as_matrix().T
        bias = start.begun[self.sensors.part][:N_BIAS]
        spread = self.sensors.bias_std**2
        by_bias = np.divide(standing[:, BIASES], spread, out=np.zeros((N_ERROR, N_BIAS)), where=spread > 0)
        values, vectors = np.linalg.eigh(standing - by_bias @ standing[BIASES])
        deviations = np.sqrt(np.maximum(values, 0))
        drawn = vectors @ (deviations * rng.standard_normal(N_ERROR))
        in_world = np.concatenate([turned.T @ bias[FORCE], turned.T @ bias[TURN]])
        drawn += by_bias @ in_world
        to_body = np.eye(N_ERROR)
        for place in PLACES[2:]:
            to_body[np.ix_(place, place)] = turned
        truth = np.concatenate([start.x[: RATE.start], bias])
        known = _off_by()(truth, -to_body @ drawn, to_body @ standing @ to_body.T)
        queue = np.zeros(self.entry_size * self.horizon(start.clock))
        return np.concatenate([known.full().ravel(), queue]), self.believed(gravity)

    def stated(self, sensor_spec: SensorSpec, vehicle: Vehicle) -> SensorSpec:
        """The deviations that the filter states when a flight begins; its errors are slow, its state is of now."""
        deviations = np.sqrt(np.diag(_standing(self, vehicle.gravity)))
        position, velocity, attitude = (Stated(drift=float(deviations[list(place)].max())) for place in PLACES[:3])
        return replace(sensor_spec, position=position, velocity=velocity, attitude=attitude)

    def first(self, inner: np.ndarray, state: np.ndarray) -> np.ndarray:
        return np.concatenate([inner[: RATE.start], state[RATE]])

    def columns(self, clock: Clock, vehicle: Vehicle) -> Mapping[str, int]:
        """Estimated biases, and the variances of the error, both on the horizon."""
        diagonal = [N_NOMINAL + i * (i + 3) // 2 for i in range(N_ERROR)]
        biases = {f"est_{name}": len(STATE_COLUMNS[: RATE.start]) + i for i, name in enumerate(BIAS_COLUMNS)}
        return biases | named(VARIANCES, diagonal)

    def measure(self, at: Readings, measured: Measured) -> tuple[ca.MX, Measured]:
        aids = self.sensors.aids
        count = self.sensors.readings(at.clock)
        behind = self.horizon(at.clock)
        entries = ca.vertcat(measured["imu"], *(measured[aid.name] for aid in aids))
        queue = ca.horzcat(ca.reshape(at.inner[N_KNOWN:], self.entry_size, behind), entries)
        parameters = ca.repmat(at.parameters, 1, count)
        known = self._filter().fold(count)(at.inner[:N_KNOWN], queue[:, :count], parameters)
        queue = queue[:, count:]
        nominal = known[:N_NOMINAL]
        if behind:
            gravity = ca.repmat(at.parameters[0], 1, behind)
            nominal = self._output().fold(behind)(nominal, queue[:N_ENTRY, :], gravity)
        rates = measured["imu"][TURN, -1] - nominal[GYROSCOPE_BIAS]
        state = ca.vertcat(nominal[: RATE.start], rates)
        return ca.vertcat(known, ca.vec(queue)), measured | {"state": state}

    def _output(self) -> ca.Function:
        """(nominal state, entry, gravity) -> nominal state after the entry's interval."""
        nominal, entry, gravity = symbols(ca.SX, nominal=N_NOMINAL, entry=N_ENTRY, gravity=1)
        after, _ = propagate(nominal, entry[:N_READING], entry[N_READING], gravity)
        return ca.Function("predict_output", [nominal, entry, gravity], ca.cse([after]))

    def _filter(self) -> ca.Function:
        """([nominal state, covariance], entry, parameters) -> [nominal state, covariance] after the entry."""
        aids = self.sensors.aids
        sizes = self._parameter_sizes()
        known, entry, parameters = symbols(ca.MX, known=N_KNOWN, entry=self.entry_size, parameters=sum(sizes))
        of_imu, *of_aids = split(parameters, sizes)
        reading, *fixes = split(entry, [N_ENTRY, *(1 + aid.size for aid in aids)])
        estimate = prediction()(known, reading[:N_READING], reading[N_READING], of_imu)
        for aid, fix, deviations in zip(aids, fixes, of_aids, strict=True):
            estimate = correction(aid)(fix[0], estimate, fix[1:], deviations)
        return ca.Function("filter_step", [known, entry, parameters], [estimate])


@cache
def _standing(filter_: Navigation, gravity: float) -> np.ndarray:
    """Covariance (15, 15) after `warm_up` at rest, level, body axes along the world's, without outages.

    The biases are constant for that time; the filter's factors are not applied. At most LARGEST_WARM_UP predictions.
    """
    sensors = filter_.sensors
    interval = max(1 / sensors.imu_rate, filter_.warm_up / LARGEST_WARM_UP)
    densities = sensors.densities
    densities[2:] = 0
    x = np.concatenate([np.zeros(3), [1], np.zeros(9)])
    reading = [0, 0, gravity, 0, 0, 0]
    parameters = np.concatenate([[gravity], densities])
    fixes = [aid.measure(ca.DM(x), ca.DM.zeros(aid.noise), ca.DM(aid.deviations)) for aid in sensors.aids]
    first = ca.diag(ca.DM(filter_.first_deviations(gravity) ** 2))
    known = ca.vertcat(x, ca.DM.zeros(N_NOMINAL - len(x)), packed(ca.densify(first)))
    predict = prediction()
    corrections = [correction(aid) for aid in sensors.aids]
    due = np.zeros(len(sensors.aids))
    for _ in range(round(filter_.warm_up / interval)):
        known = predict(known, reading, interval, parameters)
        for i, aid in enumerate(sensors.aids):
            due[i] += aid.rate * interval
            if due[i] >= 1:
                due[i] %= 1
                known = corrections[i](1, known, fixes[i], aid.deviations)
    return np.array(unpacked(known[N_NOMINAL:]).full())


@cache
def _off_by() -> ca.Function:
    """(nominal state, an error (15,), covariance (15, 15)) -> [nominal state with the error added, covariance]."""
    nominal, d, covariance = symbols(ca.SX, nominal=N_NOMINAL, d=N_ERROR, covariance=(N_ERROR, N_ERROR))
    estimate = ca.vertcat(inject(nominal, d), packed(covariance))
    return ca.Function("off_by", [nominal, d, covariance], [estimate])
