"""Rotor coefficients for two conditions: no flow through the rotor, and hover (Lei & Li 2017).

Thrust and torque per speed squared, from the blade-element equations of quadexp.physics.blade_element at w = 1 rad/s.
"""

from __future__ import annotations

from typing import NamedTuple

from quadexp.physics.blade_element import blade_forces, static_inflow
from quadexp.physics.rotor import BladeCoefficients, RotorGeometry


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
