"""One Newton step, independently at every time, for the residual outputs consistent with the motion they cause.

The unknown is Y = [l, a_air,z, tau_air], to solve Y = r(z(Y)). With s = r(z(Y)) - Y and A = dr/dY, blocks l and "rest":

    [1 - A_ll   -A_lr ] [dl   ]   [s_l   ]         (1 - A_ll - A_lr X) dl = s_l + A_lr x        X = (1 - A_rr)^-1 A_rl
    [-A_rl   1 - A_rr ] [drest] = [s_rest]    ->   drest = x + X dl                             x = (1 - A_rr)^-1 s_rest

A follows Y through the body velocity and the rotor thrusts:

    dr/dY = dr/dv_body dv_body/dl + dr/du du/dY,     du/dY = G^+ [m (dc/dl dl - da_air,z), -dtau_air],    dc/dl = -l / c

dv_body/dl: dl rotates the tilt frame by d theta, (d theta x f)_xy = -dl, which changes the velocity in it by
v x d theta. The effect of l on the rates, and of l', l'' on the torques, is neglected in A. The step is applied as a
rotation of f by at most MAX_TURN, because |f| is fixed and l is singular as a coordinate near |f|.

Interpreted, the residual's function is rebuilt for z alone (parameters as constants, scalar operations, only the needed
part of the Jacobian) and mapped over the points in numpy's memory, which is ten times faster for thousands of points.
Compiled, it is a part of the functions of traced.py.

Arrays are component first, (d, k) at k times; SI.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.models.residual import FEATURES, N_OUTPUTS, Residual
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle
from quadexp.reference.flat_map import cross, twisted, untwisted
from quadexp.reference.motion import Air, Calculus, Demand, Motion, allocation_inverse, flat_motion, within_limits

N_FEATURES = len(FEATURES)  # of z, before the thrusts
N_VELOCITY = 3  # axes
MAX_TURN = 0.3  # rad, largest rotation of the specific force in the tilt frame per step
MIN_SHARE = 0.02  # least component of the specific force along the rotors' axis, relative to its norm
MIN_DETERMINANT = 0.3  # of the system in dl; below it the step is the fixed-point step l <- r_l


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
        self.name = residual.name
        self.residual = residual
        self.backend = backend
        self.share = 1.0
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
        points = np.ascontiguousarray(z.T)
        values = np.empty((k, self._function.size1_out(0)))
        memory, evaluate = self._mapped[k].buffer()
        memory.set_arg(0, points.reshape(-1).data)
        memory.set_res(0, values.reshape(-1).data)
        evaluate()
        values = np.ascontiguousarray(values.T)
        if self.share != 1:
            values *= self.share
        y, by_velocity, by_thrust = np.split(values, [N_OUTPUTS, N_OUTPUTS * (1 + N_VELOCITY)])
        return AirResponse(y, by_velocity.reshape(N_OUTPUTS, N_VELOCITY, k), by_thrust.reshape(N_OUTPUTS, -1, k))


def outputs_and_gradients(function: ca.Function, z: Expression, theta: Expression) -> Expression:
    """y, dy/dv_body and dy/du of a residual's function, one after the other."""
    y, dy_dz = function(z, theta)
    return ca.densify(ca.vertcat(y, ca.vec(dy_dz[:, :N_VELOCITY].T), ca.vec(dy_dz[:, N_FEATURES:].T)))


def predicted_and_next(
    demand: Demand, vehicle: Vehicle, model: Callable[[np.ndarray], AirResponse], air: Air, calculus: Calculus
) -> tuple[np.ndarray, np.ndarray]:
    """The model's outputs for the motion under given outputs, and the next iterate, (6, k) each."""
    motion = flat_motion(demand, vehicle, air, calculus)
    velocity = motion.frame.into_frame(demand.path[1])
    thrusts, free = within_limits(motion.thrusts, vehicle)
    response = model(np.concatenate([twisted(velocity, motion.chi), motion.rate, thrusts]))
    predicted = np.concatenate([untwisted(response.outputs[:2], motion.chi), response.outputs[2:]])
    response = replace(response, by_thrust=response.by_thrust * free)  # zero for a rotor at its limit
    return predicted, newton_step(air.outputs, predicted, motion, velocity, response, vehicle)


def newton_step(
    current: np.ndarray, predicted: np.ndarray, motion: Motion, velocity: np.ndarray, response: AirResponse,
    vehicle: Vehicle,
) -> np.ndarray:  # fmt: skip
    """The next Y, (6, k).

    current: Y, of which `motion` is the motion; predicted: r(z(Y)); both (6, k), l in the tilt frame (m/s^2, N m).
    velocity: (3, k), tilt frame (m/s). response: derivatives of r in body axes; by thrusts zero where a rotor is at its
    limit.
    """
    by_lateral, by_rest = _gradients(motion, velocity, response, vehicle)
    difference = predicted - current
    right = np.concatenate([by_lateral[2:], difference[2:, None]], axis=1)  # A_rl, s_rest: (4, 3, k)
    solved = right
    if by_rest.any():
        system = np.eye(4) - by_rest[2:].transpose(2, 0, 1)
        solved = np.linalg.solve(system, right.transpose(2, 0, 1)).transpose(1, 2, 0)
    through_rest = np.zeros((2, 3, solved.shape[2]))  # A_lr [X, x]
    if by_rest.any():
        through_rest = np.einsum("irk,rjk->ijk", by_rest[:2], solved)
    system = np.eye(2)[..., None] - by_lateral[:2] - through_rest[:, :2]
    step = _lateral_step(system, difference[:2] + through_rest[:, 2], difference[:2])
    lateral = turned(motion.frame.force, step)
    rest = solved[:, 2] + np.einsum("rjk,jk->rk", solved[:, :2], lateral - current[:2])
    return np.concatenate([lateral, current[2:] + rest])


def _gradients(
    motion: Motion, velocity: np.ndarray, response: AirResponse, vehicle: Vehicle
) -> tuple[np.ndarray, np.ndarray]:
    """dr/dl, (6, 2, k), and dr/d[a_air,z, tau_air], (6, 4, k); r's lateral part in the tilt frame."""
    by_velocity, by_thrust = (  # lateral components, the first two, in the tilt frame
        np.concatenate([untwisted(d[:2], motion.chi), d[2:]]) for d in (response.by_velocity, response.by_thrust)
    )
    by_wrench = np.zeros((len(by_thrust), 4, by_thrust.shape[2]))
    if by_thrust.any():  # few models depend on the thrusts
        by_wrench = -np.einsum("onk,nw->owk", by_thrust, allocation_inverse(vehicle))
    by_wrench[:, 0] *= vehicle.mass
    force = motion.frame.force
    columns = []
    for axis, d_l in enumerate(((1.0, 0.0), (0.0, 1.0))):
        turn = motion.frame.solve(-d_l[0], -d_l[1])
        moved = twisted(cross(velocity, turn), motion.chi)
        columns.append((by_velocity * moved).sum(axis=1) + by_wrench[:, 0] * (force[axis] / force[2]))
    return np.stack(columns, axis=1), by_wrench


def _lateral_step(system: np.ndarray, right: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """The solution, (2, k), of system (2, 2, k) dl = right (2, k); `plain` where the system is nearly singular."""
    (a, b), (c, d) = system
    determinant = a * d - b * c
    regular = (determinant > MIN_DETERMINANT) & (a + d > 0)
    x, y = right
    newton = np.stack([d * x - b * y, a * y - c * x]) / np.where(regular, determinant, 1.0)
    return np.where(regular, newton, plain)


def turned(force: np.ndarray, step: np.ndarray) -> np.ndarray:
    """l, (2, k), of the specific force f (3, k) in the tilt frame after rotating f by the step (2, k) in l."""
    across = np.stack([*step, -(force[:2] * step).sum(axis=0) / force[2]])
    size = np.linalg.norm(force, axis=0)
    length = np.linalg.norm(across, axis=0)
    angle = np.minimum(length / size, MAX_TURN)
    after = force * np.cos(angle) + across * (size * np.sin(angle) / np.maximum(length, 1e-300))
    over = after[2] < 0  # beyond the equator: limited to its edge
    return reachable(np.where(over, 1e3, 1.0) * after[:2], size)


def reachable(lateral: np.ndarray, size: np.ndarray) -> np.ndarray:
    """l, (2, k), limited so that c is at least MIN_SHARE of the specific force `size`, (k,) (m/s^2)."""
    largest = size * np.sqrt(1 - MIN_SHARE**2)
    return lateral * np.minimum(1.0, largest / np.maximum(np.linalg.norm(lateral, axis=0), 1e-300))
