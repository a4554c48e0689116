"""How much delay and lag that nobody predicted a closed loop stands, from its linearisation at hover.

To first order the step's answer is linear in the state it is given: the subproblem of a linear model does not depend on
where it is linearised, so the last solution that a step starts from drops out. With the prediction over the dead time,
from the measured state x and the commands u_{k-j} sent before (and the rotors' thrusts T, where they are states),

    u_k = K_x x_k + sum_j K_j u_{k-j} + K_T T_k

The vehicle is the controller's own model, its air included, linear at hover: x' = A x + B thrust, thrust the command
after the dead time and the lag that the controller knows, plus the ones it does not. A held command through a delay of
q periods and a fraction is exact over a period: two matrix exponentials. The loop of all of these is stable where its
spectral radius is below 1, and a margin is where that ends for the first time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from quadexp.control.mpc.controller import PredictiveController
from quadexp.physics.motor import lagging_thrust
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.state import ATTITUDE, N_STATE

LIMIT = 0.5  # s, up to which margins are looked for
SCAN, RESOLUTION = 0.01, 1e-4  # s: between the points that are looked at, and of the answer
STABLE = 1 + 1e-9  # spectral radius: a state that no weight acts on stays where it is
DIFFERENCE = 1e-5  # of states and thrusts (SI units), for derivatives
# The quaternion's first component does not move to first order; the other twelve numbers of a state do.
MOVING = np.delete(np.arange(N_STATE), ATTITUDE.start)


class Margins(NamedTuple):
    """What a loop stands beyond what its controller predicts, each alone (s); at most LIMIT, 0: not stable at all.

    delay: pure dead time. lag: time constant of a first-order lag of every rotor. early: by how much the true dead time
    may be shorter than the predicted one; the whole of it at most.
    """

    delay: float
    lag: float
    early: float


def margins(controller: PredictiveController) -> Margins:
    """Of the loop that a controller closes at hover with its first parameters; its flight begins with `reset`."""
    controller.mpc.set_parameters(controller.mpc.residual.theta)
    loop = HoverLoop(controller)
    known = controller.settings.dead_time
    return Margins(
        _first_unstable(lambda delay: loop.radius(delay=delay), LIMIT),
        _first_unstable(lambda lag: loop.radius(lag=lag), LIMIT),
        _first_unstable(lambda early: loop.radius(delay=-early), known),
    )


def _first_unstable(radius: Callable[[float], float], limit: float) -> float:
    """Where a spectral radius first leaves the stable ones, from 0 to the limit (s)."""
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
    """The loop of a controller around its own model, linear at hover.

    Its state: the body's twelve numbers, thrusts behind the lags, the thrusts that the controller believes, and the
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
        mpc, n, samples = controller.mpc, self._n, len(controller.node_times)
        states, inputs = np.tile(self._x, (samples, 1)), np.tile(self._u, (samples - 1, 1))
        lagging = np.full(n, self._u[0]) if self._settings.motor_lag else np.zeros(0)

        def answer(x: np.ndarray) -> np.ndarray:
            mpc.reset(x, states, inputs)
            return mpc.command(x, states, inputs)[0]

        by_state = _jacobian(answer, np.concatenate([self._x, lagging]))
        sent = controller.under_way
        if sent is None:
            self._K_x, self._K_T, self._K = by_state[:, MOVING], np.zeros((n, n)), np.zeros((0, n, n))
            return
        shape = sent.commands.shape
        sent.reset(self._u)

        def ahead(point: np.ndarray) -> np.ndarray:
            sent.thrust[...] = point[N_STATE : N_STATE + n]
            sent.commands[...] = point[N_STATE + n :].reshape(shape)
            return sent.ahead(point[:N_STATE])

        by_all = by_state @ _jacobian(ahead, np.concatenate([self._x, self._u, np.tile(self._u, shape[0])]))
        self._K_x, self._K_T = by_all[:, MOVING], by_all[:, N_STATE : N_STATE + n]
        self._K = by_all[:, N_STATE + n :].reshape(n, *shape).transpose(1, 0, 2)[::-1]

    def radius(self, *, delay: float = 0.0, lag: float = 0.0) -> float:
        """Spectral radius over a control period, with a delay and a lag (s) beyond those that the controller knows."""
        return float(np.abs(np.linalg.eigvals(self.matrix(delay=delay, lag=lag))).max())

    def matrix(self, *, delay: float = 0.0, lag: float = 0.0) -> np.ndarray:
        """The loop's state from one control instant to the next, see `radius`."""
        n, known, period = self._n, self._settings.motor_lag, self._settings.control_period
        A, B = self._A, self._B
        for constant in (known, lag):  # a further state of thrusts before what was there
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
        """The controller's thrusts a period later, as CommandsUnderWay has them."""
        period, under_way = self._settings.control_period, len(self._K)
        oldest = self._settings.dead_time - (under_way - 1) * period if under_way else period
        share = float(lagging_thrust(1.0, 0.0, min(oldest, period), self._settings.motor_lag))
        thrust = share * thrust + (1 - share) * command(under_way)
        if not under_way:
            return thrust
        share = float(lagging_thrust(1.0, 0.0, period - oldest, self._settings.motor_lag))
        return share * thrust + (1 - share) * command(under_way - 1)


def _jacobian(f: Callable[[np.ndarray], np.ndarray], point: np.ndarray) -> np.ndarray:
    """Of a smooth f at a point, by central differences."""
    moves = DIFFERENCE * np.eye(len(point))
    return np.stack([(f(point + move) - f(point - move)) / (2 * DIFFERENCE) for move in moves], axis=1)


def _held(A: np.ndarray, B: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """State and input matrix of x' = A x + B u over a duration (s) of a held input."""
    n, size = B.shape[1], len(A)
    whole = _exponential(duration * np.block([[A, B], [np.zeros((n, size + n))]]))
    return whole[:size, :size], whole[:size, size:]


def _exponential(M: np.ndarray) -> np.ndarray:
    """Of a matrix: Taylor's series of M / 2^s, squared s times. (SciPy's would be another 0.1 s of import.)"""
    halvings = max(0, int(np.ceil(np.log2(np.abs(M).sum(axis=1).max() + 1e-300))) + 2)
    scaled, term = M / 2**halvings, np.eye(len(M))
    total = term.copy()
    for k in range(1, 13):
        term = term @ scaled / k
        total += term
    for _ in range(halvings):
        total = total @ total
    return total
