"""A control law in closed form (control/law.py) as a Controller: one compiled function a step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np

from quadexp.compile.backend import resolve
from quadexp.compile.memory import NOW, Memory, connected, sizes_of
from quadexp.compile.symbolic import ca
from quadexp.control.base import Belief, Window, no_belief
from quadexp.control.control_step import Call, ControlStep, InCalls, InputArrays, call, copy, law_record
from quadexp.control.inputs import Circumstances, at_start, places_of, started
from quadexp.control.wrapped import thrust_at_start
from quadexp.models.residual import Residual
from quadexp.parts.settings import Setting
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle

Rate = Annotated[float, Setting("control rate", "[1, 1000]", "Hz")]

OF_REFERENCE = {"reference", "thrusts", "thrusts_middle", "air_reference"}  # what a reference is made by flatness for
NO_BELIEF = np.hstack([*no_belief()])  # force, torque, wind, thrust scale, air scale


class ExplicitController(InCalls):
    """A Controller (see control.base) whose step is a CasADi function.

    law: the control.law.Law. about: what its equations know. function: its law_function, on a back end. residual: what
    it knows of the air; None for nothing. memory: what it remembers.
    """

    reference_period = 0.0

    def __init__(
        self, vehicle: Vehicle, law: Any, about: Circumstances, function: ca.Function, residual: Residual | None,
        places: Mapping[str, np.ndarray] | None = None,
    ) -> None:  # fmt: skip
        self.vehicle = vehicle
        self.law = law
        self.control_period = about.period
        self._about = about
        self.backend = resolve(law.backend)
        self.node_times = np.array(law.nodes) * self.control_period
        self.residual_name = "none" if residual is None else residual.name
        self.source = "" if residual is None else residual.source
        self._function = function
        reads = set(function.name_in())
        n = vehicle.n_rotors
        self.air = residual
        self.residual = residual if OF_REFERENCE & reads else None
        sizes = sizes_of([function]) | ({"sent": n} if f"{NOW}sent" in reads else {})
        self.memory = Memory(type(law).__name__, sizes)
        self._places = {"belief": NO_BELIEF.copy(), **(places or {})}
        if residual is not None:
            self._places["theta"] = np.array(residual.theta, float)
        results = {name: np.zeros(function.size1_out(name)) for name in ("command", "held")}
        results |= {f"log_{name}": np.zeros(function.numel_out(f"log_{name}")) for name in law.logged}
        self._results = results
        self._logged = {name: results[f"log_{name}"] for name in law.logged}
        self.rows: np.ndarray | None = None  # of the horizon that it is given, where that is longer; None: all

    def forget(self) -> None:
        """See Controller.forget; nothing is learned that outlives a flight."""

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        self._places["belief"][...] = NO_BELIEF
        for memory, values in self.starts(x, thrust_at_start(window, self.vehicle)):
            memory.begin(values)

    def starts(self, x: np.ndarray, thrust: np.ndarray) -> list[tuple[Memory, dict[str, Any]]]:
        """See Layer."""
        sent = at_start(self.vehicle, self._about, thrust) if "sent" in self.memory.sizes else {}
        of_law = started(self.law, self.law.start(self.vehicle, x), self.memory.sizes)
        return [(self.memory, of_law | sent)]

    def control_step(self, inputs: InputArrays, state: np.ndarray) -> ControlStep:
        """See control.control_step."""
        nodes = len(self.node_times)
        n = self.vehicle.n_rotors
        states = np.empty((nodes, N_STATE))
        thrusts = np.empty((nodes - 1, n))
        ahead = {"reference": states[0], "thrusts": thrusts[0], "thrusts_middle": thrusts[-1]} if nodes > 1 else {}
        places = {**places_of(inputs, state), **self._places, **ahead}
        looks = ahead.keys() & set(self._function.name_in())
        calls = [Call("window", states, self.rows, thrusts)] if looks else []
        command = self._results["command"]
        memory = self.memory
        calls.append(call(connected(self._function, places, self._results, memory)))
        kept = memory.pairs[0][1]
        calls += [Call("finite", source=numbers) for numbers in (command, kept) if numbers.size]
        if "sent" in memory.sizes:
            calls.append(copy(memory.of_next["sent"], command))
        logged = tuple(self._logged.values())
        record = law_record(command, self._results["held"], kept)
        return ControlStep(calls, command, record, self._results["held"], logged, memory=(memory,))

    def log(self) -> dict[str, float]:
        """See Controller.log."""
        columns: dict[str, float] = {}
        for name, values in self._logged.items():
            axes = "xyz" if values.size == 3 else range(values.size)
            ends = [""] if values.size == 1 else [f"_{axis}" for axis in axes]
            columns |= {f"{name}{end}": value for end, value in zip(ends, values.ravel().tolist(), strict=True)}
        return columns


class BelievingController(ExplicitController):
    """One whose function reads a belief."""

    @property
    def believed_numbers(self) -> np.ndarray:
        """What is assumed, in the order of Belief; (11,)."""
        return self._places["belief"]

    def believe(self, belief: Belief) -> None:
        """Take this for what acts beside the model, from the next step on."""
        self.believed_numbers[:] = np.hstack([*belief])
