"""A residual at many points, for the flatness iteration: outputs, and their derivatives by velocity and thrusts.

Interpreted, the residual's function is rebuilt for z alone (parameters as constants, scalar operations, only the needed
part of the Jacobian) and mapped over the points in numpy's memory, which is ten times faster for thousands of points.
Compiled, it is a part of the functions of traced.py.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.models.residual import FEATURES, N_OUTPUTS, Residual
from quadexp.physics.expression import Expression

N_FEATURES = len(FEATURES)  # of z, before the thrusts
N_VELOCITY = 3


@dataclass(frozen=True)
class AirResponse:
    """r and its derivatives at k points, body frame; arrays component first.

    outputs: y = [a (m/s^2), tau (N m)], (6, k). by_velocity: dy/dv_body, (6, 3, k). by_thrust: dy/du, (6, n, k).
    """

    outputs: np.ndarray
    by_velocity: np.ndarray
    by_thrust: np.ndarray


class AirModel:
    """y = h r(z), dy/dv_body and dy/du at many points, with a share h of the residual r (1 at first)."""

    def __init__(self, residual: Residual, backend: str = "interpreted") -> None:
        self.name, self.residual, self.backend, self.share = residual.name, residual, backend, 1.0
        self._mapped: dict[int, ca.Function] = {}

    def scaled(self, share: float) -> AirModel:
        """The model with another share of the residual."""
        model = copy(self)
        model.share = share
        return model

    @cached_property
    def _function(self) -> ca.Function:
        z = ca.SX.sym("z", self.residual.function.size1_in(0))
        return ca.Function("air", [z], [outputs_and_gradients(self.residual.function, z, self.residual.theta)])

    def __call__(self, z: np.ndarray) -> AirResponse:
        """The response at z = [v_body, w, u], (6 + n, k), interpreted."""
        k = z.shape[1]
        if k not in self._mapped:
            self._mapped[k] = self._function.map(k)
        points, values = np.ascontiguousarray(z.T), np.empty((k, self._function.size1_out(0)))
        memory, evaluate = self._mapped[k].buffer()
        memory.set_arg(0, points.reshape(-1).data)
        memory.set_res(0, values.reshape(-1).data)
        evaluate()
        values = np.ascontiguousarray(values.T)
        if self.share != 1:
            values *= self.share
        split = N_OUTPUTS + N_OUTPUTS * N_VELOCITY
        by_velocity, by_thrust = values[N_OUTPUTS:split], values[split:]
        return AirResponse(
            values[:N_OUTPUTS], by_velocity.reshape(N_OUTPUTS, N_VELOCITY, k), by_thrust.reshape(N_OUTPUTS, -1, k)
        )


def outputs_and_gradients(function: ca.Function, z: Expression, theta: Expression) -> Expression:
    """y, dy/dv_body and dy/du of a residual's function, one after the other."""
    y, dy_dz = function(z, theta)
    return ca.densify(ca.vertcat(y, ca.vec(dy_dz[:, :N_VELOCITY].T), ca.vec(dy_dz[:, N_FEATURES:].T)))
