"""State and input references from a trajectory by differential flatness, without the air or with any model of it.

    flat output p(t), heading  ->  R, w, w'  ->  x = [p, q, v, w],  u = G^+ [m (c - a_air,z), J w' + w x J w - tau_air]

Without a residual the map is closed-form (flat_map.py; Mellinger & Kumar 2011). With a residual model the acceleration
and torque of the air are the fixed point of fixed_point.py, solved on a regular grid of times (time_grid.py) and
interpolated. Headings: demand.py.

Where y = r(z(y)) has no solution, or none is found, the reference contains a share h of the residual, y = h r(z(y)). It
is one number for the whole path: attitude, body rates and thrusts stay derivatives of each other, and the reference
obeys the equations of motion under h r. The largest h is looked for by bisection on a coarse grid, each attempt
starting from the solution under the largest share before. h = 0 is the reference without air. World ENU, body FLU, SI.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from quadexp.air.base import N_OUTPUTS, Residual
from quadexp.errors import UsageError
from quadexp.physics.vehicle import Vehicle
from quadexp.reference.air_model import AirModel, PartialAir
from quadexp.reference.base import Trajectory
from quadexp.reference.demand import Demand
from quadexp.reference.fixed_point import Settings, agreeing_air
from quadexp.reference.motion import Air, Held, Motion, flat_motion
from quadexp.reference.time_grid import TimeGrid

COARSE_TOLERANCE = 1e-5  # m/s^2, N m: the interpolation between coarse nodes is no better
COARSE_ITERATIONS = 30
BISECTIONS = 5  # of the share of a residual that a reference contains: a 32nd is the least, and how near 1 it comes
LESS = 0.8  # by which the share is reduced where the grid has no solution and the coarse one had


@dataclass(frozen=True)
class Reference:
    """What the vehicle would do on the trajectory.

    t: (k,), s. state: (k, 13), see quadexp.physics.state; the quaternion does not jump in sign and starts with w >= 0.
    input: rotor thrusts, (k, n), N; outside the limits where the trajectory cannot be flown (see feasibility).
    residual: share of the residual model that it contains, 0 .. 1; NaN where no model was given.
    """

    t: np.ndarray
    state: np.ndarray
    input: np.ndarray
    residual: float = math.nan


def flat_reference(
    trajectory: Trajectory,
    t: np.ndarray,
    vehicle: Vehicle,
    residual: Residual | None = None,
    *,
    tolerance: float = 1e-9,
    max_iterations: int = 100,
    backend: str = "interpreted",
) -> Reference:
    """Reference states and inputs of a trajectory, under as much of a residual model as it can contain.

    t: (k,), s; outside 0 .. trajectory.duration the end is held, at rest.
    tolerance: on the last change of the residual's outputs, m/s^2 and N m; the error is some tenths of it.
    max_iterations: for each of the two iterations of fixed_point.py; they end before where they come no nearer.
    backend: that the residual is evaluated on, "compiled" or "interpreted" (see compile/backend.py).
    Raises UsageError where the trajectory asks for free fall.
    """
    t = np.atleast_1d(np.asarray(t, float))
    demand = Demand.of(trajectory, t, vehicle.gravity)
    path, share = _Path(trajectory, demand, vehicle, Settings(tolerance, max_iterations)), math.nan
    if residual is not None and not residual.is_zero:
        motion, share = path.with_largest_share(AirModel(residual, backend))
    else:
        motion = path.under(None)
    quaternion = motion.frame.body_quaternion(motion.chi)
    return as_reference(t, demand.path[0].T, quaternion.T, demand.path[1].T, motion.rate.T, motion.thrusts.T, share)


@dataclass(frozen=True)
class _Path:
    """A trajectory at the times of a demand, and the grid that its air is found on."""

    trajectory: Trajectory
    demand: Demand
    vehicle: Vehicle
    settings: Settings

    @cached_property
    def grid(self) -> TimeGrid:
        t = self._times
        start = 0.0 if self.demand.yaw is None else float(t.min())  # a free heading is an integral from the start
        return TimeGrid.around(start, float(t.max()), 0.0, self.trajectory.duration)

    @cached_property
    def _times(self) -> np.ndarray:
        return np.clip(self.demand.t, 0.0, self.trajectory.duration)

    def with_largest_share(self, model: AirModel) -> tuple[Motion, float]:
        """The motion under the largest share of the model for which one is found, and this share."""
        try:
            return self.under(model), 1.0
        except UsageError:
            pass
        for corners in (False, True):  # rates that are exact derivatives first, then those of a path with corners
            part = replace(self, settings=replace(self.settings, corners=corners))._with_part(model)
            if part is not None:
                return part
        return self.under(None), 0.0

    def _with_part(self, model: AirModel) -> tuple[Motion, float] | None:
        low, high, found = 0.0, 1.0, np.zeros((N_OUTPUTS, len(self.grid.coarse().times)))
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            outputs = self._coarsely(PartialAir(model, middle), found * (middle / low) if low else None)
            if outputs is None:
                high = middle
            else:
                low, found = middle, outputs
        share = low
        while share >= 0.5**BISECTIONS:
            try:
                return self.under(PartialAir(model, share), found * (share / low)), share
            except UsageError:
                share *= LESS
        return None

    def under(self, model: AirModel | PartialAir | None, guess: np.ndarray | None = None) -> Motion:
        """The motion at the demand's times under a model of the air or none.

        guess: of the air's outputs on the coarse grid, (6, n).
        Raises UsageError where the demand leaves no attitude, or no air is found that agrees with the motion.
        """
        still = model is None and self.demand.yaw is not None  # closed-form, time by time
        air, chi = (Air.still(len(self.demand.t)), np.zeros(len(self.demand.t))) if still else self._air(model, guess)
        return flat_motion(self.demand, self.vehicle, air, Held(chi))

    def _air(self, model: AirModel | PartialAir | None, guess: np.ndarray | None) -> tuple[Air, np.ndarray]:
        """The air and the twist of a free heading, (k,) (rad), at the demand's times, from those at the nodes."""
        air, motion = self._on_grid(model, guess)
        t = self._times
        values, first, second = self.grid.interpolate(np.concatenate([air.outputs, motion.chi[None]]), t)
        outputs, lateral_1, lateral_2, chi = values[:-1], first[:2], second[:2], values[-1]
        for held in (self.demand.t < t, self.demand.t > t):  # before the start, after the end: one state each
            if held.any():
                rest = Demand.of(self.trajectory, self.demand.t[held][:1], self.vehicle.gravity)
                air, _ = agreeing_air(rest, self.vehicle, model, Held(chi[held][:1]), self.settings)
                outputs[:, held], lateral_1[:, held], lateral_2[:, held] = air.outputs, 0.0, 0.0
        return Air(outputs, lateral_1, lateral_2), chi

    def _on_grid(self, model: AirModel | PartialAir | None, guess: np.ndarray | None) -> tuple[Air, Motion]:
        """The air and the motion at the nodes; a solution on a coarser grid is the first guess."""
        start = None
        if model is not None:
            rough = self._coarsely(model, guess)
            if rough is not None:
                start, _, _ = self.grid.coarse().interpolate(rough, self.grid.times)
        demand = Demand.of(self.trajectory, self.grid.times, self.vehicle.gravity)
        return agreeing_air(demand, self.vehicle, model, self.grid, self.settings, start=start)

    def _coarsely(self, model: AirModel | PartialAir, guess: np.ndarray | None) -> np.ndarray | None:
        """The air's outputs on the coarse grid, (6, n); None where there are none."""
        rough, settings = self.grid.coarse(), self.settings
        loose = replace(
            settings,
            tolerance=max(settings.tolerance, COARSE_TOLERANCE),
            max_iterations=min(settings.max_iterations, COARSE_ITERATIONS),
        )
        try:
            demand = Demand.of(self.trajectory, rough.times, self.vehicle.gravity)
            return agreeing_air(demand, self.vehicle, model, rough, loose, start=guess)[0].outputs
        except UsageError:
            return None


def as_reference(
    t: np.ndarray,
    position: np.ndarray,
    quaternion: np.ndarray,
    velocity: np.ndarray,
    rate: np.ndarray,
    thrusts: np.ndarray,
    residual: float = math.nan,
) -> Reference:
    """A Reference from its parts, the quaternion's sign made continuous.

    t: (k,), s. position, velocity: (k, 3), world. quaternion: (k, 4). rate: (k, 3), body. thrusts: (k, n), N.
    residual: see Reference.
    """
    flips = np.where((quaternion[1:] * quaternion[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    first = np.where(quaternion[:1, 0] < 0, -1.0, 1.0)
    quaternion = quaternion * np.cumprod(np.concatenate([first, flips]))[:, None]
    state = np.concatenate([position, quaternion, velocity, rate], axis=1)
    return Reference(t, state, np.ascontiguousarray(thrusts), residual)
