"""The first-principles Crazyflie of crazyflow, formerly drone-models, as a plant, written from the laws in CasADi.

Rotor i at r_i turns with n_i (rpm), its reaction torque has the sign s_i about +z_body; v is the air-relative body
velocity:

    n_i'  = c_1 (n*_i - n_i) + c_2 (n*_i^2 - n_i^2)         c: spin_up where n*_i > n_i, spin_down elsewhere
    f_i   = k_0 + k_1 n_i + k_2 n_i^2                       N; n*_i is its root for the commanded thrust u_i
    t_i   = m_0 + m_1 n_i + m_2 n_i^2                       N m
    F     = sum_i f_i e_z - diag(d) v                       N
    h     = -J_p N e_z,   N = sum_i s_i n_i pi / 30         angular momentum of the rotors, N m s
    Gamma = sum_i (r_i x f_i e_z + s_i t_i e_z) - w x h - h'                                                   N m
    v'    = R F / m + g,   J w' = Gamma - w x J w

r_i, s_i, m, J and the limits of u_i are the vehicle's; a rotor turns against its reaction torque, whence the sign of h.
So the torque of the rotors as gyroscopes is J_p [w_y N, -w_x N, N']; in hover N is zero. (drone-models 0.1 has -w_y N
in the first row; crazyflow 0.4 has the law.)

crazyflow: MIT licence, University of Toronto (utiasDSL/crazyflow). Where its numbers are read: parts/crazyflies.py.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.models.build_context import BuildContext
from quadexp.models.residual import Residual, feature_names, symbolic_residual
from quadexp.parts.settings import REQUIRED, Triple, key, keyed
from quadexp.physics.drag import linear_drag_force
from quadexp.physics.expression import Expression, limited, symbols
from quadexp.physics.rigid_body import body_features, state_derivative
from quadexp.physics.rotation import along_z
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.world.base import PlantPart
from quadexp.world.integrator import STEP_INPUTS, STEP_OUTPUTS, Equations, RotorSpeedPlant, integrate

THRUST = slice(0, 3)
TORQUE = slice(3, 6)
UP = slice(6, 8)
DOWN = slice(8, 10)
DRAG = slice(10, 13)
INERTIA = 13  # place of the propeller's inertia
N_PARAMETERS = 14  # of the function below
RPM = math.pi / 30  # rad/s
OTHER_ROTOR = 0.1  # of the thrust per rotor speed squared in hover: more is another vehicle's


Pair = tuple[float, float]


@keyed
class DroneModels(PlantPart):
    """Rotors and drag of crazyflow's first-principles model."""

    thrust_curve: Triple = key(REQUIRED, "rpm2thrust: N, N/rpm, N/rpm^2", "[-1, 1]")
    torque_curve: Triple = key(REQUIRED, "rpm2torque: N m, N m/rpm, N m/rpm^2", "[-1, 1]")
    spin_up: Pair = key(REQUIRED, "rotor_dyn_coef: rpm' per rpm and per rpm^2 missing, 1/s, 1/(rpm s)", "[0, 1e4]")
    spin_down: Pair = key(REQUIRED, "the same where the command is below the speed, 1/s, 1/(rpm s)", "[0, 1e4]")
    linear_drag: Triple = key(REQUIRED, "drag force per velocity, body axes (drag_matrix)", "[0, 100]", "N s/m")
    propeller_inertia: float = key(REQUIRED, "of one propeller about its axis (prop_inertia)", "[0, 1]", "kg m^2")

    former_kind = "drone_models"

    def build(self, context: BuildContext) -> DroneModelsPlant:
        return DroneModelsPlant(context.vehicle, self)


class DroneModelsPlant(RotorSpeedPlant):
    """crazyflow's first-principles model, with its motors, as a Plant.

    vehicle: with thrust_coefficient. After `advance`: rotor_speed (n,) (rad/s). Raises UsageError where thrust_curve
    does not rise over the vehicle's thrusts, or in hover is not that of the vehicle's thrust_coefficient.
    """

    def __init__(self, vehicle: Vehicle, keys: DroneModels) -> None:
        self.keys = keys
        k_0, k_1, k_2 = self.keys.thrust_curve
        if not (k_2 > 0 and k_1**2 > 4 * k_2 * (k_0 - vehicle.thrust_min)):
            raise UsageError(
                f"plant.thrust_curve={list(self.keys.thrust_curve)}: must rise with the speed from"
                f" vehicle.thrust_min={vehicle.thrust_min:g} N on"
            )
        hover = vehicle.hover_thrust / float(self.initial(vehicle.hover_thrust)) ** 2
        stated = vehicle.thrust_coefficient
        if stated is None or abs(hover / stated - 1) > OTHER_ROTOR:
            raise UsageError(
                f"plant.thrust_curve: vehicle={vehicle.name} would hover with {hover:.3g} N s^2 of thrust per rotor"
                f" speed squared, its vehicle.thrust_coefficient is {stated}: the curve is another vehicle's"
                " (vehicle=cf2x_L250 flies plant=drone_models, vehicle=cf21B_500 plant=drone_models_brushless)"
            )
        super().__init__(vehicle, _equations(vehicle), self._values(), step=keys.step, backend=keys.backend)

    def _values(self) -> np.ndarray:
        """Parameters of the equations, (14,)."""
        keys = self.keys
        return np.hstack(
            [
                keys.thrust_curve,
                keys.torque_curve,
                keys.spin_up,
                keys.spin_down,
                keys.linear_drag,
                keys.propeller_inertia,
            ]
        )

    def initial(self, thrust: npt.ArrayLike) -> np.ndarray:
        """Rotor speeds (rad/s) at thrusts (N) that are held."""
        k_0, k_1, k_2 = self.keys.thrust_curve
        return RPM * (np.sqrt(k_1**2 - 4 * k_2 * (k_0 - np.asarray(thrust))) - k_1) / (2 * k_2)

    @property
    def loop_lag(self) -> float:  # type: ignore[override]  # a plain attribute in the base
        """In hover, of thrust after a small change of the command, up or down, the longer (s)."""
        rpm = float(self.initial(self.vehicle.hover_thrust)) / RPM
        return 1 / min(linear + 2 * square * rpm for linear, square in (self.keys.spin_up, self.keys.spin_down))

    def residual(self) -> Residual:
        """Drag, reaction torque and rotors as gyroscopes at the commanded speeds.

        The lag of the motors, which controller.motor_lag says, is left out, and with it the torque of spinning up.
        """
        n = self.vehicle.n_rotors
        vehicle = self.vehicle
        z, theta = symbols(ca.SX, z=len(feature_names(n)), theta=N_PARAMETERS)
        command = z[6:]
        rpm = _commanded(ca.fmax(command, 0.1 * vehicle.hover_thrust), theta)
        _, torque = wrench(z[:3], z[3:6], rpm, ca.SX(n, 1), vehicle, theta)
        static = vehicle.allocation[1:3] @ (command - _thrust(rpm, theta))
        nominal = vehicle.allocation[1:] @ command
        acceleration = linear_drag_force(z[:3], theta[DRAG]) / vehicle.mass
        outputs = ca.vertcat(acceleration, torque + ca.vertcat(static, 0) - nominal)
        return symbolic_residual("plant", outputs, z, theta, self._values(), source="plant equations")


def _thrust(rpm: Expression, parameters: Expression) -> Expression:
    """f (n,) (N)."""
    k = parameters[THRUST]
    return k[0] + k[1] * rpm + k[2] * rpm**2


def _commanded(u: Expression, parameters: Expression) -> Expression:
    """n* (n,) (rpm) of thrusts u (n,) (N)."""
    k = parameters[THRUST]
    return (ca.sqrt(k[1] ** 2 - 4 * k[2] * (k[0] - u)) - k[1]) / (2 * k[2])


def _spinning(rpm: Expression, command: Expression, parameters: Expression) -> Expression:
    """n' (n,) (rpm/s)."""
    up = parameters[UP]
    down = parameters[DOWN]
    difference = command - rpm
    squares = command**2 - rpm**2
    return ca.if_else(difference > 0, up[0] * difference + up[1] * squares, down[0] * difference + down[1] * squares)


def wrench(
    v: Expression, rate: Expression, rpm: Expression, rpm_rate: Expression, vehicle: Vehicle, parameters: Expression
) -> tuple[Expression, Expression]:
    """Force (3,) (N) and torque (3,) (N m) of rotors and air, body frame; see the module.

    v: air-relative velocity, body frame (3,) (m/s). rate: (3,) (rad/s). rpm, rpm_rate: (n,) (rpm, rpm/s).
    """
    spin = ca.DM(vehicle.rotor_spin)
    m = parameters[TORQUE]
    rotors = vehicle.allocation[:3] @ _thrust(rpm, parameters)
    reaction = ca.dot(spin, m[0] + m[1] * rpm + m[2] * rpm**2)
    total = RPM * ca.dot(spin, rpm)
    change = RPM * ca.dot(spin, rpm_rate)
    axis = ca.DM([0, 0, 1])
    momentum = -parameters[INERTIA] * total * axis
    momentum_rate = -parameters[INERTIA] * change * axis
    gyroscopic = -ca.cross(rate, momentum) - momentum_rate
    force = linear_drag_force(v, parameters[DRAG]) + along_z(rotors[0])
    return force, ca.vertcat(rotors[1:], reaction) + gyroscopic


def derivative(vehicle: Vehicle) -> ca.Function:
    """(s (13 + n,): x and rotor speeds (rad/s), u (n,) (N), parameters) -> s', and the specific force (3,) (m/s^2)."""
    n = vehicle.n_rotors
    s, u, parameters = symbols(ca.SX, s=N_STATE + n, u=n, parameters=N_PARAMETERS)
    x = s[:N_STATE]
    rpm = s[N_STATE:] / RPM
    spinning = _spinning(rpm, _commanded(u, parameters), parameters)
    z = body_features(x, u)
    force, torque = wrench(z[:3], z[3:6], rpm, spinning, vehicle, parameters)
    motion = state_derivative(x, ca.SX(n, 1), vehicle, ca.vertcat(force / vehicle.mass, torque))
    change = ca.vertcat(motion, RPM * spinning)
    return ca.Function("drone_models_derivative", [s, u, parameters], [change, force / vehicle.mass])


def _equations(vehicle: Vehicle) -> Equations:
    """RK4; inner states are the rotor speeds, and there is no noise."""
    n = vehicle.n_rotors
    f = derivative(vehicle)
    s, u, noise, parameters, step = symbols(ca.SX, s=N_STATE + n, u=n, noise=0, parameters=N_PARAMETERS, step=1)
    thrusts = limited(u, vehicle.thrust_min, vehicle.thrust_max)
    after = integrate("rk4", lambda state: f(state, thrusts, parameters)[0], s, step)
    results = ca.cse([after, f(after, thrusts, parameters)[1]])
    rpm = s[N_STATE:] / RPM
    middle = rpm + step / 2 * _spinning(rpm, _commanded(thrusts, parameters), parameters)
    return Equations(
        ca.Function("drone_models_step", [s, u, noise, parameters, step], results, STEP_INPUTS, STEP_OUTPUTS),
        thrust=ca.Function("thrust", [s, u, parameters, step], [_thrust(middle, parameters)]),
    )
