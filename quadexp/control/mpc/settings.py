"""Settings of the model predictive controller, with the values of Torrente et al. 2021's simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.config.flight import MPCKeys
from quadexp.control.mpc.reference_thrust import SAMPLES
from quadexp.errors import UsageError
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle


@dataclass(frozen=True)
class MPCSettings(MPCKeys):
    """Horizon, weights and iteration limits (see MPCKeys for each with its unit and range).

    Every node weighs as much as its share of the horizon. *_weight: diagonal of Q on deviations in SI units.
    input_weight: diagonal of R on thrusts normalised by the largest one. terminal_weight: factor on Q at the last node.
    Raises UsageError where the periods contradict each other.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.control_period > self.node_period + 1e-12:
            raise UsageError(
                f"controller.rate={self.rate:g}: a control period of {self.control_period:g} s must not exceed the node"
                f" period of {self.node_period:g} s (horizon / nodes)"
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
    def node_period(self) -> float:
        """Mean time between shooting nodes (s)."""
        return self.horizon / self.nodes

    @property
    def node_periods(self) -> np.ndarray:
        """Time between shooting nodes, (N,) (s).

        With a first_node: a geometric series that begins with it, its nodes rounded to control instants, so that a
        reference is sampled at no other times. The first input is predicted to be held for first_node and is held for
        a control period T: with an unpredicted dead time d between command and thrust, first_node = T + 2 d centres the
        one on the other. A shorter one makes the controller stiffer and leaves less margin of dead time.
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
        """Shooting nodes from now, (N + 1,) (s)."""
        if not self.first_node:
            return self.node_period * np.arange(self.nodes + 1)
        return np.concatenate([[0.0], np.cumsum(self.node_periods)])

    @property
    def samples(self) -> int:
        """How many times in each node the reference is sampled, s: at its start; where thrusts vary, in its middle."""
        return SAMPLES if self.input_hold == "deviation" else 1

    @property
    def reference_times(self) -> np.ndarray:
        """When the reference is sampled, from now, (s N + 1,) (s)."""
        times = self.node_times
        if self.samples == 1:
            return times
        middles = (times[:-1] + times[1:]) / 2
        return np.append(np.stack([times[:-1], middles], axis=1).ravel(), times[-1])

    @property
    def node_share(self) -> np.ndarray:
        """Weight of each node, (N,): its length over the mean one; 1 where all are alike."""
        return self.node_periods / self.node_period

    def state_weight(self) -> np.ndarray:
        """Diagonal of Q, (13,)."""
        q = np.zeros(N_STATE)
        q[POSITION], q[ATTITUDE] = self.position_weight, self.attitude_weight
        q[VELOCITY], q[RATE] = self.velocity_weight, self.rate_weight
        return q

    def thrust_weight(self, vehicle: Vehicle) -> np.ndarray:
        """Diagonal of R on thrusts in N, (n,)."""
        return np.full(vehicle.n_rotors, self.input_weight / vehicle.thrust_max**2)


def _geometric_sums(terms: int, total: float) -> np.ndarray:
    """Partial sums, (terms,), of the geometric series 1 + g + g^2 + .. with that total; g >= 1, by bisection."""
    low, high, sums = 1.0, max(total, 1.0), np.arange(1.0, terms + 1)
    for _ in range(100):
        ratio = (low + high) / 2
        sums = np.cumsum(ratio ** np.arange(terms))
        low, high = (low, ratio) if sums[-1] > total else (ratio, high)
    return sums
