"""Trajectory from a file: a sampled track, or waypoints (formats: track_file.py).

A sampled track is interpolated by a degree-7 spline through every row (continuous up to the sixth derivative,
not-a-knot ends), so it must be smooth: noise in the rows is amplified by dt^-4 in the snap. Time starts at the first
row; without a yaw the heading is 0.

Waypoints are joined by minimum-snap polynomials, at rest at both ends (minimum_snap.py); without a yaw the heading is
free. Times in the file are kept. Otherwise segment durations are proportional to the p-th power of their lengths, with
the p of POWERS that gives the shortest flight within the vehicle's limits and the requested peak speed (time_scale.py).
World ENU, SI.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from quadexp.errors import UsageError
from quadexp.parts.settings import REQUIRED, key
from quadexp.reference.base import (
    MARGIN,
    N_DERIVATIVES,
    SPEED,
    FlatOutput,
    LimitedTrajectory,
    Trajectory,
    flat_output_held,
    hold_outside,
    sampled_peak_speed,
)
from quadexp.reference.minimum_snap import minimum_snap
from quadexp.reference.time_scale import ScaledPath, time_scale
from quadexp.reference.track_file import Positions, read_positions

DEGREE = 7
POWERS = (0.5, 0.75, 1.0)  # 0.5 suits a limited acceleration, 1 a limited speed


@dataclass(frozen=True, kw_only=True)
class FileTrajectory(LimitedTrajectory):
    """The track or the waypoints in a CSV or TUM file; it is read when first used.

    vehicle: its limits apply to waypoints without times; None: no limits.
    Raises UsageError for a missing file, for contradicting times and speed, or where the limits allow no flight;
    DataError (with the line number) for a file without positions.
    """

    former_kind = "file"

    path: str = key(
        REQUIRED, "track: CSV with t, p_x, p_y, p_z (yaw), or TUM; waypoints: CSV with x, y, z (t, yaw)", noise=False
    )
    speed: float | None = key(None, SPEED)
    margin: float = key(0.25, MARGIN)

    @property
    def duration(self) -> float:
        return self._flown.duration

    @property
    def peak_speed(self) -> float:
        return self._flown.peak_speed

    @property
    def note(self) -> str:
        """The limit that keeps the waypoints below the requested speed, in one line; "" if none."""
        return self._made[1]

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output."""
        return self._flown.flat_output(t)

    @property
    def _flown(self) -> Trajectory:
        return self._made[0]

    @cached_property
    def _made(self) -> tuple[Trajectory, str]:
        """The trajectory and its note."""
        if not Path(self.path).is_file():
            raise UsageError(f"trajectory.path: there is no file {self.path!r}")
        positions = read_positions(Path(self.path))
        if positions.sampled:
            if self.speed is not None:
                raise UsageError(
                    f"trajectory.speed={self.speed:g}: {self.path} is a sampled track, which has its own times;"
                    " leave the speed out, or name the columns x, y, z for waypoints"
                )
            return SampledTrack(positions), ""
        try:
            return self._through(positions)
        except ValueError as error:
            raise UsageError(f"{self.path}: no polynomials through these waypoints ({error})") from None

    def _through(self, positions: Positions) -> tuple[ScaledPath, str]:
        """The path through waypoints, and its note."""
        columns = [positions.points] + ([] if positions.yaw is None else [positions.yaw[:, None]])
        points = np.concatenate(columns, axis=1)
        if positions.times is not None:
            timed = ScaledPath(minimum_snap(positions.times, points), 1.0)
            if self.speed is not None and self.vehicle is not None and timed.peak_speed > self.speed:
                raise UsageError(
                    f"trajectory.speed={self.speed:g}: the times in {self.path} take a peak speed of"
                    f" {timed.peak_speed:.4g} m/s; leave out the column t, raise the speed, or pass"
                    " trajectory.allow_infeasible=true"
                )
            return timed, ""
        lengths = np.linalg.norm(np.diff(positions.points, axis=0), axis=1) / np.ptp(positions.points, axis=0).max()
        candidates = []
        for power in POWERS:
            path = minimum_snap(np.concatenate([[0.0], np.cumsum(lengths**power)]), points)
            scale = time_scale(path, self.vehicle, speed=self.speed, margin=self.margin)
            candidates.append((ScaledPath(path, scale.factor), scale))
        path, scale = min(candidates, key=lambda candidate: candidate[0].duration)
        return path, scale.note(self.speed, path.peak_speed, self.vehicle)


@dataclass(frozen=True)
class SampledTrack:
    """A spline through the rows of a track."""

    positions: Positions

    @cached_property
    def duration(self) -> float:
        return float(self._times[-1])

    @cached_property
    def peak_speed(self) -> float:
        return sampled_peak_speed(self)

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output."""
        t, inside = hold_outside(t, self.duration)
        values = np.stack([derivative(t) for derivative in self._derivatives], axis=1)
        return flat_output_held(values[:, :, :3].copy(), values[:, :3, 3].copy(), inside)

    @property
    def _times(self) -> np.ndarray:
        assert self.positions.times is not None
        return self.positions.times - self.positions.times[0]

    @cached_property
    def _derivatives(self) -> tuple[BSpline, ...]:
        """The splines of [x, y, z, yaw] with their derivatives up to the fourth."""
        yaw = np.zeros(len(self._times)) if self.positions.yaw is None else self.positions.yaw
        spline = make_interp_spline(self._times, np.column_stack([self.positions.points, yaw]), k=DEGREE)
        return tuple(spline.derivative(order) if order else spline for order in range(N_DERIVATIVES))
