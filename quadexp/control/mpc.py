"""Model predictive controller: one real-time SQP iteration per control step, any residual model, exact bounds."""

from __future__ import annotations

import time
from dataclasses import dataclass

import casadi as ca
import numpy as np

from quadexp.backend import BufferedFunction, realise, resolve
from quadexp.control.active_set import TOLERANCE, ActiveSet, Status
from quadexp.control.settings import MPCSettings
from quadexp.control.step import bounded_function, step_function
from quadexp.errors import QuadexpError
from quadexp.residual.base import Residual
from quadexp.state import ATTITUDE
from quadexp.vehicle import Vehicle

CONVERGED = 1e-6  # optimality residual at which the first step stops iterating


@dataclass(frozen=True)
class StepRecord:
    """How one control step went.

    solve_time: s, wall clock of the step as Python sees it. status: see Status. sweeps: active-set sweeps.
    active: inputs of the horizon at a bound. kkt: optimality residual of the shifted guess (m, N and mixed units).
    """

    solve_time: float
    status: Status
    sweeps: int
    active: int
    kkt: float


class ModelPredictiveController:
    """Tracks a sampled reference; call `reset` once, then `command` every control period.

    vehicle: what the controller believes it flies. residual: what it believes of the air.
    backend: "auto", "compiled" or "interpreted" (see quadexp.backend); `backend` afterwards says which one it got.
    """

    def __init__(
        self, vehicle: Vehicle, residual: Residual, settings: MPCSettings | None = None, *, backend: str = "auto"
    ) -> None:
        self.vehicle, self.residual = vehicle, residual
        self.settings = settings = settings or MPCSettings()
        self.backend = resolve(backend)
        step, bounded = _functions(vehicle, residual, settings.nodes, self.backend)
        self._step, self._bounded = BufferedFunction(step), BufferedFunction(bounded)
        self._active_set = ActiveSet(self._bounded, max_sweeps=settings.max_sweeps)

        arguments = self._step.arguments
        arguments["Q"][...] = settings.state_weight()
        arguments["Q_end"][...] = settings.terminal_weight * settings.state_weight()
        arguments["R"][...] = settings.thrust_weight(vehicle)
        arguments["u_min"][...], arguments["u_max"][...] = vehicle.thrust_min, vehicle.thrust_max
        arguments["dt"][...] = settings.node_period
        self._shift = settings.control_period / settings.node_period
        self.set_parameters(residual.theta)
        for name in ("Q", "Q_end", "R"):
            self._bounded.arguments[name][...] = arguments[name]
        self.node_times = settings.node_period * np.arange(settings.nodes + 1)  # s from now, for sampling references

    def set_parameters(self, theta: np.ndarray) -> None:
        """New residual parameters, (p,), from the next step on; nothing is rebuilt."""
        self._step.arguments["theta"].reshape(-1)[:] = theta

    @property
    def prediction(self) -> tuple[np.ndarray, np.ndarray]:
        """Predicted states (N + 1, 13) and inputs (N, n) of the last step; overwritten by the next."""
        return self._step.arguments["X"], self._step.arguments["U"]

    def reset(self, x0: np.ndarray, state_reference: np.ndarray, input_reference: np.ndarray) -> None:
        """Start anew from a guess on the reference; the next `command` iterates to convergence.

        x0: (13,). state_reference: (N + 1, 13). input_reference: (N, n), N.
        """
        arguments = self._step.arguments
        arguments["X"][...] = self._same_hemisphere(x0, state_reference)
        arguments["U"][...] = np.clip(input_reference, self.vehicle.thrust_min, self.vehicle.thrust_max)
        self._active_set.reset()
        self._cold = True

    def command(
        self, x0: np.ndarray, state_reference: np.ndarray, input_reference: np.ndarray
    ) -> tuple[np.ndarray, StepRecord]:
        """Rotor thrusts (n,) (N) for the measured state, and how the step went.

        x0: (13,), unit quaternion. state_reference: (N + 1, 13) at `node_times` from now; input_reference: (N, n).
        Raises QuadexpError for a measurement that is not finite. A step that fails returns the last prediction's input
        with status FAILED; whoever flies decides what to do.
        """
        if not np.isfinite(x0).all():
            raise QuadexpError("the measured state is not finite")
        began = time.perf_counter()
        arguments = self._step.arguments
        arguments["x0"][...] = x0
        arguments["X_ref"][...] = self._same_hemisphere(x0, state_reference)
        arguments["U_ref"][...] = input_reference
        arguments["shift"][...] = 0.0 if self._cold else self._shift
        status, sweeps, active, kkt = self._iterate()
        if self._cold:
            for _ in range(self.settings.initial_iterations - 1):
                if status == Status.FAILED or kkt < CONVERGED:
                    break
                status, sweeps, active, kkt = self._iterate()
            arguments["shift"][...] = 0.0
            self._cold = False
        thrust = arguments["U"][0].copy()
        return thrust, StepRecord(time.perf_counter() - began, status, sweeps, active, kkt)

    def _iterate(self) -> tuple[Status, int, int, float]:
        """One SQP iteration; the guess X, U becomes the new solution unless it failed."""
        arguments, results = self._step.arguments, self._step.results
        self._step()
        kkt = float(results["kkt"][0])
        excess = float(results["excess"][0])
        if not np.isfinite(excess):
            return Status.FAILED, 0, 0, kkt
        if excess <= TOLERANCE:  # then the unbounded solution solves the bounded problem too
            self._active_set.reset()
            arguments["X"][...], arguments["U"][...] = results["X_new"], results["U_new"]
            return Status.RICCATI, 0, 0, kkt
        for name in ("A", "B", "b", "q", "r"):
            self._bounded.arguments[name][...] = results[name]
        u = results["U_lin"]
        d_state, d_input, status = self._active_set.solve(arguments["u_min"] - u, arguments["u_max"] - u)
        if status == Status.FAILED:
            return status, self._active_set.sweeps, 0, kkt
        arguments["X"][0] = arguments["x0"]
        arguments["X"][1:] = results["X_lin"][1:] + d_state
        arguments["U"][...] = u + d_input
        return status, self._active_set.sweeps, int(np.count_nonzero(self._active_set.side)), kkt

    def _same_hemisphere(self, x0: np.ndarray, state_reference: np.ndarray) -> np.ndarray:
        """The reference with its quaternions' sign turned to the measured one (both mean the same attitude)."""
        if state_reference[0, ATTITUDE] @ x0[ATTITUDE] >= 0:
            return state_reference
        flipped = state_reference.copy()
        flipped[:, ATTITUDE] *= -1
        return flipped


_built: dict[tuple, tuple[ca.Function, ca.Function]] = {}


def _functions(vehicle: Vehicle, residual: Residual, nodes: int, backend: str) -> tuple[ca.Function, ca.Function]:
    """Step and bounded solver on the resolved back end; built once per process and structure."""
    key = (vehicle.fingerprint, residual.function.serialize(), nodes, backend)
    if key not in _built:
        scalar = backend == "compiled"
        step = step_function(vehicle, residual, nodes, scalar=scalar)
        bounded = bounded_function(step, nodes, scalar=scalar)
        _built[key] = realise(step, backend), realise(bounded, backend)
    return _built[key]
