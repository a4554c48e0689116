"""A residual at many points, as the flatness iteration needs it: outputs, and their gradients by velocity and thrusts.

Interpreted, the residual's function becomes one of z alone, its parameters constants, in scalar operations, without the
rest of the Jacobian, and is mapped over the points on numpy's memory: an order of magnitude quicker on thousands of
points. Compiled, it is a part of traced.py's functions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from quadexp.air.base import FEATURES, N_OUTPUTS, Residual
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

    def times(self, share: float) -> AirResponse:
        """The response of a model that is `share` times as strong."""
        return AirResponse(share * self.outputs, share * self.by_velocity, share * self.by_thrust)


class AirModel:
    """y = r(z), dy/dv_body and dy/du at many points."""

    share = 1.0  # of the residual

    def __init__(self, residual: Residual, backend: str = "interpreted") -> None:
        self.name, self.residual, self.backend = residual.name, residual, backend
        self._mapped: dict[int, ca.Function] = {}

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
        split = N_OUTPUTS + N_OUTPUTS * N_VELOCITY
        by_velocity, by_thrust = values[N_OUTPUTS:split], values[split:]
        return AirResponse(
            values[:N_OUTPUTS], by_velocity.reshape(N_OUTPUTS, N_VELOCITY, k), by_thrust.reshape(N_OUTPUTS, -1, k)
        )


def outputs_and_gradients(function: ca.Function, z: Expression, theta: Expression) -> Expression:
    """y, dy/dv_body and dy/du one after the other."""
    y, dy_dz = function(z, theta)
    return ca.densify(ca.vertcat(y, ca.vec(dy_dz[:, :N_VELOCITY].T), ca.vec(dy_dz[:, N_FEATURES:].T)))


@dataclass(frozen=True)
class PartialAir:
    """`share` times a model of the air."""

    model: AirModel
    share: float

    @property
    def name(self) -> str:
        return self.model.name

    @property
    def residual(self) -> Residual:
        return self.model.residual

    @property
    def backend(self) -> str:
        return self.model.backend

    def __call__(self, z: np.ndarray) -> AirResponse:
        """See AirModel."""
        return self.model(z).times(self.share)
