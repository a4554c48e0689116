"""A control law in closed form (control/law.py) as a Controller: one compiled function a step."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from quadexp.compile.backend import BufferedFunction, resolve
from quadexp.compile.symbolic import ca
from quadexp.control.base import Belief, Window, no_belief
from quadexp.control.delivered import DeliveredThrust
from quadexp.control.instant import YES, InOperations, Instant, Operation, Told, call, copy, law_record, move
from quadexp.control.wrapped import thrust_at_start
from quadexp.models.residual import Residual
from quadexp.parts.settings import Setting
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle

Rate = Annotated[float, Setting("control rate", "[1, 1000]", "Hz")]

OF_REFERENCE = {"reference", "thrusts", "thrusts_middle", "air_reference"}  # what a reference is made by flatness for
NO_BELIEF = np.hstack([*no_belief()])  # force, torque, wind, thrust scale, air scale


class ExplicitController(InOperations):
    """A Controller (see control.base) whose step is a CasADi function.

    law: the control.law.Law. function: of its law_function, on a back end. residual: what it knows of the air; None for
    nothing.
    """

    reference_period = 0.0

    def __init__(self, vehicle: Vehicle, law: Any, function: ca.Function, residual: Residual | None) -> None:
        self.vehicle, self.law, self.control_period = vehicle, law, 1.0 / law.rate
        self.backend = resolve(law.backend)
        self.node_times = np.array(law.nodes) * self.control_period
        self.name, self.source = ("none", "") if residual is None else (residual.name, residual.source)
        self._law = BufferedFunction(function)
        arguments = self._law.arguments
        self.air, self.residual = residual, residual if OF_REFERENCE & arguments.keys() else None
        self._logged = {name: self._law.results[f"log_{name}"] for name in law.logged}
        self._delivered: DeliveredThrust | None = None
        if "delivered" in arguments:
            self._delivered = DeliveredThrust(vehicle, self.control_period, backend=self.backend)
        if residual is not None and "theta" in arguments:
            arguments["theta"].ravel()[:] = residual.theta
        if "belief" in arguments:
            arguments["belief"][:] = NO_BELIEF
        self._begun = np.zeros(1)
        self.rows: np.ndarray | None = None  # of the horizon that it is told, where that is longer; None: all

    def forget(self) -> None:
        """See Controller.forget; nothing is learned that outlives a flight."""

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        arguments = self._law.arguments
        if "belief" in arguments:
            arguments["belief"][:] = NO_BELIEF
        self._begun[0] = 0.0
        if self._delivered is not None:
            self._delivered.reset(thrust_at_start(window, self.vehicle))
        if "memory" in arguments:
            arguments["memory"][:] = self.law.initial(self.vehicle, x)

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        arguments, results, n = self._law.arguments, self._law.results, self.vehicle.n_rotors
        states, thrusts = np.empty((len(self.node_times), N_STATE)), np.empty((len(self.node_times) - 1, n))
        delivered, places = self._delivered, {"state": state, "path": told.path, "heading": told.yaw[:3]}
        places |= {"specific_force": told.force, "rotor_speed": told.speed}
        ahead = {"reference": states[0], "thrusts": thrusts[0], "thrusts_middle": thrusts[-1]}
        operations = [Operation("window", states, self.rows, thrusts)] if ahead.keys() & arguments.keys() else []
        if delivered is not None:
            operations += delivered.before(told)
            places["delivered"] = delivered.thrust
        operations += [copy(arguments[name], place) for name, place in (ahead | places).items() if name in arguments]
        if "fresh" in arguments:
            fresh = arguments["fresh"]
            operations += [copy(fresh[:1], told.read), copy(fresh[1:], told.turning)]
        if "memory" in arguments:
            operations.append(move(arguments["memory"], results["memory_next"], self._begun))
            operations.append(move(results["memory_next"], results["memory_next"]))  # the call may be taken back
            operations.append(move(self._begun, YES))
        operations += [call(self._law), Operation("finite", source=results["command"])]
        operations += [] if delivered is None else delivered.after(results["command"])
        record = law_record(self._law)
        logged = tuple(self._logged.values())
        return Instant(operations, results["command"], record, held=results["held"], logged=logged)

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
        """What is believed, in the order of Belief; (11,)."""
        numbers: np.ndarray = self._law.arguments["belief"]
        return numbers

    def believe(self, belief: Belief) -> None:
        """Take this for what acts beside the model, from the next step on."""
        self.believed_numbers[:] = np.hstack([*belief])
