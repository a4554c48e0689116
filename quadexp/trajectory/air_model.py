"""A residual at many points, as the flatness iteration needs it: outputs, and their gradients by velocity and thrusts.

The residual's function becomes one of z alone, its parameters constants, in scalar operations, without the rest of the
Jacobian, and is mapped over the points on numpy's memory: an order of magnitude quicker on thousands of points.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from quadexp.residual.base import FEATURES, N_OUTPUTS, Residual

N_FEATURES = len(FEATURES)  # of z, before the thrusts


class AirModel:
    """y = r(z), d(a_x, a_y)/d v_body and d(a_z, tau)/d u; arrays component first."""

    def __init__(self, residual: Residual) -> None:
        self.name = residual.name
        z = ca.SX.sym("z", residual.function.size1_in(0))
        y, dy_dz = residual.function(z, residual.theta)
        self._n_rotors = z.numel() - N_FEATURES
        gradients = ca.vertcat(ca.vec(dy_dz[:2, :3].T), ca.vec(dy_dz[2:, N_FEATURES:].T))
        self._function = ca.Function("air", [z], [ca.densify(ca.vertcat(y, gradients))])
        self._mapped: dict[int, ca.Function] = {}

    def __call__(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """y, (6, k); d(a_x, a_y)/d v_body, (2, 3, k) (1/s); d(a_z, tau)/d u, (4, n, k) (1/kg, m), at z, (6 + n, k)."""
        k = z.shape[1]
        if k not in self._mapped:
            self._mapped[k] = self._function.map(k)
        points, values = np.ascontiguousarray(z.T), np.empty((k, self._function.size1_out(0)))
        memory, evaluate = self._mapped[k].buffer()
        memory.set_arg(0, points.reshape(-1).data)
        memory.set_res(0, values.reshape(-1).data)
        evaluate()
        values = np.ascontiguousarray(values.T)
        by_velocity, by_thrust = values[N_OUTPUTS : N_OUTPUTS + 6], values[N_OUTPUTS + 6 :]
        return values[:N_OUTPUTS], by_velocity.reshape(2, 3, k), by_thrust.reshape(4, self._n_rotors, k)
