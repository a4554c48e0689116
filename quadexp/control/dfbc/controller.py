"""Flatness-based control as a `Controller` (quadexp.control.base)."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction, realise, resolve
from quadexp.compile.symbolic import ca
from quadexp.control.base import Measurement, Window
from quadexp.control.belief import Belief, no_belief
from quadexp.control.delivered import DeliveredThrust
from quadexp.control.dfbc.law import DFBCKeys, law_function
from quadexp.control.instant import Instant, Operation, Told, call, copy
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import StepRecord
from quadexp.control.part import RESIDUAL, ControllerPart
from quadexp.models.residual import Residual
from quadexp.parts.part import Given
from quadexp.parts.settings import Backend, key, part
from quadexp.physics.vehicle import Vehicle


class DFBC:
    """Tracks position and heading of the reference; see Controller and law.py. air: its model of the air."""

    reference_period = 0.0
    residual = None  # the law needs no attitude, rates or thrusts of a reference

    def __init__(self, vehicle: Vehicle, keys: DFBCKeys, model: Residual, *, backend: str = "auto") -> None:
        self.vehicle, self.settings, self.backend = vehicle, keys, resolve(backend)
        self.control_period = 1.0 / keys.rate
        self.node_times = np.array([0.0, self.control_period])  # of which the thrust now is read when a flight begins
        self.air, self.name, self.source = model, model.name, model.source
        self._law = BufferedFunction(_law(vehicle, keys, model, self.backend))
        if model.theta.size:
            self._law.arguments["theta"].ravel()[:] = model.theta
        self._delivered = DeliveredThrust(vehicle, self.control_period, backend=self.backend)
        self.believe(no_belief())

    def believe(self, belief: Belief) -> None:
        """Take this for what acts beside the model, from the next step on."""
        values = self._law.arguments["belief"]
        values[:3], values[3:6], values[6:9], values[9], values[10] = belief

    @property
    def believed_numbers(self) -> np.ndarray:
        """What is believed, in the order of Belief; (11,)."""
        numbers: np.ndarray = self._law.arguments["belief"]
        return numbers

    def forget(self) -> None:
        """See Controller.forget; nothing is learned that outlives a flight."""

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        self.believe(no_belief())
        self._delivered.reset(np.clip(window.input[0], self.vehicle.thrust_min, self.vehicle.thrust_max))

    def step(self, measurement: Measurement, window: Window) -> tuple[np.ndarray, StepRecord]:
        """See Controller.step; a command that is not finite has status FAILED."""
        began = time.perf_counter()
        arguments = self._law.arguments
        arguments["x"][:], arguments["path"][:], arguments["yaw"][:] = measurement.state, window.position, window.yaw
        arguments["delivered"][:] = self._delivered.now(measurement)
        self._law()
        results = self._law.results
        thrust = results["thrust"].copy()
        self._delivered.record(thrust)
        status = Status.RICCATI if math.isfinite(thrust @ thrust) else Status.FAILED
        return thrust, StepRecord(time.perf_counter() - began, status, 0, int(results["held"][0]), 0.0)

    def instant(self, told: Told) -> Instant:
        """See control.instant."""
        arguments, results = self._law.arguments, self._law.results
        operations, delivered = self._delivered.before(told.speed)
        operations += [copy(arguments["x"], told.state), copy(arguments["delivered"], delivered)]
        operations += [Operation("row", arguments["path"], told.position), Operation("row", arguments["yaw"], told.yaw)]
        operations += [call(self._law), Operation("finite", source=results["thrust"])]
        operations += self._delivered.after(results["thrust"])
        ready = (lambda: self._delivered.ready(told.speed),)
        return Instant(operations, results["thrust"], held=results["held"], logged=(results["angle"],), ready=ready)

    def log(self) -> dict[str, float]:
        """See Controller.log: errors of tilt and yaw (rad)."""
        tilt, yaw = self._law.results["angle"].tolist()
        return {"error_tilt": tilt, "error_yaw": yaw}


_built: dict[tuple[object, ...], ca.Function] = {}


def _law(vehicle: Vehicle, keys: DFBCKeys, model: Residual, backend: str) -> ca.Function:
    """The law on a resolved back end, built once per process and structure."""
    key = (vehicle.fingerprint, keys, model.function.serialize(), backend)
    if key not in _built:
        _built[key] = realise(law_function(vehicle, keys, model, compiled=backend == "compiled"), backend)
    return _built[key]


@dataclass(frozen=True, kw_only=True)
class FlatnessBased(DFBCKeys, ControllerPart):
    """Flatness-based control (Sun et al. 2022). residual: its model of the air."""

    former_kind = "dfbc"
    backend: Backend = "auto"
    residual: str = key("none", RESIDUAL)

    def build(self, given: Given) -> Any:
        """See ControllerPart."""
        return DFBC(given.vehicle, part(DFBCKeys, self), given.residual(*self.kinds), backend=self.backend)
