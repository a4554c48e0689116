"""Flatness-based control as a `Controller` (quadexp.control.base)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction, resolve
from quadexp.control.base import Belief, Window, no_belief
from quadexp.control.built import built
from quadexp.control.delivered import DeliveredThrust
from quadexp.control.dfbc.law import DFBCKeys, law_function
from quadexp.control.instant import InOperations, Instant, Operation, Told, call, copy, law_record
from quadexp.control.part import RESIDUAL, ControllerPart
from quadexp.models.residual import Residual
from quadexp.parts.part import Given
from quadexp.parts.settings import Backend, key, part
from quadexp.physics.vehicle import Vehicle


class DFBC(InOperations):
    """Tracks position and heading of the reference; see Controller and law.py. air: its model of the air."""

    reference_period = 0.0
    residual = None  # the law needs no attitude, rates or thrusts of a reference

    def __init__(self, vehicle: Vehicle, keys: DFBCKeys, model: Residual, *, backend: str = "auto") -> None:
        self.vehicle, self.settings, self.backend = vehicle, keys, resolve(backend)
        self.control_period = 1.0 / keys.rate
        self.node_times = np.array([0.0, self.control_period])  # of which the thrust now is read when a flight begins
        self.air, self.name, self.source = model, model.name, model.source
        compiled = self.backend == "compiled"
        self._law = BufferedFunction(built(self.backend, law_function, vehicle, keys, model, compiled=compiled))
        if model.theta.size:
            self._law.arguments["theta"].ravel()[:] = model.theta
        self._delivered = DeliveredThrust(vehicle, self.control_period, backend=self.backend)
        self.believe(no_belief())

    def believe(self, belief: Belief) -> None:
        """Take this for what acts beside the model, from the next step on."""
        self.believed_numbers[:] = np.hstack([*belief])

    @property
    def believed_numbers(self) -> np.ndarray:
        """What is believed, in the order of Belief; (11,)."""
        numbers: np.ndarray = self._law.arguments["belief"]
        return numbers

    def forget(self) -> None:
        """See Controller.forget; nothing is learned that outlives a flight."""

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        self.believe(no_belief())
        self._delivered.reset(np.clip(window.input[0], self.vehicle.thrust_min, self.vehicle.thrust_max))

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        arguments, results, delivered = self._law.arguments, self._law.results, self._delivered
        places = {"x": state, "delivered": delivered.thrust, "path": told.path, "yaw": told.yaw[:3]}
        operations = [*delivered.before(told), *(copy(arguments[name], place) for name, place in places.items())]
        operations += [call(self._law), Operation("finite", source=results["thrust"])]
        operations += delivered.after(results["thrust"])
        record = law_record(self._law, "thrust")
        return Instant(operations, results["thrust"], record, held=results["held"], logged=(results["angle"],))

    def log(self) -> dict[str, float]:
        """See Controller.log: errors of tilt and yaw (rad)."""
        tilt, yaw = self._law.results["angle"].tolist()
        return {"error_tilt": tilt, "error_yaw": yaw}


@dataclass(frozen=True, kw_only=True)
class FlatnessBased(DFBCKeys, ControllerPart):
    """Flatness-based control (Sun et al. 2022). residual: its model of the air."""

    former_kind = "dfbc"
    backend: Backend = "auto"
    residual: str = key("none", RESIDUAL)

    def build(self, given: Given) -> Any:
        """See ControllerPart."""
        return DFBC(given.vehicle, part(DFBCKeys, self), given.residual(*self.kinds), backend=self.backend)
