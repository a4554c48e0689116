"""A plant whose truth is a model identified from flights: rigid body, thrust as commanded, identified forces beyond it.

    v' = R ((0, 0, sum u_i / m) + a_model(R^T v, w, u) + noise) + g
    w' = J^-1 (G u + tau_model + noise - w x J w)

Commands are clipped to the vehicle's limits. The model is what its checkpoint holds: drag, lumped blade element, or a
Gaussian process on its mean function (its mean; outside the fit's range it goes back to the mean function). What the
accelerometer of the logs read beside motion is in the model's offsets, so it is here too. Noise: white, by its spectral
density, held for 0.5 ms whatever the integration step (see Held in streams.py).
"""

from __future__ import annotations

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.models.build_context import BuildContext
from quadexp.models.residual import Residual
from quadexp.parts.settings import REQUIRED, key, keyed
from quadexp.physics.expression import limited, split, symbols
from quadexp.physics.rigid_body import derivative_function, features_function
from quadexp.physics.rotation import along_z
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.world.base import FORCE_DENSITY, TORQUE_DENSITY, PlantPart
from quadexp.world.integrator import STEP_INPUTS, STEP_OUTPUTS, Equations, SimulatedPlant, integrate


@keyed
class FromModel(PlantPart):
    """A model identified from flights as the truth; see the top of this file. model: its checkpoint folder."""

    former_kind = "from_model"
    makes = "quadexp identify FLIGHT... --out models/NAME"
    model: str = key(REQUIRED, "checkpoint folder of the model that is taken as the truth", noise=False)
    residual: str = key("best", "which model of an identified vehicle; best: the one that identification chose")
    force_noise_density: float = key(0.0, FORCE_DENSITY)
    torque_noise_density: float = key(0.0, TORQUE_DENSITY)

    def build(self, context: BuildContext) -> FromModelPlant:
        """The model was fitted to context.assumed."""
        return FromModelPlant(
            context.vehicle,
            context.plant_model(self.model, self.residual),
            model_mass=None if context.assumed is context.vehicle else context.assumed.mass,
            step=self.step,
            force_noise_density=self.force_noise_density,
            torque_noise_density=self.torque_noise_density,
            backend=self.backend,
        )


class FromModelPlant(SimulatedPlant):
    """An identified model as a Plant.

    vehicle: the rigid body. model: forces and torques beyond it, as accelerations of a mass (kg; None: the vehicle's),
    which move a vehicle of another mass accordingly. step: largest integration step (s).
    force_noise_density: N/sqrt(Hz). torque_noise_density: N m/sqrt(Hz).
    """

    def __init__(
        self,
        vehicle: Vehicle,
        model: Residual,
        *,
        model_mass: float | None = None,
        step: float = 1e-3,
        force_noise_density: float = 0.0,
        torque_noise_density: float = 0.0,
        backend: str = "auto",
    ) -> None:
        self._model = model
        density = np.array([force_noise_density / vehicle.mass] * 3 + [torque_noise_density] * 3)
        parameters = np.concatenate([density, model.theta])
        equations = _equations(vehicle, model, model_mass, bool(density.any()))
        super().__init__(vehicle, equations, parameters, step=step, backend=backend)

    def residual(self) -> Residual:
        """The model itself; noise and clipping left out."""
        return self._model


def _equations(vehicle: Vehicle, model: Residual, model_mass: float | None, noisy: bool) -> Equations:
    """RK4, the noise, (6,) or none, held over each step; the parameters are [densities (6,) of a and tau, theta]."""
    n = vehicle.n_rotors
    features = features_function(vehicle)
    derivative = derivative_function(vehicle)
    x, command, noise, step, parameters = symbols(
        ca.MX, x=N_STATE, u=n, noise=6 * noisy, step=1, parameters=6 + len(model.theta)
    )
    density, theta = split(parameters, (6, len(model.theta)))
    held = noise * density / ca.sqrt(step) if noisy else ca.MX.zeros(6)
    thrusts = limited(command, vehicle.thrust_min, vehicle.thrust_max)

    def correction(state: ca.MX) -> ca.MX:
        wrench = ca.densify(model.function(features(state, thrusts), theta)[0])
        if model_mass is not None:
            wrench = ca.vertcat(wrench[:3] * (model_mass / vehicle.mass), wrench[3:])
        return wrench + held

    def slope(state: ca.MX) -> ca.MX:
        return derivative(state, thrusts, correction(state))

    after = integrate("rk4", slope, x, step)
    reading = along_z(ca.sum1(thrusts) / vehicle.mass) + correction(after)[:3]
    arguments = [x, command, noise, parameters, step]
    return Equations(ca.Function("model_step", arguments, [after, reading], STEP_INPUTS, STEP_OUTPUTS))
