"""The simplified simulation of Torrente et al. 2021: rigid body, drag, motor loss, process noise.

    delivered thrust   t_i = clip(u_i - k u_i^2 / u_max - noise_i, 0, u_max)
    body force         F   = [0, 0, sum t_i + lift] - d v_b - c v_b |v_b| + noise          N, per axis; lift = k v_xy^2
    v'                     = R F / m + g
    w'                     = J^-1 (G t + noise - w x J w)

Every noise is white and given by its spectral density, held for 0.5 ms whatever the integration step h (see Held in
streams.py): in its mean over h, density / sqrt(h) times a standard normal number. The published code draws force and
torque with 0.005 N and N m at h = 0.5 ms: densities 1.118e-4. The motor noise's deviation grows with the root of the
normalised thrust, 0.02 sqrt(u / u_max) u_max at h = 0.5 ms: density 4.472e-4. The lift of rotors in forward flight is
that of Sun et al. 2022, zero by default.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.models.build_context import BuildContext
from quadexp.models.residual import Residual, feature_names, symbolic_residual
from quadexp.parts.settings import Settings, Triple, key, keyed, part
from quadexp.physics.drag import linear_drag_force, quadratic_drag_force
from quadexp.physics.expression import Expression, limited, symbols
from quadexp.physics.motor import thrust_loss
from quadexp.physics.rigid_body import body_features, state_derivative
from quadexp.physics.rotation import along_z
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.world.base import FORCE_DENSITY, TORQUE_DENSITY, PlantPart
from quadexp.world.integrator import STEP_INPUTS, STEP_OUTPUTS, Equations, SimulatedPlant, integrate


@dataclass(frozen=True)
class PlantEffects(Settings):
    """What acts on the vehicle besides its rotors and gravity, with the values of Torrente et al. 2021: their noise is
    an amplitude per step of 0.5 ms; as a spectral density it is amplitude * sqrt(0.0005 s). All zero: the ideal plant.
    """

    prefix = "plant."

    linear_drag: Triple = key((0.3, 0.3, 0.0), "linear drag coefficients, body axes", "[0, 100]", "N s/m")
    quadratic_drag: Triple = key((0.08, 0.08, 0.08), "quadratic drag coefficients, body axes", "[0, 100]", "N s^2/m^2")
    motor_loss: float = key(
        0.1 / 1.3**2, "share of the full thrust that motors lose; grows with thrust squared", "[0, 1)"
    )
    motor_noise_density: float = key(
        4.47213595499958e-4,
        "of normalised thrust's white noise at full thrust; grows with its root",
        "[0, 1]",
        "1/sqrt(Hz)",
    )
    force_noise_density: float = key(1.118033988749895e-4, FORCE_DENSITY)
    torque_noise_density: float = key(1.118033988749895e-4, TORQUE_DENSITY)
    lift: float = key(
        0.0, "k of the force k (v_x^2 + v_y^2) along z_body, v in body axes", "[0, 100]", "N s^2/m^2", noise=False
    )

    @classmethod
    def none(cls) -> PlantEffects:
        """The ideal plant: what the nominal model says is what happens."""
        return cls(ZERO, ZERO, 0.0, 0.0, 0.0, 0.0)

    @property
    def noisy(self) -> bool:
        """Whether there is noise at all."""
        return any((self.motor_noise_density, self.force_noise_density, self.torque_noise_density))

    def parameters(self) -> np.ndarray:
        """The numbers in the order of the plant's symbolic parameter vector, (11,)."""
        return np.hstack(astuple(self)).astype(float)


ZERO = (0.0, 0.0, 0.0)
N_EFFECTS = 11  # numbers of `parameters`
LINEAR_DRAG = slice(0, 3)
QUADRATIC_DRAG = slice(3, 6)
LOSS, MOTOR_NOISE, FORCE_NOISE, TORQUE_NOISE, LIFT = range(6, 11)  # places, as those above


@keyed
class Simplified(PlantEffects, PlantPart):
    """Torrente's simplified simulation."""

    former_kind = "simplified"
    former_keys = {"payload": 0.0}

    def build(self, context: BuildContext) -> SimplifiedPlant:
        return SimplifiedPlant(context.vehicle, part(PlantEffects, self), step=self.step, backend=self.backend)


class SimplifiedPlant(SimulatedPlant):
    """The simplified simulation as a Plant.

    vehicle: the true one. step: largest integration step (s); a control period is divided evenly.
    """

    def __init__(
        self, vehicle: Vehicle, effects: PlantEffects | None = None, *, step: float = 5e-4, backend: str = "auto"
    ) -> None:
        self.effects = effects or PlantEffects()
        equations = _equations(vehicle, self.effects.noisy)
        parameters = self.effects.parameters()
        super().__init__(vehicle, equations, parameters, step=step, backend=backend)

    def residual(self) -> Residual:
        """Drag and mean motor loss; noise and clipping left out."""
        n = self.vehicle.n_rotors
        z, theta = symbols(ca.SX, z=len(feature_names(n)), theta=N_EFFECTS)
        command = z[6:]
        delivered = _delivered_thrust(z[6:], theta, self.vehicle)
        nominal = along_z(ca.sum1(command) / self.vehicle.mass)
        torque = self.vehicle.allocation[1:] @ (delivered - command)
        acceleration = _body_acceleration(z[:3], delivered, theta, self.vehicle) - nominal
        outputs = ca.vertcat(acceleration, torque)
        return symbolic_residual("plant", outputs, z, theta, self.effects.parameters(), source="plant equations")


def _delivered_thrust(command: Expression, effects: Expression, vehicle: Vehicle) -> Expression:
    """Mean thrust that arrives, (n,) (N)."""
    return command - thrust_loss(command, effects[LOSS], vehicle.thrust_max)


def _body_acceleration(
    body_velocity: Expression, delivered: Expression, effects: Expression, vehicle: Vehicle
) -> Expression:
    """Acceleration by rotors and drag, body frame (m/s^2)."""
    force = linear_drag_force(body_velocity, effects[LINEAR_DRAG])
    force += quadratic_drag_force(body_velocity, effects[QUADRATIC_DRAG])
    lift = effects[LIFT] * ca.sumsqr(body_velocity[:2])
    return (force + along_z(ca.sum1(delivered) + lift)) / vehicle.mass


def _equations(vehicle: Vehicle, noisy: bool) -> Equations:
    """RK4 with the noise, (n + 6,) or none, held over each step; the parameters are PlantEffects.parameters."""
    n = vehicle.n_rotors
    x, u, noise, effects, step = symbols(ca.SX, x=N_STATE, u=n, noise=(n + 6) * noisy, effects=N_EFFECTS, step=1)
    scaled = noise / ca.sqrt(step) if noisy else ca.SX.zeros(n + 6)
    motor = effects[MOTOR_NOISE] * ca.sqrt(u * vehicle.thrust_max) * scaled[:n]
    delivered = limited(_delivered_thrust(u, effects, vehicle) - motor, 0, vehicle.thrust_max)
    force_noise = effects[FORCE_NOISE] * scaled[n : n + 3] / vehicle.mass
    torque_noise = effects[TORQUE_NOISE] * scaled[n + 3 :]

    def specific_force(state: Expression) -> Expression:
        body_velocity = body_features(state, delivered)[:3]
        return _body_acceleration(body_velocity, delivered, effects, vehicle) + force_noise

    def slope(state: Expression) -> Expression:
        """The rigid body is given what goes beyond the delivered thrust: drag, lift and noise."""
        nominal = along_z(ca.sum1(delivered) / vehicle.mass)
        return state_derivative(state, delivered, vehicle, ca.vertcat(specific_force(state) - nominal, torque_noise))

    after = integrate("rk4", slope, x, step)
    results = ca.cse([after, specific_force(after)])
    return Equations(ca.Function("plant_step", [x, u, noise, effects, step], results, STEP_INPUTS, STEP_OUTPUTS))
