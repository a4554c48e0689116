"""A controller for your own loop: measured state in, rotor thrusts out.

World ENU, body FLU, quaternion body to world with w first, SI units; see quadexp/physics/state.py.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
import numpy.typing as npt

from quadexp.api import OverrideLike, overrides
from quadexp.control.base import Controller, Measurement, Window
from quadexp.control.compiled_loop import CompiledReference, UserLoop, goes_in_c
from quadexp.control.control_step import stepped
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import StepRecord
from quadexp.control.readings import ReadingGate
from quadexp.control.wrapped import innermost
from quadexp.errors import QuadexpError, UsageError
from quadexp.experiment.build import build_controller, build_trajectory, build_vehicle, build_world, unshared
from quadexp.experiment.identity import find_model
from quadexp.experiment.rollout import Renewal, SampledReference
from quadexp.parts.compose import compose
from quadexp.parts.options import Folders
from quadexp.physics.state import RATE
from quadexp.reference.base import Trajectory

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def by_one_thread(
    method: Callable[Concatenate[ControlLoop, Parameters], Result],
) -> Callable[Concatenate[ControlLoop, Parameters], Result]:
    """Two threads in the same arrays at once would corrupt them: the second one is refused."""

    @functools.wraps(method)
    def guarded(loop: ControlLoop, /, *args: Parameters.args, **keywords: Parameters.kwargs) -> Result:
        if not loop.busy.acquire(blocking=False):
            raise UsageError(f"{method.__name__}: another thread is in this loop; give each one its own qx.controller")
        try:
            return method(loop, *args, **keywords)
        finally:
            loop.busy.release()

    return guarded


def controller(*settings: OverrideLike, conf: Folders = None, **keywords: Any) -> ControlLoop:
    """The configured controller with the configured trajectory; settings as for qx.simulate.

    Builds everything, which compiles on first use: do it before take-off.
    """
    config = compose(overrides(settings, keywords), conf, "qx.controller")
    with unshared():  # two loops of the same settings are two controllers
        vehicle = build_vehicle(config.vehicle)
        plant = build_world(config, vehicle)
        product = build_controller(config, vehicle, plant, find_model(config))
    return ControlLoop(product, build_trajectory(config.trajectory, vehicle), plant)


class ControlLoop:
    """A controller, what it tracks, and how its last step went.

    controller: see quadexp/control/base.py. plant: the configured simulated vehicle (quadexp/world/base.py), for a
    loop without a real one; in a world its flight begins with `begin` (quadexp/world/world.py). period: s, between
    steps. times: (k,), s, the control instants of the trajectory. failed: whether the last step was refused, or
    found no answer, so that its thrusts are those of an earlier prediction. busy: held by the thread that is in it.

    A step is one call into C (control/compiled_loop.py), where controller and machine allow it, with the same numbers.
    """

    def __init__(self, controller: Controller, trajectory: Trajectory, plant: Any) -> None:
        self.controller = controller
        self.plant = plant
        self.vehicle = controller.vehicle
        self.period = controller.control_period
        self.busy = threading.RLock()
        self._gate = ReadingGate(self.vehicle.n_rotors)
        self._record: StepRecord | None
        self._took: float  # s, of a step in C whose record has not been asked for; otherwise 0
        self._compiled: UserLoop | None
        self._asked: Any  # the calls of which it is known whether they go in C
        self.follow(trajectory)

    @property
    def times(self) -> np.ndarray:
        return self._reference.t

    @property
    def start(self) -> np.ndarray:
        """State of the reference at its start, (13,)."""
        return self.reference_state(0.0)

    def reference_state(self, t: float) -> np.ndarray:
        """State of the reference at the control instant nearest to t (s), (13,)."""
        return self._reference.at(self._instant(t))[0].copy()

    def _instant(self, t: float) -> int:
        if not np.isfinite(t):
            raise UsageError(f"t={t}: must be a finite time (s)")
        return min(max(round(t / self.period), 0), len(self._reference) - 1)

    @property
    def rates(self) -> np.ndarray | None:
        """Body rates (3,) that an MPC predicts for its next node (rad/s), for stacks that take rates; None without."""
        mpc = getattr(innermost(self.controller), "mpc", None)
        return None if mpc is None or self.record is None else mpc.prediction[0][1, RATE]

    @property
    def memory(self) -> dict[str, np.ndarray]:
        """What the controller remembers, OWNER.NAME -> numbers, such as L1.disturbance (copies).

        Raises UsageError for a controller that remembers what it does not declare."""
        return {name: values.copy() for name, values in self._declared().memory.items()}

    @by_one_thread
    def restore(self, memory: Mapping[str, np.ndarray]) -> None:
        """Go on from what `memory` once was: the same measurements then give the same thrusts, also in another process.

        Raises UsageError, with nothing changed, for other names, sizes or what is not finite."""
        running = self._declared()
        kept = running.memory
        stored = {name: np.ravel(values) for name, values in dict(memory).items()}
        if kept.keys() != stored.keys():
            raise UsageError(f"restore: it remembers {', '.join(kept) or 'nothing'}; {', '.join(stored)} is given")
        for name, values in stored.items():
            if values.dtype.kind not in "fiu" or values.size != kept[name].size or not np.isfinite(values).all():
                raise UsageError(f"restore: {name} must have {kept[name].size} finite numbers, it has {values.size}")
        for part in running.control_step.memory:
            part.restore(np.concatenate([np.zeros(0), *(stored[f"{part.owner}.{name}"] for name in part.sizes)]))
        if running.control_step.plan is not None:
            running.control_step.plan.mpc.go_on()

    def _declared(self) -> Any:
        """The calls of the controller, in a flight that has begun."""
        if not self._begun:
            self.reset()
        running = getattr(self.controller, "running", None)
        if running is None or not running.declared:
            raise UsageError(f"memory of {type(self.controller).__name__}: it remembers what it does not declare")
        return running

    @property
    def record(self) -> StepRecord | None:
        """StepRecord of the last step that was made, None before the first."""
        if self._compiled is not None and self._took:
            self._record = self._compiled.record(self._took)
            self._took = 0.0
        return self._record

    @by_one_thread
    def follow(self, trajectory: Trajectory) -> None:
        """Track another trajectory (quadexp/reference/base.py), in a flight that begins with the next step."""
        if not isinstance(trajectory, Trajectory):
            raise UsageError(
                f"a {type(trajectory).__name__} is no trajectory: it lacks duration, peak_speed or flat_output"
            )
        self.trajectory = trajectory
        self._reference = SampledReference(trajectory, self.controller)
        self._renewal = Renewal(round(self.controller.reference_period / self.period))
        self._begun = False
        self.failed = False
        self._record = None
        self._took = 0.0
        self._compiled = None
        self._asked = None
        self._gate.begin()
        self._prepared: tuple[int, Window] | None = None

    @by_one_thread
    def reset(self, state: npt.ArrayLike | None = None, reference: Window | None = None) -> None:
        """Begin a flight in the state (13,), or where the reference starts; the first `step` does it unasked."""
        self.follow(self.trajectory)
        first = np.asarray(self.start if state is None else state, float)
        first = self._gate.admit(Measurement(0.0, first, None, None)).state
        self._begin(first, reference or self._reference.window(0))

    def _begin(self, state: np.ndarray, window: Window) -> None:
        self.controller.reset(state, window)
        self._begun = True

    @by_one_thread
    def prepare(self, t: float) -> None:
        """Do what the step at t (s) can do before its measurement, so that it answers sooner; an MPC's, otherwise none.

        To be called after the thrusts of the step before have been sent. The answer is that of a step without it, to
        rounding.
        """
        k = self._instant(t)
        prepare = getattr(self.controller, "prepare", None)
        if prepare is None or not self._begun or self._renewal.due(k):
            return
        self._prepared = k, self._reference.window(k)
        prepare(self._prepared[1])

    @by_one_thread
    def step(
        self, measured: npt.ArrayLike | Measurement, t: float | None = None, reference: Window | None = None
    ) -> np.ndarray:
        """Rotor thrusts (n,) (N), in the order of vehicle.rotor_position, to be held for one `period`.

        measured: state (13,), or a Measurement with accelerometer and rotor speeds, which identifying controllers need.
        t: s, since the start of the reference; that of the Measurement unless given. The reference is the one at the
        nearest control instant, and after its end the last. reference: of a planner of your own, for this step.
        A step that fails says so in `failed`. Raises QuadexpError for readings that are not finite, with nothing
        changed; the last good ones of accelerometer and rotor speeds are held for a while (control/readings.py).
        """
        began = time.perf_counter()
        self.failed = True
        force = speed = None
        if isinstance(measured, Measurement):
            at, state, force, speed = measured
            state = np.asarray(state, float)
            t = at if t is None else t
        elif t is None:
            raise UsageError("step: t is needed, the time since the start of the reference (s)")
        else:
            state = np.asarray(measured, float)
        if self._compiled is not None:
            prepared = -1 if self._prepared is None else self._prepared[0]
            if self._compiled.step(t, state, force, speed, reference, prepared):
                self._took = time.perf_counter() - began
                self._prepared = None
                self.failed = False
                return self._compiled.command.copy()
            self._record = self.record
            self._compiled.hand_over(self._gate)
        return self._in_python(Measurement(t, state, force, speed), reference)

    def _in_python(self, measured: Measurement, reference: Window | None) -> np.ndarray:
        k = self._instant(measured.t)
        measured = self._gate.admit(measured)
        if reference is not None and not all(np.isfinite(part).all() for part in reference):
            raise QuadexpError(f"t={measured.t:g} s: the given reference is not finite")
        if not self._begun:
            self._begin(measured.state, reference or self._reference.window(k))
        if reference is None and self._renewal.due(k):
            self._renewal.renew(k, self._reference, self.controller.residual)
        prepared = self._prepared
        self._prepared = None
        window = prepared[1] if prepared and prepared[0] == k else self._reference.window(k)
        thrusts, record = stepped(self.controller, measured, reference or window)
        self._record = record
        self.failed = record.status == Status.FAILED
        running = getattr(self.controller, "_running", None)
        if self._asked is not running:
            self._asked = running
            self._compiled = None
            if goes_in_c(self.controller):
                table = CompiledReference(self._reference.horizons(), self._reference.path())
                self._compiled = UserLoop(self.controller, table)
        return thrusts
