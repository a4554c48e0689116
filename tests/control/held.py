"""A user's own controller: it commands what it is given, and keeps every state and window of its steps."""

from collections.abc import Iterator

import numpy as np

from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import StepRecord


class Held:
    """thrust: (n,) (N), or one for every step. given: state and window of every step since `reset`. belief: the
    last."""

    reference_period, backend, residual_name, source, settings = 0.0, "interpreted", "held", "", None

    def __init__(self, vehicle, thrust, period=0.02, node_times=(0.0,), residual=None):
        self.vehicle, self.thrust, self.control_period, self.residual = vehicle, thrust, period, residual
        self.node_times, self.inputs = np.array(node_times), []

    def forget(self):
        pass

    def reset(self, x, window):
        self.inputs = []

    def believe(self, belief):
        self.belief = belief

    def step(self, measurement, window):
        self.inputs.append((measurement.state, window))
        thrust = next(self.thrust) if isinstance(self.thrust, Iterator) else np.array(self.thrust, float)
        return thrust, StepRecord(0.0, Status.OK, 0, 0, 0.0)

    def log(self):
        return {}

    @property
    def states(self):
        """(k, 13)."""
        return np.array([state for state, _ in self.inputs])
