"""A late state brought to now by the gyroscope's and accelerometer's readings since: no model, no disturbance needed.

Position, velocity and attitude are those of t - tau; the body rate w and the specific force f are read at every control
instant, and taken to be linear between two. Over a part of a period, of length h, from (w_0, f_0) to (w_1, f_1):

    phi(s) = integral of w + s^2 / 12 w_0 x w(s)          rotation vector from its beginning, to third order in s
    q^    <- q^ o Exp(phi(h))
    a(s)   = R(q^) Exp(phi(s)) f(s) + g                   quadratic in s through s = 0, h/2, h
    p^    <- p^ + h v^ + h^2 (a(0) + 2 a(h/2)) / 6
    v^    <- v^ + h (a(0) + 4 a(h/2) + a(h)) / 6

It starts from the newest measurement at every instant, so nothing drifts (Tal & Karaman 2021; Savage 1998 for phi). A
bias b of the accelerometer leaves b tau^2 / 2 in the position and b tau in the velocity. The oldest period counts by
the part of it that is younger than tau.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.base import Controller, Window
from quadexp.control.built import built
from quadexp.control.instant import YES, Instant, Operation, Told, call, copy, instant_of, move, python
from quadexp.control.part import Remedy
from quadexp.control.wrapped import WrappedController
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import symbols, unit
from quadexp.physics.rotation import along_z, exponential, product, rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY


@keyed
class KnownDelay(Remedy):
    """How old the state is that the controller is told."""

    prefix = "delay."

    time: float = key(0.01, "age of the measured state that is made good", "[0, 0.5]", "s")


class Strapdown(WrappedController):
    """A controller that is told position, velocity and attitude of now instead of those of `delay` (s) ago."""

    def __init__(self, inner: Controller, delay: float, largest: float | None = None) -> None:
        super().__init__(inner)
        self.delay, self._tuned = delay, largest is not None
        self._periods = math.ceil((largest or delay) / self.control_period - 1e-9)
        self._since, self._young, self._flown, self._force_read = 0, np.ones(1), np.zeros(1), False
        if self._periods:
            given = self._periods, self.vehicle.gravity, self.control_period
            self._propagate = BufferedFunction(built(inner.backend, propagation, *given))
            arguments = self._propagate.arguments
            self._state, self._late = arguments["x"], arguments["late"]
            self._rates, self._forces = arguments["rates"], arguments["forces"]  # (K + 1, 3), the oldest first
            flat = [one.reshape(-1) for one in (self._rates, self._forces)]
            self._older, self._newer = [one[:-3] for one in flat], [one[3:] for one in flat]
            self._rate, self._force = [one[-3:] for one in flat]
            self._now = self._propagate.results["now"]

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        self._since, self._young[0], self._flown[0], self._force_read = 0, 1.0, 0.0, False
        if self._tuned:
            self._rates[...], self._forces[...] = x[RATE], (0.0, 0.0, self.vehicle.gravity)
        super().reset(x, window)

    def tune(self, delay: float) -> None:
        """Go on with another age (s), up to `largest`."""
        self.delay, self._late[0] = delay, delay

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        operations, now = self.before(told, state)
        inner = instant_of(self.inner, told, now)
        return inner._replace(operations=[*operations, *inner.operations])

    def before(self, told: Told, state: np.ndarray) -> tuple[list[Operation], np.ndarray]:
        """Brings the state that is found there, (13,), whose rate is of now as the specific force is, to now; and the
        array that has it then."""
        if not self._periods:
            return [], state

        def begin() -> None:
            """Until `delay` has passed since the start, the measured state is that of the start."""
            if not self._flown[0]:
                self._rates[...], self._forces[...] = state[RATE], (0.0, 0.0, self.vehicle.gravity)
                return
            if told.read[0] and not self._force_read:
                self._forces[...], self._force_read = told.force, True
            self._since += 1
            self._late[0] = min(self.delay, self._since * self.control_period)
            self._young[0] = self._late[0] < self.delay

        flown, (older_rates, older_forces), (newer_rates, newer_forces) = self._flown, self._older, self._newer
        operations = [move(flown, YES, told.read)]
        operations += [] if self._tuned else [python(begin, self._young)]
        operations += [
            move(older_rates, newer_rates, flown),
            move(older_forces, newer_forces, flown),  # where nothing is read, the last force goes on
            move(self._rate, state[RATE], flown),
            move(self._force, told.force, told.read),
            copy(self._state, state),
            copy(self._now, state),
            call(self._propagate, flown),
        ]
        return [*operations, move(flown, YES)], self._now


def propagation(periods: int, gravity: float, period: float) -> ca.Function:
    """The state `late` (s) after x by the readings of the last K = `periods` control periods.

    Inputs: x (13,), its rate unused; rates (3, K + 1) (rad/s) and forces (3, K + 1) (m/s^2), body, the last ones of
    now; late, at most K periods. Output: now (13,), with the rate of now.
    """
    x, late, rates, forces = symbols(ca.SX, x=N_STATE, late=1, rates=(3, periods + 1), forces=(3, periods + 1))
    p, q, v = x[POSITION], x[ATTITUDE], x[VELOCITY]
    for j in range(periods):
        h = ca.fmax(ca.fmin(late - (periods - 1 - j) * period, period), 0)
        before = 1 - h / period  # share of the period that is older than the state
        w, f = (
            [values[:, j] + share * (values[:, j + 1] - values[:, j]) for share in (before, (1 + before) / 2, 1)]
            for values in (rates, forces)
        )
        R = rotation_matrix(q)
        turned = [f[0], *(rotation_matrix(exponential(_turn(w[0], w[i], h * i / 2))) @ f[i] for i in (1, 2))]
        a = [R @ one + along_z(-gravity) for one in turned]
        p = p + h * v + h**2 * (a[0] + 2 * a[1]) / 6
        v = v + h * (a[0] + 4 * a[1] + a[2]) / 6
        q = product(q, exponential(_turn(w[0], w[2], h)))
    now = ca.vertcat(p, unit(q), v, rates[:, -1])
    return ca.Function("strapdown", [x, rates, forces, late], [now], ["x", "rates", "forces", "late"], ["now"])


def _turn(first: ca.SX, last: ca.SX, duration: ca.SX) -> ca.SX:
    """Rotation vector (3,) (rad) of a body rate that goes linearly from first to last (rad/s) in a duration (s)."""
    return duration / 2 * (first + last) + duration**2 / 12 * ca.cross(first, last)


@keyed
class StrapdownPart(KnownDelay):
    """A late state is brought to now by gyroscope and accelerometer."""

    def around(self, controller: Any) -> Strapdown:
        """See Remedy: the controller behind a strapdown propagation of its measurements."""
        return Strapdown(controller, self.time)
