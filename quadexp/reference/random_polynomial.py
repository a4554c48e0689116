"""Smooth random closed path as minimum-snap polynomials from rest to rest.

Each axis is a draw from a Gaussian process with periodic kernel over the path phase s (one loop is s = 0 .. 1),

    k(s, s') = exp(-2 sin^2(pi c (s - s')) / l^2),      c cycles per loop, l length scale

drawn exactly by the kernel's Fourier series, with I_n the modified Bessel function,

    k = e^(-1/l^2) [ I_0(1/l^2) + 2 sum_n I_n(1/l^2) cos(2 pi n c (s - s')) ]

(the covariance matrix is singular to working precision, so that a Cholesky factor would depend on the machine). The
path is scaled so that the mean of its three axis ranges is `extent`. Keypoints are taken at equal phase, the last one
equal to the first, with segments of equal duration, and joined by minimum-snap polynomials (polynomial.py). The path
is shifted up so that its lowest point is at `clearance`.

The path depends on the seed only; its duration follows from the requested peak speed and, if a vehicle is given, from
the vehicle's limits (polynomial.py). World frame, m.
Source: Torrente et al. 2021, public code (kernels, extent). There, `speed` is the mean keypoint distance over
the segment time, and the peak about 2.4 times that.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from quadexp.errors import UsageError
from quadexp.parts.settings import REQUIRED, SEEDS, key, keyed
from quadexp.reference.base import MARGIN, SPEED, FlatOutput, LimitedTrajectory

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

    from quadexp.reference.polynomial import ScaledPath

KERNELS = (  # per axis: (length scale, cycles per loop), summed
    ((4.5, 2), (4.5, 1)),
    ((4.5, 1), (4.0, 2)),
    ((5.5, 1),),
)
N_HARMONICS = 8  # I_8(1/l^2) is below 1e-17 of I_1 for every kernel above
N_PATH = 100  # points for measuring the path's extent


@keyed
class RandomPolynomial(LimitedTrajectory):
    """A random closed path; the same seed gives the same path for any speed and vehicle.

    vehicle: its limits apply, and lower the speed where they require it; None: no limits.
    Raises UsageError where a number is out of range, or where the vehicle cannot fly the path at any speed.
    """

    former_kind = "random"

    speed: float = key(REQUIRED, SPEED)
    margin: float = key(0.25, MARGIN)
    seed: int = key(0, "seed of the random path", SEEDS)
    keypoints: int = key(10, "number of random points that the path passes through", "[4, 200]", "points")
    extent: float = key(6.0, "edge of the cube that the keypoints are drawn in", "(0, 1000]", "m")
    clearance: float = key(1.0, "height of the lowest keypoint, world", "[-1000, 1000]", "m")

    @property
    def note(self) -> str:
        """The limit that keeps the path below the requested speed, in one line; "" if none."""
        return self.flown.note(self.speed, self.vehicle)

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        flat = super().flat_output(t)
        flat.position[:, 0, 2] += self._lift
        return flat

    @cached_property
    def _keypoints(self) -> np.ndarray:
        """The keypoints relative to the centre of the path, (keypoints, 3) (m)."""
        rng = np.random.default_rng(self.seed)
        phases = np.concatenate([np.linspace(0, 1, N_PATH + 1), np.linspace(0, 1, self.keypoints)])
        points = np.column_stack([sum(_periodic_draw(phases, *kernel, rng) for kernel in axis) for axis in KERNELS])
        path = points[: N_PATH + 1]
        keypoints = points[N_PATH + 1 :]
        low = path.min(axis=0)
        high = path.max(axis=0)
        keypoints[-1] = keypoints[0]  # exactly closed
        return (keypoints - (low + high) / 2) * (self.extent / (high - low).mean())

    @cached_property
    def _path(self) -> PPoly:
        """The polynomials through the keypoints relative to the centre, m, one unit of time per segment."""
        from quadexp.reference.polynomial import minimum_snap

        try:
            return minimum_snap(np.arange(self.keypoints), self._keypoints)
        except ValueError as error:
            span = f"trajectory.extent={self.extent:g}"
            raise UsageError(f"{span}: no polynomials through these keypoints ({error})") from None

    @cached_property
    def flown(self) -> ScaledPath:
        """See LimitedTrajectory."""
        from quadexp.reference.polynomial import time_scale

        return time_scale(self._path, self.vehicle, speed=self.speed, margin=self.margin)

    @cached_property
    def _lift(self) -> float:
        """Height of the centre of the path with its lowest point at the clearance, m."""
        instants = np.linspace(0, self.keypoints - 1, 200 * self.keypoints)
        return self.clearance - self._path(instants)[:, 2].min()


def _periodic_draw(phase: np.ndarray, length_scale: float, cycles: int, rng: np.random.Generator) -> np.ndarray:
    """Zero-mean part of a draw from the periodic kernel at the phases (k,): (k,)."""
    from scipy.special import ive

    n = np.arange(1, N_HARMONICS + 1)
    amplitude = np.sqrt(2 * ive(n, 1 / length_scale**2))
    cosine, sine = rng.standard_normal((2, N_HARMONICS)) * amplitude
    angle = 2 * np.pi * cycles * phase[:, None] * n
    return np.cos(angle) @ cosine + np.sin(angle) @ sine
