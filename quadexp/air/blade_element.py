"""Blade-element residual: forces and torques of rotors and airframe minus those of the nominal rigid body.

    y = [F / m - (0, 0, sum u) / m_nominal,  Gamma - G u]        F, Gamma: quadexp.physics.blade_element, (4)-(17)

The command u (N) is a static thrust, so w = sqrt(u / k_T,static); at V = 0 with the true coefficients y is zero. The
induced velocity is computed by a few Newton steps at every evaluation: held constant over a horizon it would be wrong
within a tenth of a second. Its derivative is that of the equation it solves, dV_I/dz = -g_z / g_V, not of the steps.

Below the idle speed the residual keeps its value there, so that it stays differentiable for u -> 0.
"""

from __future__ import annotations

import numpy as np

from quadexp.air.base import Residual, feature_names
from quadexp.compile.symbolic import ca
from quadexp.physics.blade_element import (
    ADOPTED,
    CrossTerms,
    aerodynamic_wrench,
    rotor_flow,
    static_rotor_speed,
)
from quadexp.physics.expression import Expression
from quadexp.physics.induced_velocity import balance, newton, starting_point
from quadexp.physics.rotor import C_LA, IDLE_SPEED, THETA, BladeCoefficients
from quadexp.physics.vehicle import Vehicle

ITERATIONS = 4  # Newton steps; three reach 1e-9 m/s in cruise, idling rotors and steep descents need a fourth


def blade_element_residual(
    vehicle: Vehicle,
    coefficients: BladeCoefficients,
    source: str = "",
    *,
    iterations: int = ITERATIONS,
) -> Residual:
    """Residual with theta = (C_d0, C_la, C_Dx, C_Dy, C_Dz) as runtime parameters, (5,).

    vehicle: with rotor and thrust_coefficient. coefficients: initial values. source: for the record.
    iterations: Newton steps for V_I.
    Raises UsageError where the vehicle has no rotor geometry.
    """
    z, theta = ca.SX.sym("z", len(feature_names(vehicle.n_rotors))), ca.SX.sym("theta", len(THETA))
    y, dy_dz = blade_element_correction(vehicle, z, theta, iterations=iterations)
    return residual_from_correction("blade_element", z, theta, y, dy_dz, coefficients.parameters(), source)


def residual_from_correction(
    name: str, z: Expression, theta: Expression, y: Expression, dy_dz: Expression, values: np.ndarray, source: str
) -> Residual:
    """Residual from expressions for y and dy/dz; common subexpressions are shared."""
    y, dy_dz = ca.cse([y, dy_dz])
    function = ca.Function(f"residual_{name}", [z, theta], [y, dy_dz], ["z", "theta"], ["y", "dy_dz"])
    return Residual(name, function, values, source)


def blade_element_correction(
    vehicle: Vehicle,
    z: Expression,
    theta: Expression,
    *,
    lift_scale: Expression = 1.0,
    payload: Expression = 0.0,
    rotor_local_velocity: bool = False,
    terms: CrossTerms = ADOPTED,
    iterations: int = ITERATIONS,
    rotor_speed_min: float = IDLE_SPEED,
) -> tuple[Expression, Expression]:
    """y (6,) and dy/dz (6, 6 + n) as SX expressions.

    z: features (6 + n,). theta: (5,). lift_scale: factor on every rotor's C_la, scalar or (n,). payload: kg.
    """
    rotor, thrust_coefficient = vehicle.rotor_geometry, vehicle.static_thrust_coefficient
    velocity, rate = z[:3], z[3:6] if rotor_local_velocity else None
    command = ca.fmax(z[6:], thrust_coefficient * rotor_speed_min**2)
    w = static_rotor_speed(command, thrust_coefficient)
    flow = rotor_flow(vehicle, velocity, rate)
    lift_slope = theta[C_LA] * lift_scale
    equation = balance(rotor, lift_slope, w, flow.in_plane_squared, flow.axial, terms)
    solution = newton(equation, starting_point(equation), iterations)

    induced = ca.SX.sym("V_I", vehicle.n_rotors)
    force, torque = aerodynamic_wrench(
        vehicle, theta, velocity, w, induced, rate=rate, lift_scale=lift_scale, terms=terms
    )
    acceleration = force / (vehicle.mass + payload) - ca.vertcat(0, 0, ca.sum1(command) / vehicle.mass)
    y = ca.vertcat(acceleration, torque - ca.mtimes(ca.sparsify(ca.DM(vehicle.allocation[1:])), command))
    dg_dz, slope = ca.jacobian(equation.value(induced), z), equation.slope(induced)
    d_induced = -ca.mtimes(ca.diag(1 / slope), dg_dz)
    dy_dz = ca.jacobian(y, z) + ca.mtimes(ca.jacobian(y, induced), d_induced)
    y, dy_dz = ca.substitute([y, dy_dz], [induced], [solution])
    return y, dy_dz


def require_rotor(vehicle: Vehicle) -> None:
    """Raise UsageError where the vehicle has no rotor geometry or no thrust coefficient."""
    _ = vehicle.rotor_geometry, vehicle.static_thrust_coefficient
