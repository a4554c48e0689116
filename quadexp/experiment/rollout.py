"""One closed-loop flight: plant, controller and reference, sample by sample."""

from __future__ import annotations

import itertools
import math
import time
from typing import Any

import numpy as np

from quadexp.control.base import Controller, Measurement, Window
from quadexp.control.control_step import stepped
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.controller import as_controller
from quadexp.control.mpc.mpc import ModelPredictiveController, StepRecord
from quadexp.control.readings import ReadingGate
from quadexp.errors import ModelDomainError, QuadexpError, UsageError
from quadexp.experiment.compiled_flight import CompiledFlight, covers
from quadexp.log.outcome import CORRIDOR, corridor
from quadexp.log.schema import Flight
from quadexp.models.residual import Residual
from quadexp.names import named
from quadexp.physics.rotation import heading, heading_rate
from quadexp.physics.state import ATTITUDE, POSITION, RATE, STATE_COLUMNS, VELOCITY, in_motion, input_columns, norms
from quadexp.reference.base import Trajectory
from quadexp.reference.flatness import Reference, clipped, flat_reference
from quadexp.world.base import Plant
from quadexp.world.integrator import SimulatedPlant
from quadexp.world.world import World

LOST_DISTANCE = 10.0  # m from the reference; beyond it a flight counts as lost
TIME_RESOLUTION = 1e-9  # s; closer sampling times count as equal
BLOCK = 4096  # control instants whose horizons are looked up at once
INNER_STATES = ("rotor_speed", "induced_velocity")  # (n,) attributes of some plants, logged as columns


class SampledReference:
    """The reference at every control instant and every node of the horizon that starts there.

    controller: its period and node times determine the sampling; its residual, if fed forward, enters attitude, rates
    and thrusts. free_heading: whether the trajectory leaves the heading free.
    """

    def __init__(self, trajectory: Trajectory, controller: Controller | ModelPredictiveController) -> None:
        controller = as_controller(controller)
        controller.forget()
        self._trajectory = trajectory
        self._vehicle = controller.vehicle
        self._backend = controller.backend
        samples = int(np.floor(trajectory.duration / controller.control_period + 1e-6)) + 1
        self.t = np.arange(samples) * controller.control_period
        ahead = np.concatenate([[0.0], controller.node_times])  # a horizon need not begin now
        where = np.empty((samples, len(ahead)), np.int64)
        blocks = [slice(first, first + BLOCK) for first in range(0, samples, BLOCK)]
        for block in blocks:
            where[block] = np.round((self.t[block, None] + ahead) / TIME_RESOLUTION)
        self._grid = np.unique(np.concatenate([np.unique(where[block]) for block in blocks]))
        for block in blocks:
            where[block] = np.searchsorted(self._grid, where[block])
        self._now = where[:, 0]
        self._where = where[:, 1:]
        self._stride = _common_stride(self._where)
        flat = trajectory.flat_output(self.t)
        self._position = flat.position
        self._follow_heading = flat.yaw is None
        self.free_heading = flat.yaw is None and not getattr(trajectory, "counts_heading", False)
        self._yaw = np.zeros((samples, 3)) if flat.yaw is None else flat.yaw
        self._drift = np.zeros(samples)
        self._residual: Residual | object | None = self  # none yet
        self.reference: Reference
        self.renew(controller.residual)

    def renew(self, residual: Residual | None) -> None:
        """Recompute attitude, rates and thrusts for another residual, with the largest share of it that is possible.

        Raises UsageError where the trajectory does not determine the attitude.
        """
        if residual is self._residual:
            return
        self._residual = residual
        times = self._grid * TIME_RESOLUTION
        self.reference = flat_reference(
            self._trajectory, times, self._vehicle, residual=residual, backend=self._backend
        )
        if getattr(self._trajectory, "clipped", False):
            self.reference = clipped(self.reference, self._vehicle)
        if self._follow_heading:
            attitude = self.reference.state[self._now, ATTITUDE]
            rate = self.reference.state[self._now, RATE]
            self._yaw[:, 0] = heading(attitude)
            self._drift = heading_rate(attitude, rate)
        self.reference.state.flags.writeable = self.reference.input.flags.writeable = False  # horizons are views

    def serves(self, controller: Controller) -> bool:
        """Whether it is still the reference of the controller that it was made for."""
        return controller.residual is self._residual

    @property
    def residual_share(self) -> float:
        """Share of the controller's residual in the reference, 0 .. 1; NaN without feed-forward of a residual."""
        return self.reference.residual

    def __len__(self) -> int:
        return len(self.t)

    def horizon(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """States (N + 1, 13) and inputs (N, n) over the horizon from control instant k; read-only."""
        where = self._where[k]
        stride = self._stride
        if stride:
            first = where.item(0)
            last = where.item(-1)
            return self.reference.state[first : last + 1 : stride], self.reference.input[first:last:stride]
        return self.reference.state[where], self.reference.input[where[:-1]]

    def horizons(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States (g, 13) and inputs (g, n) on a grid, and which of its rows make each horizon, (k, N + 1)."""
        return self.reference.state, self.reference.input, self._where

    def window(self, k: int) -> Window:
        """The reference for the controller at control instant k."""
        return Window(*self.horizon(k), self._position[k], self._yaw[k], self._drift.item(k))

    def box(self, margin: float) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest position (3,) of the reference, widened by a margin (m)."""
        position = self._position[:, 0]
        return position.min(axis=0) - margin, position.max(axis=0) + margin

    @property
    def first_thrust(self) -> np.ndarray | None:
        """Rotor thrusts (n,) (N) with which a flight begins, where the reference begins in motion; else None."""
        state, thrust = self.at(0)
        return np.clip(thrust, self._vehicle.thrust_min, self._vehicle.thrust_max) if in_motion(state) else None

    def path(self) -> tuple[np.ndarray, np.ndarray]:
        """Position with its derivatives (k, 5, 3), and heading with its own and the drift, (k, 4), at the instants."""
        return self._position, np.column_stack([self._yaw, self._drift])

    def along(self) -> tuple[np.ndarray, np.ndarray]:
        """States (k, 13) and inputs (k, n) at the control instants."""
        return self.at(slice(None))

    def at(self, k: int | slice) -> tuple[np.ndarray, np.ndarray]:
        """State (13,) and input (n,) at control instant k; (j, 13) and (j, n) at several."""
        where = self._now[k]
        return self.reference.state[where], self.reference.input[where]


def _common_stride(where: np.ndarray) -> int:
    """The common step of all rows of indices, (k, N + 1); 0 where there is none."""
    first = int(where[0, 1] - where[0, 0]) if where.shape[1] > 1 else 0
    same = all((after - before == first).all() for before, after in itertools.pairwise(where.T))
    return first if same else 0


def fly(
    plant: Plant,
    controller: Controller | ModelPredictiveController,
    reference: SampledReference,
    rng: np.random.Generator,
    *,
    start: np.ndarray | None = None,
    lost_distance: float = LOST_DISTANCE,
    lost_box: float | None = None,
    metadata: dict[str, Any] | None = None,
) -> Flight:
    """Fly the reference from its start (or from `start`, (13,)) and return the log, one row per control instant.

    plant: a World tells the controller what its sensors and estimator make of the state; the log has both then, and
    the flight ends by the true one.
    The flight ends early, with the log up to there, where the vehicle is further than lost_distance (m) from the
    reference, or outside the box around it widened by lost_box (m; None: no box), or its state is not finite ("lost"),
    or a control step fails, or what is measured is refused ("solver_failed"). One that was flown to its end has left
    its corridor where it was further from its reference than log/outcome.py allows ("left_corridor"). metadata:
    extended by the outcome, the corridor (m) and the mean share of the residual in the reference (None without
    feed-forward of a residual).
    """
    controller = as_controller(controller)
    period = controller.control_period
    renewal = Renewal(round(controller.reference_period / period))
    x = reference.at(0)[0].copy() if start is None else np.array(start, float)
    world = plant if isinstance(plant, World) else None
    noise: Any = rng
    thrust = reference.first_thrust if start is None else None
    if isinstance(plant, World) or (
        isinstance(plant, SimulatedPlant) and type(plant).advance is SimulatedPlant.advance
    ):
        noise = plant.begin(x, period, float(reference.t[-1]) + period, rng, thrust)
    else:
        plant.reset()
    inner = _Inner(plant, period)
    log = _Log(len(reference), plant.vehicle.n_rotors, len(inner.names), world is not None and world.estimates)
    reading = np.array([0.0, 0.0, plant.vehicle.gravity])
    measured = None
    speed = None
    measured_state = x if world is None else world.measured
    controller.reset(measured_state, reference.window(0))
    gate = ReadingGate(plant.vehicle.n_rotors)
    compiled: CompiledFlight | None = None
    box = None if lost_box is None else reference.box(lost_box)
    inside = lost_distance if lost_box is None else min(lost_distance, lost_box)  # surely not lost
    in_c = inner.places is not None and covers(plant, controller, rng)
    outcome = "ok"
    cause = ""
    shares = np.full(len(reference), reference.residual_share)
    k = 0
    commanded = False
    while k < len(reference):
        if not commanded:
            t = float(reference.t[k])
            if renewal.due(k):
                renewal.renew(k, reference, controller.residual)
            state_reference, input_reference = reference.at(k)
            shares[k] = reference.residual_share
            why = _too_far(x[POSITION], state_reference[POSITION], lost_distance)
            if not why and box is not None and not (box[0] <= x[POSITION]).all() & (x[POSITION] <= box[1]).all():
                why = f"{lost_box:g} m outside the box of the reference"
            if why:
                outcome = "lost"
                cause = f"{why} at t={t:.2f} s"
                break
            try:
                asked = gate.admit(Measurement(t, measured_state, measured, speed)), reference.window(k)
            except QuadexpError as error:
                if isinstance(error, UsageError):  # a plant's mistake
                    raise
                outcome = "solver_failed"
                cause = str(error)
                break
            began = time.perf_counter()
            u, record = stepped(controller, *asked)
            took = time.perf_counter() - began
            log.add(
                record, took, controller.log(), state=x, input=u, reading=reading, inner=inner.values(),
                estimate=measured_state, state_reference=state_reference, input_reference=input_reference,
            )  # fmt: skip
            if in_c and compiled is None:  # when all that logs has said what
                log.state_reference[:], log.input_reference[:] = along = reference.along()
                arrays = (reference.horizons(), along[0], reference.path(), log.arrays())
                compiled = CompiledFlight(plant, controller, *arrays, inner.places, noise, inside)
                in_c = compiled.flies
            if record.status == Status.FAILED:
                outcome = "solver_failed"
                what = "" if np.isfinite(u).all() else ": its command is not finite"
                cause = f"the control step failed at t={t:.2f} s{what}"
                break
        try:
            x, reading = plant.advance(x, u, period, noise)
        except ModelDomainError as error:
            outcome = "lost"
            cause = str(error)
            break
        k += 1
        commanded = False
        if compiled is not None and in_c:
            k, commanded, x, reading = compiled.go_on(k, x, reading)
            if log.rows < k + commanded:
                log.rows = k + commanded
                last = log.rows - 1
                u = log.input[last].copy()
                gate.admit(Measurement(float(reference.t[last]), log.state[last], log.reading[last], None))
        measured_state = x if world is None else world.measured
        measured = reading
        speed = getattr(plant, "rotor_speed", None)
    if not log.rows:
        raise QuadexpError(f"the flight ended before its first sample: {cause}")
    wanted = log.state_reference[: log.rows]
    width = corridor(plant.vehicle.size, reference.t[: log.rows], wanted[:, POSITION], wanted[:, VELOCITY])
    away = norms(log.state[: log.rows, POSITION] - wanted[:, POSITION])
    if outcome == "ok" and away.max() > width:
        at = int(away.argmax())
        outcome = "left_corridor"
        cause = f"{away[at]:.3g} m from the reference at t={reference.t[at]:.2f} s, beyond its corridor of"
        cause += f" {width:.3g} m, {CORRIDOR:g} sizes of the vehicle"
    share = float(np.mean(shares[: k + 1]))  # it may change where references are recomputed in flight
    details: dict[str, Any] = {"outcome": outcome, "cause": cause, "corridor": width, "backend": controller.backend}
    details |= {"free_heading": reference.free_heading, "reference_residual": None if math.isnan(share) else share}
    if renewal.failed:
        details["stale_references"] = renewal.failed
    return Flight(log.columns(reference.t, inner.names), {**(metadata or {}), **details})


def _too_far(position: np.ndarray, wanted: np.ndarray, lost_distance: float) -> str:
    """Why a vehicle at a position (3,) is too far from where it should be, "" where it is not."""
    error = position - wanted
    distance = math.sqrt(error.dot(error))
    if math.isnan(distance):
        return "the plant's state is not finite"
    return f"{distance:.1f} m from the reference" if distance > lost_distance else ""


class Renewal:
    """Recomputes the reference with the identified residual every `period` control steps (0: never).

    Where that fails, the previous reference is kept. After a failure, and after a reference with only a share of the
    residual, the waiting time doubles, because both take many iterations.
    """

    def __init__(self, period: int) -> None:
        self._period = period
        self._wait = period
        self._next = period
        self.failed = 0

    def due(self, k: int) -> bool:
        return bool(self._period) and k >= self._next

    def renew(self, k: int, reference: SampledReference, residual: Residual | None) -> None:
        try:
            reference.renew(residual)
            self._wait = 2 * self._wait if reference.residual_share < 1 else self._period
        except UsageError:
            self.failed += 1
            self._wait *= 2
        self._next = k + self._wait


class _Inner:
    """Which inner states of a plant are columns of a flight.

    names: of the columns. places: which of the inner states they are; None where the plant gives them by attributes
    alone.
    """

    def __init__(self, plant: Plant, period: float) -> None:
        self._plant = plant
        self._attributes = [name for name in INNER_STATES if hasattr(plant, name)]
        self.places: np.ndarray | None = None
        if isinstance(plant, World):
            columns = plant.columns(period)
            self.names = [*columns]
            self.places = np.array([*columns.values()], np.int64)
            return
        self.names = [f"{name}_{j}" for name in self._attributes for j in range(len(getattr(plant, name)))]
        if isinstance(plant, SimulatedPlant) and [*plant.inner_columns] == self.names:
            self.places = np.arange(len(self.names))

    def values(self) -> np.ndarray:
        """What they are now."""
        if self.places is not None and isinstance(self._plant, SimulatedPlant):
            return self._plant.inner[self.places]
        values = [getattr(self._plant, name) for name in self._attributes]
        return np.concatenate(values) if values else np.empty(0)


class _Log:
    """The samples of a flight. inner: how many inner states are logged. estimates: whether the controller is given
    another state than the true one."""

    def __init__(self, samples: int, rotors: int, inner: int, estimates: bool) -> None:
        self.rows = 0
        self.state, self.state_reference = np.empty((2, samples, len(STATE_COLUMNS)))
        self.input, self.input_reference = np.empty((2, samples, rotors))
        self.reading = np.empty((samples, 3))
        self.record = np.empty((samples, len(StepRecord._fields)))
        self.inner = np.empty((samples, inner))
        self.estimate = np.empty((samples if estimates else 0, len(STATE_COLUMNS)))
        self.extra = np.empty((samples, 0))
        self.extra_names = list[str]()

    def arrays(self) -> dict[str, np.ndarray]:
        """What flight.c fills."""
        filled = ("state", "input", "reading", "inner", "record", "estimate", "extra")
        return {name: getattr(self, name) for name in filled}

    def add(self, record: StepRecord, took: float, extra: dict[str, float], **sample: np.ndarray) -> None:
        """Another sample. took: s, with all that is around the MPC. sample: values by the names of their arrays."""
        k = self.rows
        self.rows = self.rows + 1
        for name, values in sample.items():
            samples = getattr(self, name)
            if len(samples):  # no estimates where the controller is given the true state
                samples[k] = values
        self.record[k] = record
        self.record[k, 0] = took
        if not k:
            self.extra_names = [*extra]
            self.extra = np.empty((len(self.extra), len(extra)))
        self.extra[k] = [extra[name] for name in self.extra_names]

    def columns(self, t: np.ndarray, inner_names: list[str]) -> dict[str, np.ndarray]:
        """Named columns of the flown samples."""
        flown = slice(self.rows)
        inputs = input_columns(self.input.shape[1])
        columns = {"t": t[flown]}
        columns |= named(STATE_COLUMNS, self.state[flown].T)
        columns |= named(inputs, self.input[flown].T)
        columns |= {f"ref_{n}": v for n, v in zip(STATE_COLUMNS, self.state_reference[flown].T, strict=True)}
        columns |= {f"ref_{n}": v for n, v in zip(inputs, self.input_reference[flown].T, strict=True)}
        columns |= {f"acc_{axis}": values for axis, values in zip("xyz", self.reading[flown].T, strict=True)}
        record = named(StepRecord._fields, self.record[flown].T)
        counts = {"status": np.int8, "sweeps": np.int16, "active": np.int16}
        columns["solve_time"] = record["solve_time"]
        columns |= {name: record[name].astype(kind) for name, kind in counts.items()}
        columns |= {"kkt": record["kkt"], "unconverged": (record["converged"] == 0).astype(np.int8)}
        estimates = [f"est_{name}" for name in STATE_COLUMNS] if len(self.estimate) else []
        more = (inner_names, self.inner), (estimates, self.estimate), (self.extra_names, self.extra)
        for whose, (names, values) in zip(("columns", "columns", "logged"), more, strict=True):
            if taken := [name for name in names if name in columns]:
                raise UsageError(f"{whose}: {taken[0]} is a column of every flight: choose another name for it")
            columns |= named(names, values[flown].T if names else ())
        return {name: np.ascontiguousarray(values) for name, values in columns.items()}
