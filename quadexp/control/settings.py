"""Settings of the model predictive controller, with the values of Torrente et al. 2021's simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.control.attitude_error import ATTITUDE_ERRORS
from quadexp.errors import UsageError
from quadexp.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.vehicle import Vehicle


@dataclass(frozen=True)
class MPCSettings:
    """Horizon, weights and iteration limits.

    horizon: s. nodes: shooting intervals N. rate: control steps per second (Hz).
    *_weight: diagonal of Q on deviations in SI units; attitude on a quaternion (w, x, y, z), which is the plain
    difference or the error's rotation in the reference's body frame, as attitude_error says ("plain" or "body").
    input_weight: diagonal of R on thrusts normalised by the largest one.
    terminal_weight: factor on Q at the last node. feedforward: let the reference's attitude, rates and thrusts contain
    the residual. initial_iterations: SQP iterations allowed on the first step (one on every later step): full ones
    first, and where these do not converge, more with a line search (first_solve.py).
    distance_limit: m, largest position error that the controller acts on; see PredictiveController.
    """

    horizon: float = 1.0
    nodes: int = 10
    rate: float = 50.0
    position_weight: tuple[float, ...] = (10.0, 10.0, 10.0)
    attitude_weight: tuple[float, ...] = (0.0, 0.1, 0.1, 0.1)
    attitude_error: str = "plain"
    velocity_weight: tuple[float, ...] = (0.05, 0.05, 0.05)
    rate_weight: tuple[float, ...] = (0.05, 0.05, 0.05)
    input_weight: float = 0.1
    terminal_weight: float = 0.0
    feedforward: bool = True
    initial_iterations: int = 400
    distance_limit: float = 10.0

    def __post_init__(self) -> None:
        if self.nodes < 2:
            raise UsageError(f"controller.nodes={self.nodes}: must be at least 2")
        if self.attitude_error not in ATTITUDE_ERRORS:
            allowed = ", ".join(ATTITUDE_ERRORS)
            raise UsageError(f"controller.attitude_error={self.attitude_error}: allowed are {allowed}")
        if self.control_period > self.node_period + 1e-12:
            raise UsageError(
                f"controller.rate={self.rate:g}: a control period of {self.control_period:g} s must not exceed the node"
                f" period of {self.node_period:g} s (horizon / nodes)"
            )

    @property
    def control_period(self) -> float:
        """Time between control steps (s)."""
        return 1.0 / self.rate

    @property
    def node_period(self) -> float:
        """Time between shooting nodes (s)."""
        return self.horizon / self.nodes

    def state_weight(self) -> np.ndarray:
        """Diagonal of Q, (13,)."""
        q = np.zeros(N_STATE)
        q[POSITION], q[ATTITUDE] = self.position_weight, self.attitude_weight
        q[VELOCITY], q[RATE] = self.velocity_weight, self.rate_weight
        return q

    def thrust_weight(self, vehicle: Vehicle) -> np.ndarray:
        """Diagonal of R on thrusts in N, (n,)."""
        return np.full(vehicle.n_rotors, self.input_weight / vehicle.thrust_max**2)
