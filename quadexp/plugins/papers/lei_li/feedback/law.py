"""The control law of Lei & Li 2017, equations (27)-(40), for one sample, as one CasADi function.

Position, from the tracking error to thrust and tilt; H: hub force, D: body drag, delta_T, delta_Gamma: deviations of
the rotors' thrust and torque from the motor terms T_im = k_Tm w^2, Q_im = k_Qm w^2 by the flow (section 2, (21)):

    (30)  u_xi = -(K_p e_xi + K_d e_v)                                             e_xi = xi - xi_d
    (32)  u_T  = -R_d,k-1 (H_x + D_x) e1 - R_d,k-1 (H_y + D_y) e2 - m (u_xi - g e3 + a_d)
    (33)  T_m  = ||u_T|| - delta_T - D_z
    (34)  phi_d   = arcsin((u_Tx sin psi_d - u_Ty cos psi_d) / ||u_T||)
    (35)  theta_d = arctan((u_Tx cos psi_d + u_Ty sin psi_d) / u_Tz)          wrong quadrant for u_Tz < 0: see `in_cone`

Derivatives of the desired angles by a high-gain observer with l = (3 w0, 3 w0^2, w0^3), all poles at -w0 (rad/s):

    (36)  x_k = e^{A h} x_{k-1} + int_0^h e^{A s} ds B y_k,    A = [-l1 1 0; -l2 0 1; -l3 0 0],  B = (l1, l2, l3)

Attitude, eta = (phi, theta, psi), the yaw error wrapped to (-pi, pi]; W is singular at theta = +-90 deg:

    (37)  Omega = W eta_dot,    W = [1 0 -sin theta; 0 cos phi sin phi cos theta; 0 -sin phi cos phi cos theta]
    (39)  u_eta = -(K_p e_eta + K_d e_eta_dot)              the minus sign is missing in print: unstable without
    (40)  Gamma_m = J (W (u_eta + eta_d_ddot) + W_dot W^-1 Omega) + Omega x J Omega - delta_Gamma

Allocation, per rotor at (x, y), s the sign of its reaction torque about the body's z axis (down):

    (27)  (T, Gamma) = Pi (w_1^2 .. w_n^2),    Pi = [k; -k y; k x; q s]

k and q, thrust and drag torque per speed squared, are divisors: with q near zero a small yaw torque demands an
arbitrarily large speed. Estimates are therefore clipped (quadexp.plugins.papers.lei_li.rls) to at least half of their
initial values.

World NED, body FRD; state and reference are given in ENU and FLU and converted here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.parts.settings import Settings, Triple, key
from quadexp.physics.blade_element import aerodynamic_wrench, blade_forces, body_drag, static_inflow
from quadexp.physics.expression import Expression, dense_function, limited, named_symbols, symbols
from quadexp.physics.induced_velocity import balance, safe_newton
from quadexp.physics.rotation import air_velocity, along_z, rotation_matrix
from quadexp.physics.rotor import C_D0, C_DX, C_DZ, C_LA
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.papers.lei_li.feedback.frames import FRD_FLU, NED_ENU, euler_angles, rotation_euler, yaw_ned


@dataclass(frozen=True)
class FeedbackSettings(Settings):
    """Gains, observer and safety options, with the values of Lei & Li 2017.

    *_proportional, *_derivative: diagonals of K_p (1/s^2) and K_d (1/s). cone: keep the desired thrust in the cone that
    a multirotor can hold: an upward demand of at least thrust_share_min m g, tilted by at most tilt_max.
    """

    prefix = "controller."

    rate: float = key(100.0, "control rate", "[1, 1000]", "Hz")
    position_proportional: Triple = key(
        (0.3, 0.3, 0.3), "gain on the position error", "[0, 1000]", "1/s^2", tuned="0.1..10:log"
    )
    position_derivative: Triple = key(
        (0.9, 0.9, 0.9), "gain on the velocity error", "[0, 1000]", "1/s", tuned="0.3..10:log"
    )
    attitude_proportional: Triple = key(
        (0.8, 0.8, 0.8), "gain on the error of the Euler angles", "[0, 1000]", "1/s^2", tuned="0.3..100:log"
    )
    attitude_derivative: Triple = key(
        (2.4, 2.4, 2.4), "gain on the error of the Euler rates", "[0, 1000]", "1/s", tuned="0.5..50:log"
    )
    observer_bandwidth: float = key(
        6.0, "of the high-gain observer (36) of desired angles", "(0, 1000]", "rad/s", tuned="2..60:log"
    )
    cone: bool = key(True, "limit the desired thrust by thrust_share_min and tilt_max (the paper does not)")
    thrust_share_min: float = key(
        0.3, "least upward component of the desired thrust", "(0, 1]", "of the weight", when="cone"
    )
    tilt_max: float = key(math.radians(60.0), "largest tilt of the desired thrust", "(0, 1.57]", "rad", when="cone")
    rotor_speed_min: float = key(50.0, "least rotor speed that is commanded", "[0, 1000]", "rad/s")
    inner_iterations: int = key(
        50, "iterations of the fixed point, in variants that do not use the last sample's values", "[1, 1000]"
    )

    @property
    def control_period(self) -> float:
        """h, s."""
        return 1.0 / self.rate


@dataclass(frozen=True)
class Variant:
    """What a feedback controller compensates, and with which coefficients.

    hub, drag: hub force H and body drag D in (32), (33). thrust, torque: delta_T in (33), delta_Gamma in (40).
    allocation: coefficients of (27): "motor": k_Tm, k_Qm; "static": k_T,static, k_Q,static from the parameters;
    "vehicle": the static ones of the vehicle. parameters: "identified" in flight, "true", or "none" (not needed).
    delayed: H, delta_T and delta_Gamma of the previous sample (as printed), else of this one by a fixed point.
    """

    hub: bool = True
    drag: bool = True
    thrust: bool = True
    torque: bool = True
    allocation: str = "motor"
    parameters: str = "identified"
    delayed: bool = True


_NOTHING = Variant(hub=False, drag=False, thrust=False, torque=False)

VARIANTS: dict[str, Variant] = {
    "rls": Variant(),
    "static": replace(_NOTHING, allocation="vehicle", parameters="none"),  # Remark 7, the baseline
    "literal": _NOTHING,  # Section 5 taken literally: k_Tm is 1.74 times the thrust coefficient in hover
    "nocomp_statid": replace(_NOTHING, allocation="static"),
    "oracle": Variant(parameters="true"),
    "oracle_impl": Variant(parameters="true", delayed=False),
    "rls_noH": Variant(hub=False),
    "static_H": replace(_NOTHING, hub=True, allocation="vehicle", parameters="true"),
}


COSINE_MIN = 1e-6  # lower bound on |cos theta| in W^-1, which is singular at 90 deg
NEWTON_ITERATIONS = 20  # safeguarded, from an upper bound: accurate to 1e-12 m/s except in very steep descents


def law_function(vehicle: Vehicle, settings: FeedbackSettings, variant: Variant) -> ca.Function:
    """The law as a function.

    Inputs: x (13,), reference (3, 3) with columns [p, v, a], yaw (3,): heading, rate, acceleration (rad, s), ENU/FLU;
    theta (5,); of the previous sample: velocity_last (3,) FRD, rotor_speed_last (n,), eta_d_last (3,),
    observer_last (3, 2).
    Outputs: thrust (n,), commanded static thrusts (N); rotor_speed (n,); eta_d (3,); observer (3, 2); velocity (3,)
    FRD; error: e_eta (3,); outside: whether the thrust vector was moved into the cone (0 or 1); floored: number of
    rotors at the least speed; limited: number of rotors at the largest thrust; u_T (3,), NED.
    """
    n = vehicle.n_rotors
    shapes = {"x": N_STATE, "reference": (3, 3), "yaw": 3, "theta": 5, "velocity_last": 3, "rotor_speed_last": n}
    inputs = named_symbols(ca.SX, shapes | {"eta_d_last": 3, "observer_last": (3, 2)})
    x, reference, yaw, theta, velocity_last, rotor_speed_last, eta_d_last, observer_last = inputs.values()

    R = NED_ENU @ rotation_matrix(x[ATTITUDE]) @ FRD_FLU
    eta = euler_angles(R)
    rate = FRD_FLU @ x[RATE]
    velocity_ned = NED_ENU @ x[VELOCITY]
    velocity = FRD_FLU @ air_velocity(x[ATTITUDE], x[VELOCITY])
    target = NED_ENU @ reference
    psi_d = yaw_ned(yaw[0])
    psi_d_dot = -yaw[1]
    psi_d_ddot = -yaw[2]

    hub, delta_thrust, delta_torque = compensation(vehicle, theta, velocity_last, rotor_speed_last)
    hub = hub * variant.hub
    delta_thrust = delta_thrust * variant.thrust
    delta_torque = delta_torque * variant.torque
    # D of (6), which opposes the velocity.
    drag = -body_drag(vehicle.rotor_geometry, velocity, theta[C_DX : C_DZ + 1]) * variant.drag

    u_xi = position_feedback(
        NED_ENU @ x[POSITION] - target[:, 0],
        velocity_ned - target[:, 1],
        ca.DM(settings.position_proportional),
        ca.DM(settings.position_derivative),
    )
    R_last = rotation_euler(eta_d_last)
    u_T = thrust_vector(u_xi, target[:, 2], R_last, hub + drag[:2], vehicle.mass, vehicle.gravity)
    outside = ca.SX(0)
    if settings.cone:
        u_T, outside = in_cone(u_T, settings.thrust_share_min * vehicle.mass * vehicle.gravity, settings.tilt_max)
    thrust = ca.norm_2(u_T) - delta_thrust - drag[2]

    eta_d = ca.vertcat(*desired_tilt(u_T, psi_d), psi_d)
    exact, driven = observer_matrices(settings.observer_bandwidth, settings.control_period)
    observer = exact @ observer_last + ca.DM(driven) @ eta_d[:2].T
    error = attitude_error(eta, eta_d)
    torque = attitude_torque(
        eta,
        rate,
        error,
        ca.vertcat(observer[1, :].T, psi_d_dot),
        ca.vertcat(observer[2, :].T, psi_d_ddot),
        ca.DM(settings.attitude_proportional),
        ca.DM(settings.attitude_derivative),
        ca.DM(FRD_FLU @ vehicle.inertia_matrix @ FRD_FLU),
        delta_torque,
    )
    coefficients = allocation_coefficients(vehicle, variant.allocation, theta)
    squared = allocate(thrust, torque, *coefficients, np.linalg.inv(unit_allocation(vehicle)))
    low = settings.rotor_speed_min**2
    high = vehicle.thrust_max / vehicle.static_thrust_coefficient
    commanded = limited(squared, low, high)
    floored = ca.sum1(squared < low)
    at_limit = ca.sum1(squared > high)

    outputs = {
        "thrust": vehicle.static_thrust_coefficient * commanded,
        "rotor_speed": ca.sqrt(commanded),
        "eta_d": eta_d,
        "observer": observer,
        "velocity": velocity,
        "error": error,
        "outside": outside,
        "floored": floored,
        "limited": at_limit,
        "u_T": u_T,
    }
    return dense_function("feedback_law", inputs, outputs)


class Compensation(NamedTuple):
    """hub: H (2,), x and y (N). thrust: delta_T (N). torque: delta_Gamma (3,) (N m). All FRD."""

    hub: ca.SX
    thrust: ca.SX
    torque: ca.SX


def compensation(vehicle: Vehicle, theta: Expression, velocity: Expression, rotor_speed: Expression) -> Compensation:
    """H, delta_T and delta_Gamma at a body velocity (3,), FRD (m/s), and rotor speeds (n,) (rad/s).

    theta: (C_d0, C_la, C_Dx, C_Dy, C_Dz), (5,).
    """
    in_plane = velocity[0] ** 2 + velocity[1] ** 2
    equation = balance(vehicle.rotor_geometry, theta[C_LA], rotor_speed, in_plane, velocity[2])
    induced = safe_newton(equation, NEWTON_ITERATIONS)
    rotors_only = ca.vertcat(theta[C_D0], theta[C_LA], 0, 0, 0)
    no_inflow = ca.DM.zeros(vehicle.n_rotors)
    flu = FRD_FLU @ velocity
    force, torque = aerodynamic_wrench(vehicle, rotors_only, flu, rotor_speed, induced)
    motor_force, motor_torque = aerodynamic_wrench(vehicle, rotors_only, ca.DM.zeros(3), rotor_speed, no_inflow)
    return Compensation(-(FRD_FLU @ force)[:2], force[2] - motor_force[2], FRD_FLU @ (torque - motor_torque))


def allocation_coefficients(vehicle: Vehicle, kind: str, theta: Expression) -> tuple[Expression, Expression]:
    """Thrust (N s^2) and drag torque (N m s^2) per squared rotor speed for the allocation; see Variant.allocation."""
    if kind == "vehicle":
        return vehicle.static_thrust_coefficient, vehicle.torque_coefficient * vehicle.static_thrust_coefficient
    inflow = static_inflow(vehicle.rotor_geometry, theta[C_LA]) if kind == "static" else 0.0
    forces = blade_forces(vehicle.rotor_geometry, theta[C_D0], theta[C_LA], 1.0, inflow, 0.0)
    return forces.thrust, forces.torque


def hover_rotor_speed(vehicle: Vehicle) -> float:
    """Rotor speed in hover by the vehicle's thrust map (rad/s)."""
    return float(np.sqrt(vehicle.hover_thrust / vehicle.static_thrust_coefficient))


def position_feedback(
    error: Expression, velocity_error: Expression, proportional: Expression, derivative: Expression
) -> Expression:
    """u_xi, (3,), NED (m/s^2): equation (30). Errors (3,) (m, m/s); gains (3,) (1/s^2, 1/s)."""
    return -(proportional * error + derivative * velocity_error)


def thrust_vector(
    u_xi: Expression, acceleration: Expression, R_last: Expression, lateral: Expression, mass: float, gravity: float
) -> Expression:
    """u_T, (3,), NED (N): equation (32). It points along the body's z axis (down), opposite to the thrust.

    acceleration: a_d (3,), NED (m/s^2). R_last: R_d,k-1, (3, 3). lateral: (H + D)_xy, (2,), FRD (N).
    """
    lateral_force = R_last @ ca.vertcat(lateral, 0)
    return -lateral_force - mass * (u_xi - along_z(gravity) + acceleration)


def in_cone(u_T: Expression, down_min: float, tilt_max: float) -> tuple[Expression, Expression]:
    """u_T limited to a cone about the vertical, (3,) (N), and whether it was outside (0 or 1).

    down_min: least u_Tz (N). tilt_max: largest angle from the vertical (rad); the vertical component is kept.
    """
    down = ca.fmax(u_T[2], down_min)
    across = ca.sqrt(u_T[0] ** 2 + u_T[1] ** 2)
    allowed = ca.tan(tilt_max) * down
    share = ca.if_else(across > allowed, allowed / ca.fmax(across, 1e-12), 1.0)
    outside = ca.logic_or(u_T[2] < down_min, across > allowed)
    return ca.vertcat(share * u_T[0], share * u_T[1], down), outside


def desired_tilt(u_T: Expression, psi: Expression) -> tuple[Expression, Expression]:
    """phi_d, theta_d (rad): equations (34), (35). u_T (3,) NED (N), psi: desired heading (rad)."""
    sine = ca.sin(psi)
    cosine = ca.cos(psi)
    roll = ca.asin(limited((u_T[0] * sine - u_T[1] * cosine) / ca.norm_2(u_T), -1.0, 1.0))
    return roll, ca.atan((u_T[0] * cosine + u_T[1] * sine) / u_T[2])


def observer_matrices(bandwidth: float, period: float) -> tuple[np.ndarray, np.ndarray]:
    """e^{A h}, (3, 3), and int e^{A s} ds B, (3,): exact for y held over a period.

    bandwidth: w0 (rad/s). period: h (s).
    """
    from scipy.linalg import expm

    gains = np.array([3 * bandwidth, 3 * bandwidth**2, bandwidth**3])
    augmented = np.zeros((4, 4))
    augmented[:3, 0] = -gains
    augmented[0, 1] = 1.0
    augmented[1, 2] = 1.0
    augmented[:3, 3] = gains
    exact = expm(augmented * period)
    return exact[:3, :3], exact[:3, 3]


def rate_matrix(eta: Expression) -> Expression:
    """W, (3, 3): equation (37). eta (3,) (rad)."""
    sp = ca.sin(eta[0])
    cp = ca.cos(eta[0])
    st = ca.sin(eta[1])
    ct = ca.cos(eta[1])
    return ca.vertcat(ca.horzcat(1, 0, -st), ca.horzcat(0, cp, sp * ct), ca.horzcat(0, -sp, cp * ct))


def euler_rates(eta: Expression, rate: Expression) -> Expression:
    """eta_dot = W^-1 Omega, (3,) (rad/s). rate: Omega (3,), FRD (rad/s)."""
    sp = ca.sin(eta[0])
    cp = ca.cos(eta[0])
    ct = ca.cos(eta[1])
    ct = ca.if_else(ct < 0, -1, 1) * ca.fmax(abs(ct), COSINE_MIN)
    heading = (sp * rate[1] + cp * rate[2]) / ct
    return ca.vertcat(rate[0] + ca.sin(eta[1]) * heading, cp * rate[1] - sp * rate[2], heading)


def wrapped(angle: Expression) -> Expression:
    """The angle (rad) in (-pi, pi]."""
    return angle - 2 * math.pi * ca.ceil((angle - math.pi) / (2 * math.pi))


def attitude_error(eta: Expression, eta_d: Expression) -> Expression:
    """e_eta = eta - eta_d, (3,) (rad), the yaw error wrapped."""
    return ca.vertcat(eta[0] - eta_d[0], eta[1] - eta_d[1], wrapped(eta[2] - eta_d[2]))


def attitude_torque(
    eta: Expression,
    rate: Expression,
    error: Expression,
    eta_d_dot: Expression,
    eta_d_ddot: Expression,
    proportional: Expression,
    derivative: Expression,
    inertia: Expression,
    compensation: Expression,
) -> Expression:
    """Gamma_m, (3,), FRD (N m): equations (39), (40).

    eta, error: (3,) (rad). rate: Omega (3,) (rad/s). eta_d_dot, eta_d_ddot: (3,) (rad/s, rad/s^2).
    proportional, derivative: gains (3,) (1/s^2, 1/s). inertia: J (3, 3), FRD (kg m^2).
    compensation: delta_Gamma (3,) (N m).
    """
    eta_dot = euler_rates(eta, rate)
    u_eta = -(proportional * error + derivative * (eta_dot - eta_d_dot))
    W_dot = _rate_matrix_derivative()(eta, eta_dot)
    acceleration = rate_matrix(eta) @ (u_eta + eta_d_ddot) + W_dot @ eta_dot
    return inertia @ acceleration + ca.cross(rate, inertia @ rate) - compensation


def _rate_matrix_derivative() -> ca.Function:
    """(eta, eta_dot) -> W_dot, (3, 3)."""
    eta, eta_dot = symbols(ca.SX, eta=3, eta_dot=3)
    derivative = ca.jtimes(ca.vec(rate_matrix(eta)), eta, eta_dot)
    return ca.Function("W_dot", [eta, eta_dot], [ca.reshape(derivative, 3, 3)])


def unit_allocation(vehicle: Vehicle) -> np.ndarray:
    """Pi for k = q = 1, (4, 4), FRD.

    Raises UsageError for a vehicle without four rotors.
    """
    if vehicle.n_rotors != 4:
        raise UsageError(
            f"vehicle={vehicle.name}: feedback control needs 4 rotors, this vehicle has {vehicle.n_rotors}"
        )
    x, y, _ = FRD_FLU @ np.array(vehicle.rotor_position, float).T
    return np.stack([np.ones(4), -y, x, -np.array(vehicle.rotor_spin, float)])


def allocate(
    thrust: Expression,
    torque: Expression,
    thrust_coefficient: Expression,
    torque_coefficient: Expression,
    inverse: np.ndarray,
) -> Expression:
    """Squared rotor speeds, (4,) (rad^2/s^2): equation (27) solved.

    thrust: T (N). torque: Gamma (3,), FRD (N m). thrust_coefficient: k (N s^2). torque_coefficient: q (N m s^2).
    inverse: of `unit_allocation`, (4, 4).
    """
    scaled = ca.vertcat(ca.vertcat(thrust, torque[0], torque[1]) / thrust_coefficient, torque[2] / torque_coefficient)
    return inverse @ scaled
