"""The control law of Lei & Li 2017, equations (27)-(40), for one sample, as one CasADi function.

State and reference are given in ENU/FLU and converted here; all other inputs and outputs are in NED/FRD.
"""

from __future__ import annotations

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.feedback.allocation import allocate, unit_allocation
from quadexp.control.feedback.attitude import attitude_error, attitude_torque
from quadexp.control.feedback.compensation import allocation_coefficients, compensation, drag_force
from quadexp.control.feedback.frames import FRD_FLU, NED_ENU, euler_angles, rotation_euler, yaw_ned
from quadexp.control.feedback.observer import observer_matrices
from quadexp.control.feedback.position import desired_tilt, in_cone, position_feedback, thrust_vector
from quadexp.control.feedback.settings import FeedbackSettings, Variant
from quadexp.physics.rotation import air_velocity, rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle


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
    x, reference, yaw = ca.SX.sym("x", N_STATE), ca.SX.sym("reference", 3, 3), ca.SX.sym("yaw", 3)
    theta, velocity_last, rotor_speed_last = ca.SX.sym("theta", 5), ca.SX.sym("v", 3), ca.SX.sym("w", n)
    eta_d_last, observer_last = ca.SX.sym("eta_d", 3), ca.SX.sym("observer", 3, 2)

    R = ca.mtimes([ca.DM(NED_ENU), rotation_matrix(x[ATTITUDE]), ca.DM(FRD_FLU)])
    eta, rate = euler_angles(R), ca.mtimes(ca.DM(FRD_FLU), x[RATE])
    velocity_ned = ca.mtimes(ca.DM(NED_ENU), x[VELOCITY])
    velocity = ca.mtimes(ca.DM(FRD_FLU), air_velocity(x[ATTITUDE], x[VELOCITY]))
    target = ca.mtimes(ca.DM(NED_ENU), reference)
    psi_d, psi_d_dot, psi_d_ddot = yaw_ned(yaw[0]), -yaw[1], -yaw[2]

    hub, delta_thrust, delta_torque = compensation(vehicle, theta, velocity_last, rotor_speed_last)
    hub, delta_thrust, delta_torque = hub * variant.hub, delta_thrust * variant.thrust, delta_torque * variant.torque
    drag = drag_force(vehicle, theta, velocity) * variant.drag

    u_xi = position_feedback(
        ca.mtimes(ca.DM(NED_ENU), x[POSITION]) - target[:, 0],
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
    observer = ca.mtimes(ca.DM(exact), observer_last) + ca.mtimes(ca.DM(driven), eta_d[:2].T)
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
    low, high = settings.rotor_speed_min**2, vehicle.thrust_max / vehicle.static_thrust_coefficient
    commanded = ca.fmin(ca.fmax(squared, low), high)
    floored, limited = ca.sum1(squared < low), ca.sum1(squared > high)

    inputs = {
        "x": x,
        "reference": reference,
        "yaw": yaw,
        "theta": theta,
        "velocity_last": velocity_last,
        "rotor_speed_last": rotor_speed_last,
        "eta_d_last": eta_d_last,
        "observer_last": observer_last,
    }
    outputs = {
        "thrust": vehicle.static_thrust_coefficient * commanded,
        "rotor_speed": ca.sqrt(commanded),
        "eta_d": eta_d,
        "observer": observer,
        "velocity": velocity,
        "error": error,
        "outside": outside,
        "floored": floored,
        "limited": limited,
        "u_T": u_T,
    }
    values = ca.cse([ca.densify(value) for value in outputs.values()])
    return ca.Function("feedback_law", list(inputs.values()), values, list(inputs), list(outputs))
