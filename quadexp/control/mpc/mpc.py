"""Model predictive controller: one real-time SQP iteration per control step, any residual model, exact bounds."""

from __future__ import annotations

import math
import time
from typing import Any, NamedTuple

import numpy as np

from quadexp.compile.backend import resolve
from quadexp.compile.memory import Memory
from quadexp.control.cached_function import cached_function
from quadexp.control.mpc.active_set import ActiveSet, Status
from quadexp.control.mpc.first_solve import CONVERGED, Direction, FirstSolve, rollout_function
from quadexp.control.mpc.interpreted import InterpretedStages
from quadexp.control.mpc.node import Form
from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.mpc.stages import compiled_stages
from quadexp.control.mpc.step import Stages, Step
from quadexp.errors import QuadexpError, UsageError
from quadexp.models.residual import Residual
from quadexp.parts.settings import changed
from quadexp.physics.state import ATTITUDE, N_STATE, norms
from quadexp.physics.vehicle import Vehicle

TOLERANCE = 1e-9  # N: bound violation that counts as none
MAX_TURN = 0.25  # largest change of a quaternion (length of the difference) in one iteration
STATIONARY = 1e-4  # share of the thrust range: largest input error of a first step that counts as converged
PLAIN_ITERATIONS = 20  # full SQP steps of the first control step, before a line search begins


class StepRecord(NamedTuple):
    """Result of one control step, except for the input.

    solve_time: wall-clock time of the MPC's call (s); a flight logs that of the whole step. status: see Status. sweeps:
    exchanges of the active set. active: number of inputs of the horizon at a bound. kkt: optimality residual at the
    shifted last solution (mixed units). converged: whether the first step of a flight reached a stationary point; later
    steps make one iteration and are always True.
    """

    solve_time: float
    status: Status
    sweeps: int
    active: int
    kkt: float
    converged: bool = True


class ModelPredictiveController:
    """Tracks a sampled reference; call `reset` once, then `command` every control period.

    vehicle, residual: the prediction model: rigid body and rotors, and a correction of the acceleration and torque.
    backend: "auto", "compiled" or "interpreted" (see compile/backend.py); the attribute is the one in use.
    disturbed: whether the model has a disturbance that may be set before every step (`set_disturbance`).
    step: the control step, with the arrays that `command` works on. memory: the last solution and active set, which it
    works on in place.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        residual: Residual,
        settings: MPCSettings | None = None,
        *,
        backend: str = "auto",
        disturbed: bool = False,
    ) -> None:
        self.vehicle = vehicle
        self.residual = residual
        self.settings = settings = settings or MPCSettings()
        self.backend = resolve(backend)
        deviation = settings.input_hold == "deviation"
        structure = {"attitude_error": settings.attitude_error, "lag": bool(settings.motor_lag)}
        structure |= {"deviation": deviation, "disturbed": disturbed}
        self.step = Step(
            cached_function(self.backend, stages_of, vehicle, residual, self.backend, **structure), settings.nodes
        )
        arguments = self.step.arguments
        self._active_set = ActiveSet(self.step)

        self._weigh(settings)
        self.set_thrust_scale(1.0)
        if settings.motor_lag:
            arguments["tau"][...] = settings.motor_lag
        self._x0 = arguments["x0"]
        self._X_ref = arguments["X_ref"]
        self._U_ref = arguments["U_ref"]
        self._X_ref_flat = self._X_ref.ravel()
        self._U_ref_flat = self._U_ref.ravel()
        self._X = arguments["X"]
        self._U = arguments["U"]
        self._X_ref_body = self._X_ref[:, :N_STATE]
        self._X_new = self.step.results["X_new"]
        self._U_new = self.step.results["U_new"]
        self._checks = self.step.results["checks"]
        self._thrust = self._U[0]
        self._attitude = self._x0[ATTITUDE]
        self._attitude_ref = self._X_ref[0, ATTITUDE]
        self._attitude_predicted = self._X[0, ATTITUDE]
        self._first_solve: FirstSolve | None = None  # few flights need it
        self.memory = Memory("MPC", worked={name: arguments[name] for name in ("X", "U", "guess")})
        self.prepared = False
        self._cold = True
        self.set_parameters(residual.theta)

    def weights(self, settings: MPCSettings) -> dict[str, np.ndarray]:
        """Weights and node times of settings as the step has them, by its arguments' names."""
        share = settings.node_share[:, None]
        vehicle = self.vehicle
        Q_end = np.zeros_like(self.step.arguments["Q_end"])  # thrusts that are states weigh nothing
        Q_end[:N_STATE] = settings.state_weight()
        shift = settings.control_period / settings.node_periods  # share of each node between two steps
        first = {"first_share": shift[:1]} if settings.input_hold == "deviation" else {}
        weights = {"Q": share * Q_end, "Q_end": settings.terminal_weight * Q_end, "shift": shift, **first}
        return weights | {"R": share * settings.thrust_weight(vehicle), "dt": settings.node_periods}

    def _weigh(self, settings: MPCSettings) -> None:
        """Enter weights and node times."""
        arguments = self.step.arguments
        vehicle = self.vehicle
        for name, values in self.weights(settings).items():
            arguments[name][...] = values.reshape(arguments[name].shape)
        # An input error du means a gradient of at least R du, and rounding errors of the gradient grow with R.
        error = STATIONARY * (vehicle.thrust_max - vehicle.thrust_min)
        self._stationary = max(CONVERGED, error * float(arguments["R"].min()))
        self.node_times = settings.reference_times  # s from now, for sampling references

    def use(self, settings: MPCSettings) -> None:
        """Go on with other weights and node times; nothing is compiled again, and the last solution is kept.

        settings: of the same nodes, input_hold, attitude_error, rate and motor_lag; UsageError otherwise.
        """
        fixed = ("nodes", "input_hold", "attitude_error", "rate", "motor_lag")
        if any(getattr(settings, name) != getattr(self.settings, name) for name in fixed):
            raise UsageError(f"settings in flight: {', '.join(fixed)} must remain as they are")
        former = self.settings
        self.settings = settings
        self.prepared = False
        self._active_set.reset()
        if changed(former, dead_time=settings.dead_time, motor_lead=settings.motor_lead) != settings:
            before = former.node_times
            now = settings.node_times
            self._X[...] = np.column_stack([np.interp(now, before, column) for column in self._X.T])
            held = np.clip(np.searchsorted(before, now[:-1] + 1e-9) - 1, 0, settings.nodes - 1)
            self._U[...] = self._U[held]
            self._weigh(settings)
        self._X[:, ATTITUDE] /= np.maximum(norms(self._X[:, ATTITUDE]), 1e-12)[:, None]
        self.memory.commit()

    @property
    def parameters(self) -> np.ndarray:
        """Residual parameters in use, (p,); `set_parameters` changes this array in place."""
        return self.step.arguments["theta"]

    def set_parameters(self, theta: np.ndarray) -> None:
        """Use other residual parameters, (p,), from the next step on; nothing is compiled again."""
        self.prepared = False
        self.step.arguments["theta"].ravel()[:] = theta

    @property
    def disturbance(self) -> np.ndarray | None:
        """Acceleration, world (m/s^2), and angular acceleration, body (rad/s^2), in use, (6,), changed in place by
        `set_disturbance`; None where the model has none."""
        return self.step.arguments["disturbance"] if self.step.form.disturbed else None

    def set_disturbance(self, disturbance: np.ndarray) -> None:
        """Use another disturbance, (6,), from the next step on; nothing is compiled again.

        Raises QuadexpError where the controller was made without.
        """
        if self.disturbance is None:
            raise QuadexpError("this model has no disturbance: ModelPredictiveController(.., disturbed=True) has")
        self.prepared = False
        self.disturbance[...] = disturbance

    def set_thrust_scale(self, scale: float) -> None:
        """What a rotor gives of a command of 1 N, from the next step on: inputs are the thrusts that are delivered, so
        only their limits change."""
        self.prepared = False
        low, high = self.limits
        vehicle = self.vehicle
        low[...] = scale * vehicle.thrust_min
        high[...] = scale * vehicle.thrust_max

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """The arrays of the limits of delivered thrusts, (n,) each (N)."""
        return self.step.arguments["u_min"], self.step.arguments["u_max"]

    @property
    def reference(self) -> tuple[np.ndarray, np.ndarray]:
        """The arrays of the reference, states (s N + 1, m) and inputs (s N, n); `command` takes them as they are."""
        return self._X_ref, self._U_ref

    @property
    def cold(self) -> bool:
        """Whether the next step is the first of a flight, which iterates."""
        return self._cold

    @property
    def prediction(self) -> tuple[np.ndarray, np.ndarray]:
        """Predicted states (N + 1, m) and inputs (N, n) of the last step; overwritten by the next."""
        return self._X, self._U

    def reset(self, x0: np.ndarray, state_reference: np.ndarray, input_reference: np.ndarray) -> None:
        """Take the reference as the initial guess; the next `command` iterates to convergence.

        x0, state_reference, input_reference: see `command`.
        """
        self._X[:, :N_STATE] = state_reference[:: self.settings.samples]
        if state_reference[0, ATTITUDE] @ x0[ATTITUDE] < 0:
            self._X[:, ATTITUDE] *= -1
        self._U[...] = np.clip(
            input_reference[:: self.settings.samples], self.vehicle.thrust_min, self.vehicle.thrust_max
        )
        self._X[:-1, N_STATE:] = self._U[:, : self._X.shape[1] - N_STATE]
        self._X[-1, N_STATE:] = self._X[-2, N_STATE:]
        self._active_set.reset()
        self.memory.commit()
        self._cold = True
        self.prepared = False

    def go_on(self) -> None:
        """Take `memory`, which has been restored, for the last solution of a flight that goes on."""
        self._cold = False
        self.prepared = False

    def _set_reference(self, state_reference: np.ndarray, input_reference: np.ndarray, finite: bool = False) -> None:
        if state_reference is not self._X_ref:  # else it is in place already
            self._X_ref_body[...] = state_reference
            self._U_ref[...] = input_reference
        if not finite and not math.isfinite(
            self._X_ref_flat.dot(self._X_ref_flat) + self._U_ref_flat.dot(self._U_ref_flat)
        ):
            raise QuadexpError("the reference is not finite")

    def command(
        self, x0: np.ndarray, state_reference: np.ndarray, input_reference: np.ndarray, *, finite: bool = False
    ) -> tuple[np.ndarray, StepRecord]:
        """Rotor thrusts (n,) (N) for the measured state, and the record of the step.

        x0: (13,), unit quaternion; with settings.motor_lag (13 + n,), the rotors' thrusts (N) behind it.
        state_reference: (s N + 1, 13) at `node_times` from now; input_reference: (s N, n) (N); s as in MPCSettings.
        finite: whether all of them are known to be. Raises QuadexpError for a measurement or a reference that is not
        finite. A step that fails returns the last
        solution's first input with status FAILED; the caller decides what to do.
        """
        began = time.perf_counter()
        if not finite and not math.isfinite(sum(x0.tolist())):
            raise QuadexpError("the measured state is not finite")
        self._x0[...] = x0
        self.prepared = False
        self._set_reference(state_reference, input_reference, finite)
        if self._attitude_ref.dot(self._attitude) < 0:  # q and -q are the same attitude: take the measured sign
            self._X_ref[:, ATTITUDE] *= -1
        if self._attitude_predicted.dot(self._attitude) < 0:
            self._X[:, ATTITUDE] *= -1
        cold = self._cold
        status, sweeps, active, kkt = self._converge() if cold else self._iterate()
        thrust = self._thrust.copy()
        converged = not cold or kkt < self._stationary
        return thrust, StepRecord(time.perf_counter() - began, status, sweeps, active, kkt, converged)

    def prepare(self, state_reference: np.ndarray, input_reference: np.ndarray) -> None:
        """Compute what the next step does not need its measurement for; `feedback` completes it.

        References: as for `command`. To be called after a step and before the next; before the first step it does
        nothing. Valid until the next step, `set_parameters` or `reset`. Raises
        QuadexpError for a reference that is not finite.
        """
        self.prepared = False
        if self._cold:
            return
        self._set_reference(state_reference, input_reference)
        if self._attitude_ref.dot(self._attitude_predicted) < 0:
            self._X_ref[:, ATTITUDE] *= -1
        self.step.prepare()
        self.prepared = True

    def feedback(self, x0: np.ndarray) -> tuple[np.ndarray, StepRecord]:
        """As `command` with the prepared reference, with less work after the measurement; equal to rounding.

        x0: as for `command`. Where the measured attitude is so far from the reference that the sign of the reference's
        quaternion must change, the whole step is computed. Raises QuadexpError for a measurement that is not finite, or
        where nothing has been prepared.
        """
        began = time.perf_counter()
        if not self.prepared:
            raise QuadexpError("feedback: nothing has been prepared for this step")
        if not math.isfinite(sum(x0.tolist())):
            raise QuadexpError("the measured state is not finite")
        self._x0[...] = x0
        if self._attitude_predicted.dot(self._attitude) < 0:  # q and -q are the same attitude: take the predicted sign
            self._attitude *= -1
        if self._attitude_ref.dot(self._attitude) < 0:
            return self.command(x0, self._X_ref_body.copy(), self._U_ref.copy())
        self.prepared = False
        self.step.feedback()
        status, sweeps, active, kkt = self._conclude()
        thrust = self._thrust.copy()
        return thrust, StepRecord(time.perf_counter() - began, status, sweeps, active, kkt)

    def _converge(self) -> tuple[Status, int, int, float]:
        """Iterate on the first measurement without shifting the guess: full steps first, then with a line search."""
        shift = self.step.arguments["shift"]
        shift[...] = 0.0
        guess = self._U.copy()
        iterations = self.settings.initial_iterations
        for _ in range(min(iterations, PLAIN_ITERATIONS)):
            outcome = self._iterate()
            if outcome[0] == Status.FAILED or outcome[3] < CONVERGED:
                break
        if not outcome[3] < CONVERGED and iterations > PLAIN_ITERATIONS:
            reached = self._X.copy(), self._U.copy()
            descended = self._descend(guess, iterations - PLAIN_ITERATIONS)
            if (
                descended is None or descended[0] == Status.FAILED
            ):  # then keep the result of the full steps, not converged
                self._X[...], self._U[...] = reached
            else:
                outcome = descended
        shift[...] = self.settings.control_period / self.step.arguments["dt"]
        self._cold = False
        return outcome

    def _descend(self, guess: np.ndarray, iterations: int) -> tuple[Status, int, int, float] | None:
        """Iterations with a line search, from the result of the full steps or from the first guess, (N, n).

        None where the trajectory of neither is finite.
        """
        if self._first_solve is None:
            rollout = rollout_function(self.vehicle, self.residual, self.step.form, self.settings.nodes)
            self._first_solve = FirstSolve(rollout, self.step, self._direction)
        reached = np.clip(self._U, self.vehicle.thrust_min, self.vehicle.thrust_max)
        solution = self._first_solve.solve([reached, guess], iterations)
        return None if solution is None else solution[1:]

    def _direction(self) -> Direction:
        """Linearise at the guess and solve the bounded subproblem; the guess does not move."""
        self.step()
        excess, turn, kkt = self._checks.tolist()
        d_input = self._U_new - self.step.results["U_lin"]
        if not math.isfinite(excess + turn):
            return Direction(d_input, Status.FAILED, 0, 0, kkt)
        if excess <= TOLERANCE:
            return Direction(d_input, Status.OK, 0, 0, kkt)
        solver = self._active_set
        status = solver.solve()
        return Direction(solver.U_new - self.step.results["U_lin"], status, solver.exchanges, solver.active, kkt)

    def _iterate(self) -> tuple[Status, int, int, float]:
        """One SQP iteration: status, exchanges, active bounds, optimality residual. A failed one leaves the guess."""
        self.step()
        return self._conclude()

    def _conclude(self) -> tuple[Status, int, int, float]:
        """Complete an iteration from its solution without bounds; results as of `_iterate`."""
        excess, turn, kkt = self._checks.tolist()
        if not math.isfinite(excess + turn):
            return Status.FAILED, 0, 0, kkt
        if excess <= TOLERANCE:  # then the unbounded solution is the bounded one
            self._active_set.reset()
            self._move(self._X_new, self._U_new, turn)
            return Status.OK, 0, 0, kkt
        solver = self._active_set
        status = solver.solve()
        if status == Status.FAILED:
            return status, solver.exchanges, 0, kkt
        self._move(solver.X_new, solver.U_new, solver.turn)
        return status, solver.exchanges, solver.active, kkt

    def _move(self, X_new: np.ndarray, U_new: np.ndarray, turn: float) -> None:
        """Move the guess to a solution; only part of the way where an attitude would change by more than MAX_TURN."""
        if turn <= MAX_TURN:
            self._X[...] = X_new
            self._U[...] = U_new
            return
        x = self.step.results["X_lin"]
        u = self.step.results["U_lin"]
        length = MAX_TURN / turn
        self._X[...] = x + length * (X_new - x)
        self._U[...] = u + length * (U_new - u)


def stages_of(vehicle: Vehicle, residual: Residual, backend: str, **structure: Any) -> Stages:
    """The step of a model on a resolved back end. structure: see node.Form."""
    form = Form(vehicle.n_rotors, residual.function.size1_in(1), **structure)
    make = InterpretedStages if backend == "interpreted" else compiled_stages
    return make(vehicle, residual, form)
