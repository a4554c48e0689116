"""A control instant in C: a controller's calls by loop.c, on the arrays that they have in Python.

C leaves to Python what is out of the ordinary, such as a failed step: Python then makes that instant, with the same
result as if it had made all of them.
"""

from __future__ import annotations

import ctypes
import re
import struct
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction, CFunction, strict_library
from quadexp.control.base import Window
from quadexp.control.control_step import KINDS, Call, Running, in_calls
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import MAX_TURN, TOLERANCE, ModelPredictiveController, StepRecord
from quadexp.control.readings import ReadingGate
from quadexp.physics.state import N_STATE

SOURCE = Path(__file__).with_name("loop.c")
PLAIN = {"integer": ctypes.c_longlong, "real": ctypes.c_double, "function": CFunction}  # types of fields
NUMBERS = struct.Struct("6d")  # before the readings in loop.c's `measured`


def structure(source: Path, name: str) -> type[ctypes.Structure]:
    """A structure of a C source, field by field as it is declared there."""
    declared = re.sub(r"/\*.*?\*/", "", source.read_text(encoding="utf-8"), flags=re.DOTALL)
    body = next(body for body, named in re.findall(r"typedef struct {([^}]*)} (\w+);", declared) if named == name)
    fields: list[tuple[str, Any]] = []
    for kind, names in re.findall(r"^ *(?:const )?(\w+) ([^;(]*);", body, flags=re.MULTILINE):
        for field in re.split(r",\s*", names):
            fields.append((re.split(r"[* ]", field)[-1], ctypes.c_void_p if "*" in field else PLAIN[kind]))
    return type(name, (ctypes.Structure,), {"_fields_": fields})


STEP_CALL, MPC, REFERENCE, LOOP = (structure(SOURCE, name) for name in ("step_call", "mpc", "reference", "loop"))


def addresses(arrays: dict[str, np.ndarray | None]) -> dict[str, int]:
    """Where the arrays lie, without those that are empty."""
    return {name: array.ctypes.data for name, array in arrays.items() if array is not None and array.size}


class CompiledReference:
    """A reference as C reads it. horizons: states (g, 13) and inputs (g, n), and which rows make each horizon,
    (k, N + 1). path: position with its derivatives (k, 5, 3), and heading with its own and the drift, (k, 4)."""

    def __init__(
        self, horizons: tuple[np.ndarray, np.ndarray, np.ndarray], path: tuple[np.ndarray, np.ndarray]
    ) -> None:
        self.states, self.inputs, self.where = (np.ascontiguousarray(array) for array in horizons)
        self.paths, self.yaws = (np.ascontiguousarray(array) for array in path)
        instants, rows = self.where.shape
        names = ("states", "inputs", "where", "paths", "yaws")
        places = addresses({name: getattr(self, name) for name in names})
        self.structure = REFERENCE(**places, instants=instants, rows=rows)


class CompiledLoop:
    """The control instants of a controller in C, where `goes_in_c` says so. running: its calls.

    mpc: the structure of its plan, None with a law. structure: `loop` of loop.c.
    """

    def __init__(self, running: Running, period: float) -> None:
        self.running = running
        instant = running.control_step
        inputs = running.inputs
        calls = [_structure_of(o) for o in instant.calls]
        self._calls = (STEP_CALL * len(calls))(*calls)
        self.mpc = None if instant.plan is None else self._mpc(instant.plan)
        names = ("state", "specific_force", "rotor_speed", "path", "yaw", "accelerometer_valid", "rotor_speed_valid")
        self.structure = LOOP(
            **addresses({name: getattr(inputs, name) for name in names}),
            calls=ctypes.addressof(self._calls),
            calls_size=len(calls),
            inputs=len(inputs.rotor_speed),
            plan=None if self.mpc is None else ctypes.addressof(self.mpc),
            period=period,
        )

    def _mpc(self, plan: Any) -> ctypes.Structure:
        step = plan.mpc.step
        states = step.form.states
        nodes, inputs = step.arguments["U"].shape
        arrays = {name: step.arguments[name] for name in ("x0", "X_ref", "X", "U", "guess")}
        solved = ("checks", "X_new", "U_new", "X_lin", "U_lin", "bounded_checks", "bounded_X", "bounded_U", "side")
        arrays |= {name: step.results[name] for name in solved} | {"unprepared": plan.unprepared}
        return MPC(
            **addresses(arrays),
            prepare=step.prepare.for_c,
            feedback=step.feedback.for_c,
            bounded=step.bounded.for_c,
            states=states,
            inputs=inputs,
            nodes=nodes,
            reference_rows=len(step.arguments["X_ref"]),
            tolerance=TOLERANCE,
            max_turn=MAX_TURN,
        )

    def record(self, took: float) -> StepRecord:
        """Of the last step, which took so long (s)."""
        instant = self.running.control_step
        mpc = self.mpc
        if mpc is not None:
            status = Status(int(mpc.status))
            sweeps = int(mpc.sweeps)
            active = int(mpc.active)
            instant.plan.record = StepRecord(took, status, sweeps, active, mpc.kkt, bool(mpc.converged))
        return instant.record(took)


class UserLoop(CompiledLoop):
    """The steps of a loop of the user's own, one call into C each. command: of the last one, (n,) (N)."""

    def __init__(self, controller: Any, reference: CompiledReference) -> None:
        super().__init__(controller.running, controller.control_period)
        self._controller = controller
        self._reference = reference
        self.command = self.running.control_step.command
        self._plan = None if self.mpc is None else self.running.control_step.plan.mpc
        rows = reference.where.shape[1]
        n = len(self.command)
        first = NUMBERS.size // 8
        numbers = np.zeros(first + N_STATE + 3 + n)
        self._given = numbers.data
        self._state, self._force, self._speed = np.split(numbers[first:], [N_STATE, N_STATE + 3])
        states, inputs, position, yaw = (np.zeros(size) for size in ((rows, N_STATE), (rows - 1, n), (5, 3), 4))
        self._window = (states, inputs, position, yaw[:3])
        self._drift = yaw[3:]
        alone = CompiledReference((states, inputs, np.arange(rows)[None]), (position[None], yaw[None]))
        self._alone = alone
        s = self.structure
        s.given, s.reference, s.window = numbers.ctypes.data, *map(_address, (reference, alone))
        self._call: Callable[[], int] = partial(_library().step, ctypes.addressof(s))
        self._read: dict[str, float] = {}  # when C was given the last reading

    def step(self, t: float, state: np.ndarray, force: Any, speed: Any, window: Window | None, prepared: int) -> bool:
        """Whether C made the step. prepared: for which instant of the reference it is, -1: for none.

        t: s. state: (13,). force: (3,), speed: (n,), None where there is none. window: of a reference for this step.
        """
        plan = self._plan
        if self._controller._running is not self.running or state.shape != (N_STATE,):
            return False
        if plan is not None and (plan.cold or plan.prepared != (prepared >= 0 and window is None)):
            return False
        present = window is not None, force is not None, speed is not None
        NUMBERS.pack_into(self._given, 0, t, prepared, self.running.k, *present)
        self._state[...] = state
        if force is not None and not _fill(self._force, force):
            return False
        if speed is not None and not _fill(self._speed, speed):
            return False
        if window is not None:
            if not all(map(_fill, self._window, window)):  # all but the drift
                return False
            self._drift[0] = window.drift
        if not self._call():
            return False
        self.running.k += 1
        if plan is not None:
            plan.prepared = False
        if force is not None:
            self._read["specific_force"] = t
        if speed is not None:
            self._read["rotor_speed"] = t
        return True

    def hand_over(self, gate: ReadingGate) -> None:
        """Let Python go on from here. gate: is given the readings that C has admitted last."""
        for name, t in self._read.items():
            gate.keep(name, t)
        self._read.clear()


def _fill(array: np.ndarray, values: Any) -> bool:
    if type(values) is not np.ndarray or values.shape != array.shape:
        return False  # Python decides about others
    array[...] = values
    return True


def _address(reference: CompiledReference) -> int:
    return ctypes.addressof(reference.structure)


@cache
def _library() -> ctypes.CDLL:  # which keeps the interpreter's lock: a step is shorter than handing it over
    library = strict_library("loop", SOURCE, loader=ctypes.PyDLL)
    library.step.argtypes = [ctypes.c_void_p]
    library.step.restype = ctypes.c_int
    return library


def goes_in_c(controller: Any) -> bool:
    """Whether C can make the instants of a controller, with nothing that is always Python's."""
    if controller.backend != "compiled" or controller.reference_period or not in_calls(controller):
        return False
    instant = controller.running.control_step
    functions = [o.function for o in instant.calls if o.function is not None]
    if instant.plan is not None and type(instant.plan.mpc) is not ModelPredictiveController:
        return False
    arrays = [(o, a) for o in instant.calls for a in (o.to, o.source, o.other, o.when) if a is not None]
    return (
        not any(o.kind == "python" and o.when is None for o in instant.calls)
        and all(isinstance(f, BufferedFunction) and f.for_c is not None for f in functions)
        and all(a.dtype == float and (a.flags.c_contiguous or o.kind == "window") for o, a in arrays)
    )


def _structure_of(o: Call) -> ctypes.Structure:
    """As C has it."""
    counted = o.to if o.to is not None else o.source
    function = o.function
    count = 0
    if counted is not None:
        count = counted.strides[0] // 8 if o.kind == "window" else counted.size
    after = o.source if o.kind == "commit" else None
    places = addresses({"to": o.to, "source": o.source, "other": o.other, "when": o.when, "next": after})
    if function is not None:
        places["function"] = ctypes.addressof(function.for_c)  # type: ignore[arg-type]  # `goes_in_c` saw to it
    shape = {"count": count, "factor": o.factor}
    if o.kind == "window" and o.source is not None:
        shape["factor"] = len(o.source)
    elif o.kind == "gather" and o.source is not None:
        shape["rows"], shape["columns"] = o.source[0].shape
    return STEP_CALL(kind=KINDS.index(o.kind), every=o.every, **shape, **places)
