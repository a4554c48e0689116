"""One closed-loop flight: plant, sensor, controller and reference, sample by sample."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np

from quadexp.air.base import Residual
from quadexp.control.base import Controller, Measurement, Window
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.controller import as_controller
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.errors import ModelDomainError, QuadexpError, UsageError
from quadexp.log.schema import Flight
from quadexp.physics.state import POSITION, STATE_COLUMNS, input_columns
from quadexp.reference.base import Trajectory
from quadexp.reference.flatness import Reference, flat_reference
from quadexp.world.base import Plant

LOST_DISTANCE = 10.0  # m from the reference: further away nobody calls it tracking
TIME_RESOLUTION = 1e-9  # s, two sampling times closer than this are one
INNER_STATES = ("rotor_speed", "induced_velocity")  # (n,) of a plant that has them, logged as columns


class Sensor(Protocol):
    """What stands between the plant's specific force and the controller; see quadexp.world."""

    def read(self, specific_force: np.ndarray, rng: np.random.Generator) -> np.ndarray: ...


class SampledReference:
    """The reference at every control instant and every node of the horizon that starts there.

    trajectory: what to fly. controller: its period and node times decide where to sample, and its residual, where it
    feeds forward, enters attitude, rates and thrusts.
    """

    def __init__(self, trajectory: Trajectory, controller: Controller | ModelPredictiveController) -> None:
        controller = as_controller(controller)
        controller.forget()
        self._trajectory, self._vehicle = trajectory, controller.vehicle
        samples = int(np.floor(trajectory.duration / controller.control_period + 1e-6)) + 1
        self.t = np.arange(samples) * controller.control_period
        times = self.t[:, None] + controller.node_times
        self._grid, where = np.unique(np.round(times / TIME_RESOLUTION).astype(np.int64), return_inverse=True)
        self._where = where.reshape(times.shape)
        self._stride = _common_stride(self._where)
        flat = trajectory.flat_output(self.t)
        self._position = flat.position
        self._yaw = np.zeros((samples, 3)) if flat.yaw is None else flat.yaw
        self._believed: Residual | object | None = self  # nothing yet
        self.reference: Reference
        self.renew(controller.residual)

    def renew(self, residual: Residual | None) -> None:
        """Make attitude, rates and thrusts anew for another belief of the air, under as much of it as can be.

        Raises UsageError where the trajectory leaves no attitude.
        """
        if residual is self._believed:
            return
        self._believed = residual
        times = self._grid * TIME_RESOLUTION
        self.reference = flat_reference(self._trajectory, times, self._vehicle, residual=residual)
        self.reference.state.flags.writeable = self.reference.input.flags.writeable = False  # horizons are views

    @property
    def residual_share(self) -> float:
        """Share of the controller's residual that the reference contains, 0 .. 1; NaN where it shall contain none."""
        return self.reference.residual

    def __len__(self) -> int:
        return len(self.t)

    def horizon(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """States (N + 1, 13) and inputs (N, n) over the horizon from control instant k; not to be written to."""
        where, stride = self._where[k], self._stride
        if stride:
            first, last = where.item(0), where.item(-1)
            return self.reference.state[first : last + 1 : stride], self.reference.input[first:last:stride]
        return self.reference.state[where], self.reference.input[where[:-1]]

    def window(self, k: int) -> Window:
        """What a controller sees of the reference at control instant k."""
        return Window(*self.horizon(k), self._position[k], self._yaw[k])

    def along(self) -> tuple[np.ndarray, np.ndarray]:
        """States (k, 13) and inputs (k, n) at the control instants."""
        where = self._where[:, 0]
        return self.reference.state[where], self.reference.input[where]

    def at(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """State (13,) and input (n,) at control instant k."""
        where = self._where[k, 0]
        return self.reference.state[where], self.reference.input[where]


def _common_stride(where: np.ndarray) -> int:
    """The one distance of neighbours in every row of indices, (k, N + 1); 0 where there are several, or none."""
    strides = np.unique(np.diff(where, axis=1))
    return int(strides[0]) if len(strides) == 1 else 0


def fly(
    plant: Plant,
    controller: Controller | ModelPredictiveController,
    reference: SampledReference,
    rng: np.random.Generator,
    *,
    start: np.ndarray | None = None,
    sensor: Sensor | None = None,
    lost_distance: float = LOST_DISTANCE,
    metadata: dict[str, Any] | None = None,
) -> Flight:
    """Fly the reference from its start (or from `start`, (13,)) and return the log, one row per control instant.

    sensor: what the controller's accelerometer makes of the specific force; None: it reads it exactly.
    The flight ends early, with the log up to there, where the vehicle is further than lost_distance (m) from the
    reference or its state is not finite ("lost"), or a control step fails ("solver_failed"). metadata is kept and
    extended by the outcome, and by the share of the residual that the reference contained on average over the flight
    (None: it shall contain none).
    """
    controller = as_controller(controller)
    period, rotors = controller.control_period, plant.vehicle.n_rotors
    renewal = Renewal(round(controller.reference_period / period))
    log = _Log(len(reference), rotors)
    sensor_rng = rng.spawn(1)[0] if sensor is not None else rng
    plant.reset()
    inner_names = [name for name in INNER_STATES if hasattr(plant, name)]
    x = reference.at(0)[0].copy() if start is None else np.array(start, float)
    reading = np.array([0.0, 0.0, plant.vehicle.gravity])
    measured, speed = None, None
    controller.reset(x, reference.window(0))
    outcome, cause, shares = "ok", "", []
    for k in range(len(reference)):
        t = float(reference.t[k])
        if renewal.due(k):
            renewal.make(k, reference, controller.residual)
        state_reference, input_reference = reference.at(k)
        shares.append(reference.residual_share)
        error = x[POSITION] - state_reference[POSITION]
        distance = math.sqrt(error.dot(error))
        if not distance <= lost_distance:
            outcome, cause = "lost", f"{distance:.1f} m from the reference at t={t:.2f} s"
            break
        u, record = controller.step(Measurement(t, x, measured, speed), reference.window(k))
        inner = [getattr(plant, name) for name in inner_names]
        log.add(x, u, state_reference, input_reference, reading, inner, record, controller.log())
        if record.status == Status.FAILED:
            outcome, cause = "solver_failed", f"the control step failed at t={t:.2f} s"
            break
        try:
            x, reading = plant.advance(x, u, period, rng)
        except ModelDomainError as error:
            outcome, cause = "lost", str(error)
            break
        if sensor is not None:
            reading = sensor.read(reading, sensor_rng)
        measured, speed = reading, getattr(plant, "rotor_speed", None)
    if not log.records:
        raise QuadexpError(f"the flight is over before it began: {cause}")
    share = float(np.mean(shares))  # a reference that is made anew in flight may contain more or less than before
    details: dict[str, Any] = {"outcome": outcome, "cause": cause, "backend": controller.backend}
    details["reference_residual"] = None if math.isnan(share) else share
    if renewal.failed:
        details["stale_references"] = renewal.failed
    return Flight(log.columns(reference.t, inner_names), {**(metadata or {}), **details})


class Renewal:
    """When a reference is made anew from what has been identified: every `period` control steps (0: never).

    Where the new belief admits no reference the earlier one stays. After that, and after a reference that contains a
    share of the belief only, the next attempt waits twice as long as the one before: both cost many iterations.
    """

    def __init__(self, period: int) -> None:
        self._period, self._wait, self._next, self.failed = period, period, period, 0

    def due(self, k: int) -> bool:
        return bool(self._period) and k >= self._next

    def make(self, k: int, reference: SampledReference, residual: Residual | None) -> None:
        try:
            reference.renew(residual)
            self._wait = 2 * self._wait if reference.residual_share < 1 else self._period
        except UsageError:
            self.failed += 1
            self._wait *= 2
        self._next = k + self._wait


class _Log:
    """Rows of a flight, as they come."""

    def __init__(self, samples: int, rotors: int) -> None:
        self.state, self.state_reference = np.empty((2, samples, len(STATE_COLUMNS)))
        self.input, self.input_reference = np.empty((2, samples, rotors))
        self.reading = np.empty((samples, 3))
        self.inner: list[np.ndarray] = []
        self.records: list[Any] = []
        self.extra: list[dict[str, float]] = []

    def add(
        self,
        x: np.ndarray,
        u: np.ndarray,
        state_reference: np.ndarray,
        input_reference: np.ndarray,
        reading: np.ndarray,
        inner: list[np.ndarray],
        record: Any,
        extra: dict[str, float],
    ) -> None:
        k = len(self.records)
        self.state[k], self.input[k], self.reading[k] = x, u, reading
        self.state_reference[k], self.input_reference[k] = state_reference, input_reference
        if inner:
            self.inner.append(np.array(inner))
        self.records.append(record)
        self.extra.append(extra)

    def columns(self, t: np.ndarray, inner_names: list[str]) -> dict[str, np.ndarray]:
        """Named columns of the rows that were flown."""
        flown, inputs = len(self.records), input_columns(self.input.shape[1])
        columns = {"t": t[:flown]}
        columns |= dict(zip(STATE_COLUMNS, self.state[:flown].T, strict=True))
        columns |= dict(zip(inputs, self.input[:flown].T, strict=True))
        columns |= {f"ref_{n}": v for n, v in zip(STATE_COLUMNS, self.state_reference[:flown].T, strict=True)}
        columns |= {f"ref_{n}": v for n, v in zip(inputs, self.input_reference[:flown].T, strict=True)}
        columns |= {f"acc_{axis}": values for axis, values in zip("xyz", self.reading[:flown].T, strict=True)}
        columns |= {
            "solve_time": np.array([record.solve_time for record in self.records]),
            "status": np.array([record.status for record in self.records], np.int8),
            "sweeps": np.array([record.sweeps for record in self.records], np.int16),
            "active": np.array([record.active for record in self.records], np.int16),
            "kkt": np.array([record.kkt for record in self.records]),
            "unconverged": np.array([not record.converged for record in self.records], np.int8),
        }
        inner = np.array(self.inner)
        for i, name in enumerate(inner_names):
            columns |= {f"{name}_{j}": inner[:, i, j] for j in range(inner.shape[2])}
        columns |= {name: np.array([row[name] for row in self.extra], float) for name in self.extra[0]}
        return {name: np.ascontiguousarray(values) for name, values in columns.items()}
