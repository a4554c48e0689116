"""A plant of your own: rotors whose thrust follows the command with a lag, and linear drag on the airframe.

    T_i' = (u_i - T_i) / tau,        a_body = -D v_body

The rotors' thrusts are inner states of the plant, integrated with the 13 states that a controller measures.
"""

from dataclasses import dataclass

import casadi as ca

from quadexp.models.linear_drag import linear_drag_residual
from quadexp.parts.settings import Triple, key
from quadexp.physics.drag import linear_drag_force
from quadexp.physics.rigid_body import body_features, state_derivative
from quadexp.physics.state import N_STATE
from quadexp.world.base import PlantPart
from quadexp.world.integrator import Equations, SimulatedPlant, integrate


@dataclass(frozen=True, kw_only=True)
class MotorLag(PlantPart):
    """Rotors with a lag, and linear drag."""

    # The keys of plant=motor_lag, besides those of every plant (`step`); swept as plant.time_constant=0.02,0.04.
    time_constant: float = key(0.03, "tau of the rotors' thrusts", "[0.001, 1]", "s")
    drag: Triple = key((0.3, 0.3, 0.1), "D, body axes", "[0, 100]", "1/s")

    def build(self, context):
        return MotorLagPlant(context.vehicle, step=self.step, time_constant=self.time_constant, drag=self.drag)


class MotorLagPlant(SimulatedPlant):
    """time_constant: tau, s. drag: (3,) 1/s. step: of the integrator, s."""

    def __init__(self, vehicle, *, step, time_constant, drag):
        self.drag, n = drag, vehicle.n_rotors
        s, u, dt = ca.SX.sym("s", N_STATE + n), ca.SX.sym("u", n), ca.SX.sym("dt")
        noise, parameters = ca.SX.sym("noise", 0), ca.SX.sym("parameters", 0)

        def air(s):
            return linear_drag_force(body_features(s[:N_STATE], u)[:3], ca.DM(list(drag)))

        def slope(s):
            state, thrust = s[:N_STATE], s[N_STATE:]
            correction = ca.vertcat(air(s), 0, 0, 0)
            return ca.vertcat(state_derivative(state, thrust, vehicle, correction), (u - thrust) / time_constant)

        after = integrate("rk4", slope, s, dt)
        reading = air(after) + ca.vertcat(0, 0, ca.sum1(after[N_STATE:]) / vehicle.mass)
        one = ca.Function("motor_lag_step", [s, u, noise, parameters, dt], [after, reading])
        super().__init__(vehicle, Equations(one), step=step, backend="auto")

    def initial(self, thrust):
        """The inner states at the beginning of a flight: thrusts (n,), N."""
        return thrust

    def residual(self):
        """What perfect_mpc is given: these equations as a Residual, as far as it can know them."""
        return linear_drag_residual(self.vehicle, self.drag, source="motor_lag plant, without its lag")
