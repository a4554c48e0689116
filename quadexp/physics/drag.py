"""Drag forces of the airframe and the rotors, body frame, per axis.

linear     F_i = -k_i V_i            rotor drag, Faessler et al. 2018             k in N s / m
quadratic  F_i = -c_i V_i |V_i|      Torrente et al. 2021, simplified simulation  c in N s^2 / m^2
"""

from __future__ import annotations

from quadexp.physics.expression import Expression


def linear_drag_force(body_velocity: Expression, coefficient: Expression) -> Expression:
    """Linear drag, (3,) (N); body_velocity (3,) (m/s), coefficient (3,) (N s / m)."""
    return -coefficient * body_velocity


def quadratic_drag_force(body_velocity: Expression, coefficient: Expression) -> Expression:
    """Quadratic drag per axis, (3,) (N); body_velocity (3,) (m/s), coefficient (3,) (N s^2 / m^2)."""
    return -coefficient * body_velocity * abs(body_velocity)
