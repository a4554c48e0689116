"""A layer around a controller, as equations: what is done before the controller inside acts, and what after it.

    class Mine(LayerPart):
        def remembers(self, given):
            return {"filtered": 3}

        def before(self, vehicle, given, memory):   # from what is given: what the controller inside is given
            return {"state": .., "belief": .., "filtered": ..}

        def after(self, vehicle, given, memory, found):   # from given.command, of the controller inside: what is sent
            return {"command": given.command + ..}

As with a law (control.law), the step in C, margins, and columns follow from them. `given` are Inputs (control.inputs),
`found` is what `before` gave at this instant. World ENU, body FLU, SI.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from quadexp.compile.memory import NEXT, NOW, Memory, connected, sizes_of
from quadexp.compile.symbolic import ca
from quadexp.control.base import N_BELIEF, Controller, Window, belief_of, no_belief
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, ControlStep, InputArrays, call, control_step_of, copy, in_calls, python
from quadexp.control.inputs import Circumstances, Inputs, Symbols, at_start, places_of, remembered, started
from quadexp.control.law import given_by, refuse_unread, sizes_given
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import StepRecord
from quadexp.control.part import Compensation
from quadexp.control.wrapped import WrappedController, thrust_at_start
from quadexp.errors import UsageError
from quadexp.models.residual import Residual
from quadexp.names import named
from quadexp.parts.settings import keyed
from quadexp.physics.expression import named_function
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle

FOUND = "found_"  # before the names of results that are no memory
NO_BELIEF = np.hstack([*no_belief()])


@keyed
class LayerPart(Compensation):
    """A compensation that is equations, see the module. logged: columns, by the name of the result that has them."""

    hooks = ("before", "after")
    logged: ClassVar[Mapping[str, tuple[str, ...]]] = {}

    def remembers(self, inputs: Inputs) -> Mapping[str, int]:
        """What it remembers from instant to instant: names and lengths; zero at the start unless `start` says so."""
        return {}

    def start(self, inputs: Inputs, x: np.ndarray, thrust: np.ndarray) -> dict[str, np.ndarray]:
        """What it remembers at the start of a flight in the state x, (13,), where that is not zero. thrust: that the
        rotors give then, (n,) (N)."""
        return {}

    def before(self, vehicle: Vehicle, inputs: Inputs, memory: Any) -> dict[str, Any]:
        """`state` and `belief` for the controller inside, where they are others; of `memory` next values; the rest is
        for `after` and the log."""
        return {}

    def after(self, vehicle: Vehicle, inputs: Inputs, memory: Any, before: Any) -> dict[str, Any]:
        """`command`, thrusts within the limits (N), where it is another than inputs.command; of `memory` next
        values."""
        return {}

    def around(self, controller: Any) -> Layer:
        """See Remedy; the equations know of no delay and of no model."""
        return Layer(controller, self, Circumstances(controller.control_period))


class Layer(WrappedController):
    """A LayerPart around a controller, or on another backend than that.

    about: what its equations know; the period is that of the layer, in whole parts of the controller's. residual: the
    model of the air that they read. places: arrays of inputs that nobody else has, such as theta. memory: what it
    remembers. kept: what is remembered as it is found behind the controller inside, name -> array.
    """

    def __init__(
        self, wrapped: Controller, part: LayerPart, about: Circumstances, residual: Residual | None = None,
        places: Mapping[str, np.ndarray] | None = None, *, backend: str | None = None,
        kept: Mapping[str, np.ndarray] | None = None,
    ) -> None:  # fmt: skip
        super().__init__(wrapped)
        self.part = part
        self.about = about
        self.control_period = about.period
        self.every = round(wrapped.control_period / about.period)
        asked = backend or wrapped.backend
        self._functions = cached_function(
            asked, layer_functions, replace(part, name="layer"), self.vehicle, about, residual
        )
        reads = {name for function in self._functions for name in function.name_in()}
        self._kept = dict(kept or {})
        sizes = sizes_of(self._functions) | {name: values.size for name, values in self._kept.items()}
        self._remembers_sent = NOW + "sent" in reads
        commands = {"sent": self._remembers_sent, "held": self.every > 1}  # of those the newest: sent, and inside
        sizes |= {name: self.vehicle.n_rotors for name, kept in commands.items() if kept}
        self.memory = Memory(type(part).__name__, sizes)
        self._places = dict(places or {})
        self.results = {
            name.removeprefix(FOUND): np.zeros(function.numel_out(name))
            for function in self._functions
            for name in function.name_out()
            if name.startswith(FOUND)
        }
        remembers = part.remembers(Inputs(self.vehicle, about, ca.SX, residual))
        if not isinstance(part.logged, Mapping):
            raise UsageError(
                f'{type(part).__name__}.logged: must be a dict of results and their columns, {{"x": ("x",)}}'
            )
        for name in (*remembers, *part.logged):
            if name not in self.memory.sizes.keys() | self.results.keys():
                raise UsageError(f"equations of {type(part).__name__}: neither `before` nor `after` gives {name!r}")
        if "belief" in self.results:
            self._check_believing()
            if in_calls(wrapped):
                self.results["belief"] = wrapped.believed_numbers  # type: ignore[attr-defined]  # as checked

    def _check_believing(self) -> None:
        """Raise UsageError where the belief would reach nobody."""
        name = type(self.part).__name__
        if not self.part.believes:
            raise UsageError(f"equations of {name}: `before` gives a belief: the class must say so, `believes = True`")
        if not hasattr(self.wrapped, "believed_numbers" if in_calls(self.wrapped) else "believe"):
            raise UsageError(f"equations of {name}: `before` gives a belief, and the controller inside reads none")

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        for memory, values in self.starts(x, thrust_at_start(window, self.vehicle)):
            memory.begin(values)
        if "belief" in self.results:
            self.results["belief"][...] = NO_BELIEF

    def starts(self, x: np.ndarray, thrust: np.ndarray) -> list[tuple[Memory, dict[str, Any]]]:
        """What is remembered as a flight begins, see `reset`; x, (13,), and thrust, (n,) (N), may be symbols."""
        start = at_start(self.vehicle, self.about, thrust) if self._remembers_sent else {}
        start = {name: value for name, value in start.items() if name in self.memory.sizes}
        of_part = self.part.start(Inputs(self.vehicle, self.about, ca.SX), x, thrust)
        return [(self.memory, start | started(self.part, of_part, self.memory.sizes))]

    def control_step(self, inputs: InputArrays, state: np.ndarray) -> ControlStep:
        """See control.control_step; the record is that of the controller's last step."""
        results = self.results
        calls = self.calls("before", inputs, state)
        inside = [*self.inside(inputs), *self._believing()]
        step = control_step_of(self.wrapped, inputs, results.get("state", state))
        inside += [*step.calls, *(copy(self.memory.of_next[name], values) for name, values in self._kept.items())]
        command_inside = step.command
        if self.every > 1:
            command_inside = self.memory.of_next["held"]
            inside.append(copy(command_inside, step.command))
        calls += [o._replace(every=o.every * self.every) for o in inside]
        calls += self.calls("after", inputs, state, command_inside)
        command = results.get("command", step.command)
        if self._remembers_sent:
            calls.append(copy(self.memory.of_next["sent"], command))
        checked = [after for _, after in self.memory.pairs if after.size]
        checked += [command] if "command" in results else []
        calls += [Call("finite", source=numbers) for numbers in checked]

        def record(took: float) -> StepRecord:
            last = step.record(took)
            finite = all(math.isfinite(numbers.sum()) for numbers in checked)
            return last if finite else last._replace(status=Status.FAILED)

        logged = (*step.logged, *self._logged.values())
        memory = (*step.memory, self.memory)
        return step._replace(calls=calls, command=command, record=record, logged=logged, memory=memory)

    def calls(
        self, which: str, inputs: InputArrays, state: np.ndarray, command: np.ndarray | None = None
    ) -> list[Call]:
        """Its function `before`, or `after` the controller inside, whose command is found there. state: (13,)."""
        results = {FOUND + name: values for name, values in self.results.items()}
        result_places = results | {FOUND + name: values for name, values in self.memory.of_next.items()}
        places = {**places_of(inputs, state), **self._places, **result_places}
        if command is not None:
            places["command"] = command
        functions = [function for function in self._functions if function.name().endswith(which)]
        return [call(connected(function, places, results, self.memory)) for function in functions]

    def inside(self, inputs: InputArrays) -> list[Call]:
        """What else is done before the controller inside acts."""
        return []

    def _believing(self) -> list[Call]:
        """What tells the controller inside of the belief, where that is not written where it reads it."""
        wrapped = self.wrapped
        belief = self.results.get("belief")
        if belief is None or in_calls(wrapped):
            return []
        return [python(lambda: wrapped.believe(belief_of(belief)))]  # type: ignore[attr-defined]  # as checked

    def log(self) -> dict[str, float]:
        """See Controller.log."""
        columns = self.wrapped.log()
        for name, labels in self.part.logged.items():
            values = self._logged[name].tolist()
            if len(values) != len(labels) or not columns.keys().isdisjoint(labels):
                raise UsageError(
                    f"{type(self.part).__name__}.logged: {name} has {len(values)} numbers, for the columns"
                    f" {', '.join(labels)}, which no part inside may have"
                )
            columns |= named(labels, values)
        return columns

    @property
    def _logged(self) -> dict[str, np.ndarray]:
        """What is logged, results or memory, by name."""
        values = self.memory.of_next | self.results
        return {name: values[name] for name in self.part.logged}


def layer_functions(
    part: LayerPart, vehicle: Vehicle, about: Circumstances, residual: Residual | None
) -> list[ca.Function]:
    """`before` and `after` of a layer, as functions whose names end so; one that gives nothing is left out."""
    functions = list[ca.Function]()
    sizes = dict[str, int]()
    result_names = list[str]()
    known = {"state", "belief", "command", *part.logged}
    for which in ("before", "after"):
        inputs = Inputs(vehicle, about, ca.MX, residual)
        inputs.commanded = which == "after"
        kept = sizes_given(part, part.remembers(inputs))
        memory = remembered(inputs, kept)
        before = Symbols(inputs, FOUND, sizes, "what `before` gave")
        more = [before] if which == "after" else []
        equations = partial(getattr(part, which), vehicle, inputs, memory, *more)
        wanted = {"state": N_STATE, "belief": N_BELIEF, "command": vehicle.n_rotors, **kept}
        outputs = given_by(part, inputs, equations, wanted, needed=())
        results = {(NEXT if name in kept else FOUND) + name: value for name, value in outputs.items()} | inputs.left
        sizes = {name: value.numel() for name, value in outputs.items()}
        result_names += outputs
        known |= {*kept, *(name.removeprefix(FOUND) for name in inputs.read)}
        if results:
            functions.append(named_function(f"{type(part).__name__}_{which}", inputs.read, results))
    refuse_unread(part, result_names, sorted(known))
    return functions
