"""A plant whose truth is a model identified from flights: rigid body, thrust as commanded, identified forces beyond it.

    v' = R ((0, 0, sum u_i / m) + a_model(R^T v, w, u) + noise) + g
    w' = J^-1 (G u + tau_model + noise - w x J w)

Commands are clipped to the vehicle's limits. The model is what its checkpoint holds: drag, lumped blade element, or a
Gaussian process on its mean function (its mean; outside the fit's range it goes back to the mean function). What the
accelerometer of the logs read beside motion is in the model's offsets, so it is here too. Noise: white, by its spectral
density, drawn once per integration step h with standard deviation density / sqrt(h).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from quadexp.air.base import Residual
from quadexp.physics.integrator import rk4_step
from quadexp.physics.rigid_body import body_features, state_derivative
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.world.period import NoisyPeriod, unit_attitude


class FromModelPlant:
    """An identified model as a Plant.

    vehicle: the rigid body. model: forces and torques beyond it. step: largest integration step (s).
    force_noise_density: N/sqrt(Hz). torque_noise_density: N m/sqrt(Hz).
    """

    def __init__(
        self,
        vehicle: Vehicle,
        model: Residual,
        *,
        step: float = 1e-3,
        force_noise_density: float = 0.0,
        torque_noise_density: float = 0.0,
        backend: str = "auto",
    ) -> None:
        self.vehicle, self.step = vehicle, step
        self._model = model
        density = np.array([force_noise_density / vehicle.mass] * 3 + [torque_noise_density] * 3)
        parameters = np.concatenate([density, model.theta])
        self._period = NoisyPeriod(_one_step(vehicle, model), parameters, step, backend)

    def reset(self) -> None:
        """See Plant.reset; this plant remembers nothing."""

    def advance(
        self, x: np.ndarray, u: np.ndarray, duration: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """See Plant.advance; RK4 with the noise held over each step."""
        return self._period.advance(x, u, duration, rng)

    def residual(self) -> Residual:
        """See Plant.residual: the model itself; noise and clipping left out."""
        return self._model


def _one_step(vehicle: Vehicle, model: Residual) -> ca.Function:
    """(x, u, noise (6,) standard normal, [densities (6,) of a and tau, theta], step (s)) -> x_next, specific force."""
    n = vehicle.n_rotors
    x, u, y = ca.SX.sym("x", N_STATE), ca.SX.sym("u", n), ca.SX.sym("y", 6)
    features = ca.Function("features", [x, u], [body_features(x, u)])
    derivative = ca.Function("derivative", [x, u, y], [state_derivative(x, u, vehicle, y)])

    x, command = ca.MX.sym("x", N_STATE), ca.MX.sym("u", n)
    noise, parameters, step = ca.MX.sym("noise", 6), ca.MX.sym("parameters", 6 + len(model.theta)), ca.MX.sym("step")
    density, theta = ca.vertsplit(parameters, [0, 6, 6 + len(model.theta)])
    held = noise * density / ca.sqrt(step)
    thrusts = ca.fmin(ca.fmax(command, vehicle.thrust_min), vehicle.thrust_max)

    def correction(state: ca.MX) -> ca.MX:
        return ca.densify(model.function(features(state, thrusts), theta)[0]) + held

    x_next = unit_attitude(rk4_step(lambda state: derivative(state, thrusts, correction(state)), x, step))
    reading = ca.vertcat(0, 0, ca.sum1(thrusts) / vehicle.mass) + correction(x_next)[:3]
    return ca.Function("model_step", [x, command, noise, parameters, step], [x_next, reading])
