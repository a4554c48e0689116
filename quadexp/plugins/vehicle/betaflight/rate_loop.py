"""Betaflight's rate loop as an effect, for the margins of a law whose torque goes through it as body rates.

A control instant sends rates w* (rates.py) and a collective thrust u over the radio; the firmware smooths both, here by
a lag, and its controller of each axis gives a share s of that axis' torque:

    s = P e + I integral(e) - D w' + H (w* - w*_slow),    e = w* - w
    u_i = u / n + thrust_max sum_axis m_axis,i s_axis

m: signs of its mixer. w*_slow: w* behind a lag of 0.1 s; H: of yaw, the feedforward that is held. All are its settings
as they come, in its own units (thousandths of a share, degrees). Its integral grows 2.5 times as fast as I says: the
simulation build makes every 50 us what it takes for 125 us. Left out: limits of shares, and feedforward of w*', which
it divides by 8 where sticks hardly move.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.experiment.evaluate import InfeasibleError, Loop
from quadexp.physics.expression import Expression
from quadexp.physics.state import RATE
from quadexp.physics.vehicle import Vehicle
from quadexp.plugin import brought
from quadexp.plugins.vehicle.rates import wanted_rates
from quadexp.world.effect import Clock, Effect, Moment, Sizes, Start
from quadexp.world.link import Latency
from quadexp.world.world import World

SHARE = np.degrees(1) / 1000  # of a torque, from the firmware's units
PROPORTIONAL = SHARE * 0.032029 * np.array([45.0, 47.0, 45.0])  # s; of roll, pitch, yaw
INTEGRAL = SHARE * 0.244381 * np.array([80.0, 84.0, 80.0]) * 125 / 50
DERIVATIVE = SHARE * 0.000529 * np.array([30.0, 34.0, 0.0])  # s^2
HELD = SHARE * 0.013754 * 15 * np.array([0.0, 0.0, 1.2])  # s
HELD_LAG = 0.1  # s, of w*_slow
LAG = 2e-3  # s, of the smoothing, less what is left out, and of the filter of w'
SENT = 4  # numbers: rates (rad/s) and thrust (N)
OWN = SENT + 9  # inner states beside those of the radio, see _parts


def axis_gains(vehicle: Vehicle) -> np.ndarray:
    """K of alpha = K (w* - w) of the firmware's P on a vehicle, (3,) (1/s)."""
    torque = vehicle.thrust_max * np.abs(vehicle.allocation[1:]).sum(axis=1)  # N m, of a whole share
    gains: np.ndarray = PROPORTIONAL * torque / np.diag(vehicle.inertia_matrix)
    return gains


@dataclass(frozen=True, kw_only=True)
class RateLoop(Latency):
    """Radio and firmware between a law's thrusts and the rotors of a quadrotor. vehicle: for which the law computes.
    gain: with which its torques become rates, (3,) (1/s). period: of control (s)."""

    vehicle: Vehicle
    gain: np.ndarray
    period: float

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        radio = super().sizes(clock, vehicle)
        return radio._replace(inner=radio.inner + OWN)

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        sent = np.array([0.0, 0.0, 0.0, start.thrust.sum()])
        waiting, parameters = super().start(rng, start._replace(thrust=sent))
        return np.concatenate([waiting, sent, np.zeros(9)]), parameters

    def begin(self, at: Moment) -> Expression:
        """What the law commands is sent."""
        rates = wanted_rates(self.vehicle, at.x, at.command, self.gain, self.period)
        sent = at._replace(inner=at.inner[:-OWN], command=ca.vertcat(rates, ca.sum1(at.command)))
        return ca.vertcat(super().begin(sent), at.inner[-OWN:])

    def thrusts(self, at: Moment) -> Expression:
        """Of the shares of the torques, and of the collective thrust."""
        wanted, thrust, integral, filtered, slow = self._parts(at)
        rate = at.x[RATE]
        share = ca.DM(PROPORTIONAL) * (wanted - rate) + ca.DM(INTEGRAL) * integral
        share += ca.DM(HELD) * (wanted - slow) - ca.DM(DERIVATIVE) * (rate - filtered) / LAG
        mixer = ca.DM(np.sign(self.vehicle.allocation[1:]))
        return thrust / self.vehicle.n_rotors + self.vehicle.thrust_max * (mixer.T @ share)

    def advance(self, at: Moment) -> Expression:
        wanted, thrust, integral, filtered, slow = self._parts(at)
        arrived = super().thrusts(at._replace(inner=at.inner[:-OWN], command=ca.SX(SENT, 1)))
        rate = at.x[RATE]
        smooth = _lagging(ca.vertcat(wanted, thrust), arrived, at.step, LAG)
        integral += at.step * (wanted - rate)
        filtered = _lagging(filtered, rate, at.step, LAG)
        slow = _lagging(slow, wanted, at.step, HELD_LAG)
        return ca.vertcat(at.inner[:-OWN], smooth, integral, filtered, slow)

    def _parts(self, at: Moment) -> list[Any]:
        """Its own states: smoothed rates (3,) (rad/s) and thrust (N), the integral (3,) (rad), w behind its filter and
        w*_slow, (3,) each (rad/s)."""
        parts: list[Any] = ca.vertsplit(at.inner[-OWN:], [0, 3, 4, 7, 10, OWN])
        return parts


def _lagging(value: Any, towards: Any, step: Any, lag: float) -> Any:
    return towards + (value - towards) * ca.exp(-step / lag)


def with_rate_loop(loop: Loop, gain: np.ndarray, held: float) -> World:
    """The plant of a loop, with the firmware between it and a law. held: s, by which pulses come later than commands.

    gain: see RateLoop."""
    world = loop.plant if isinstance(loop.plant, World) else World(loop.plant, [])
    radio = next((effect for effect in world.effects if isinstance(effect, Latency)), Latency())
    others: list[Effect] = [effect for effect in world.effects if effect is not radio]
    late = asdict(radio) | {"latency": radio.latency + held}
    period = loop.controller.control_period
    firmware = RateLoop(**late, vehicle=loop.vehicle, gain=gain, period=period)
    return World(world.airframe, [firmware, *others], world._believed)


def law_margins(loop: Loop, gain: np.ndarray, held: float) -> dict[str, Any]:
    """Margins of a law's loop with the firmware in it. gain, held: see with_rate_loop.

    Raises InfeasibleError, with what helps, where this loop is not stable at hover."""
    margins_of = brought("services", "loop_margins")
    if "unknown" in loop.margins or margins_of is None:
        return loop.margins
    margins: dict[str, Any] = margins_of(loop.controller, with_rate_loop(loop, gain, held))
    if margins.get("delay", 1.0) > 0:
        return margins
    own = axis_gains(loop.vehicle)
    stable = margins_of(loop.controller, with_rate_loop(loop, own, held)).get("delay", 1.0) > 0
    helps = "--rates inverse" if stable else "a higher controller.rate, or lower bandwidths of the law"
    doubling = np.log(2) / margins["growth"]
    raise InfeasibleError(
        f"--rates inverse={_text(gain)}: with the firmware's rate loop, of gains {_text(own)} 1/s on this vehicle, the"
        f" law is not stable at hover, an error doubles every {doubling:.2g} s; what makes it stable: {helps}"
    )


def _text(gain: np.ndarray) -> str:
    return ",".join(f"{value:.3g}" for value in gain)
