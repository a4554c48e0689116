"""Trajectory from a file: a sampled track, or waypoints; positions.py says how they are written.

A sampled track is interpolated by a degree-7 spline through every row (continuous up to the sixth derivative, not-a-
knot ends), so it must be smooth: noise in the rows is amplified by dt^-4 in the snap. With `smooth` (s) the spline is
one of least squares with a knot in so many seconds, which leaves faster noise out. Time starts at the first row;
without a yaw the heading is 0.

Waypoints are joined by minimum-snap polynomials, at rest at both ends; without a yaw the heading is free. Times in the
file are kept. Otherwise segment durations are proportional to the p-th power of their lengths, with the p of POWERS
that gives the shortest flight within the vehicle's limits and the requested peak speed (polynomial.py). World ENU, SI.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline, make_lsq_spline

from quadexp.errors import UsageError
from quadexp.parts.settings import REQUIRED, key, keyed
from quadexp.physics.state import norms
from quadexp.plugins.logs.positions import Positions, read_positions
from quadexp.reference.base import (
    MARGIN,
    SPEED,
    FlatOutput,
    LimitedTrajectory,
    Trajectory,
    derivatives,
    flat_output_held,
    hold_outside,
    sampled_peak_speed,
)
from quadexp.reference.polynomial import ScaledPath, minimum_snap, time_scale

DEGREE = 7  # the snap is then continuous, and piecewise cubic
POWERS = (0.5, 0.75, 1.0)  # 0.5 suits a limited acceleration, 1 a limited speed
SMOOTH = 0.3  # s: what is proposed for a noisy track
NOISY = 3.0  # times the snap of the smoothed track: more is noise


@keyed
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
    smooth: float | None = key(
        None, "of a track: time between the knots of a smoothing spline; null: every row", "(0, 60]", "s"
    )

    @property
    def note(self) -> str:
        """The limit that keeps waypoints below the requested speed, and what of the file is not flown; "" if none."""
        limit = self.flown.note(self.speed, self.vehicle) if isinstance(self.flown, ScaledPath) else ""
        return "; ".join(filter(None, [limit, *self._positions.notes]))

    @property
    def remedy(self) -> str:
        """What helps where the path cannot be flown."""
        if self._positions.times is None:
            return "lower trajectory.speed"
        if not isinstance(self.flown, SampledTrack):
            return "stretch the times in the file"
        smoothed = replace(self.flown, smooth=max(SMOOTH, 2 * self.flown.smooth))
        peak, without = (norms(track.flat_output(track.times).position[:, 4]).max() for track in (self.flown, smoothed))
        if peak > NOISY * without:
            return f"its rows are noisy: trajectory.smooth={smoothed.smooth:g} (s) smooths them, or leave rows out"
        return "stretch the times in the file"

    @cached_property
    def _positions(self) -> Positions:
        if not Path(self.path).is_file():
            raise UsageError(f"trajectory.path: there is no file {self.path!r}")
        return read_positions(Path(self.path))

    @cached_property
    def flown(self) -> Trajectory:
        """See LimitedTrajectory."""
        positions = self._positions
        if positions.times is not None and self.margin != FileTrajectory.margin:
            raise UsageError(f"trajectory.margin={self.margin:g}: {self.path} has its own times; leave the margin out")
        if positions.sampled:
            return self._sampled(positions)
        if self.smooth is not None:
            way = "leave it out, or name the columns t, p_x, p_y, p_z for a sampled track"
            raise UsageError(f"trajectory.smooth={self.smooth:g}: {self.path} has waypoints, which are all met; {way}")
        try:
            return self._through(positions)
        except ValueError as error:
            raise UsageError(f"{self.path}: no polynomials through these waypoints ({error})") from None

    def _sampled(self, positions: Positions) -> SampledTrack:
        """The spline through a track."""
        if self.speed is not None:
            way = "leave the speed out, or name the columns x, y, z for waypoints"
            own = f"{self.path} is a sampled track, which has its own times"
            raise UsageError(f"trajectory.speed={self.speed:g}: {own}; {way}")
        assert positions.times is not None
        yaw = np.zeros(len(positions.times)) if positions.yaw is None else positions.yaw
        points = np.column_stack([positions.points, yaw])
        return SampledTrack(positions.times - positions.times[0], points, self.smooth or 0.0)

    def _through(self, positions: Positions) -> ScaledPath:
        """The path through waypoints."""
        points = positions.points
        if positions.yaw is not None:
            points = np.column_stack([points, positions.yaw])
        if positions.times is not None:
            timed = ScaledPath(minimum_snap(positions.times, points), 1.0)
            if self.speed is not None and self.vehicle is not None and timed.peak_speed > self.speed:
                takes = f"the times in {self.path} take a peak speed of {timed.peak_speed:.4g} m/s"
                way = "leave out the column t, raise the speed, or pass trajectory.allow_infeasible=true"
                raise UsageError(f"trajectory.speed={self.speed:g}: {takes}; {way}")
            return timed
        lengths = norms(np.diff(positions.points, axis=0)) / np.ptp(positions.points, axis=0).max()
        candidates = []
        for power in POWERS:
            path = minimum_snap(np.concatenate([[0.0], np.cumsum(lengths**power)]), points)
            candidates.append(time_scale(path, self.vehicle, speed=self.speed, margin=self.margin))
        return min(candidates, key=lambda candidate: candidate.duration)


@dataclass(frozen=True)
class SampledTrack:
    """A spline through the rows of a track. times: (k,), s, from zero on. points: (k, 4), x, y, z (m) and yaw (rad).
    smooth: time between its knots (s), 0: every row."""

    times: np.ndarray
    points: np.ndarray
    smooth: float = 0.0

    @property
    def duration(self) -> float:
        return float(self.times[-1])

    @cached_property
    def peak_speed(self) -> float:
        return sampled_peak_speed(self)

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        t, inside = hold_outside(t, self.duration)
        values = np.stack([derivative(t) for derivative in self._derivatives], axis=1)
        return flat_output_held(values[:, :, :3].copy(), values[:, :3, 3].copy(), inside)

    @cached_property
    def _derivatives(self) -> tuple[BSpline, ...]:
        """The splines of the points with their derivatives up to the fourth."""
        inner = np.arange(self.smooth, self.duration - self.smooth / 2, self.smooth) if self.smooth else np.empty(0)
        if not self.smooth or len(inner) + DEGREE + 1 >= len(self.times):
            return derivatives(make_interp_spline(self.times, self.points, k=DEGREE))
        knots = np.concatenate([[0.0] * (DEGREE + 1), inner, [self.duration] * (DEGREE + 1)])
        return derivatives(make_lsq_spline(self.times, self.points, knots, k=DEGREE))
