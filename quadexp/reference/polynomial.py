"""Polynomial paths: minimum snap through points, flown in the shortest time within a vehicle's limits.

Pieces of degree 7 that minimise the integral of the squared snap, at rest with zero acceleration and jerk at both ends;
the minimiser is continuous up to the sixth derivative. Source: Mellinger & Kumar 2011; `minsnap-trajectories`.

A path p(s) flown as p(t / c) keeps its shape; its n-th derivative, and that of its heading, is divided by c^n. The
factor c is the least one with

    |p'| / c <= speed,        |w| <= (1 - margin) rate_max,
    u_0 - (1 - margin) (u_0 - thrust_min) <= u <= u_0 + (1 - margin) (thrust_max - u_0)       for every rotor,

where u_0 is its thrust in hover: `margin` is the share of the range between hover and a limit that is reserved for the
controller and the air. Thrusts u and body rates w are those of the reference without residual (motion.py), so that the
path does not depend on the controller. The speed bound is exact; the others are checked on a fine time grid, and the
boundary of the feasible factors is found by bracketing. World ENU, body FLU, SI.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from minsnap_trajectories import Waypoint, generate_trajectory
from scipy.interpolate import PPoly
from scipy.optimize import brentq

from quadexp.errors import UsageError
from quadexp.physics.vehicle import Vehicle
from quadexp.reference.base import N_DERIVATIVES, FlatOutput, derivatives, flat_output_held, hold_outside
from quadexp.reference.motion import Air, Demand, allocation_inverse, flat_motion
from quadexp.reference.time_grid import TimeGrid

DEGREE = 7  # of a minimum-snap polynomial
_REAL = 1e-6  # largest imaginary part of a real root, relative to the length of the piece
SPEED = "speed"  # the limit where the requested speed is reached first
STEPS = 64  # grid points per mean piece
FEWEST = 16  # least per piece
MOST = 30_000  # most in total
DOUBLINGS = 60  # of the factor, before the limits are considered unreachable
NEAR_LIMIT = 0.1  # share of the hover thrust; with less range to a limit, hover itself restricts the path
TOLERANCE = 1e-9  # of the logarithm of the factor
BEYOND = 10.0  # excess where the attitude is undefined; larger excesses are clipped to it


def minimum_snap(times: np.ndarray, points: np.ndarray) -> PPoly:
    """The path through the points (k, d) at the increasing times (k,), k of 2 or more.

    Raises ValueError where there are no such polynomials, for instance for points too close for their times.
    """
    unit = (times[-1] - times[0]) / (len(times) - 1)  # a mean piece of length 1 keeps the linear system well scaled
    rest = np.zeros(points.shape[1])
    rows = zip((times - times[0]) / unit, points, [rest, *[None] * (len(times) - 2), rest], strict=True)
    waypoints = [Waypoint(time, point, jerk=jerk) for time, point, jerk in rows]
    pieces = generate_trajectory(waypoints, degree=DEGREE, idx_minimized_orders=4, num_continuous_orders=4)
    coefficients = pieces.coefficients[:, ::-1].transpose(1, 0, 2)
    if not np.all(np.isfinite(coefficients)):
        raise ValueError("coefficients that are not finite")
    powers = np.arange(DEGREE, -1, -1)[:, None, None]
    return PPoly(coefficients / unit**powers, times[0] + unit * pieces.time_reference)


def largest_speed(path: PPoly) -> float:
    """The largest speed of a path in its first three components, exact up to rounding.

    The maximum over the ends of each piece and the roots of d/dt |p'|^2 = 0.
    """
    velocity = path.derivative()
    largest = 0.0
    for piece, length in enumerate(np.diff(path.x)):
        scaled = velocity.c[:, piece, :3] * length ** np.arange(len(velocity.c) - 1, -1, -1)[:, None]
        square = np.sum([np.convolve(component, component) for component in scaled.T], axis=0)
        slope = np.trim_zeros(np.polyder(square), "f")
        roots = np.roots(slope) if len(slope) > 1 else np.empty(0)
        inside = roots.real[(np.abs(roots.imag) < _REAL) & (roots.real > 0) & (roots.real < 1)]
        largest = max(largest, float(np.polyval(square, np.concatenate([[0.0, 1.0], inside])).max()))
    return float(np.sqrt(largest))


@dataclass(frozen=True)
class ScaledPath:
    """A path flown in `factor` times its path time.

    path: components x, y, z (m) and optionally the yaw (rad); without it the heading is free. limited_by: the limit
    that determines the factor, such as SPEED, "rotor 2 thrust".
    """

    path: PPoly
    factor: float
    limited_by: str = SPEED

    @property
    def duration(self) -> float:
        """s."""
        return float(self.factor * (self.path.x[-1] - self.path.x[0]))

    @cached_property
    def peak_speed(self) -> float:
        """Largest speed, m/s."""
        return largest_speed(self.path) / self.factor

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        t, inside = hold_outside(t, self.duration)
        path_time = np.clip(self.path.x[0] + t / self.factor, self.path.x[0], self.path.x[-1])
        values = np.stack([d(path_time) / self.factor**n for n, d in enumerate(self._derivatives)], axis=1)
        yaw = values[:, :3, 3].copy() if values.shape[2] > 3 else None
        return flat_output_held(np.ascontiguousarray(values[:, :, :3]), yaw, inside)

    def note(self, requested: float | None, vehicle: Vehicle | None) -> str:
        """The limit that keeps the peak speed below the requested one (m/s), in one line; "" if none."""
        if vehicle is None or self.limited_by == SPEED:
            return ""
        parts = []
        hover = vehicle.hover_thrust
        if requested is not None:
            parts.append(
                f"peak speed {self.peak_speed:.3g} m/s instead of the requested {requested:g} m/s: a higher one would"
                f" bring {self.limited_by} closer to its limit than trajectory.margin allows"
            )
        if vehicle.thrust_max - hover < NEAR_LIMIT * hover:
            parts.append(f"hovering alone takes {hover / vehicle.thrust_max:.0%} of vehicle.thrust_max")
        elif hover - vehicle.thrust_min < NEAR_LIMIT * hover:
            parts.append(f"vehicle.thrust_min is {vehicle.thrust_min / hover:.0%} of the hover thrust")
        return "; ".join(parts)

    @cached_property
    def _derivatives(self) -> tuple[PPoly, ...]:
        return derivatives(self.path)


def time_scale(path: PPoly, vehicle: Vehicle | None, *, speed: float | None, margin: float) -> ScaledPath:
    """The path in the shortest time within the limits.

    path: components x, y, z (m) and optionally the yaw (rad); without it the heading is free. vehicle: None: only the
    speed is limited. speed: largest speed, m/s; None: limited by the vehicle only. margin: see the module.
    Raises UsageError where the path does not move, or where no factor satisfies the limits.
    """
    peak = largest_speed(path)
    if speed is None and vehicle is None:
        raise UsageError("trajectory.speed: is required where no vehicle limits the path")
    if not (np.isfinite(peak) and peak > 0):
        raise UsageError("the path does not move: its points (trajectory.extent, trajectory.path) are all the same")
    demands = None if vehicle is None else _Demands(path, vehicle, margin)
    fast = 1e-3 * peak if speed is None else peak / speed  # 1 km/s: faster than any vehicle
    if demands is None or demands.worst(fast)[0] <= 0:
        return ScaledPath(path, fast)
    slow = fast
    for _ in range(DOUBLINGS):
        fast = slow
        slow = 2 * slow
        if demands.worst(slow)[0] <= 0:
            break
    else:
        raise UsageError("this path exceeds the limits of the vehicle at any speed")
    logarithm = brentq(lambda c: demands.worst(np.exp(c))[0], np.log(fast), np.log(slow), xtol=TOLERANCE)
    factor = float(np.exp(logarithm + 2 * TOLERANCE))
    return ScaledPath(path, factor, demands.worst(factor)[1])


@dataclass(frozen=True)
class _Demands:
    """Thrusts and rates that a path requires of a vehicle, at instants of path time."""

    path: PPoly
    vehicle: Vehicle
    margin: float

    def worst(self, factor: float) -> tuple[float, str]:
        """The largest excess over a limit, relative to its range (below 0: within limits), and its name."""
        grid, sampled = self._sampled
        values = sampled / factor ** np.arange(N_DERIVATIVES)[:, None, None]
        force = values[2, :3] + [[0.0], [0.0], [self.vehicle.gravity]]
        yaw = np.ascontiguousarray(values[:3, 3]) if values.shape[1] > 3 else None
        demand = Demand(factor * grid.times, np.ascontiguousarray(values[:, :3]), force, yaw)
        calculus = TimeGrid(demand.t, factor * grid.spacing)
        try:
            motion = flat_motion(demand, self.vehicle, Air.still(len(demand.t)), calculus)
        except UsageError:
            return BEYOND, "free fall"
        hover, below, above = self._ranges
        over = motion.thrusts - hover[:, None]
        used = np.max(over / np.where(over > 0, above[:, None], below[:, None]) * np.sign(over), axis=1)
        shares = {f"rotor {i} thrust": share for i, share in enumerate(used)}
        shares["body rate"] = np.sqrt((motion.rate**2).sum(axis=0)).max() / self.vehicle.rate_max
        what = max(shares, key=lambda name: shares[name])
        return min(float(shares[what]) - (1 - self.margin), BEYOND), what

    @cached_property
    def _sampled(self) -> tuple[TimeGrid, np.ndarray]:
        """Instants, and the derivatives 0 .. 4 of the path there, (5, d, k)."""
        x = self.path.x
        pieces = np.diff(self.path.x)
        spacing = max(min(pieces.mean() / STEPS, pieces.min() / FEWEST), (x[-1] - x[0]) / MOST)
        grid = TimeGrid.over(x[0], x[-1], spacing)
        return grid, np.stack([derivative(grid.times).T for derivative in derivatives(self.path)])

    @cached_property
    def _ranges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Thrust of every rotor in hover, and its distance to the lower and to the upper limit, (n,) each (N)."""
        vehicle = self.vehicle
        hover = allocation_inverse(vehicle)[:, 0] * vehicle.mass * vehicle.gravity
        below = hover - vehicle.thrust_min
        above = vehicle.thrust_max - hover
        if min(below.min(), above.min()) <= 0:
            at = int(np.argmin(np.minimum(below, above)))
            raise UsageError(
                f"vehicle={vehicle.name}: in hover rotor {at} needs {hover[at]:.4g} N, outside"
                f" ({vehicle.thrust_min:g}, {vehicle.thrust_max:g}) N: no path is within its limits"
            )
        return hover, below, above
