"""Rigid body under its rotors' thrusts and a residual (Torrente et al. 2021, eqs 1-4).

    p' = v
    q' = 1/2 q o [0, w]
    v' = R(q) (T e_z / m + a_body) + g                                      world, m/s^2
    w' = J^-1 (tau + tau_body - w x J w)                                    body, rad/s^2

[T, tau] = G u is the vehicle's allocation; [a_body, tau_body] = y is the output of a residual (quadexp.models.residual,
which imports this package) at z = [v_body, w, u], zero for the nominal body.
A disturbance d = [F / m (world, m/s^2), J^-1 tau (body, rad/s^2)] is added to [v', w'].
"""

from __future__ import annotations

from typing import Protocol

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression, named_function, named_symbols, symbols
from quadexp.physics.rotation import air_velocity, along_z, quaternion_rate, rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

N_DISTURBANCE = 6  # force and torque
FEATURES = ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")  # of a residual, beside the rotors' thrusts
OUTPUTS = ("a_x", "a_y", "a_z", "tau_x", "tau_y", "tau_z")
N_OUTPUTS = len(OUTPUTS)


class Correction(Protocol):
    """An object with the function of a residual, such as quadexp.models.residual.Residual."""

    @property
    def function(self) -> ca.Function:
        """CasADi, (z (6 + n,), theta (p,)) -> (y (6,), dy/dz (6, 6 + n))."""


def disturbed_derivative(derivative: Expression, disturbance: Expression) -> Expression:
    """x' (13,) with a disturbance (6,): acceleration, world (m/s^2), and angular acceleration, body (rad/s^2)."""
    return derivative + ca.vertcat(type(derivative)(N_STATE - N_DISTURBANCE, 1), disturbance)


def state_derivative(
    x: Expression, u: Expression, vehicle: Vehicle, correction: Expression | None = None
) -> Expression:
    """x' of the rigid body, (13,).

    x: state (13,). u: rotor thrusts (n,) (N).
    correction: [a_body (m/s^2), tau_body (N m)], (6,), or None for the nominal body.
    """
    q = x[ATTITUDE]
    v = x[VELOCITY]
    w = x[RATE]
    wrench = ca.sparsify(ca.DM(vehicle.allocation)) @ u
    acceleration = along_z(wrench[0] / vehicle.mass)
    torque = wrench[1:]
    if correction is not None:
        acceleration += correction[:3]
        torque += correction[3:]
    J = ca.DM(vehicle.inertia_matrix)
    moment = torque - ca.cross(w, ca.sparsify(J) @ w)
    v_dot = rotation_matrix(q) @ acceleration + along_z(-vehicle.gravity)
    w_dot = ca.sparsify(ca.inv(J), 1e-14) @ moment
    return ca.vertcat(v, quaternion_rate(q, w), v_dot, w_dot)


def body_features(x: Expression, u: Expression) -> Expression:
    """z = [v_body, w, u], (6 + n,): the inputs of a residual, in still air."""
    return ca.vertcat(air_velocity(x[ATTITUDE], x[VELOCITY]), x[RATE], u)


def features_function(vehicle: Vehicle) -> ca.Function:
    """(x (13,), u (n,)) -> z, see body_features."""
    x, u = symbols(ca.SX, x=N_STATE, u=vehicle.n_rotors)
    return ca.Function("features", [x, u], [body_features(x, u)])


def derivative_function(vehicle: Vehicle) -> ca.Function:
    """(x (13,), u (n,), y (6,)) -> x' (13,), see state_derivative."""
    x, u, y = symbols(ca.SX, x=N_STATE, u=vehicle.n_rotors, y=N_OUTPUTS)
    return ca.Function("derivative", [x, u, y], [state_derivative(x, u, vehicle, y)])


def rigid_body_function(vehicle: Vehicle) -> ca.Function:
    """Nominal dynamics as a CasADi function (x (13,), u (n,)) -> x' (13,)."""
    x, u = symbols(ca.SX, x=N_STATE, u=vehicle.n_rotors)
    return ca.Function("rigid_body", [x, u], [state_derivative(x, u, vehicle)], ["x", "u"], ["x_dot"])


def corrected_function(vehicle: Vehicle, residual: Correction) -> ca.Function:
    """Dynamics with a residual, (x (13,), u (n,), theta (p,)) -> x' (13,): f_cor = f_dyn + B_d r(z)."""
    shapes = {"x": N_STATE, "u": vehicle.n_rotors, "theta": residual.function.size1_in(1)}
    inputs = named_symbols(ca.MX, shapes)
    x, u, theta = inputs.values()
    output, _ = residual.function(features_function(vehicle)(x, u), theta)
    return named_function("corrected", inputs, {"x_dot": derivative_function(vehicle)(x, u, output)})
