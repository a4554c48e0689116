"""One setting for a vehicle that nobody measured: what is late, off, or blown, made good as far as the evidence goes.

    told state, readings -> as of now, by what is known of the age -> observer -> MPC or law -> command
                        bank (bank.py) -> posterior (posterior.py), every DECIDES periods -> what acts (decide.py)

It is told the vehicle, which sensors there are and the noise of the accelerometer; nothing of delays, lags, air, load,
battery or wind. A flight begins as if nothing were known. Columns: COLUMNS, delays in s.
"""

from __future__ import annotations

import copy as copying
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadexp.control.auto.ahead import LARGEST, Ahead, CommandsAhead, Delivered, sent_commands
from quadexp.control.auto.bank import SPINS, Bank
from quadexp.control.auto.decide import GATE, LEAST_LAG, Acting, Decision, Senses, grids
from quadexp.control.auto.following import following
from quadexp.control.auto.posterior import Posterior
from quadexp.control.auto.senses import WALKS
from quadexp.control.base import Window
from quadexp.control.delay.strapdown import Strapdown
from quadexp.control.instant import Instant, Operation, Told, copy, instant_of, python
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.dead_time import MotorLead
from quadexp.control.observers.observer import air_of, parameters_of
from quadexp.control.part import Remedy
from quadexp.control.wrapped import WrappedController, thrust_at_start
from quadexp.errors import UsageError
from quadexp.parts.settings import key
from quadexp.physics.state import N_STATE

DECIDES = 10  # periods of the bank
LATER = 1.04  # how much longer a flight has to be until the evidence is looked at again
SPACING = 4  # samples of the reference in a control period, so that it may be asked for later ones
KNOWN = (
    "age", "age_sd", "delay", "delay_sd", "lag", "lag_sd", "scale", "scale_sd", "rates_fresh", "acts_age",
    "acts_dead_time", "acts_lag", "grid", "acts_lateral", "acts_vertical", "acts_torque",
)  # fmt: skip
COLUMNS = tuple(f"auto_{name}" for name in KNOWN)
NOTHING_KNOWN = np.array([0.0, math.nan, 0.0, math.nan, 0.0, math.nan, 1.0, math.nan, *np.zeros(8)])


class Auto(WrappedController):
    """An MPC that finds out in flight what makes its model wrong; inner: it, inside its observer."""

    in_margins = True
    delay = 0.0  # of a flight that begins

    def __init__(self, core: PredictiveController, config: AutoPart) -> None:
        self._observer = following(core)
        super().__init__(self._observer.around(core))
        inner, world = self.inner, core.believed
        assert world is not None
        self._core, self._world = core, world
        self._grids = grids(core.settings)
        self._commands = sent_commands(inner.vehicle, self.control_period)
        theta, numbers = parameters_of(core), self._world.numbers
        shared = {"theta": theta, "push": core.mpc.disturbance, "wind": numbers[6:9], "scale": numbers[9:10]}
        self._to_now = Ahead(inner.vehicle, core.mpc.residual, inner.backend, self._commands, shared)
        self._strapdown = Strapdown(inner, 0.0, LARGEST)
        self._delivered = Delivered(self._commands, inner.backend)
        self._ahead, self._lead = CommandsAhead(core.mpc), MotorLead(inner.vehicle, core.settings, inner.backend)
        self._world.thrust = self._delivered.thrust
        self._bank = Bank(inner.vehicle, air_of(core), theta, self.control_period, config.noise, inner.backend)
        self._posterior, self._decision = Posterior(self._bank), Decision()
        self._fresh, self._unbiased, self._minus_bias = np.zeros(1), np.zeros(3), np.zeros(3)
        self._beliefs = NOTHING_KNOWN.copy()
        self._spacing = self.control_period / SPACING
        longest = LARGEST + max(one.horizon for one in self._grids)
        self.node_times = self._spacing * np.arange(math.ceil(longest / self._spacing) + 2)
        self._rows = np.zeros(len(core.node_times))
        self._world.rows = self._rows
        self._use(Acting())

    def forget(self) -> None:
        """See Controller.forget: nothing is known."""
        self._use(Acting())
        self.inner.forget()

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset: nothing is known."""
        self._use(Acting())
        rows = self._rows.astype(int)
        inside = window._replace(state=window.state[rows], input=window.input[rows[:-1]])
        super().reset(x, inside)
        thrust = thrust_at_start(inside, self.vehicle)
        self._strapdown.reset(x, inside)
        self._commands.reset(thrust)
        self._bank.reset(x, thrust)
        self._posterior.reset()
        self._decision.reset()
        self._bank.weights[...] = self._posterior.weights(*self._posterior.best)
        self._beliefs[...], self._minus_bias[...] = NOTHING_KNOWN, 0.0
        self._time = self._again = 0.0
        self._observe(Acting(), Acting(), Senses())

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        inside = copying.copy(told)
        inside.force = self._unbiased
        decide = python(self._decide, told.read)._replace(every=DECIDES * self._bank.every)
        operations = [decide, Operation("add", self._unbiased, told.force, self._minus_bias)]
        predicted, by_model = self._to_now.before(state)
        propagated, by_readings = self._strapdown.before(inside, state)
        now = np.zeros(N_STATE)
        operations += [*predicted, *propagated, copy(now, by_model), copy(now, by_readings, self._fresh)]
        operations += self._delivered.before()
        inner = instant_of(self.inner, inside, now)
        operations += [*inner.operations, *self._bank.after(told, state, inner.command)]
        operations += self._commands.after(inner.command)
        return inner._replace(operations=operations, logged=(*inner.logged, self._beliefs))

    def log(self) -> dict[str, float]:
        """See Controller.log."""
        return {**self.inner.log(), **dict(zip(COLUMNS, self._beliefs.tolist(), strict=True))}

    def _decide(self) -> None:
        """Look at the evidence so far, and act on it from this instant on."""
        bank = self._bank
        self._time += DECIDES * bank.period
        senses, before = self._senses(), self._decision.acting
        if bank.count < DECIDES or self._time < self._again:
            acting = before if bank.count >= DECIDES else self._decision.begin(senses)
            self._observe(acting, before, senses)
            return
        self._again = self._time * LATER
        evidence = self._posterior.evidence()
        acting = self._decision.take(evidence, senses, self._time)
        late = 0.0 if evidence.fresh else evidence.mean[0]
        bank.weights[...] = self._posterior.weights(late, *evidence.mean[1:])
        bank.follow(evidence.spin)
        bias, deviation = evidence.bias
        bank.bias[...] = bias * (np.abs(bias) > GATE * deviation)
        self._minus_bias[...] = -bank.bias
        if replace(acting, timed=before.timed, push=before.push) != before:
            self._use(acting)
        self._observe(acting, before, senses)
        known = (*evidence.mean, *evidence.deviation)
        about = [known[i + j] for i in range(3) for j in (0, 3)]
        doing = acting.age, acting.dead_time, acting.lag, acting.grid, *acting.push
        self._beliefs[...] = *about, *evidence.scale, evidence.fresh, *doing

    def _senses(self) -> Senses:
        """What the bank has measured beside the delays."""
        part = self._bank.part
        walk, variance, likelihood = (
            part(name).reshape(-1, 3) for name in ("walk", "walk_variance", "walk_likelihood")
        )
        best = likelihood.argmax(0), np.arange(3)
        away = np.abs(walk[best]) / np.sqrt(variance[best])
        shares = np.exp(likelihood - likelihood.max(0))
        strength = np.sqrt(np.square(WALKS) @ shares / shares.sum(0))
        torque = float(np.abs(part("torque")[2:]).max()) / self._bank.torque_deviation
        return Senses(
            (float(away[:2].max()), float(away[2]), torque),
            strength,
            self._bank.reading_noise,
            *self._bank.pose_noise,
            *SPINS[self._bank.spin],
        )

    def _use(self, acting: Acting) -> None:
        """Plan with these delays and this grid from now on."""
        age, dead_time, lag = (min(getattr(acting, n), LARGEST) for n in ("age", "dead_time", "lag"))
        by_readings = age if acting.fresh else 0.0
        self._to_now.tune(by_readings - age, 0.0, dead_time, lag)
        self._strapdown.tune(by_readings)
        self._fresh[0] = by_readings > 0
        self._delivered.tune(0.0, dead_time, lag)
        waits = round(dead_time / self._spacing) * self._spacing  # what is left counts as lag
        lags = lag + dead_time - waits
        lags = lags if lags > LEAST_LAG else 0.0
        settings = replace(self._grids[acting.grid], dead_time=waits, motor_lead=lags)
        self._ahead.tune(waits, lags, self._world.numbers[9] * self._commands.values)
        self._lead.tune(settings)
        self._core.use(settings, self._ahead, self._lead)
        self._rows[...] = np.round(self._core.node_times / self._spacing)

    def _observe(self, acting: Acting, before: Acting, senses: Senses) -> None:
        """Gains of the observer: by the noise of what it compares; nothing of what has not shown itself."""
        self._world.settings[...] = self._observer.follow(self._world.estimate, acting, before, senses)


@dataclass(frozen=True, kw_only=True)
class AutoPart(Remedy):
    """What is late, off or blown, found in flight; alone around a controller."""

    prefix = "delay."
    believes = True
    finds_delays = True

    noise: float = key(
        0.06, "standard deviation of a reading of the accelerometer by its data sheet", "(0, 100]", "m/s^2"
    )

    def suited(self, settings: Any) -> Any:
        """See Remedy. UsageError where it is told of what it finds itself."""
        if settings.dead_time or settings.known_lag:
            raise UsageError(
                f"delay={self.name}: finds dead time and lag itself; controller.dead_time, controller.motor_lag and"
                " controller.motor_lead must be 0"
            )
        return grids(replace(settings, input_hold="deviation"))[0]

    def around(self, controller: Any) -> Auto:
        """See Remedy."""
        if type(controller) is not PredictiveController:
            raise UsageError(f"delay={self.name}: not around this controller")
        return Auto(controller, self)
