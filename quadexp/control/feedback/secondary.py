"""Secondary aerodynamic terms, Lei & Li 2017, section 2: what the rotors do beyond T_im = k_Tm w^2, Q_im = k_Qm w^2.

    delta_T = sum T_i - k_Tm sum w_i^2,    delta_Gamma = Gamma(T_i, Q_i) - Gamma(T_im, Q_im)

Body frame FRD. The rotors' equations are those of quadexp.physics.blade_element.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from quadexp.control.feedback.frames import FRD_FLU
from quadexp.physics.blade_element import aerodynamic_wrench, blade_forces, body_drag, static_inflow
from quadexp.physics.expression import Expression
from quadexp.physics.induced_velocity import balance, safe_newton
from quadexp.physics.rotor import C_D0, C_DX, C_DZ, C_LA
from quadexp.physics.vehicle import Vehicle

NEWTON_ITERATIONS = 20  # safeguarded, from an upper bound: 1e-12 m/s but in the steepest descents


class Secondary(NamedTuple):
    """hub: H (2,), x and y (N). thrust: delta_T (N). torque: delta_Gamma (3,) (N m). All FRD."""

    hub: ca.SX
    thrust: ca.SX
    torque: ca.SX


def secondary_terms(vehicle: Vehicle, theta: Expression, velocity: Expression, rotor_speed: Expression) -> Secondary:
    """The secondary terms at a body velocity (3,), FRD (m/s), and rotor speeds (n,) (rad/s).

    theta: (C_d0, C_la, C_Dx, C_Dy, C_Dz), (5,).
    """
    in_plane = velocity[0] ** 2 + velocity[1] ** 2
    equation = balance(vehicle.rotor_geometry, theta[C_LA], rotor_speed, in_plane, velocity[2])
    induced = safe_newton(equation, NEWTON_ITERATIONS)
    rotors_only = ca.vertcat(theta[C_D0], theta[C_LA], 0, 0, 0)
    still, flu = ca.DM.zeros(vehicle.n_rotors), ca.mtimes(FRD_FLU, velocity)
    force, torque = aerodynamic_wrench(vehicle, rotors_only, flu, rotor_speed, induced)
    motor_force, motor_torque = aerodynamic_wrench(vehicle, rotors_only, ca.DM.zeros(3), rotor_speed, still)
    return Secondary(
        -ca.mtimes(FRD_FLU, force)[:2], force[2] - motor_force[2], ca.mtimes(FRD_FLU, torque - motor_torque)
    )


def drag_force(vehicle: Vehicle, theta: Expression, velocity: Expression) -> Expression:
    """D, (3,), FRD (N): equation (6); it opposes the velocity (3,), FRD (m/s)."""
    return -body_drag(vehicle.rotor_geometry, velocity, theta[C_DX : C_DZ + 1])


def allocation_coefficients(vehicle: Vehicle, kind: str, theta: Expression) -> tuple[Expression, Expression]:
    """Thrust (N s^2) and drag torque (N m s^2) per speed squared that allocation divides by; see Variant.allocation."""
    if kind == "vehicle":
        return vehicle.static_thrust_coefficient, vehicle.torque_coefficient * vehicle.static_thrust_coefficient
    inflow = static_inflow(vehicle.rotor_geometry, theta[C_LA]) if kind == "static" else 0.0
    one = blade_forces(vehicle.rotor_geometry, theta[C_D0], theta[C_LA], 1.0, inflow, 0.0)
    return one.thrust, one.torque


def hover_rotor_speed(vehicle: Vehicle) -> float:
    """Rotor speed in hover by the vehicle's thrust map (rad/s)."""
    return float(np.sqrt(vehicle.hover_thrust / vehicle.static_thrust_coefficient))
