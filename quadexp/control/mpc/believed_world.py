"""Planning in the world that an observer believes in (control.belief).

    disturbance   F / m and J^-1 tau are parameters of the prediction model
    wind          the plan is made in the frame that moves with the air from now on: v - w, p*(t) - w t. In a constant
                  wind the equations of motion there are those of still air, so that nothing changes in the model.
    thrust scale  the inputs of the plan are the thrusts that are delivered, s u, within s times the limits

The last solution is kept in the air's frame: when the wind is believed to be another, or a control period has passed,
it is moved into the new one.
"""

from __future__ import annotations

import numpy as np

from quadexp.control.base import Window
from quadexp.control.belief import no_belief
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.physics.state import POSITION, VELOCITY


class BelievedWorld:
    """From the world to the plan's frame and back.

    mpc: made with disturbed=True. node_times: of the reference, from the measurement on, (k,) (s).
    belief: the one to enter with; set it before each step.
    """

    def __init__(self, mpc: ModelPredictiveController, node_times: np.ndarray) -> None:
        self._mpc, self._times = mpc, node_times[:, None]
        self._period = mpc.settings.control_period
        self._horizon = (mpc.settings.dead_time + mpc.settings.node_times)[:, None]
        self._inverse_inertia = np.linalg.inv(mpc.vehicle.inertia_matrix)
        self._disturbance, self._scale = np.zeros(6), 1.0
        self.reset()

    def reset(self) -> None:
        """Begin a flight in the world of the model."""
        self.belief, self._wind = no_belief(), np.zeros(3)
        self._tell()

    def _tell(self) -> None:
        belief, mpc, scale = self.belief, self._mpc, self.belief.thrust_scale
        self._disturbance[:3] = belief.force / mpc.vehicle.mass
        self._disturbance[3:] = self._inverse_inertia @ belief.torque
        mpc.set_disturbance(self._disturbance)
        if scale != self._scale:
            mpc.set_thrust_scale(scale)
            self._scale = scale

    def enter(self, x: np.ndarray, window: Window) -> tuple[np.ndarray, Window]:
        """State (13,) and window in the plan's frame; the MPC is told of the rest."""
        self._tell()
        wind = self.belief.wind
        if not (wind.any() or self._wind.any()):
            return x, window
        self._carry(wind)
        x, state = x.copy(), window.state.copy()
        x[VELOCITY] -= wind
        state[:, VELOCITY] -= wind
        state[:, POSITION] -= self._times * wind
        return x, window._replace(state=state)

    def commanded(self, thrust: np.ndarray) -> np.ndarray:
        """The command, (n,) (N), that delivers a planned thrust."""
        if self._scale == 1.0:
            return thrust
        vehicle = self._mpc.vehicle
        return np.clip(thrust / self._scale, vehicle.thrust_min, vehicle.thrust_max)

    def _carry(self, wind: np.ndarray) -> None:
        """Move the last solution: its frame met the world one control period ago, the new one does so now."""
        X, change = self._mpc.prediction[0], wind - self._wind
        X[:, VELOCITY] -= change
        X[:, POSITION] += self._period * wind - self._horizon * change
        self._wind = wind.copy()
