"""A control law in closed form as a Controller: one compiled function a step.

The function names what it reads: x (13,), state and input (thrusts) of the reference now (13,), (n,), its thrusts in
the middle of the control period, path (3, 5), yaw (3,), delivered thrusts (n,), belief (11,), theta, memory; and what
it gives: command (n,), memory_next, held (rotors at a limit), log. Only what it names is filled.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np

from quadexp.compile.backend import BufferedFunction, resolve
from quadexp.compile.symbolic import ca
from quadexp.control.base import Belief, Window, no_belief
from quadexp.control.delivered import DeliveredThrust
from quadexp.control.instant import YES, InOperations, Instant, Operation, Told, call, copy, law_record, move
from quadexp.control.wrapped import thrust_at_start
from quadexp.models.residual import Residual
from quadexp.names import named
from quadexp.parts.settings import Setting
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle

Rate = Annotated[float, Setting("control rate", "[1, 1000]", "Hz")]

NO_BELIEF = np.hstack([*no_belief()])  # force, torque, wind, thrust scale, air scale


class ExplicitController(InOperations):
    """A Controller (see control.base) whose step is a CasADi function.

    function: see the module. rate: of control (Hz). residual: what it knows of the air, for its references too; None
    for nothing. logged: names of the entries of the function's output log. backend: as resolved.
    """

    reference_period = 0.0

    def __init__(
        self,
        vehicle: Vehicle,
        function: ca.Function,
        rate: float,
        *,
        residual: Residual | None = None,
        logged: Sequence[str] = (),
        backend: str = "auto",
    ) -> None:
        self.vehicle, self.control_period = vehicle, 1.0 / rate
        self.residual = self.air = residual
        self.backend = resolve(backend)
        self.node_times = np.array([0.0, 0.5, 1.0]) * self.control_period
        self.name, self.source = ("none", "") if residual is None else (residual.name, residual.source)
        self._logged, self._law = tuple(logged), BufferedFunction(function)
        arguments = self._law.arguments
        self._delivered: DeliveredThrust | None = None
        if "delivered" in arguments:
            self._delivered = DeliveredThrust(vehicle, self.control_period, backend=self.backend)
        if residual is not None:
            arguments["theta"].ravel()[:] = residual.theta
        if "belief" in arguments:
            arguments["belief"][:] = NO_BELIEF
        self._begun = np.zeros(1)
        self.rows: np.ndarray | None = None  # of the horizon that it is told, where that is longer; None: all

    def forget(self) -> None:
        """See Controller.forget; nothing is learned that outlives a flight."""

    def initial(self, x: np.ndarray, window: Window) -> Any:
        """Memory at the start of a flight in the state x, (13,)."""
        return 0.0

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
            arguments["memory"][:] = self.initial(x, window)

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        arguments, results, n = self._law.arguments, self._law.results, self.vehicle.n_rotors
        states, thrusts = np.empty((len(self.node_times), N_STATE)), np.empty((len(self.node_times) - 1, n))
        delivered, places = self._delivered, {"x": state, "path": told.path, "yaw": told.yaw[:3]}
        ahead = {"state": states[0], "input": thrusts[0], "middle": thrusts[-1]}
        operations = [Operation("window", states, self.rows, thrusts)] if ahead.keys() & arguments.keys() else []
        if delivered is not None:
            operations += delivered.before(told)
            places["delivered"] = delivered.thrust
        operations += [copy(arguments[name], place) for name, place in (ahead | places).items() if name in arguments]
        if "memory" in arguments:
            operations.append(move(arguments["memory"], results["memory_next"], self._begun))
            operations.append(move(results["memory_next"], results["memory_next"]))  # the call may be taken back
            operations.append(move(self._begun, YES))
        operations += [call(self._law), Operation("finite", source=results["command"])]
        operations += [] if delivered is None else delivered.after(results["command"])
        logged = (results["log"],) if self._logged else ()
        record = law_record(self._law)
        return Instant(operations, results["command"], record, held=results["held"], logged=logged)

    def log(self) -> dict[str, float]:
        """See Controller.log."""
        return named(self._logged, self._law.results["log"].tolist()) if self._logged else {}


class BelievingController(ExplicitController):
    """One whose function reads a belief."""

    @property
    def believed_numbers(self) -> np.ndarray:
        """What is believed, in the order of Belief; (11,)."""
        return self._law.arguments["belief"]

    def believe(self, belief: Belief) -> None:
        """Take this for what acts beside the model, from the next step on."""
        self.believed_numbers[:] = np.hstack([*belief])
