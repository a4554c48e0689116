"""A rigid body under a control law, and what a hand-made reference shows it."""

from dataclasses import replace

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.control.base import Measurement, Window
from quadexp.experiment.build import build_vehicle
from quadexp.parts.compose import compose
from quadexp.physics.rigid_body import state_derivative
from quadexp.physics.state import ATTITUDE, N_STATE

VEHICLES = ("torrente", "blackbird", "crazyflie", "cf2x_L250", "cf21B_500", "hummingbird", "lei_li")


def vehicle_of(base, **changes):
    made = build_vehicle(compose([f"vehicle={base}"]).vehicle)
    return replace(made, **changes) if changes else made


def hovering(vehicle, position=(0.0, 0.0, 0.0), yaw=0.0):
    """The window of a held point."""
    state = np.zeros((3, N_STATE))
    state[:, :3], state[:, 3], state[:, 6] = position, np.cos(yaw / 2), np.sin(yaw / 2)
    path = np.zeros((5, 3))
    path[0] = position
    return Window(state, np.full((2, vehicle.n_rotors), vehicle.hover_thrust), path, np.array([yaw, 0.0, 0.0]))


def at_rest(position=(0.0, 0.0, 0.0), attitude=None):
    q = [1.0, 0, 0, 0] if attitude is None else attitude.as_quat(scalar_first=True)
    return np.concatenate([position, q, np.zeros(6)])


class Body:
    """The rigid body, integrated by RK4 in steps of at most 2 ms. force: world (N), torque: body (N m), of the time."""

    def __init__(self, vehicle, force=lambda t: np.zeros(3), torque=lambda t: np.zeros(3)):
        self.vehicle, self.force, self.torque = vehicle, force, torque
        self._steps = {}

    def advance(self, x, u, t, duration):
        n = max(1, round(duration / 2e-3))
        middles = t + (np.arange(n) + 0.5) * duration / n
        force = np.stack([np.concatenate([self.force(at), self.torque(at)]) for at in middles], axis=1)
        if n not in self._steps:
            self._steps[n] = self._function(n)
        return self._steps[n](x, u, force, duration / n).full().ravel()

    def _function(self, n):
        x, u, F, h = ca.SX.sym("x", 13), ca.SX.sym("u", self.vehicle.n_rotors), ca.SX.sym("F", 6, n), ca.SX.sym("h")
        after = x
        for i in range(n):

            def f(x, i=i):
                slope = state_derivative(x, u, self.vehicle, ca.vertcat(ca.SX(3, 1), F[3:, i]))
                return slope + ca.vertcat(ca.SX(7, 1), F[:3, i] / self.vehicle.mass, ca.SX(3, 1))

            k_1 = f(after)
            k_2 = f(after + h / 2 * k_1)
            k_3 = f(after + h / 2 * k_2)
            k_4 = f(after + h * k_3)
            after = after + h / 6 * (k_1 + 2 * k_2 + 2 * k_3 + k_4)
            q = after[ATTITUDE]
            after = ca.vertcat(after[:3], q / ca.norm_2(q), after[7:])
        return ca.Function("body", [x, u, F, h], [after])


def fly(body, controller, x, duration, window, before=lambda t: None):
    """States (k + 1, 13) and commands (k, n); window: of the time; before: called with the time before each step."""
    period = controller.control_period
    states, commands = [x], []
    controller.forget()
    controller.reset(x, window(0.0))
    for k in range(round(duration / period)):
        t = k * period
        before(t)
        u, record = controller.step(Measurement(t, x, None, None), window(t))
        assert np.isfinite(u).all() and record.status >= 0
        x = body.advance(x, u, t, period)
        states.append(x)
        commands.append(u)
    return np.array(states), np.array(commands)


def rotation(x):
    return Rotation.from_quat(x[..., ATTITUDE], scalar_first=True)
