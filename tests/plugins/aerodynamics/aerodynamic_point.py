"""The blade-element model evaluated numerically at one velocity and set of rotor speeds.

Plants and controllers use the expressions of quadexp.plugins.aerodynamics.blade_element.
"""

from functools import cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from quadexp.errors import ModelDomainError
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.blade_element import ADOPTED, CrossTerms, aerodynamic_wrench, blade_forces, rotor_flow
from quadexp.plugins.aerodynamics.coefficients import C_D0, C_LA, STANDING, THETA, BladeCoefficients
from quadexp.plugins.aerodynamics.induced_velocity import REASONS, Defined, solution_function


class AerodynamicPoint(NamedTuple):
    """induced_velocity (n,) m/s. thrust (n,) N. hub_force H (n,) N. drag_torque (n,) N m.

    force F (3,) N and torque Gamma (3,) N m: body frame FLU.
    """

    induced_velocity: np.ndarray
    thrust: np.ndarray
    hub_force: np.ndarray
    drag_torque: np.ndarray
    force: np.ndarray
    torque: np.ndarray


def aerodynamic_point(
    vehicle: Vehicle, coefficients: BladeCoefficients, body_velocity: np.ndarray, rotor_speed: np.ndarray, *,
    rate: np.ndarray | None = None, terms: CrossTerms = ADOPTED,
) -> AerodynamicPoint:  # fmt: skip
    """Forces and torques of equations (4)-(7), (9)-(17) at one point.

    body_velocity: (3,) FLU (m/s). rotor_speed: (n,) (rad/s). rate: (3,) (rad/s) for rotor-local velocities, or None.
    Raises ModelDomainError, naming the rotor and the reason, where the model is not defined, and UsageError where the
    vehicle has no rotor geometry.
    """
    geometry = vehicle.rotor_geometry
    w = np.asarray(rotor_speed, float)
    local = np.zeros(3) if rate is None else np.asarray(rate, float)
    theta, flow = coefficients.parameters(), _flow_function(vehicle)
    in_plane_squared, axial = (np.array(part).ravel() for part in flow(body_velocity, local))
    solution = solution_function(geometry, terms)(theta[C_LA], w[None], in_plane_squared[None], axial[None])
    induced, status = (np.array(part).ravel() for part in solution)
    for i, code in enumerate(status):
        if code != Defined.OK:
            raise ModelDomainError(
                f"blade-element model, rotor {i}: {REASONS[Defined(int(code))]} (V_h={in_plane_squared[i] ** 0.5:.3g}"
                f" m/s, V_z={axial[i]:.3g} m/s, w={w[i]:.4g} rad/s)"
            )
    function = _point_function(vehicle, rate is not None, terms)
    values = function(theta, body_velocity, local, np.maximum(w, STANDING), induced)
    thrust, hub, torque, force, moment = (np.array(part).ravel() for part in values)
    return AerodynamicPoint(induced, thrust, hub * np.sqrt(in_plane_squared), torque, force, moment)


@cache
def _flow_function(vehicle: Vehicle) -> ca.Function:
    v, rate = ca.SX.sym("v", 3), ca.SX.sym("rate", 3)
    flow = rotor_flow(vehicle, v, rate)
    return ca.Function("flow", [v, rate], [flow.in_plane_squared, flow.axial])


@cache
def _point_function(vehicle: Vehicle, local: bool, terms: CrossTerms) -> ca.Function:
    n = vehicle.n_rotors
    theta, v, rate = ca.SX.sym("theta", len(THETA)), ca.SX.sym("v", 3), ca.SX.sym("rate", 3)
    w, induced = ca.SX.sym("w", n), ca.SX.sym("V_I", n)
    flow = rotor_flow(vehicle, v, rate)
    rotors = blade_forces(
        vehicle.rotor_geometry, theta[C_D0], theta[C_LA], w, induced - flow.axial, flow.in_plane_squared, terms
    )
    wrench = aerodynamic_wrench(vehicle, theta, v, w, induced, rate=rate if local else None, terms=terms)
    return ca.Function("point", [theta, v, rate, w, induced], [*rotors, *wrench])
