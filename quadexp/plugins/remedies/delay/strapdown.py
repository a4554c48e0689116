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
from typing import Any, ClassVar

from quadexp.compile.symbolic import ca
from quadexp.control.inputs import Circumstances, Inputs
from quadexp.control.layer import Layer, LayerPart
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import named_function, named_symbols, unit
from quadexp.physics.rotation import along_z, exponential, product, rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle


@keyed
class KnownDelay(LayerPart):
    """How old the state is that the controller is given."""

    prefix = "delay."
    age_key: ClassVar[str] = "time"

    time: float = key(0.01, "age of the measured state that is compensated", "[0, 0.5]", "s")


@keyed
class Strapdown(KnownDelay):
    """A late state is brought to now by gyroscope and accelerometer: the controller is given position, velocity and
    attitude of now."""

    def remembers(self, inputs: Inputs) -> dict[str, int]:
        """See LayerPart: readings, the oldest first; whether a force was read; whether the flight goes on, and for how
        many instants."""
        kept = 3 * (self._periods(inputs) + 1)
        if not self._periods(inputs):
            return {}
        return {"rates": kept, "forces": kept, "read": 1, "flown": 1, "since": 1}

    def before(self, vehicle: Vehicle, inputs: Inputs, memory: Any) -> dict[str, Any]:
        """The propagation. Until `time` has passed since the start, the measured state is that of the start; the first
        force that is read counts for those before it, and where none is read the last one goes on."""
        periods = self._periods(inputs)
        read = inputs.fresh[0]
        if not periods:
            return {}
        weight = ca.DM([0, 0, vehicle.gravity])
        rate = inputs.state[RATE]
        force = ca.if_else(read, inputs.specific_force, memory.forces[-3:])
        flown = ca.fmax(memory.flown, read)
        begins = ca.logic_and(read, ca.logic_not(memory.read))
        rates = ca.if_else(flown, _shifted(memory.rates, rate), _filled(rate, periods))
        forces = ca.if_else(begins, _filled(force, periods), _shifted(memory.forces, force))
        forces = ca.if_else(flown, forces, _filled(weight, periods))
        results = {"rates": rates, "forces": forces, "flown": 1, "since": memory.since + flown}
        late = self._late(inputs, results["since"])
        propagate = propagation(periods, vehicle.gravity, inputs.period)
        now = propagate(inputs.state, ca.reshape(rates, 3, -1), ca.reshape(forces, 3, -1), late)
        results["read"] = ca.fmax(memory.read, read)
        results["state"] = ca.if_else(ca.logic_and(flown, late > 0), now, inputs.state, True)
        return results

    def _late(self, inputs: Inputs, since: Any) -> Any:
        """How old the state is after so many instants (s)."""
        return ca.fmin(self.time, since * inputs.period)

    def _periods(self, inputs: Inputs) -> int:
        return math.ceil(self.time / inputs.period - 1e-9)

    def around(self, controller: Any) -> Layer:
        """See Remedy: the controller behind a strapdown propagation of its measurements."""
        return Layer(controller, self, Circumstances(controller.control_period))


def _shifted(kept: ca.MX, newest: ca.MX) -> ca.MX:
    return ca.vertcat(kept[3:], newest)


def _filled(values: ca.MX, periods: int) -> ca.MX:
    return ca.repmat(values, periods + 1, 1)


def propagation(periods: int, gravity: float, period: float) -> ca.Function:
    """The state `late` (s) after x by the readings of the last K = `periods` control periods.

    Inputs: x (13,), its rate unused; rates (3, K + 1) (rad/s) and forces (3, K + 1) (m/s^2), body, the last ones of
    now; late, at most K periods. Output: now (13,), with the rate of now.
    """
    readings = (3, periods + 1)
    inputs = named_symbols(ca.SX, {"x": N_STATE, "rates": readings, "forces": readings, "late": 1})
    x, rates, forces, late = inputs.values()
    p = x[POSITION]
    q = x[ATTITUDE]
    v = x[VELOCITY]
    for j in range(periods):
        h = ca.fmin(late - (periods - 1 - j) * period, period)
        h = ca.fmax(h, 0)
        before = 1 - h / period  # share of the period that is older than the state
        w = []
        f = []
        for share in (before, (1 + before) / 2, 1):
            w.append(rates[:, j] + share * (rates[:, j + 1] - rates[:, j]))
            f.append(forces[:, j] + share * (forces[:, j + 1] - forces[:, j]))
        R = rotation_matrix(q)
        a = []
        for i in range(3):
            turn = _turn(w[0], w[i], h * i / 2)
            turned = rotation_matrix(exponential(turn)) @ f[i] if i else f[0]
            a.append(R @ turned + along_z(-gravity))
        p = p + h * v + h**2 * (a[0] + 2 * a[1]) / 6
        v = v + h * (a[0] + 4 * a[1] + a[2]) / 6
        q = product(q, exponential(_turn(w[0], w[2], h)))
    now = ca.vertcat(p, unit(q), v, rates[:, -1])
    return named_function("strapdown", inputs, {"now": now})


def _turn(first: ca.SX, last: ca.SX, duration: ca.SX) -> ca.SX:
    """Rotation vector (3,) (rad) of a body rate that goes linearly from first to last (rad/s) in a duration (s)."""
    return duration / 2 * (first + last) + duration**2 / 12 * ca.cross(first, last)


@keyed
class TunedStrapdown(Strapdown):
    """The same, for an age that is found in flight, up to `time`: the input `late`."""

    def _late(self, inputs: Inputs, since: Any) -> Any:
        return inputs.symbol("late", (1, 1))
