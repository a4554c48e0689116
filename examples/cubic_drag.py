"""A residual of your own: drag that grows with the cube of the speed.

    a_body = -c v |v|^2                                                             m/s^2

As CasADi expressions it is used in the MPC's prediction and in the reference's feed-forward like any other residual.
"""

from dataclasses import dataclass

import casadi as ca

from quadexp.control.mpc.part import MPC
from quadexp.models.residual import feature_names, symbolic_residual
from quadexp.parts.settings import key


@dataclass(frozen=True, kw_only=True)
class CubicDragMPC(MPC):
    """The MPC with this residual in its prediction."""

    # A key of controller=cubic_drag_mpc, besides those of every MPC; swept as controller.coefficient=0.003,0.006.
    coefficient: float = key(0.006, "c", "[0, 1]", "s/m^2")

    def model(self, given):
        return cubic_drag(given.vehicle, coefficient=self.coefficient)


def cubic_drag(vehicle, *, coefficient):
    """coefficient: c, s/m^2; a runtime parameter, so that another value needs no recompilation."""
    features = ca.SX.sym("z", len(feature_names(vehicle.n_rotors)))  # body velocity, body rate, rotor thrusts
    theta = ca.SX.sym("theta", 1)
    velocity = features[:3]
    acceleration = -theta * velocity * ca.sumsqr(velocity)
    torque = ca.SX(3, 1)  # N m, body; structural zeros cost nothing
    return symbolic_residual("cubic_drag", ca.vertcat(acceleration, torque), features, theta, [coefficient])
