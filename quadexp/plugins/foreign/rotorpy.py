"""RotorPy's multirotor (Folk, Paulos and Kumar 2023; version 3.0) as a plant: its equations, written anew in CasADi.

Rotor i at r_i turns with w_i, its reaction torque has the sign s_i about +z_body; v is the air-relative body velocity,
v_i = v + w x r_i that of the rotor's hub, [v_i]_xy its part in the plane of the rotor:

    w_i'  = (clip(sqrt(u_i / k)) - w_i) / tau                                   k, k_m: thrust, torque per speed squared
    T_i   = (k w_i^2 + k_h |[v_i]_xy|^2) e_z                                    thrust and translational lift
    H_i   = -w_i diag(k_d, k_d, k_z) v_i                                        rotor drag, and loss of thrust to inflow
    F     = sum_i (T_i + H_i) - |v| diag(c_D) v                                 N; parasitic drag
    Gamma = sum_i (r_i x (T_i + H_i) + s_i k_m w_i^2 e_z - k_flap w_i v_i x e_z)        N m
    v'    = R F / m + g,   J w' = Gamma - w x J w

k, k_m, r_i, s_i, m and J are the vehicle's. RotorPy's contact with the ground is left out (it is off there too by
default), and its noise of the motors, which is zero for the Hummingbird.

RotorPy: MIT licence, copyright 2023 RotorPy Authors. Folk, Paulos, Kumar: "RotorPy: A Python-based Multirotor Simulator
with Aerodynamics for Education and Research", arXiv 2306.04485.
"""

from __future__ import annotations

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.models.build_context import BuildContext
from quadexp.models.residual import Residual, feature_names, symbolic_residual
from quadexp.parts.settings import Triple, key, keyed
from quadexp.physics.blade_element import TINY_SPEED
from quadexp.physics.expression import Expression, limited, symbols
from quadexp.physics.motor import lagging_rk4_step, lagging_thrust
from quadexp.physics.rigid_body import body_features, state_derivative
from quadexp.physics.rotation import along_z, with_unit_attitude
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.world.base import PlantPart
from quadexp.world.integrator import STEP_INPUTS, STEP_OUTPUTS, Equations, RotorSpeedPlant

# Places among the parameters.
PARASITIC = slice(0, 3)
ROTOR_DRAG, INFLOW, LIFT, FLAPPING, LAG, SPEED_MIN, SPEED_MAX = range(3, 10)
AIR = slice(0, 7)
N_PARAMETERS = 10  # of the function below
SLOWEST = 0.01  # share of rotor_speed_max, below which a controller believes that rotors do not go: w = sqrt(u / k) has
# no slope at u = 0


@keyed
class RotorPy(PlantPart):
    """Air and motors of RotorPy 3.0's Multirotor (Folk et al. 2023), with the numbers of its Hummingbird."""

    aero: bool = key(True, "forces and torques of the air; false: thrust and reaction torque of the rotors alone")
    parasitic_drag: Triple = key(
        (0.5e-2, 0.5e-2, 1e-2),
        "drag of the airframe per |v| v, body axes (c_Dx, c_Dy, c_Dz)",
        "[0, 100]",
        "N s^2/m^2",
        when="aero",
    )
    rotor_drag: float = key(
        1.19e-4, "in-plane drag of a rotor per speed of rotor and air (k_d)", "[0, 1]", "kg/rad", when="aero"
    )
    inflow_drag: float = key(
        2.32e-4,
        "thrust lost to the flow along the rotor's axis, per speed of both (k_z)",
        "[0, 1]",
        "kg/rad",
        when="aero",
    )
    translational_lift: float = key(
        3.39e-3, "thrust gained by a rotor per square of the flow in its plane (k_h)", "[0, 1]", "kg/m", when="aero"
    )
    flapping: float = key(
        0.0, "flapping moment of a rotor per speed of rotor and air (k_flap)", "[0, 1]", "kg m/rad", when="aero"
    )
    motor_lag: float = key(0.005, "time constant of the rotor speeds (tau_m); 0: none", "[0, 1]", "s")
    rotor_speed_min: float = key(0.0, "least rotor speed", "[0, 1e5]", "rad/s")
    rotor_speed_max: float = key(1500.0, "largest rotor speed", "(0, 1e5]", "rad/s")

    former_kind = "rotorpy"

    def build(self, context: BuildContext) -> RotorPyPlant:
        return RotorPyPlant(context.vehicle, self)


class RotorPyPlant(RotorSpeedPlant):
    """RotorPy's Multirotor as a Plant.

    vehicle: with thrust_coefficient. After `advance`: rotor_speed (n,) (rad/s). Raises UsageError where the vehicle has
    no thrust_coefficient, or its rotors need more than rotor_speed_max to hover.
    """

    def __init__(self, vehicle: Vehicle, keys: RotorPy) -> None:
        self.keys = keys
        if vehicle.thrust_coefficient is None:
            raise UsageError(
                f"plant=rotorpy: vehicle={vehicle.name} has no vehicle.thrust_coefficient (thrust per rotor speed"
                " squared); vehicle=hummingbird has"
            )
        hover = float(np.sqrt(vehicle.hover_thrust / vehicle.thrust_coefficient))
        if not self.keys.rotor_speed_min < hover < self.keys.rotor_speed_max:
            raise UsageError(
                f"plant.rotor_speed_max: vehicle={vehicle.name} hovers at {hover:.4g} rad/s,"
                f" outside ({self.keys.rotor_speed_min:g}, {self.keys.rotor_speed_max:g})"
            )
        super().__init__(vehicle, _equations(vehicle), self._values(), step=keys.step, backend=keys.backend)

    def initial(self, thrust: np.ndarray) -> np.ndarray:
        speed = np.sqrt(thrust / self.vehicle.static_thrust_coefficient)
        return np.clip(speed, self.keys.rotor_speed_min, self.keys.rotor_speed_max)

    def _values(self) -> np.ndarray:
        """Parameters of the equations, (10,)."""
        keys = self.keys
        air = np.hstack(
            [keys.parasitic_drag, keys.rotor_drag, keys.inflow_drag, keys.translational_lift, keys.flapping]
        )
        return np.hstack([air * keys.aero, keys.motor_lag, keys.rotor_speed_min, keys.rotor_speed_max])

    def residual(self) -> Residual:
        """All but the lag of the motors, which controller.motor_lag says."""
        n = self.vehicle.n_rotors
        vehicle = self.vehicle
        z, theta = symbols(ca.SX, z=len(feature_names(n)), theta=N_PARAMETERS)
        command = z[6:]
        w = _commanded_speed(command, vehicle, SLOWEST * theta[SPEED_MAX], theta[SPEED_MAX])
        force, torque = wrench(z[:3], z[3:6], w, vehicle, theta[AIR])
        nominal = vehicle.allocation @ command
        acceleration = (force - along_z(nominal[0])) / vehicle.mass
        outputs = ca.vertcat(acceleration, torque - nominal[1:])
        return symbolic_residual("plant", outputs, z, theta, self._values(), source="plant equations")


def wrench(
    v: Expression, rate: Expression, w: Expression, vehicle: Vehicle, air: Expression
) -> tuple[Expression, Expression]:
    """Force (3,) (N) and torque (3,) (N m) of rotors and air, body frame; see the module.

    v: air-relative velocity, body frame (3,) (m/s). rate: (3,) (rad/s). w: rotor speeds (n,) (rad/s). air: [c_D (3,),
    k_d, k_z, k_h, k_flap].
    """
    k = vehicle.static_thrust_coefficient
    speed = ca.sqrt(ca.sumsqr(v) + TINY_SPEED**2)  # which has a slope at rest
    force = -speed * air[PARASITIC] * v
    torque = type(v)(3, 1)
    up = ca.DM([0, 0, 1])
    rotor_drag = ca.vertcat(air[ROTOR_DRAG], air[ROTOR_DRAG], air[INFLOW])
    for i, (position, spin) in enumerate(zip(vehicle.rotor_position, vehicle.rotor_spin, strict=True)):
        r = ca.DM(position)
        hub = v + ca.cross(rate, r)
        at_hub = up * (k * w[i] ** 2 + air[LIFT] * (hub[0] ** 2 + hub[1] ** 2)) - w[i] * rotor_drag * hub
        force += at_hub
        torque += ca.cross(r, at_hub) + spin * vehicle.torque_coefficient * k * w[i] ** 2 * up
        torque -= air[FLAPPING] * w[i] * ca.cross(hub, up)
    return force, torque


def _commanded_speed(u: Expression, vehicle: Vehicle, least: Expression, largest: Expression) -> Expression:
    """Rotor speeds (n,) (rad/s) that thrusts u (n,) (N) ask for, within the limits."""
    k = vehicle.static_thrust_coefficient
    return ca.sqrt(limited(u, k * least**2, k * largest**2) / k)


def derivative(vehicle: Vehicle) -> ca.Function:
    """(x (13,), w (n,) (rad/s), parameters) -> x' (13,), and the specific force (3,), body frame (m/s^2)."""
    n = vehicle.n_rotors
    x, w, parameters = symbols(ca.SX, x=N_STATE, w=n, parameters=N_PARAMETERS)
    z = body_features(x, w)
    force, torque = wrench(z[:3], z[3:6], w, vehicle, parameters[AIR])
    motion = state_derivative(x, ca.SX(n, 1), vehicle, ca.vertcat(force / vehicle.mass, torque))
    return ca.Function("rotorpy_derivative", [x, w, parameters], [motion, force / vehicle.mass])


def _equations(vehicle: Vehicle) -> Equations:
    """RK4, the rotors' lag exact; inner states are the rotor speeds, and there is no noise."""
    n = vehicle.n_rotors
    f = derivative(vehicle)
    s, u, noise, parameters, step = symbols(ca.SX, s=N_STATE + n, u=n, noise=0, parameters=N_PARAMETERS, step=1)
    command = _commanded_speed(u, vehicle, parameters[SPEED_MIN], parameters[SPEED_MAX])
    lags = parameters[LAG] > 0
    begun = ca.vertcat(s[:N_STATE], ca.if_else(lags, s[N_STATE:], command))
    lag = ca.if_else(lags, parameters[LAG], 1)  # s; any, where the speeds are the commanded ones already
    after = lagging_rk4_step(lambda x, w: f(x, w, parameters)[0], begun, command, step, lag)
    after = with_unit_attitude(after)
    reading = f(after[:N_STATE], after[N_STATE:], parameters)[1]
    results = ca.cse([after, reading])
    middle = lagging_thrust(begun[N_STATE:], command, step / 2, lag)
    return Equations(
        ca.Function("rotorpy_step", [s, u, noise, parameters, step], results, STEP_INPUTS, STEP_OUTPUTS),
        thrust=ca.Function("thrust", [s, u, parameters, step], [vehicle.static_thrust_coefficient * middle**2]),
    )
