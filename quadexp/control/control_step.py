"""A control instant as calls on fixed arrays, in order: the one text of what a controller does.

A controller of this program, and everything around it, says by `control_step(inputs)` what it does; what is around a
controller asks the one inside, and adds its own calls before and behind. The same list on the same arrays is run
by `run`, in Python, and by loop.c, so that either may take over from the other at any instant. What cannot
be said in calls, such as a user's own controller, is a call of the kind `python`.

Where an instant is out of the ordinary, C leaves it to Python from its beginning: memory (compile/memory.py) is as it
was until all calls have succeeded, and what else goes on from instant to instant is written behind the command.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.memory import Memory
from quadexp.control.base import Controller, Measurement, Window
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import StepRecord
from quadexp.errors import UsageError
from quadexp.physics.state import N_STATE

KINDS = (
    "call", "copy", "commit", "window", "square", "divide", "mix", "add", "gather", "finite", "near", "plan",
    "python",
)  # fmt: skip
YES = np.ones(1)


class Call(NamedTuple):
    """to, source, other: arrays; numbers as many as `to` has. factor: a number. function: that is called. act: what
    Python does. every: at which instants, one of so many. when: (1,), only where it is not 0; None: always.
    decides: of settings from what was collected, which margins of a loop take as they are.

    call    function, on its arguments and results
    copy    to = source
    commit  the same, for memory: what is now and what has become of it
    window  states of the reference over the horizon to `to`, inputs to `other`; source: which of them, None: all
    square  to = factor source^2
    divide  to = source / other[0]
    mix     to = factor source + (1 - factor) other
    add     to = source + other
    gather  to (b, c, c) = factor to + sum over the rows s of source, (b, k, c), of s' s: the lower triangles
    finite  left to Python where a number of source is not
    near    left to Python where positions at the beginning of source and other are further apart than factor
    plan    the MPC's step on its own arrays; in Python `act`
    python  `act`, left to Python
    """

    kind: str
    to: np.ndarray | None = None
    source: np.ndarray | None = None
    other: np.ndarray | None = None
    factor: float = 0.0
    function: BufferedFunction | None = None
    act: Callable[[], Any] | None = None
    every: int = 1
    when: np.ndarray | None = None
    decides: bool = False


def call(function: BufferedFunction, when: np.ndarray | None = None) -> Call:
    return Call("call", function=function, when=when)


def copy(to: np.ndarray, source: np.ndarray, when: np.ndarray | None = None) -> Call:
    return Call("copy", to, source, when=when)


def python(act: Callable[[], Any], when: np.ndarray | None = None) -> Call:
    return Call("python", act=act, when=when)


class InputArrays:
    """Where a controller finds what it is given at an instant.

    state: (13,). force: specific force, (3,). speed: of the rotors, (n,). read, turning: (1,), whether these two are
    measured now, otherwise they are as they were; fresh: both. path: (5, 3), yaw: (4,), of the reference now:
    Window.position; Window.yaw with drift behind it. t: s. window: of the reference. Both for calls in Python
    alone.
    """

    def __init__(self, rotors: int) -> None:
        self.state = np.zeros(N_STATE)
        self.specific_force = np.zeros(3)
        self.rotor_speed = np.zeros(rotors)
        self.fresh = np.zeros(2)
        self.accelerometer_valid = self.fresh[:1]
        self.rotor_speed_valid = self.fresh[1:]
        self.path = np.zeros((5, 3))
        self.yaw = np.zeros(4)
        self.t = 0.0
        self.window: Window

    def set_measurement(self, measurement: Measurement, window: Window) -> None:
        """Write what is known at a control instant."""
        self.t, state, force, speed = measurement
        self.state[...] = state
        self.accelerometer_valid[0] = force is not None
        self.rotor_speed_valid[0] = speed is not None
        if force is not None:
            self.specific_force[...] = force
        if speed is not None:
            self.rotor_speed[...] = speed
        self.set_reference(window)

    def set_reference(self, window: Window) -> None:
        """Write what is known of the reference."""
        self.window = window
        self.path[...] = window.position
        self.yaw[:3] = window.yaw
        self.yaw[3] = window.drift


class ControlStep(NamedTuple):
    """calls: in their order. command: where they leave it, (n,). record: of the step, by the seconds that it took.
    state: the array that has the state as this controller is given. saturated: number of rotors at a limit, of a law.
    logged: what `Controller.log` gives, in its order. plan: the PredictiveController that makes it. memory: what is
    remembered; behind all calls what they have left of it becomes what they read."""

    calls: list[Call]
    command: np.ndarray
    record: Callable[[float], StepRecord]
    saturated: np.ndarray | None = None
    logged: tuple[np.ndarray, ...] = ()
    plan: Any = None
    memory: tuple[Memory, ...] = ()


def law_record(thrust: np.ndarray, saturated: np.ndarray, kept: np.ndarray) -> Callable[[float], StepRecord]:
    """The record of a law in closed form, of its command, (n,), how many rotors are at a limit, (1,), and what it
    remembers, (m,); FAILED where these are not finite."""

    def record(took: float) -> StepRecord:
        status = Status.OK if math.isfinite(thrust.sum() + kept.sum()) else Status.FAILED
        return StepRecord(took, status, 0, int(saturated.item(0)), 0.0)

    return record


def run(calls: Sequence[Call], k: int = 0, window: Any = None) -> None:
    """The calls of control instant k, as loop.c runs them; window: of the reference, a Window."""
    entry: Any
    for entry in calls:
        kind, to, source, other, factor, function, act, every, when, _ = entry
        if k % every or (when is not None and not when[0]):
            continue
        if kind == "copy" or kind == "commit":
            to[...] = source
        elif kind == "call":
            function()
        elif kind == "plan" or kind == "python":
            act()
        elif kind == "window":
            rows = np.arange(len(window.state)) if source is None else source.astype(int)
            to[...] = window.state[rows]
            other[...] = window.input[rows[:-1]]
        elif kind == "square":
            to[...] = factor * (source * source)
        elif kind == "divide":
            np.divide(source, other[0], out=to)
        elif kind == "mix":
            to[...] = factor * source + (1 - factor) * other
        elif kind == "add":
            np.add(source, other, out=to)
        elif kind == "gather":
            to *= factor
            for row in np.moveaxis(source, 1, 0):
                to += np.tril(row[:, :, None] * row[:, None])


class Running:
    """The calls of a controller, and the arrays that have its inputs. k: instants since the flight began."""

    def __init__(self, controller: Any) -> None:
        self.inputs = InputArrays(controller.vehicle.n_rotors)
        self.k = 0
        step: ControlStep = controller.control_step(self.inputs, self.inputs.state)
        kept = [Call("commit", *pair, when=memory.when) for memory in step.memory for pair in memory.pairs]
        self.control_step = step._replace(calls=[*step.calls, *kept])
        self._calls = [o for o in self.control_step.calls if o.kind not in ("finite", "near")]  # which are C's

    @property
    def declared(self) -> bool:
        """Whether all that is remembered is declared."""
        return not any(o.kind == "python" for o in self.control_step.calls)

    @property
    def memory(self) -> dict[str, np.ndarray]:
        """What is remembered now, OWNER.NAME -> the array."""
        kept = self.control_step.memory
        return {f"{part.owner}.{name}": values for part in kept for name, values in part.of_now.items()}

    def step(self, measurement: Measurement, window: Window) -> tuple[np.ndarray, StepRecord]:
        """See Controller.step."""
        began = time.perf_counter()
        self.inputs.set_measurement(measurement, window)
        try:
            run(self._calls, self.k, window)
        except BaseException:  # Ctrl-C too: who goes on afterwards goes on from what was remembered
            for memory in self.control_step.memory:
                memory.take_back()
            raise
        self.k += 1
        return self.control_step.command.copy(), self.control_step.record(time.perf_counter() - began)


class InCalls:
    """A controller that says by `control_step(inputs, state)` what it does: Controller.step for all of this program.

    given: see InputArrays. state: the array that has the state for it, which need not be inputs.state.
    """

    vehicle: Any
    _running: Running | None = None

    @property
    def running(self) -> Running:
        """Its calls, made when they are first asked for in a flight."""
        if self._running is None:
            self._running = Running(self)
        return self._running

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        self._running = None

    def step(self, measurement: Measurement, window: Window) -> tuple[np.ndarray, StepRecord]:
        """See Controller.step."""
        return self.running.step(measurement, window)


def in_calls(controller: Any) -> bool:
    """Whether a controller says by `control_step` what it does; its class may step in another way than its parent, and
    then has to say what its own instant is."""
    if not isinstance(controller, InCalls) or not hasattr(controller, "control_step"):
        return False
    steps, knows = (next(c for c in type(controller).__mro__ if name in vars(c)) for name in ("step", "control_step"))
    return issubclass(knows, steps)


def control_step_of(controller: Any, inputs: InputArrays, state: np.ndarray) -> ControlStep:
    """The instant of a controller; one call in Python where it does not say what it does."""
    return controller.control_step(inputs, state) if in_calls(controller) else _stepped(controller, inputs, state)


def stepped(controller: Controller, measurement: Measurement, window: Window) -> tuple[np.ndarray, StepRecord]:
    """The step of a controller. One in Python is given copies, and may give its thrusts alone: FAILED where they are
    not finite. Raises UsageError where they are something else."""
    if not in_calls(controller):
        measurement, window = deepcopy((measurement, window))
    began = time.perf_counter()
    result = controller.step(measurement, window)
    if isinstance(result, tuple):
        return result
    vehicle = controller.vehicle
    if np.shape(result) != (vehicle.n_rotors,):
        said = f"step of {type(controller).__name__}: gives {str(result)[:60]}"
        raise UsageError(f"{said}; {vehicle.n_rotors} thrusts (N) are needed")
    u = np.asarray(result, float)
    limited = int(((u <= vehicle.thrust_min) | (u >= vehicle.thrust_max)).sum())
    status = Status.OK if np.isfinite(u).all() else Status.FAILED
    return u, StepRecord(time.perf_counter() - began, status, 0, limited, 0.0)


def _stepped(controller: Controller, inputs: InputArrays, state: np.ndarray) -> ControlStep:
    """A controller whose step is Python, as one call."""
    command = np.zeros(controller.vehicle.n_rotors)
    records = list[StepRecord]()

    def step() -> None:
        force = inputs.specific_force.copy() if inputs.accelerometer_valid[0] else None
        speed = inputs.rotor_speed.copy() if inputs.rotor_speed_valid[0] else None
        command[...], record = stepped(controller, Measurement(inputs.t, state.copy(), force, speed), inputs.window)
        records[:] = [record]

    return ControlStep([python(step)], command, lambda took: records[0])
