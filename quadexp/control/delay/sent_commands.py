"""The thrusts that commands of the last periods give, as weights on them.

A command sent at t_j acts from t_j + d on, until the next one does, and the thrust follows with a first-order lag. So
the thrust is linear in the commands, and its mean over a span [a, b] is

    sum_j u_j (S(s_j) - S(s_{j+1})) / (b - a),    s_j = t_j + d,    S(s) = G(b - s) - G(a - s)
    G(x) = x - lag (1 - exp(-x / lag)) for x > 0, else 0            integral of the step response

The oldest command that is kept counts as having been sent for ever: S(s_0) = b - a.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.instant import Operation, copy

SETTLED = 6.0  # time constants, after which nothing of a lag is left
INSTANT = 1e-9  # s, a span that counts as an instant
NO_LAG = 1e-18  # s


class SentCommands:
    """The last commands, (m, n) (N), the oldest first; `reset` begins a flight.

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

    def after(self, command: np.ndarray) -> list[Operation]:
        """Adds the command that is found there, (n,) (N), and goes on by one control period."""
        return [copy(self._older, self._newer), copy(self._newest, command)]

    def weights(self, spans: np.ndarray, dead_time: float, lag: float) -> np.ndarray:
        """Weights (s, m) on the commands of the mean thrusts over spans (s, 2) (s): beginning and end, 0 is now, before
        the command of now is sent. A span of no length has the thrust at its time."""
        function = _weights(len(self.values), self._period)
        spans = np.where(np.diff(spans) > INSTANT, spans, spans[:, 1:] + [-INSTANT, 0.0])
        return np.array(function(spans[:, 0], spans[:, 1], dead_time, lag)).T[:, ::-1].copy()


def command_weights(count: int, period: float, span: Any, dead_time: Any, lag: Any) -> Any:
    """Weights (m,) on m = count commands, a control period (s) apart, the newest first, of the mean thrust over a span
    (begin, end) (s); symbols."""
    acts = dead_time - period * ca.DM(np.arange(1.0, count + 1))  # s_j
    tau = ca.fmax(lag, NO_LAG)

    def integral(x: Any) -> Any:
        """Of the step response over x (s) since the step."""
        x = ca.fmax(x, 0)
        return x + tau * ca.expm1(-x / tau)

    passed = (integral(span[1] - acts) - integral(span[0] - acts)) / (span[1] - span[0])
    passed = ca.vertcat(passed[:-1], 1)
    return passed - ca.vertcat(0, passed[:-1])


@lru_cache(maxsize=32)
def _weights(count: int, period: float) -> Callable[..., np.ndarray]:
    """Of many spans at once, (m, k): begin, end (k,), dead time, lag."""
    begin, end, dead_time, lag = (ca.SX.sym(name) for name in ("begin", "end", "dead_time", "lag"))
    weights = command_weights(count, period, (begin, end), dead_time, lag)
    one = ca.Function("weights", [begin, end, dead_time, lag], [weights])

    def each(begins: np.ndarray, ends: np.ndarray, dead: float, tau: float) -> np.ndarray:
        return np.array(one(begins[None], ends[None], dead, tau))

    return each
