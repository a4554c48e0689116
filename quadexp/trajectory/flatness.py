"""State and input references from a trajectory by differential flatness, without the air or with any model of it.

    flat output p(t), heading  ->  R, w, w'  ->  x = [p, q, v, w],  u = G^+ [m (c - a_air,z), J w' + w x J w - tau_air]

Without a residual the map is closed-form (flat_map.py; Mellinger & Kumar 2011). With a residual model the acceleration
and torque of the air are the fixed point of fixed_point.py, solved on a regular grid of times (time_grid.py) and
interpolated. Headings: demand.py. World ENU, body FLU, SI.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np

from quadexp.errors import UsageError
from quadexp.residual.base import Residual
from quadexp.trajectory.air_model import AirModel
from quadexp.trajectory.base import Trajectory
from quadexp.trajectory.demand import Demand
from quadexp.trajectory.fixed_point import Settings, agreeing_air
from quadexp.trajectory.motion import Air, Held, Motion, flat_motion
from quadexp.trajectory.time_grid import TimeGrid
from quadexp.vehicle import Vehicle

COARSE_TOLERANCE = 1e-5  # m/s^2, N m: the interpolation between coarse nodes is no better
COARSE_ITERATIONS = 30


@dataclass(frozen=True)
class Reference:
    """What the vehicle would do on the trajectory.

    t: (k,), s. state: (k, 13), see quadexp.state; the quaternion does not jump in sign and starts with w >= 0.
    input: rotor thrusts, (k, n), N; outside the limits where the trajectory cannot be flown (see feasibility).
    """

    t: np.ndarray
    state: np.ndarray
    input: np.ndarray


def flat_reference(
    trajectory: Trajectory,
    t: np.ndarray,
    vehicle: Vehicle,
    residual: Residual | None = None,
    *,
    tolerance: float = 1e-9,
    max_iterations: int = 100,
) -> Reference:
    """Reference states and inputs of a trajectory, under a residual model if one is given.

    t: (k,), s; outside 0 .. trajectory.duration the end is held, at rest.
    tolerance: on the last change of the residual's outputs, m/s^2 and N m; the error is some tenths of it.
    max_iterations: for each of the two iterations of fixed_point.py; they end before where they come no nearer.
    Raises UsageError where the trajectory asks for free fall, or where the iteration does not converge.
    """
    t = np.atleast_1d(np.asarray(t, float))
    demand = Demand.of(trajectory, t, vehicle.gravity)
    model = None if residual is None or residual.is_zero else AirModel(residual)
    air, chi = Air.still(len(t)), np.zeros(len(t))
    if model is not None or demand.yaw is None:
        air, chi = _from_grid(trajectory, demand, vehicle, model, Settings(tolerance, max_iterations))
    motion = flat_motion(demand, vehicle, air, Held(chi))
    quaternion = motion.frame.body_quaternion(motion.chi)
    return as_reference(t, demand.path[0].T, quaternion.T, demand.path[1].T, motion.rate.T, motion.thrusts.T)


def _from_grid(
    trajectory: Trajectory, demand: Demand, vehicle: Vehicle, model: AirModel | None, settings: Settings
) -> tuple[Air, np.ndarray]:
    """The air and the twist of a free heading, (k,) (rad), at the demand's times, from a regular grid over them."""
    t = np.clip(demand.t, 0.0, trajectory.duration)
    start = 0.0 if demand.yaw is None else float(t.min())  # a free heading is an integral from the start
    grid = TimeGrid.around(start, float(t.max()), 0.0, trajectory.duration)
    air, motion = _on_grid(trajectory, grid, vehicle, model, settings)
    values, first, second = grid.interpolate(np.concatenate([air.outputs, motion.chi[None]]), t)
    outputs, lateral_1, lateral_2, chi = values[:-1], first[:2], second[:2], values[-1]
    for held in (demand.t < t, demand.t > t):  # before the start, after the end: one state each
        if held.any():
            rest = Demand.of(trajectory, demand.t[held][:1], vehicle.gravity)
            air, _ = agreeing_air(rest, vehicle, model, Held(chi[held][:1]), settings)
            outputs[:, held], lateral_1[:, held], lateral_2[:, held] = air.outputs, 0.0, 0.0
    return Air(outputs, lateral_1, lateral_2), chi


def _on_grid(
    trajectory: Trajectory, grid: TimeGrid, vehicle: Vehicle, model: AirModel | None, settings: Settings
) -> tuple[Air, Motion]:
    """The air and the motion at the nodes; a solution on a coarser grid is the first guess."""
    start = None
    if model is not None:
        rough = grid.coarse()
        demand = Demand.of(trajectory, rough.times, vehicle.gravity)
        loose = Settings(max(settings.tolerance, COARSE_TOLERANCE), min(settings.max_iterations, COARSE_ITERATIONS))
        with contextlib.suppress(UsageError):  # the grid itself decides whether there is a solution
            air, _ = agreeing_air(demand, vehicle, model, rough, loose)
            start, _, _ = rough.interpolate(air.outputs, grid.times)
    return agreeing_air(Demand.of(trajectory, grid.times, vehicle.gravity), vehicle, model, grid, settings, start=start)


def as_reference(
    t: np.ndarray,
    position: np.ndarray,
    quaternion: np.ndarray,
    velocity: np.ndarray,
    rate: np.ndarray,
    thrusts: np.ndarray,
) -> Reference:
    """A Reference from its parts, the quaternion's sign made continuous.

    t: (k,), s. position, velocity: (k, 3), world. quaternion: (k, 4). rate: (k, 3), body. thrusts: (k, n), N.
    """
    flips = np.where((quaternion[1:] * quaternion[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    first = np.where(quaternion[:1, 0] < 0, -1.0, 1.0)
    quaternion = quaternion * np.cumprod(np.concatenate([first, flips]))[:, None]
    state = np.concatenate([position, quaternion, velocity, rate], axis=1)
    return Reference(t, state, np.ascontiguousarray(thrusts))
