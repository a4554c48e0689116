"""Minimum-snap polynomials through points, for random keypoints and for waypoints from a file.

Pieces of degree 7 that minimise the integral of the squared snap, at rest with zero acceleration and jerk at both ends;
the minimiser is continuous up to the sixth derivative. Source: Mellinger & Kumar 2011; `minsnap-trajectories`.
"""

from __future__ import annotations

import numpy as np
from minsnap_trajectories import Waypoint, generate_trajectory
from scipy.interpolate import PPoly

DEGREE = 7
_REAL = 1e-6  # largest imaginary part of a real root, relative to the length of the piece


def minimum_snap(times: np.ndarray, points: np.ndarray) -> PPoly:
    """The path through the points (k, d) at the increasing times (k,), k of 2 or more.

    Raises ValueError where there are no such polynomials, for instance for points too close for their times.
    """
    rest, ends = np.zeros(points.shape[1]), (0, len(times) - 1)
    unit = (times[-1] - times[0]) / (len(times) - 1)  # a mean piece of length 1 keeps the linear system well scaled
    pieces = generate_trajectory(
        [
            Waypoint((time - times[0]) / unit, point, jerk=rest if i in ends else None)
            for i, (time, point) in enumerate(zip(times, points, strict=True))
        ],
        degree=DEGREE,
        idx_minimized_orders=4,
        num_continuous_orders=4,
    )
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
