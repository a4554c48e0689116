"""Aerodynamic terms that the feedback law compensates, Lei & Li 2017, section 2 and equation (21).

The deviation of the rotors' hub force, thrust and torque from the motor terms T_im = k_Tm w^2, Q_im = k_Qm w^2, due to
the flow through and across the rotors (the paper's "secondary" terms):

    H = sum H_i,    delta_T = sum T_i - k_Tm sum w_i^2,    delta_Gamma = Gamma(T_i, Q_i) - Gamma(T_im, Q_im)

Body frame FRD. Rotor equations: quadexp.physics.blade_element.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.feedback.frames import FRD_FLU
from quadexp.physics.blade_element import aerodynamic_wrench, blade_forces, body_drag, static_inflow
from quadexp.physics.expression import Expression
from quadexp.physics.induced_velocity import balance, safe_newton
from quadexp.physics.rotor import C_D0, C_DX, C_DZ, C_LA
from quadexp.physics.vehicle import Vehicle

NEWTON_ITERATIONS = 20  # safeguarded, from an upper bound: accurate to 1e-12 m/s except in very steep descents


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
    no_inflow, flu = ca.DM.zeros(vehicle.n_rotors), ca.mtimes(FRD_FLU, velocity)
    force, torque = aerodynamic_wrench(vehicle, rotors_only, flu, rotor_speed, induced)
    motor_force, motor_torque = aerodynamic_wrench(vehicle, rotors_only, ca.DM.zeros(3), rotor_speed, no_inflow)
    return Compensation(
        -ca.mtimes(FRD_FLU, force)[:2], force[2] - motor_force[2], ca.mtimes(FRD_FLU, torque - motor_torque)
    )


def drag_force(vehicle: Vehicle, theta: Expression, velocity: Expression) -> Expression:
    """D, (3,), FRD (N): equation (6); it opposes the velocity (3,), FRD (m/s)."""
    return -body_drag(vehicle.rotor_geometry, velocity, theta[C_DX : C_DZ + 1])


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
