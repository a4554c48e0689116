"""State and input references from a trajectory by differential flatness, with or without a residual model, and whether
a vehicle can fly them.

    flat output p(t), heading  ->  R, w, w'  ->  x = [p, q, v, w],  u = G^+ [m (c - a_air,z), J w' + w x J w - tau_air]

Without a residual the map is in closed form (flat_map.py; Mellinger & Kumar 2011). With a residual model the
acceleration and torque of the air are the fixed point of fixed_point.py, solved on a regular grid of times
(time_grid.py) and interpolated. Headings: motion.py.

Where no solution of y = r(z(y)) is found, the reference contains a share h of the residual, y = h r(z(y)). h is one
number for the whole path, so that attitude, body rates and thrusts remain derivatives of each other and the reference
satisfies the equations of motion with h r. The largest h is found by bisection on a coarse grid, each attempt starting
from the solution for the largest share so far. h = 0 is the reference without residual. World ENU, body FLU, SI.

A vehicle can fly a reference with thrust_min <= u_i <= thrust_max (N) and |w| <= rate_max (rad/s).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from quadexp.errors import UsageError
from quadexp.models.residual import N_OUTPUTS, Residual
from quadexp.physics import rotation
from quadexp.physics.state import RATE
from quadexp.physics.vehicle import Vehicle
from quadexp.reference.air_step import AirModel
from quadexp.reference.base import Trajectory, end_of
from quadexp.reference.fixed_point import Settings, consistent_air
from quadexp.reference.motion import Air, Constant, Demand, Motion, flat_motion
from quadexp.reference.time_grid import TimeGrid

TOLERANCE = 1e-9  # m/s^2, N m: last change of the residual's outputs; the error is some tenths of it
ITERATIONS = 100  # of each of the two of fixed_point.py, which also end when they stall
COARSE_TOLERANCE = 1e-5  # m/s^2, N m: accuracy of the interpolation between coarse nodes
COARSE_ITERATIONS = 30  # at most; a fixed point that contracts by half reaches 1e-9
BISECTIONS = 5  # of the share of the residual: its resolution and least value is 1/32
REDUCTION = 0.8  # factor on the share where the fine grid has no solution although the coarse one had


@dataclass(frozen=True)
class Reference:
    """State and input of the vehicle on the trajectory.

    t: (k,), s. state: (k, 13), see quadexp.physics.state; the quaternion's sign is continuous and starts with w >= 0.
    input: rotor thrusts, (k, n), N; beyond the limits where the trajectory cannot be flown (see check_feasible).
    residual: share of the residual model in the reference, 0 .. 1; NaN without a model.
    """

    t: np.ndarray
    state: np.ndarray
    input: np.ndarray
    residual: float = math.nan


def flat_reference(
    trajectory: Trajectory, t: np.ndarray, vehicle: Vehicle, residual: Residual | None = None, *,
    backend: str = "interpreted",
) -> Reference:  # fmt: skip
    """Reference states and inputs of a trajectory, with the largest possible share of a residual model.

    t: (k,), s; outside 0 .. trajectory.duration the end is held, at rest.
    backend: of the residual's evaluation, "compiled" or "interpreted" (see compile/backend.py).
    Raises UsageError where the trajectory requires free fall.
    """
    t = np.atleast_1d(np.asarray(t, float))
    demand = Demand.of(trajectory, t, vehicle.gravity)
    path = _Path(trajectory, demand, vehicle, Settings(TOLERANCE, ITERATIONS))
    share = math.nan
    if residual is not None and not residual.is_zero:
        motion, share = path.with_largest_share(AirModel(residual, backend))
    else:
        motion = path.under(None)
    quaternion = continuous(motion.frame.body_quaternion(motion.chi).T)
    state = np.concatenate([demand.path[0].T, quaternion, demand.path[1].T, motion.rate.T], axis=1)
    return Reference(t, state, np.ascontiguousarray(motion.thrusts.T), share)


def continuous(quaternion: np.ndarray) -> np.ndarray:
    """Quaternions (k, 4) with a continuous sign, which starts with w >= 0."""
    sign = np.where(quaternion[:1, :1] < 0, -1.0, 1.0)
    return sign * rotation.continuous(quaternion)


@dataclass(frozen=True)
class _Path:
    """A trajectory at the times of a demand, and the grid on which the residual is solved."""

    trajectory: Trajectory
    demand: Demand
    vehicle: Vehicle
    settings: Settings

    @cached_property
    def grid(self) -> TimeGrid:
        t = self._times
        start = 0.0 if self.demand.yaw is None else float(t.min())  # a free heading is an integral from the start
        return TimeGrid.around(start, float(t.max()), 0.0, end_of(self.trajectory))

    @cached_property
    def _times(self) -> np.ndarray:
        return np.clip(self.demand.t, 0.0, end_of(self.trajectory))

    def with_largest_share(self, model: AirModel) -> tuple[Motion, float]:
        """The motion with the largest share of the model for which a solution is found, and this share."""
        try:
            return self.under(model), 1.0
        except UsageError:
            pass
        for corners in (False, True):  # first exact derivatives, then those of a path with corners
            part = replace(self, settings=replace(self.settings, corners=corners))._with_part(model)
            if part is not None:
                return part
        return self.under(None), 0.0

    def _with_part(self, model: AirModel) -> tuple[Motion, float] | None:
        low = 0.0
        high = 1.0
        guess = np.zeros((N_OUTPUTS, len(self.grid.coarse().times)))
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            outputs = self._coarsely(model.scaled(middle), guess * (middle / low) if low else None)
            if outputs is None:
                high = middle
            else:
                low = middle
                guess = outputs
        share = low
        while share >= 0.5**BISECTIONS:
            try:
                return self.under(model.scaled(share), guess * (share / low)), share
            except UsageError:
                share *= REDUCTION
        return None

    def under(self, model: AirModel | None, guess: np.ndarray | None = None) -> Motion:
        """The motion at the demand's times, with a residual model or none.

        guess: of the residual's outputs on the coarse grid, (6, n).
        Raises UsageError where the attitude is not determined, or no consistent residual is found.
        """
        if model is None and self.demand.yaw is not None:  # in closed form
            air = Air.still(len(self.demand.t))
            chi = np.zeros(len(self.demand.t))
        else:
            air, chi = self._air(model, guess)
        return flat_motion(self.demand, self.vehicle, air, Constant(chi))

    def _air(self, model: AirModel | None, guess: np.ndarray | None) -> tuple[Air, np.ndarray]:
        """The air and the twist of a free heading, (k,) (rad), at the demand's times, interpolated from the nodes."""
        air, motion = self._on_grid(model, guess)
        t = self._times
        values, first, second = self.grid.interpolate(np.concatenate([air.outputs, motion.chi[None]]), t)
        outputs = values[:-1]
        lateral_1 = first[:2]
        lateral_2 = second[:2]
        chi = values[-1]
        for held in (self.demand.t < t, self.demand.t > t):  # before the start, after the end: one constant state each
            if held.any():
                rest = Demand.of(self.trajectory, self.demand.t[held][:1], self.vehicle.gravity)
                air, _ = consistent_air(rest, self.vehicle, model, Constant(chi[held][:1]), self.settings)
                outputs[:, held] = air.outputs
                lateral_1[:, held] = 0.0
                lateral_2[:, held] = 0.0
        return Air(outputs, lateral_1, lateral_2), chi

    def _on_grid(self, model: AirModel | None, guess: np.ndarray | None) -> tuple[Air, Motion]:
        """The air and the motion at the nodes; the solution on the coarse grid is the initial guess."""
        start = None
        if model is not None:
            rough = self._coarsely(model, guess)
            if rough is not None:
                start, _, _ = self.grid.coarse().interpolate(rough, self.grid.times)
        demand = Demand.of(self.trajectory, self.grid.times, self.vehicle.gravity)
        return consistent_air(demand, self.vehicle, model, self.grid, self.settings, start=start)

    def _coarsely(self, model: AirModel, guess: np.ndarray | None) -> np.ndarray | None:
        """The residual's outputs on the coarse grid, (6, n); None where no solution is found."""
        rough = self.grid.coarse()
        loose = replace(self.settings, tolerance=COARSE_TOLERANCE, max_iterations=COARSE_ITERATIONS)
        try:
            demand = Demand.of(self.trajectory, rough.times, self.vehicle.gravity)
            return consistent_air(demand, self.vehicle, model, rough, loose, start=guess)[0].outputs
        except UsageError:
            return None


@dataclass(frozen=True)
class Infeasibility:
    """The worst violation of a limit along a reference.

    what: "rotor 2 thrust", "body rate". value, limit: in `unit`. t: s. margin: excess over the limit, above 0.
    share: of the reference's samples that are beyond any limit.
    """

    what: str
    value: float
    limit: float
    unit: str
    t: float
    margin: float
    share: float

    def __str__(self) -> str:
        side = "above" if self.value > self.limit else "below"
        return (
            f"the reference cannot be flown: {self.what} would be {self.value:.4g} {self.unit} at t = {self.t:.2f} s,"
            f" {self.margin:.3g} {self.unit} {side} the limit of {self.limit:g} {self.unit}"
            f" ({100 * self.share:.3g} % of the reference is beyond a limit)"
        )


def check_feasible(reference: Reference, vehicle: Vehicle) -> Infeasibility | None:
    """The largest violation relative to the limit's range, or None."""
    thrust_range = vehicle.thrust_max - vehicle.thrust_min
    rate = np.linalg.norm(reference.state[:, RATE], axis=1, keepdims=True)
    rotors = [f"rotor {i} thrust" for i in range(vehicle.n_rotors)]
    checks = (  # names, values (k, n), limit, sign of the violation, unit, range
        (rotors, reference.input, vehicle.thrust_max, 1.0, "N", thrust_range),
        (rotors, reference.input, vehicle.thrust_min, -1.0, "N", thrust_range),
        (["body rate"], rate, vehicle.rate_max, 1.0, "rad/s", vehicle.rate_max),
    )
    beyond = np.any([(sign * (values - limit) > 0).any(axis=1) for _, values, limit, sign, _, _ in checks], axis=0)
    if not beyond.any():
        return None
    names, values, limit, sign, unit, _ = max(checks, key=lambda c: (c[3] * (c[1] - c[2])).max() / c[5])
    row, column = np.unravel_index(np.argmax(sign * values), values.shape)
    value = float(values[row, column])
    return Infeasibility(
        names[column], value, limit, unit, float(reference.t[row]), sign * (value - limit), float(beyond.mean())
    )


def clipped(reference: Reference, vehicle: Vehicle) -> Reference:
    """The reference with every thrust, and every component of the body rate, brought back to the vehicle's limits."""
    state = reference.state.copy()
    state[:, RATE] = np.clip(state[:, RATE], -vehicle.rate_max, vehicle.rate_max)
    return replace(reference, state=state, input=np.clip(reference.input, vehicle.thrust_min, vehicle.thrust_max))
