"""Forces and torques of a rotorcraft by blade-element and momentum theory (Lei & Li 2017, equations 4-17).

Rotor i turns at w (rad/s), moves in its plane at V_h (m/s) and along the paper's downward axis at V_z (m/s), and draws
air through itself at u = V_I - V_z (m/s). With s = N_b rho c / 2 (s = rho c for two blades) and th = theta_tw:

    T = s C_la [ r^3 th w^2 / 3 + A r th V_h^2 - r^2 u w / 2 ]                             (9), (14)    N
    H = V_h h,   h = s [ r^2 C_d0 w / 2 - B r th C_la u + C_la u^2 / (2 w) ]               (10), (15)   N
    Q = s C_d0 [ r^4 w^2 / 4 + 3 r^2 V_h^2 / 4 ] + (T u + H V_h) / w                       (11), (16)   N m
    T = 2 rho pi r^2 V_I sqrt(V_h^2 + u^2)                                                 (17)

A = 1/2 and B = 1/6 follow from (9) and (10) and are adopted; (14) and (15) print A = 2 and B = 2/3, both four times
that (`PRINTED`, for comparison only). Only V_h^2 and h enter below, so V_h = 0 is a regular point.

On the vehicle, body frame FLU (V_z = -v_z there; x and y enter symmetrically, so the sign of y does not matter):

    F     = (-v_x sum h_i, -v_y sum h_i, sum T_i) - S rho |v| diag(C_D) v / 2              (4), (6), (7)
    Gamma = (sum y_i T_i, -sum x_i T_i, sum s_i Q_i)                                       (5)

All rotors move at the body's velocity v, as in the paper, or each at its own, v + omega x r_i; then the hub forces also
act at their rotors. Every function takes CasADi expressions; the rotor equations also take plain numbers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression
from quadexp.plugins.aerodynamics.coefficients import C_D0, C_DX, C_DZ, C_LA

if TYPE_CHECKING:
    from quadexp.physics.rotor import RotorGeometry
    from quadexp.physics.vehicle import Vehicle
    from quadexp.plugins.aerodynamics.coefficients import BladeCoefficients

TINY_SPEED = 1e-12  # m/s, added in square under roots to keep them differentiable at rest


class CrossTerms(NamedTuple):
    """Coefficients of the two theta_tw cross terms: A in the thrust (14), B in the hub force (15)."""

    thrust: float
    hub: float


ADOPTED = CrossTerms(1 / 2, 1 / 6)
PRINTED = CrossTerms(2.0, 2 / 3)


class BladeForces(NamedTuple):
    """One rotor, or (n,) of them. thrust T: N. hub h = H / V_h: N s/m. torque Q: N m."""

    thrust: ca.SX
    hub: ca.SX
    torque: ca.SX


class MotorCoefficients(NamedTuple):
    """(18)-(21): T_im = thrust w^2 (N s^2), H_im = hub V_h w (N s^2/m), Q_im = torque w^2 (N m s^2)."""

    thrust: float
    hub: float
    torque: float


class StaticCoefficients(NamedTuple):
    """At V = 0: T = thrust w^2 (N s^2), Q = torque w^2 (N m s^2), V_I = inflow w (m)."""

    thrust: float
    torque: float
    inflow: float


class RotorFlow(NamedTuple):
    """Velocity of the rotors relative to the air. x, y: in-plane (FLU, m/s). in_plane_squared: V_h^2 (m^2/s^2).

    axial: V_z, positive down the body's axis (m/s). Scalars where it is the same for all rotors, else (n,).
    """

    x: ca.SX
    y: ca.SX
    in_plane_squared: ca.SX
    axial: ca.SX


def unloaded_thrust(
    geometry: RotorGeometry, lift_slope: Expression, w: Expression, in_plane_squared: Expression,
    terms: CrossTerms = ADOPTED,
) -> Expression:  # fmt: skip
    """Thrust without flow through the rotor, a in T = a - b u (N); arguments as in `blade_forces`."""
    r, twist = geometry.radius, geometry.twist
    return geometry.blade_density * twist * r * lift_slope * (r * r / 3 * w * w + terms.thrust * in_plane_squared)


def thrust_loss_per_flow(geometry: RotorGeometry, lift_slope: Expression, w: Expression) -> Expression:
    """Thrust loss per velocity of the flow through the rotor, b in T = a - b u (N s/m)."""
    return geometry.blade_density * geometry.radius**2 / 2 * lift_slope * w


def blade_forces(
    geometry: RotorGeometry, profile_drag: Expression, lift_slope: Expression, w: Expression,
    through_flow: Expression, in_plane_squared: Expression, terms: CrossTerms = ADOPTED,
) -> BladeForces:  # fmt: skip
    """Thrust, hub force per in-plane speed, and drag torque of rotors (14)-(16).

    profile_drag C_d0, lift_slope C_la: dimensionless. w: rotor speed (rad/s), not zero. through_flow u: m/s.
    in_plane_squared V_h^2: m^2/s^2. Numbers, or CasADi scalars or vectors (n,).
    """
    s, r, twist = geometry.blade_density, geometry.radius, geometry.twist
    u = through_flow
    thrust = unloaded_thrust(geometry, lift_slope, w, in_plane_squared, terms)
    thrust = thrust - thrust_loss_per_flow(geometry, lift_slope, w) * u
    hub = s * (r * r / 2 * profile_drag * w + lift_slope * u * (u / (2 * w) - terms.hub * r * twist))
    profile = s * r * r / 4 * profile_drag * (r * r * w * w + 3 * in_plane_squared)
    return BladeForces(thrust, hub, profile + (thrust * u + hub * in_plane_squared) / w)


def static_inflow(geometry: RotorGeometry, lift_slope: Expression) -> Expression:
    """nu = V_I / w (m) of a rotor at rest: the positive root of K nu^2 = a - b nu, (14) and (17) at V = 0."""
    K = geometry.momentum_factor
    a, b = unloaded_thrust(geometry, lift_slope, 1.0, 0.0), thrust_loss_per_flow(geometry, lift_slope, 1.0)
    return (ca.sqrt(b * b + 4 * K * a) - b) / (2 * K)


def motor_coefficients(geometry: RotorGeometry, coefficients: BladeCoefficients) -> MotorCoefficients:
    """k_Tm, k_Hm, k_Qm: rotor forces without flow through the rotor (18)-(21)."""
    forces = blade_forces(geometry, coefficients.profile_drag, coefficients.lift_slope, 1.0, 0.0, 0.0)
    return MotorCoefficients(*forces)


def static_coefficients(geometry: RotorGeometry, coefficients: BladeCoefficients) -> StaticCoefficients:
    """k_T,static, k_Q,static and nu = V_I / w of a rotor at rest (Remark 4).

    nu is the positive root of (17) at V = 0: 2 rho pi r^2 nu^2 = a - b nu, with T = a - b nu at w = 1 rad/s.
    """
    inflow = float(static_inflow(geometry, coefficients.lift_slope))
    thrust, _, torque = blade_forces(geometry, coefficients.profile_drag, coefficients.lift_slope, 1.0, inflow, 0.0)
    return StaticCoefficients(thrust, torque, inflow)


def static_rotor_speed(thrust: Expression, thrust_coefficient: float) -> Expression:
    """Rotor speed w = sqrt(u / k_T,static) (rad/s) that gives the thrust u (N) at rest."""
    return ca.sqrt(thrust / thrust_coefficient)


def rotor_flow(vehicle: Vehicle, body_velocity: Expression, rate: Expression | None = None) -> RotorFlow:
    """Flow at the rotors; body_velocity (3,) FLU (m/s); rate (3,) (rad/s): each rotor moves at v + omega x r_i."""
    if rate is None:
        x, y, z = body_velocity[0], body_velocity[1], body_velocity[2]
    else:
        px, py, pz = (ca.DM(column) for column in np.array(vehicle.rotor_position, float).T)
        x = body_velocity[0] + rate[1] * pz - rate[2] * py
        y = body_velocity[1] + rate[2] * px - rate[0] * pz
        z = body_velocity[2] + rate[0] * py - rate[1] * px
    return RotorFlow(x, y, x * x + y * y, -z)


def body_drag(geometry: RotorGeometry, body_velocity: Expression, coefficients: Expression) -> Expression:
    """Drag of the airframe, (3,) (N), along the body axes (6); body_velocity (3,) (m/s), coefficients C_D (3,)."""
    speed = ca.sqrt(ca.dot(body_velocity, body_velocity) + TINY_SPEED**2)
    return -geometry.air_density * geometry.reference_area / 2 * speed * coefficients * body_velocity


def aerodynamic_wrench(
    vehicle: Vehicle, theta: Expression, body_velocity: Expression, rotor_speed: Expression,
    induced_velocity: Expression, *, rate: Expression | None = None, lift_scale: Expression = 1.0,
    terms: CrossTerms = ADOPTED,
) -> tuple[Expression, Expression]:  # fmt: skip
    """Force F (3,) (N) and torque Gamma (3,) (N m) of air on the vehicle, body frame FLU (4)-(7).

    theta: (C_d0, C_la, C_Dx, C_Dy, C_Dz), (5,). body_velocity: (3,) (m/s). rotor_speed: (n,) (rad/s).
    induced_velocity: V_I, (n,) (m/s). rate: None, or (3,) (rad/s) for rotor-local velocities.
    lift_scale: factor on every rotor's C_la, scalar or (n,).
    """
    geometry = vehicle.rotor_geometry
    flow = rotor_flow(vehicle, body_velocity, rate)
    lift_slope, through_flow = theta[C_LA] * lift_scale, induced_velocity - flow.axial
    thrust, hub, torque = blade_forces(
        geometry, theta[C_D0], lift_slope, rotor_speed, through_flow, flow.in_plane_squared, terms
    )
    in_plane = -ca.vertcat(ca.sum1(hub * flow.x), ca.sum1(hub * flow.y))
    force = ca.vertcat(in_plane, ca.sum1(thrust)) + body_drag(geometry, body_velocity, theta[C_DX : C_DZ + 1])
    px, py, pz = np.array(vehicle.rotor_position, float).T
    spin = np.array(vehicle.rotor_spin, float)
    moment = ca.vertcat(ca.dot(ca.DM(py), thrust), -ca.dot(ca.DM(px), thrust), ca.dot(ca.DM(spin), torque))
    if rate is not None:
        hub_x, hub_y = -hub * flow.x, -hub * flow.y
        moment += ca.vertcat(
            -ca.dot(ca.DM(pz), hub_y), ca.dot(ca.DM(pz), hub_x), ca.dot(ca.DM(px), hub_y) - ca.dot(ca.DM(py), hub_x)
        )
    return force, moment
