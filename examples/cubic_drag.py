"""A residual of your own: drag that grows with the cube of the speed.

    a_body = -c v |v|^2                                                             m/s^2

As CasADi expressions it is used in the MPC's prediction and in the reference's feed-forward like any other residual.
"""

import casadi as ca

from quadexp.air.base import feature_names, symbolic_residual


# Arguments: the vehicle, and the keys under `options` of controller/cubic_drag_mpc.yaml.
def cubic_drag(vehicle, *, coefficient):
    """coefficient: c, s/m^2; a runtime parameter, so that another value needs no recompilation."""
    features = ca.SX.sym("z", len(feature_names(vehicle.n_rotors)))  # body velocity, body rate, rotor thrusts
    theta = ca.SX.sym("theta", 1)
    velocity = features[:3]
    acceleration = -theta * velocity * ca.sumsqr(velocity)
    torque = ca.SX(3, 1)  # N m, body; structural zeros cost nothing
    return symbolic_residual("cubic_drag", ca.vertcat(acceleration, torque), features, theta, [coefficient])
