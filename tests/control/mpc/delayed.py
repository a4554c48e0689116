"""A world whose commands arrive late and whose rotors lag: any plant behind a latency and a first-order lag."""

import numpy as np

SUBSTEP = 2e-3  # s, over which the lagging thrust is held at its mean


class DelayedPlant:
    """plant: what the thrust acts on. latency: s, any length. lag: time constant (s); 0: none."""

    def __init__(self, plant, *, latency: float = 0.0, lag: float = 0.0) -> None:
        self.plant, self.vehicle, self.latency, self.lag = plant, plant.vehicle, latency, lag
        self.reset()

    def reset(self) -> None:
        self.plant.reset()
        self.time = 0.0
        self.thrust = self.command = None
        self.under_way: list[tuple[float, np.ndarray]] = []

    def residual(self):
        return self.plant.residual()

    def advance(self, x, u, duration, rng):
        if self.command is None:  # as if the first command had been sent for long
            self.command, self.thrust = u, u
        self.under_way.append((self.time + self.latency, u))
        end = self.time + duration
        while end - self.time > 1e-9:
            while self.under_way and self.under_way[0][0] <= self.time + 1e-9:
                self.command = self.under_way.pop(0)[1]
            until = min([end, self.time + SUBSTEP, *(t for t, _ in self.under_way[:1])])
            x, reading = self._hold(x, until - self.time, rng)
            self.time = until
        return x, reading

    def _hold(self, x, step, rng):
        if not self.lag:
            return self.plant.advance(x, self.command, step, rng)
        left = np.exp(-step / self.lag)
        mean = self.command + (self.thrust - self.command) * (1 - left) * self.lag / step
        self.thrust = self.command + (self.thrust - self.command) * left
        return self.plant.advance(x, mean, step, rng)
