"""The interface of trajectories: a flat output (position and yaw) with its derivatives as a function of time.

World frame ENU (z up), SI units. A trajectory is defined on 0 <= t <= duration; outside, the nearest flat output is
held, with all derivatives zero. One that goes on for the horizon of a controller has a later `end`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from quadexp.errors import UsageError
from quadexp.messages import note
from quadexp.parts.part import Part
from quadexp.parts.settings import Setting, key, keyed
from quadexp.physics.state import norms
from quadexp.physics.vehicle import Vehicle

SPEED = Setting(
    "nominal speed (circle, lemniscate; `quadexp simulate` prints the peak speed), or largest speed of the path"
    " (random, waypoints without t), reduced where the vehicle's limits do not allow it; the column `speed` of tables",
    "(0, 60]",
    "m/s",
)
MARGIN = Setting(
    "control authority that the reference leaves unused, as a share: of the range between the hover thrust and the"
    " thrust limits, and of the largest body rate",
    "[0, 0.9]",
)
RADIUS = Setting("radius of the circle, half width of the lemniscate", "(0, 1000]", "m")
DURATION = Setting("length of the flight", "(0, 3600]", "s")

N_DERIVATIVES = 5  # position, velocity, acceleration, jerk, snap
STEP = 1e-4  # s, of differences: by less than a control period, and far from rounding
LONGEST = 4 * 3600.0  # s of a flight


@dataclass(frozen=True)
class FlatOutput:
    """A flat output at k times.

    position: (k, 5, 3), world: position (m), velocity, acceleration, jerk, snap (m/s .. m/s^4).
    yaw: (k, 3): heading (rad), rate (rad/s), acceleration (rad/s^2); None where the heading is free: from 0 at the
        start the vehicle does not turn about its thrust axis (body yaw rate zero, Torrente et al. 2021; motion.py).
    """

    position: np.ndarray
    yaw: np.ndarray | None


@runtime_checkable
class Trajectory(Protocol):
    """A flat output over time."""

    @property
    def duration(self) -> float:
        """Length, s."""

    @property
    def peak_speed(self) -> float:
        """Largest speed, m/s."""

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """Flat output at the times t, (k,) (s); held outside 0 .. duration."""


@keyed
class TrajectoryPart(Part):
    """What every trajectory has, as an option of the configuration.

    allow_infeasible: fly a reference although it asks for more than the vehicle has.
    lost_distance: a flight ends as lost when the vehicle is further (m) from the reference. lost_box: or when it leaves
    the box around the whole reference, widened by this (m).
    """

    prefix = "trajectory."

    allow_infeasible: bool = key(
        False, "also fly what needs more thrust than there is; random: at the asked speed", noise=False
    )
    lost_distance: float = key(
        10.0, "from the reference, beyond which a flight ends as lost", "(0, 1e6]", "m", noise=False
    )
    lost_box: float | None = key(
        None, "margin of the reference's box, beyond which a flight is lost; null: no box", "(0, 1e6]", "m", noise=False
    )
    follows_limits: ClassVar[bool] = False

    def build(self, vehicle: Vehicle | None) -> Any:
        """The trajectory, for a flight by a vehicle; None: by any."""
        return replace(self)


@keyed
class LimitedTrajectory(TrajectoryPart):
    """A path that is timed by the limits of the vehicle. vehicle: whose; None: no limits.

    flown: the path with its times, which a subclass makes when it is first asked for.
    """

    follows_limits = True

    vehicle: Vehicle | None = None

    @property
    def flown(self) -> Trajectory:
        raise NotImplementedError

    @property
    def duration(self) -> float:
        return self.flown.duration

    @property
    def peak_speed(self) -> float:
        return self.flown.peak_speed

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        return self.flown.flat_output(t)

    def build(self, vehicle: Vehicle | None) -> Any:
        """See TrajectoryPart; UsageError without a vehicle."""
        if vehicle is None:
            raise UsageError(f"trajectory={self.name}: is timed by the limits of a vehicle, and none was given")
        return replace(self, vehicle=None if self.allow_infeasible else vehicle)


def check_own(trajectory: Trajectory, name: str) -> None:
    """Raise UsageError where a user's trajectory does not give what the class Trajectory says. name: for messages."""
    said = f"trajectory={name}: "
    for what in ("duration", "peak_speed"):
        value = getattr(trajectory, what)
        number = isinstance(value, (int, float, np.floating)) and np.isfinite(value)
        if not number or value < 0 or (what == "duration" and value == 0):
            raise UsageError(f"{said}{what} is {str(value)[:40]}; a positive number is needed")
    times = trajectory.duration * np.array([0.23, 0.52, 0.81])  # where no corner of a path is likely
    times.flags.writeable = False
    flat, again = trajectory.flat_output(times), trajectory.flat_output(times)
    if not isinstance(flat, FlatOutput):
        raise UsageError(f"{said}flat_output must give a FlatOutput, not {type(flat).__name__}")
    needed = {"position": (3, N_DERIVATIVES, 3), "yaw": (3, 3)}
    for what, shape in needed.items():
        array = getattr(flat, what)
        if what == "yaw" and array is None:
            continue
        if np.shape(array) != shape:
            raise UsageError(f"{said}{what} of 3 times has the shape {np.shape(array)}; {shape} is needed")
        if not np.isfinite(array).all():
            raise UsageError(f"{said}{what} is not finite in the flight")
        if not np.array_equal(array, getattr(again, what)):
            raise UsageError(f"{said}{what} of one time differs from call to call; let it follow from t and keys alone")
    before, after = (trajectory.flat_output(times + step).position[:, :-1] for step in (-STEP, STEP))
    slope = (after - before) / (2 * STEP)
    error = np.abs(slope - flat.position[:, 1:])
    for order in np.flatnonzero(error.mean(axis=(0, 2)) > 0.1 * np.abs(slope).mean(axis=(0, 2)) + 1e-3):
        note(f"{said}flat_output: its derivative of order {order + 1} is not that of order {order}, differentiated")


def end_of(trajectory: Trajectory) -> float:
    """Time (s) up to which a trajectory moves: its `end` where it goes on after the flight, else its duration."""
    return float(getattr(trajectory, "end", trajectory.duration))


def sample_times(trajectory: Trajectory, step: float) -> np.ndarray:
    """Times of a flight, `step` (s) or less apart; UsageError for a longer one than can be flown."""
    if not trajectory.duration <= LONGEST:
        takes = f"the trajectory takes {trajectory.duration:.3g} s, {LONGEST:g} s are allowed"
        raise UsageError(f"{takes}: make it faster or shorter")
    return np.linspace(0.0, trajectory.duration, max(2, math.ceil(trajectory.duration / step) + 1))


def hold_outside(t: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Times clipped to 0 .. duration, (k,) (s), and whether each was inside, (k,) bool."""
    t = np.atleast_1d(np.asarray(t, float))
    return np.clip(t, 0.0, duration), (t >= 0.0) & (t <= duration)


def flat_output_held(position: np.ndarray, yaw: np.ndarray | float | None, inside: np.ndarray) -> FlatOutput:
    """The flat output with its derivatives zero where `inside`, (k,) bool, is false.

    position: (k, 5, 3), changed in place. yaw: (k, 3), changed in place, or a constant (rad), or None (free).
    """
    position[~inside, 1:] = 0.0
    if yaw is None:
        return FlatOutput(position, None)
    headings = np.tile([yaw, 0.0, 0.0], (len(position), 1)) if np.ndim(yaw) == 0 else np.asarray(yaw)
    headings[~inside, 1:] = 0.0
    return FlatOutput(position, headings)


def level_path(x: np.ndarray, y: np.ndarray, height: float) -> np.ndarray:
    """Positions with their derivatives (k, 5, 3) of a path at a constant height (m), from x and y with theirs."""
    position = np.stack([x, y, np.zeros_like(x)], axis=2)
    position[:, 0, 2] = height
    return position


def standing(points: npt.ArrayLike, yaw: float = 0.0) -> FlatOutput:
    """The flat output that holds points (k, 3) and a heading (rad): all derivatives are zero."""
    position = np.zeros((len(np.asarray(points)), N_DERIVATIVES, 3))
    position[:, 0] = points
    return FlatOutput(position, np.tile([yaw, 0.0, 0.0], (len(position), 1)))


def derivatives(function: Any) -> tuple[Any, ...]:
    """A spline, or polynomials, with the derivatives up to the fourth."""
    return tuple(function.derivative(order) if order else function for order in range(N_DERIVATIVES))


def sampled_peak_speed(trajectory: Trajectory, step: float = 2e-3) -> float:
    """Largest speed on a grid of `step` (s), m/s."""
    return float(norms(trajectory.flat_output(sample_times(trajectory, step)).position[:, 1]).max())
