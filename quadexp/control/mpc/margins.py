"""Margins for unmodelled delay and motor lag of a closed loop, from its linearisation at hover.

To first order the control step is a linear feedback of the state it is given, independent of the last solution from
which it starts. With the prediction over the dead time it is a feedback of the measured state x, of the commands
u_{k-j} sent before, and of the rotors' thrusts T where they are states:

    u_k = K_x x_k + sum_j K_j u_{k-j} + K_T T_k

The plant is the controller's own model linearised at hover, x' = A x + B thrust, where the thrust is the command after
the known dead time and lag and the additional, unmodelled ones. With a held command and a delay of q periods and a
fraction it is discretised exactly by two matrix exponentials. The loop is stable while the spectral radius of its
matrix is below 1; a margin is the smallest additional delay or lag for which it is not.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from quadexp.control.instant import run
from quadexp.control.mpc.controller import PredictiveController
from quadexp.physics.motor import lagging_thrust
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.state import ATTITUDE, N_STATE

LIMIT = 0.5  # s: largest margin that is searched for
SCAN, RESOLUTION = 0.01, 1e-4  # s: step of the search, and accuracy of the result
STABLE = 1 + 1e-9  # largest spectral radius that counts as stable: a state without weight has an eigenvalue of 1
DIFFERENCE = 1e-5  # of states and thrusts (SI units), for derivatives
# The quaternion's first component does not move to first order; the other twelve numbers of a state do.
MOVING = np.delete(np.arange(N_STATE), ATTITUDE.start)


class Margins(NamedTuple):
    """Delay and lag that the loop tolerates in addition to the modelled ones, each alone (s); at most LIMIT.

    0: the loop is not stable even without. delay: dead time. lag: time constant of a first-order lag of every rotor.
    early: by how much the true dead time may be shorter than the predicted one; at most the predicted one.
    """

    delay: float
    lag: float
    early: float


def margins(controller: PredictiveController) -> Margins:
    """Margins at hover with the parameters that a flight begins with. The controller must be `reset` afterwards."""
    controller.mpc.set_parameters(controller.mpc.residual.theta)
    loop = HoverLoop(controller)
    known = controller.settings.dead_time
    return Margins(
        _first_unstable(lambda delay: loop.radius(delay=delay), LIMIT),
        _first_unstable(lambda lag: loop.radius(lag=lag), LIMIT),
        _first_unstable(lambda early: loop.radius(delay=-early), known),
    )


def _first_unstable(radius: Callable[[float], float], limit: float) -> float:
    """The smallest argument in 0 .. limit (s) at which the spectral radius is not stable."""
    if not radius(0.0) <= STABLE:
        return 0.0
    low, points = 0.0, np.linspace(0.0, limit, 1 + int(np.ceil(limit / SCAN)))
    for point in points[1:]:
        if radius(point) <= STABLE:
            low = float(point)
            continue
        high = float(point)
        while high - low > RESOLUTION:
            middle = (low + high) / 2
            low, high = (middle, high) if radius(middle) <= STABLE else (low, middle)
        break
    return low


class HoverLoop:
    """The closed loop of a controller and its own model, linearised at hover.

    Its state: 12 states of the body, the thrusts behind each lag, the thrusts that the controller computes, and the
    commands sent before, the newest first.
    """

    def __init__(self, controller: PredictiveController) -> None:
        self._settings, self._n = controller.settings, controller.vehicle.n_rotors
        self._x = np.zeros(N_STATE)
        self._x[ATTITUDE.start] = 1.0
        self._u = np.full(self._n, controller.vehicle.hover_thrust)
        model = corrected_function(controller.vehicle, controller.mpc.residual)
        theta = controller.mpc.parameters

        def derivative(point: np.ndarray) -> np.ndarray:
            return model(point[:N_STATE], point[N_STATE:], theta).full().ravel()[MOVING]

        by_all = _jacobian(derivative, np.concatenate([self._x, self._u]))
        self._A, self._B = by_all[:, MOVING], by_all[:, N_STATE:]
        self._gains(controller)

    def _gains(self, controller: PredictiveController) -> None:
        """K_x (n, 12), K_T (n, n) and K_j (K, n, n), of u_{k-1} first."""
        mpc, n, samples, lagging = controller.mpc, self._n, len(controller.node_times), self._settings.known_lag > 0
        lead = controller.lead if lagging else None
        states, inputs = np.tile(self._x, (samples, 1)), np.tile(self._u, (samples - 1, 1))
        thrusts = np.full(n, self._u[0]) if lagging else np.zeros(0)

        def answer(x: np.ndarray) -> np.ndarray:
            s = x if lead is None else x[:N_STATE]
            mpc.reset(s, states, inputs)
            planned = mpc.command(s, states, inputs)[0]
            if lead is None:
                return planned
            operations, command = lead.after(planned, x[N_STATE:])
            run(operations)
            return command.copy()

        by_state = _jacobian(answer, np.concatenate([self._x, thrusts]))
        predictor = controller.predictor
        if predictor is None or not (lagging or self._settings.dead_time):
            self._K_x, self._K_T, self._K = by_state[:, MOVING], np.zeros((n, n)), np.zeros((0, n, n))
            return
        shape = predictor.commands.shape
        predictor.reset(self._u)

        def predicted(point: np.ndarray) -> np.ndarray:
            predictor.thrust[...] = point[N_STATE : N_STATE + n]
            predictor.commands[...] = point[N_STATE + n :].reshape(shape)
            return predictor.predict(point[:N_STATE])

        by_all = by_state @ _jacobian(predicted, np.concatenate([self._x, self._u, np.tile(self._u, shape[0])]))
        self._K_x, self._K_T = by_all[:, MOVING], by_all[:, N_STATE : N_STATE + n]
        self._K = by_all[:, N_STATE + n :].reshape(n, *shape).transpose(1, 0, 2)[::-1]

    def radius(self, *, delay: float = 0.0, lag: float = 0.0) -> float:
        """Spectral radius over a control period, with an unmodelled delay and lag (s)."""
        return float(np.abs(np.linalg.eigvals(self.matrix(delay=delay, lag=lag))).max())

    def matrix(self, *, delay: float = 0.0, lag: float = 0.0) -> np.ndarray:
        """Transition matrix of the loop's state over a control period, see `radius`."""
        n, known, period = self._n, self._settings.known_lag, self._settings.control_period
        A, B = self._A, self._B
        for constant in (known, lag):  # the thrusts become states, with the commands as inputs
            if constant > 0:
                A = np.block([[A, B], [np.zeros((n, len(A))), -np.eye(n) / constant]])
                B = np.vstack([np.zeros((len(B), n)), np.eye(n) / constant])
        whole = self._settings.dead_time + delay
        periods = int(np.floor(whole / period + 1e-9))
        split = max(whole - periods * period, 0.0)
        (first, by_old), (second, by_new) = _held(A, B, split), _held(A, B, period - split)

        body, believed = len(A), n if known else 0
        history = max(periods + 1, len(self._K))
        at_commands = body + believed
        size = at_commands + n * history
        answer = np.zeros((n, size))  # u_k of the loop's state
        answer[:, : len(self._A)] = self._K_x
        answer[:, body:at_commands] = self._K_T[:, :believed]
        answer[:, at_commands : at_commands + n * len(self._K)] = np.concatenate([np.zeros((n, 0)), *self._K], axis=1)

        def command(j: int) -> np.ndarray:
            """u_{k-j} of the loop's state."""
            return answer if j == 0 else np.eye(n, size, at_commands + n * (j - 1))

        after = np.zeros((size, size))
        after[:body, :body] = second @ first
        after[:body] += second @ by_old @ command(periods + 1) + by_new @ command(periods)
        if known:
            after[body:at_commands] = self._believed(np.eye(n, size, body), command)
        for j in range(history):
            after[at_commands + n * j : at_commands + n * (j + 1)] = command(j)
        return after

    def _believed(self, thrust: np.ndarray, command: Callable[[int], np.ndarray]) -> np.ndarray:
        """Thrusts that the controller computes, a period later, as DeadTimePredictor does."""
        period, pending = self._settings.control_period, len(self._K)
        oldest = self._settings.dead_time - (pending - 1) * period if pending else period
        share = float(lagging_thrust(1.0, 0.0, min(oldest, period), self._settings.known_lag))
        thrust = share * thrust + (1 - share) * command(pending)
        if not pending:
            return thrust
        share = float(lagging_thrust(1.0, 0.0, period - oldest, self._settings.known_lag))
        return share * thrust + (1 - share) * command(pending - 1)


def _jacobian(f: Callable[[np.ndarray], np.ndarray], point: np.ndarray) -> np.ndarray:
    """Jacobian of a smooth function at a point, by central differences."""
    moves = DIFFERENCE * np.eye(len(point))
    return np.stack([(f(point + move) - f(point - move)) / (2 * DIFFERENCE) for move in moves], axis=1)


def _held(A: np.ndarray, B: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Discrete state and input matrices of x' = A x + B u for an input held over a duration (s)."""
    n, size = B.shape[1], len(A)
    whole = _exponential(duration * np.block([[A, B], [np.zeros((n, size + n))]]))
    return whole[:size, :size], whole[:size, size:]


def _exponential(M: np.ndarray) -> np.ndarray:
    """Matrix exponential: Taylor series of M / 2^s, squared s times. (Importing SciPy's takes 0.1 s.)"""
    halvings = max(0, int(np.ceil(np.log2(np.abs(M).sum(axis=1).max() + 1e-300))) + 2)
    scaled, term = M / 2**halvings, np.eye(len(M))
    total = term.copy()
    for k in range(1, 13):
        term = term @ scaled / k
        total += term
    for _ in range(halvings):
        total = total @ total
    return total
