"""A plant whose truth is a model identified from flights: rigid body, thrust as commanded, identified forces beyond it.

    v' = R ((0, 0, sum u_i / m) + a_model(R^T v, w, u) + noise) + g
    w' = J^-1 (G u + tau_model + noise - w x J w)

Commands are clipped to the vehicle's limits. The model is what its checkpoint holds: drag, lumped blade element, or a
Gaussian process on its mean function (its mean; outside the fit's range it goes back to the mean function). What the
accelerometer of the logs read beside motion is in the model's offsets, so it is here too. Noise: white, by its spectral
density, drawn once per integration step h with standard deviation density / sqrt(h).
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np

from quadexp.backend import BufferedFunction, realise, resolve
from quadexp.dynamics.integrator import rk4_step
from quadexp.dynamics.rigid_body import body_features, state_derivative
from quadexp.residual.base import Residual
from quadexp.state import ATTITUDE, N_STATE, RATE, VELOCITY
from quadexp.vehicle import Vehicle


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
        self._density = np.array([force_noise_density / vehicle.mass] * 3 + [torque_noise_density] * 3)
        self._backend = resolve(backend)
        self._advance: dict[int, BufferedFunction] = {}

    def reset(self) -> None:
        """See Plant.reset; this plant remembers nothing."""

    def advance(
        self, x: np.ndarray, u: np.ndarray, duration: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """See Plant.advance; RK4 with the noise held over each step."""
        steps = max(1, math.ceil(duration / self.step - 1e-9))
        function = self._function(steps)
        arguments, h = function.arguments, duration / steps
        arguments["x"][...] = x
        arguments["u"][...] = np.clip(u, self.vehicle.thrust_min, self.vehicle.thrust_max)
        arguments["step"][...] = h
        rng.standard_normal(out=arguments["noise"])
        # What is kept in memory is column by column: six numbers a step.
        arguments["noise"].reshape(-1, 6)[...] *= self._density / math.sqrt(h)
        function()
        return function.results["x_next"].copy(), function.results["specific_force"].copy()

    def residual(self) -> Residual:
        """See Plant.residual: the model itself; noise and clipping left out."""
        return self._model

    def _function(self, steps: int) -> BufferedFunction:
        if steps not in self._advance:
            function = BufferedFunction(realise(_advance_function(self.vehicle, self._model, steps), self._backend))
            function.arguments["theta"][...] = self._model.theta
            self._advance[steps] = function
        return self._advance[steps]


def _advance_function(vehicle: Vehicle, model: Residual, steps: int) -> ca.Function:
    """(x, u, noise (6, steps) on [a, tau], theta, step (s)) -> x_next, specific force at the end."""
    n = vehicle.n_rotors
    x, u, y = ca.SX.sym("x", N_STATE), ca.SX.sym("u", n), ca.SX.sym("y", 6)
    features = ca.Function("features", [x, u], [body_features(x, u)])
    derivative = ca.Function("derivative", [x, u, y], [state_derivative(x, u, vehicle, y)])

    x, u = ca.MX.sym("x", N_STATE), ca.MX.sym("u", n)
    noise, theta, step = ca.MX.sym("noise", 6), ca.MX.sym("theta", len(model.theta)), ca.MX.sym("step")

    def correction(state: ca.MX) -> ca.MX:
        return ca.densify(model.function(features(state, u), theta)[0]) + noise

    after = rk4_step(lambda state: derivative(state, u, correction(state)), x, step)
    q = after[ATTITUDE]
    after = ca.vertcat(after[:3], q / ca.norm_2(q), after[VELOCITY], after[RATE])
    reading = ca.vertcat(0, 0, ca.sum1(u) / vehicle.mass) + correction(after)[:3]
    one = ca.Function("model_step", [x, u, noise, theta, step], [after, reading])

    noises = ca.MX.sym("noise", 6, steps)
    state, readings = x, None
    for column in ca.horzsplit(noises):
        state, readings = one(state, u, column, theta, step)
    return ca.Function(
        "model_advance", [x, u, noises, theta, step], [state, readings],
        ["x", "u", "noise", "theta", "step"], ["x_next", "specific_force"],
    )  # fmt: skip
