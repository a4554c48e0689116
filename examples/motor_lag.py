"""A plant of your own: rotors whose thrust follows the command with a lag, and linear drag on the airframe.

    T_i' = (u_i - T_i) / tau,        a_body = -D v_body

The rotors' thrust is a state of the plant, beside the 13 numbers that a controller measures: `reset` forgets it.
"""

import casadi as ca
import numpy as np

from quadexp.air.linear_drag import linear_drag_residual
from quadexp.physics.drag import linear_drag_force
from quadexp.physics.integrator import rk4_step
from quadexp.physics.rigid_body import body_features, state_derivative
from quadexp.physics.state import ATTITUDE, N_STATE


class MotorLagPlant:
    """time_constant: tau, s. drag: (3,) 1/s. step: of the integrator, s."""

    # Arguments: the vehicle, `step`, and the keys under `options` of plant/motor_lag.yaml.
    def __init__(self, vehicle, *, step, time_constant=0.03, drag=(0.3, 0.3, 0.1)):
        self.vehicle, self.drag, self.step = vehicle, drag, step
        n = vehicle.n_rotors
        x, u, dt = ca.SX.sym("x", N_STATE + n), ca.SX.sym("u", n), ca.SX.sym("dt")

        def derivative(x):
            state, thrust = x[:N_STATE], x[N_STATE:]
            air = linear_drag_force(body_features(state, thrust)[:3], ca.DM(list(drag)))
            correction = ca.vertcat(air, 0, 0, 0)
            return ca.vertcat(state_derivative(state, thrust, vehicle, correction), (u - thrust) / time_constant)

        after = rk4_step(derivative, x, dt)
        after[ATTITUDE] /= ca.norm_2(after[ATTITUDE])
        air = linear_drag_force(body_features(x[:N_STATE], u)[:3], ca.DM(list(drag)))
        reading = air + ca.vertcat(0, 0, ca.sum1(x[N_STATE:]) / vehicle.mass)
        self._step = ca.Function("motor_lag_step", [x, u, dt], [after])
        self._reading = ca.Function("motor_lag_reading", [x], [reading])
        self.reset()

    def reset(self):
        """Begin a flight: forget what an earlier one left behind."""
        self.thrust = np.full(self.vehicle.n_rotors, self.vehicle.hover_thrust)

    def advance(self, x, u, duration, rng):
        """State (13,) after holding the thrusts u (n,) N for `duration` s, and the accelerometer's reading then."""
        steps = max(1, round(duration / self.step))
        full = np.concatenate([x, self.thrust])
        for _ in range(steps):
            full = self._step(full, u, duration / steps).full().ravel()
        self.thrust = full[N_STATE:]
        return full[:N_STATE], self._reading(full).full().ravel()

    def residual(self):
        """What perfect_mpc is told: these equations as a Residual, as far as it can know them."""
        return linear_drag_residual(self.vehicle, self.drag, source="motor_lag plant, without its lag")
