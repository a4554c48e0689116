"""A residual at many points, as the flatness iteration needs it: outputs and their lateral velocity gradient.

The residual's function becomes one of z alone, its parameters constants, in scalar operations, without the rest of the
Jacobian, and is mapped over the points on numpy's memory: an order of magnitude quicker on thousands of points.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from quadexp.residual.base import N_OUTPUTS, Residual


class AirModel:
    """y = r(z) and d(a_x, a_y)/d v_body; arrays component first."""

    def __init__(self, residual: Residual) -> None:
        self.name = residual.name
        z = ca.SX.sym("z", residual.function.size1_in(0))
        y, dy_dz = residual.function(z, residual.theta)
        self._function = ca.Function("air", [z], [ca.densify(ca.vertcat(y, ca.vec(dy_dz[:2, :3].T)))])
        self._mapped: dict[int, ca.Function] = {}

    def __call__(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """y, (6, k), and d(a_x, a_y)/d v_body, (2, 3, k) (1/s), at z, (6 + n, k)."""
        k = z.shape[1]
        if k not in self._mapped:
            self._mapped[k] = self._function.map(k)
        points, values = np.ascontiguousarray(z.T), np.empty((k, self._function.size1_out(0)))
        memory, evaluate = self._mapped[k].buffer()
        memory.set_arg(0, memoryview(points.reshape(-1)))
        memory.set_res(0, memoryview(values.reshape(-1)))
        evaluate()
        values = np.ascontiguousarray(values.T)
        return values[:N_OUTPUTS], values[N_OUTPUTS:].reshape(2, 3, k)
