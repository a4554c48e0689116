"""The thrusts that commands of the last periods give, as weights on them.

A command sent at t_j acts from t_j + d on, until the next one does, and the thrust follows with a first-order lag. So
the thrust is linear in the commands, and its mean over a span [a, b] is

    sum_j u_j (S(s_j) - S(s_{j+1})) / (b - a),    s_j = t_j + d,    S(s) = G(b - s) - G(a - s)
    G(x) = x - lag (1 - exp(-x / lag)) for x > 0, else 0            integral of the step response

The oldest command that is kept counts as having been sent for ever: S(s_0) = b - a.
"""

from __future__ import annotations

import math

import numpy as np

SETTLED = 6.0  # time constants, after which nothing of a lag is left


class SentCommands:
    """The last commands, (m, n) (N), the oldest first; `reset`, then `record` at every control instant.

    reach: how far back spans may begin (s), dead time and lags included.
    """

    def __init__(self, rotors: int, period: float, reach: float) -> None:
        self._period = period
        self.values = np.zeros((math.ceil(reach / period - 1e-9) + 1, rotors))
        flat = self.values.reshape(-1)
        self._older, self._newer, self._newest = flat[:-rotors], flat[rotors:], flat[-rotors:]

    def reset(self, thrust: np.ndarray) -> None:
        """Begin a flight: this command, (n,) (N), has been sent for a long time."""
        self.values[...] = thrust

    def record(self, command: np.ndarray) -> None:
        """Add the command, (n,) (N), of this control instant, and go on by one control period."""
        self._older[...] = self._newer
        self._newest[...] = command

    def weights(self, spans: np.ndarray, dead_time: float, lag: float) -> np.ndarray:
        """Weights (s, m) on the commands of the mean thrusts over spans (s, 2) (s): beginning and end, 0 is now, before
        the command of now is sent. A span of no length has the thrust at its time."""
        count = len(self.values)
        acts = dead_time - self._period * np.arange(count, 0, -1.0)  # s_j
        spans = np.where(np.diff(spans) > 1e-9, spans, spans[:, 1:] + [-1e-9, 0.0])
        a, b = spans[:, :1], spans[:, 1:]
        passed = (_step_integral(b - acts, lag) - _step_integral(a - acts, lag)) / (b - a)
        passed[:, 0] = 1.0
        return passed - np.append(passed[:, 1:], np.zeros((len(passed), 1)), axis=1)


def _step_integral(x: np.ndarray, lag: float) -> np.ndarray:
    """Integral of the step response over x (s) since the step."""
    x = np.maximum(x, 0.0)
    return x if not lag else x + lag * np.expm1(-x / lag)
