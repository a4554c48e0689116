"""Tracking a reference of the bench in a world of the bench, as an environment of Gymnasium.

    gymnasium.make("quadexp/Tracking-v0", overrides=["plant=rotorpy", "vehicle=hummingbird"], action="rates")

Observation and action: task.py; in a world with sensors the observation is the estimate, and info["state"] the truth.
Reward (the figure of eight of crazyflow, with a price on twitching), e: position error (m), a: action:

    exp(-2 |e|) - 0.01 |w / rate_max|^2 - 0.02 |a - a_before|^2,    -1 where the flight is lost

Terminated: further than `lost` from the reference, or outside what the plant's equations hold for. Truncated: at the
end of the reference, or of `episode`. reset(seed, options={"t": s, "state": (13,)}): otherwise a drawn time of the
reference, `spread` away from it. One seed gives one flight, to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np

from quadexp.errors import ModelDomainError, UsageError
from quadexp.experiment.build import build_trajectory, build_vehicle, build_world, unshared
from quadexp.parts.compose import compose
from quadexp.parts.options import Folders
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.plugins.gym.task import Action, Task
from quadexp.reference.flatness import flat_reference

INNER = 0.002  # s, period of the rate loop


class Tracking(gymnasium.Env[np.ndarray, np.ndarray]):
    """See the module.

    overrides: settings, as on the command line. conf: configuration folders. rate: actions a second (Hz). future,
    spacing: points of the reference that are seen, and the time between them (s). lost: m. spread: standard deviation
    of the start: position (m), velocity (m/s), attitude (rad). episode: longest (s), None for the whole reference.
    Raises UsageError for a setting that is none, as the commands do."""

    def __init__(
        self,
        overrides: Sequence[str] = (),
        *,
        action: Action = "thrusts",
        conf: Folders = None,
        rate: float = 50.0,
        future: int = 5,
        spacing: float = 0.1,
        lost: float = 2.0,
        spread: Sequence[float] = (0.2, 0.3, 0.1),
        episode: float | None = None,
    ) -> None:
        if action not in ("thrusts", "rates"):
            raise UsageError(f"action={action}: must be one of thrusts, rates")
        if not 1 <= rate <= 1 / INNER or future < 0 or spacing * rate < 0.5:
            raise UsageError(
                f"rate={rate:g}, future={future}, spacing={spacing:g}: 1 to 500 Hz, points after each other"
            )
        config = compose(list(overrides), conf, "gymnasium.make")
        with unshared():  # environments side by side are flights side by side
            self.vehicle = build_vehicle(config.vehicle)
            self.plant = build_world(config, self.vehicle)
            trajectory = build_trajectory(config.trajectory, self.vehicle)
        self.task = Task(self.vehicle, action, future)
        self.period = 1.0 / rate
        self.lost = lost
        self.spread = np.asarray(spread, float)
        self._skip = round(spacing * rate)
        self._steps = int(np.floor(trajectory.duration * rate + 1e-6))
        self._episode = self._steps if episode is None else min(self._steps, round(episode * rate))
        times = np.arange(self._steps + 1 + self._skip * future) * self.period
        reference = flat_reference(trajectory, np.minimum(times, trajectory.duration), self.vehicle)
        self._reference = reference.state
        self._input = reference.input
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.task.actions,), np.float32)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self.task.size,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """See gymnasium.Env; options: see the module."""
        super().reset(seed=seed)
        options = options or {}
        latest = self._steps - self._episode
        self._k = int(self.np_random.integers(latest + 1))
        if "t" in options:
            self._k = min(round(options["t"] / self.period), self._steps - 1)
        self._first = self._k
        x = self._reference[self._k].copy()
        if "state" in options:
            x = np.array(options["state"], float)
        elif self.spread.any():
            x = self._moved(x)
        stream = np.random.default_rng(self.np_random.integers(2**63))
        period = INNER if self.task.action == "rates" else self.period
        thrust = np.clip(self._input[self._k], self.vehicle.thrust_min, self.vehicle.thrust_max)
        self._x = x
        self._noise = self.plant.begin(x, period, (self._episode + 2) * self.period, stream, thrust)
        self._last = np.zeros(self.task.actions)
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        action = np.clip(np.asarray(action, float), -1.0, 1.0)
        terminated = not self._advanced(action)
        self._k += 1
        error = self._error()
        terminated = terminated or not error <= self.lost  # not a number is lost too
        rate = self._x[RATE] / self.vehicle.rate_max
        change = action - self._last
        reward = float(np.exp(-2 * error) - 0.01 * (rate @ rate) - 0.02 * (change @ change))
        self._last = action
        if not np.isfinite(self._x).all():
            self._x = self._reference[self._k].copy()
        ended = self._k >= self._steps or self._k - self._first >= self._episode
        return self._observation(), -1.0 if terminated else reward, terminated, ended and not terminated, self._info()

    def _advanced(self, action: np.ndarray) -> bool:
        """Fly for one period; False where the plant's equations have no answer."""
        loops = round(self.period / INNER) if self.task.action == "rates" else 1
        try:
            for _ in range(loops):
                thrusts = self.task.thrusts(action, self._measured()[RATE])
                self._x, _ = self.plant.advance(self._x, thrusts, self.period / loops, self._noise)
        except ModelDomainError:
            return False
        return True

    def _moved(self, x: np.ndarray) -> np.ndarray:
        """A state drawn around another one."""
        position, velocity, attitude = self.spread
        x[POSITION] += self.np_random.normal(0, position, 3)
        x[VELOCITY] += self.np_random.normal(0, velocity, 3)
        q = x[ATTITUDE] + self.np_random.normal(0, attitude / 2, 4)
        x[ATTITUDE] = q / np.linalg.norm(q)
        return x

    def _measured(self) -> np.ndarray:
        """The state as controllers are given it."""
        return np.asarray(getattr(self.plant, "measured", self._x))

    def _observation(self) -> np.ndarray:
        last = self._k + self._skip * self.task.future
        return self.task.observation(self._measured(), self._reference[self._k : last + 1 : self._skip], self._last)

    def _error(self) -> float:
        return float(np.linalg.norm(self._x[POSITION] - self._reference[self._k, POSITION]))

    def _info(self) -> dict[str, Any]:
        return {"state": self._x.copy(), "error": self._error(), "t": self._k * self.period}
