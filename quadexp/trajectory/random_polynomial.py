"""Smooth random closed path, flown as minimum-snap polynomials from rest to rest.

Each axis is a draw from a Gaussian process with periodic kernel over the path phase s (one loop is s = 0 .. 1),

    k(s, s') = exp(-2 sin^2(pi c (s - s')) / l^2),      c cycles per loop, l length scale

drawn exactly through the kernel's Fourier series, with I_n the modified Bessel function,

    k = e^(-1/l^2) [ I_0(1/l^2) + 2 sum_n I_n(1/l^2) cos(2 pi n c (s - s')) ]

(its covariance matrix is singular to working precision, so that a Cholesky factor would give other numbers on other
machines). The path is scaled so that the mean of its three axis ranges is `extent`; keypoints are taken at equal phase,
the last one equal to the first, each segment lasting (mean keypoint distance) / (nominal speed). Through them run
7th-order polynomials of minimal integrated squared snap (Mellinger & Kumar 2011), at rest with zero acceleration and
jerk at both ends; the minimiser is continuous up to the sixth derivative. The whole is moved up so that its lowest
point clears the ground. World frame, m.
Source: Torrente et al. 2021, public code (kernels, extent, segment time); `minsnap-trajectories` for the polynomials.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from minsnap_trajectories import Waypoint, generate_trajectory
from scipy.interpolate import PPoly
from scipy.special import ive

from quadexp.errors import UsageError
from quadexp.trajectory.base import (
    N_DERIVATIVES,
    FlatOutput,
    check_finite,
    check_positive,
    flat_output_held,
    hold_outside,
    sampled_peak_speed,
)

KERNELS = (  # per axis: (length scale, cycles per loop), summed
    ((4.5, 2), (4.5, 1)),
    ((4.5, 1), (4.0, 2)),
    ((5.5, 1),),
)
N_HARMONICS = 8  # I_8(1/l^2) is below 1e-17 of I_1 for every kernel above
N_PATH = 100  # points that measure the path's extent
DEGREE = 7


@dataclass(frozen=True, kw_only=True)
class RandomPolynomial:
    """A random closed path; the same seed gives the same path whatever the speed.

    speed: nominal speed, m/s: mean keypoint distance over segment time (the peak is higher, see peak_speed).
    keypoints: number of keypoints, the closing one included. extent: mean range of the three axes, m.
    clearance: height of the lowest point, m. yaw: heading held, rad; None: free, body yaw rate zero.
    Raises UsageError where a number is out of range.
    """

    speed: float
    seed: int = 0
    keypoints: int = 10
    extent: float = 6.0
    clearance: float = 1.0
    yaw: float | None = None

    def __post_init__(self) -> None:
        check_positive(speed=self.speed, extent=self.extent)
        check_finite(clearance=self.clearance, yaw=self.yaw)
        if int(self.keypoints) != self.keypoints or self.keypoints < 4:
            raise UsageError(f"trajectory.keypoints: {self.keypoints!r} is not allowed, 4 or more are needed")
        if int(self.seed) != self.seed or self.seed < 0:
            raise UsageError(f"trajectory.seed: {self.seed!r} is not allowed, it must be a whole number of 0 or more")

    @property
    def duration(self) -> float:
        return float(self.times[-1])

    @cached_property
    def peak_speed(self) -> float:
        return sampled_peak_speed(self)

    @cached_property
    def times(self) -> np.ndarray:
        """Times of the keypoints, (keypoints,) (s)."""
        distance = np.linalg.norm(np.diff(self._keypoints, axis=0), axis=1).mean()
        return distance / self.speed * np.arange(self.keypoints)

    @cached_property
    def waypoints(self) -> np.ndarray:
        """The keypoints, (keypoints, 3), world (m)."""
        return self._keypoints + [0.0, 0.0, self._lift]

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output."""
        t, inside = hold_outside(t, self.duration)
        position = np.stack([derivative(t) for derivative in self._derivatives], axis=1)
        position[:, 0, 2] += self._lift
        return flat_output_held(position, self.yaw, inside)

    @cached_property
    def _keypoints(self) -> np.ndarray:
        """The keypoints about the middle of the path, (keypoints, 3) (m)."""
        rng = np.random.default_rng(self.seed)
        phases = np.concatenate([np.linspace(0, 1, N_PATH + 1), np.linspace(0, 1, self.keypoints)])
        points = np.stack([sum(_periodic_draw(phases, *kernel, rng) for kernel in axis) for axis in KERNELS], axis=1)
        path, keypoints = points[: N_PATH + 1], points[N_PATH + 1 :]
        low, high = path.min(axis=0), path.max(axis=0)
        keypoints[-1] = keypoints[0]  # closed to the last bit
        return (keypoints - (low + high) / 2) * (self.extent / (high - low).mean())

    @cached_property
    def _path(self) -> PPoly:
        """The polynomials through the keypoints about the middle of the path, m."""
        rest = np.zeros(3)
        ends = (0, self.keypoints - 1)
        points = zip(self.times, self._keypoints, strict=True)
        try:
            pieces = generate_trajectory(
                [Waypoint(time, point, jerk=rest if i in ends else None) for i, (time, point) in enumerate(points)],
                degree=DEGREE,
                idx_minimized_orders=4,
                num_continuous_orders=4,
            )
        except ValueError as error:
            span = f"trajectory.extent={self.extent:g} at trajectory.speed={self.speed:g}"
            raise UsageError(f"{span}: no polynomials through these keypoints ({error})") from None
        return PPoly(pieces.coefficients[:, ::-1].transpose(1, 0, 2), pieces.time_reference)

    @cached_property
    def _lift(self) -> float:
        """Height of the middle of the path that gives its lowest point the clearance, m."""
        return self.clearance - self._path(np.linspace(0, self.duration, 200 * self.keypoints))[:, 2].min()

    @cached_property
    def _derivatives(self) -> tuple[PPoly, ...]:
        """Derivatives of the path up to snap."""
        return tuple(self._path.derivative(order) for order in range(N_DERIVATIVES))


def _periodic_draw(phase: np.ndarray, length_scale: float, cycles: int, rng: np.random.Generator) -> np.ndarray:
    """Zero-mean part of a draw from the periodic kernel at the phases (k,): (k,)."""
    n = np.arange(1, N_HARMONICS + 1)
    amplitude = np.sqrt(2 * ive(n, 1 / length_scale**2))
    cosine, sine = rng.standard_normal((2, N_HARMONICS)) * amplitude
    angle = 2 * np.pi * cycles * phase[:, None] * n
    return np.cos(angle) @ cosine + np.sin(angle) @ sine
