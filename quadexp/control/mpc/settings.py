"""Settings of the model predictive controller, with the values of Torrente et al. 2021's simulation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from quadexp.errors import UsageError
from quadexp.parts.settings import Settings, Triple, key
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

SAMPLES = 2  # of the reference in a node, where its thrust within nodes counts: the start and the middle


@dataclass(frozen=True)
class MPCSettings(Settings):
    """Horizon, weights and iteration limits, with the values of Torrente et al. 2021.

    The weight of a node is proportional to its length. *_weight: diagonal of Q, on deviations in SI units.
    input_weight: diagonal of R, on thrusts divided by thrust_max. terminal_weight: factor on Q at the last node.
    Raises UsageError where control period, first node and mean node period do not fit together.
    """

    prefix = "controller."

    horizon: float = key(1.0, "length of the prediction horizon", "(0, 10]", "s")
    nodes: int = key(10, "number of intervals of the horizon", "[2, 200]", "nodes")
    first_node: float = key(
        0.0, "first interval, from which the others grow: less error, less margin; 0: equal ones", "[0, 10]", "s"
    )
    input_hold: Literal["command", "deviation"] | None = key(
        None,
        "what is constant in an interval: the command, or its deviation from the reference; null: the command, or"
        " the deviation where what is around the controller plans so",
    )
    dead_time: float = key(
        0.0, "known delay of thrust, which is predicted; with any lag that motor_lag does not model", "[0, 0.5]", "s"
    )
    motor_lag: float = key(
        0.0, "known time constant of the rotor thrusts, which then are states of the model; 0: no lag", "[0, 0.5]", "s"
    )
    motor_lead: float = key(
        0.0, "rotors' lag that is inverted behind the MPC; cheaper than motor_lag; 0: none", "[0, 0.5]", "s"
    )
    rate: float = key(50.0, "control rate", "[1, 1000]", "Hz")
    position_weight: Triple = key(
        (10.0, 10.0, 10.0), "weight of the squared position error, world axes, m^-2", "[0, 1e6]", tuned="1..1000:log"
    )
    attitude_weight: tuple[float, float, float, float] = key(
        (0.0, 0.1, 0.1, 0.1), "on the squared attitude error, w first", "[0, 1e6]", tuned="0.01..10:log"
    )
    attitude_error: Literal["plain", "body", "world"] = key(
        "plain", "plain: q - q_ref, as published; body: q_ref^-1 o q, roll, pitch and yaw errors; world: q o q_ref^-1"
    )
    velocity_weight: Triple = key(
        (0.05, 0.05, 0.05), "on the squared velocity error, s^2 m^-2", "[0, 1e6]", tuned="0.005..5:log"
    )
    rate_weight: Triple = key(
        (0.05, 0.05, 0.05), "weight of the squared body rate error, s^2", "[0, 1e6]", tuned="0.005..5:log"
    )
    input_weight: float = key(
        0.1, "weight of the squared thrust error divided by thrust_max", "(0, 1e6]", tuned="0.01..1:log"
    )
    terminal_weight: float = key(
        0.0, "factor on the weights of the last state; 0: no terminal cost, as published", "[0, 1e6]"
    )
    feedforward: bool = key(
        True, "compute the reference attitude, rates and thrusts with the controller's model of the air"
    )
    initial_iterations: int = key(400, "largest number of SQP iterations before the first input", "[1, 1000]")
    distance_limit: float = key(
        10.0, "largest position error that the MPC acts on; a larger one is reduced to this length", "(0, 1e6]", "m"
    )

    def check_together(self) -> None:
        if self.control_period > self.node_period + 1e-12:
            raise UsageError(
                f"controller.rate={self.rate:g}: a control period of {self.control_period:g} s must not exceed the node"
                f" period of {self.node_period:g} s (horizon / nodes)"
            )
        if self.motor_lag and self.motor_lead:
            raise UsageError(
                f"controller.motor_lead={self.motor_lead:g}: must be 0 where controller.motor_lag={self.motor_lag:g}"
                " models the rotors' lag: it is inverted or planned with, not both"
            )
        if self.first_node and not self.control_period - 1e-12 <= self.first_node <= self.node_period + 1e-12:
            raise UsageError(
                f"controller.first_node={self.first_node:g}: must be 0 or between the control period of"
                f" {self.control_period:g} s and the mean node period of {self.node_period:g} s (horizon / nodes)"
            )

    @property
    def control_period(self) -> float:
        """Time between control steps (s)."""
        return 1.0 / self.rate

    @property
    def known_lag(self) -> float:
        """Time constant (s) of the rotors that the controller knows of, be it planned with or inverted."""
        return self.motor_lag or self.motor_lead

    @property
    def node_period(self) -> float:
        """Mean time between shooting nodes (s)."""
        return self.horizon / self.nodes

    @property
    def node_periods(self) -> np.ndarray:
        """Time between shooting nodes, (N,) (s).

        With first_node > 0: a geometric series that begins with it, rounded to control instants. A shorter first node
        makes the feedback stiffer and the delay margin smaller. With a control period T and an unmodelled dead time d
        between command and thrust, first_node = T + 2 d is a good choice: the middle of the first node is then where
        the middle of the held command acts.
        """
        if not self.first_node:
            return np.full(self.nodes, self.node_period)
        longest = np.floor(self.node_period * self.rate + 1e-9)
        first = min(max(1.0, np.floor(self.first_node * self.rate + 0.5)), longest)
        total = self.horizon * self.rate
        ends = np.floor(first * _geometric_sums(self.nodes, total / first) + 0.5)
        ends[-1] = total
        return np.diff(ends, prepend=0.0) * self.control_period

    @property
    def node_times(self) -> np.ndarray:
        """Times of the shooting nodes, from now, (N + 1,) (s)."""
        if not self.first_node:
            return self.node_period * np.arange(self.nodes + 1)
        return np.concatenate([[0.0], np.cumsum(self.node_periods)])

    @property
    def samples(self) -> int:
        """Samples of the reference in each node, s: at its start, and with input_hold=deviation in its middle."""
        return SAMPLES if self.input_hold == "deviation" else 1

    @property
    def reference_times(self) -> np.ndarray:
        """Times at which the reference is sampled, from now, (s N + 1,) (s)."""
        times = self.node_times
        if self.samples == 1:
            return times
        middles = (times[:-1] + times[1:]) / 2
        return np.append(np.column_stack([times[:-1], middles]).ravel(), times[-1])

    @property
    def node_share(self) -> np.ndarray:
        """Weight of each node, (N,): its length divided by the mean one."""
        return self.node_periods / self.node_period

    def state_weight(self) -> np.ndarray:
        """Diagonal of Q, (13,)."""
        q = np.zeros(N_STATE)
        q[POSITION] = self.position_weight
        q[ATTITUDE] = self.attitude_weight
        q[VELOCITY] = self.velocity_weight
        q[RATE] = self.rate_weight
        return q

    def thrust_weight(self, vehicle: Vehicle) -> np.ndarray:
        """Diagonal of R on thrusts in N, (n,)."""
        return np.full(vehicle.n_rotors, self.input_weight / vehicle.thrust_max**2)


@cache
def _geometric_sums(terms: int, total: float) -> np.ndarray:
    """Partial sums, (terms,), of the series 1 + g + g^2 + .. whose sum is total; g >= 1 is found by bisection."""
    low = 1.0
    high = max(total, 1.0)
    sums = np.arange(1.0, terms + 1)
    for _ in range(100):
        ratio = (low + high) / 2
        sums = np.cumsum(ratio ** np.arange(terms))
        low, high = (low, ratio) if sums[-1] > total else (ratio, high)
    return sums
