"""One setting for a vehicle that nobody measured: what is late, off or blown, made good as far as the evidence goes.

    told state, readings -> as of now, by what is known of the age -> observer -> MPC or law -> command
                        bank (bank.py) -> posterior (posterior.py), every DECIDES -> what acts (decide.py)

It is told the vehicle, which sensors there are and the noise of the accelerometer; nothing of delays, lags, air, load,
battery or wind. A flight begins as if nothing were known. Columns: COLUMNS, delays in s, each with its standard
deviation; what is believed of the world is in the columns of the observer.
"""

from __future__ import annotations

import copy as copying
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from quadexp.control.auto.ahead import LARGEST, Ahead
from quadexp.control.auto.bank import SHEET, SPINS, Bank
from quadexp.control.auto.decide import GATE, Acting, Decision, Senses, found_at
from quadexp.control.auto.following import (
    DEVIATIONS,
    LEAST_NOISE,
    UNKNOWN,
    ForceFollowing,
    SpeedFollowing,
    WindFollowing,
)
from quadexp.control.auto.posterior import Posterior
from quadexp.control.auto.senses import WALKS
from quadexp.control.base import Controller, Window
from quadexp.control.delay.strapdown import Strapdown
from quadexp.control.delivered import SentCommands
from quadexp.control.instant import Operation, Told, copy, python
from quadexp.control.observers.observer import air_of, parameters_of
from quadexp.control.wrapped import WrappedController, thrust_at_start
from quadexp.models.residual import Residual
from quadexp.parts.sensor_sheet import SensorSheet
from quadexp.physics.state import N_STATE, VELOCITY

LAST, AT_LIMIT = 0.3, 0.999  # s, of commands that may be at their limits, and from where on they are
# s: the beginning of a flight, between looks before there is a decision, and between looks at what pushes, in the
# beginning and for the rest of the flight
BEGINS, LOOKS, SOON, DECIDES = 1.0, 0.02, 0.1, 0.1
# s of readings that are few: no decision yet, and a push has to stand out against a noise as far off as a sheet may be
FEW = 0.2
GOOD_SPEED = 0.005, 0.002  # relative noise and age (s) of rotor speeds that tell thrusts better than the commands
INEXACT = 0.03  # of a delay: messages take unlike times
# Of a lag: motors lag unlike up and down, by a third of the mean to either side (RotorS); which of both counts by how
# thrusts change, within a fifth of that. Where thrusts stand in a period is off as much, and so an age.
UNLIKE = 0.07
BAND = 1.96  # deviations of half a 95 % band
LATER, LATEST = 1.04, 1.0  # how much longer a flight has to be until delays are looked at again, and at most (s)
KNOWN = (
    "age", "age_sd", "delay", "delay_sd", "lag", "lag_sd", "rates_fresh", "acts_age", "acts_dead_time", "acts_lag",
    "grid", "acts_lateral", "acts_vertical", "acts_torque", *DEVIATIONS,
)  # fmt: skip
COLUMNS = tuple(f"auto_{name}" for name in KNOWN)
NOTHING_KNOWN = np.array([*([0.0, np.nan] * 3), *np.zeros(8), *UNKNOWN])


class Auto(WrappedController):
    """A controller that finds out in flight what makes its model wrong.

    inner: what is told, the Observer first. core: the controller itself. sheet: of the sensors. believed: arrays of the
    believed world, for Ahead. commands: for all that needs them. observer: what follows the world; None where the core
    takes no belief.
    A subclass says how it plans (`_plan`), and what its instant is.
    """

    delay = 0.0  # of a flight that begins

    def __init__(
        self, inner: Controller, core: Any, sheet: SensorSheet, residual: Residual, believed: dict[str, np.ndarray],
        observer: WindFollowing | SpeedFollowing | ForceFollowing | None, commands: SentCommands,
    ) -> None:  # fmt: skip
        super().__init__(inner)
        self._core, self._observer, vehicle, period = core, observer, inner.vehicle, self.control_period
        self._commands = commands
        self._to_now = Ahead(vehicle, residual, inner.backend, commands, believed)
        self._strapdown = Strapdown(inner, 0.0, LARGEST)
        noise = LEAST_NOISE if sheet.accelerometer is None else max(sheet.accelerometer.noise, LEAST_NOISE)
        rate, attitude = (0.0 if sensor is None else sensor.noise for sensor in (sheet.gyroscope, sheet.attitude))
        inertial = (sensor.delay or 0.0 for sensor in (sheet.accelerometer, sheet.gyroscope) if sensor is not None)
        speeds = sheet.rotor_speed
        self._turns = speeds is not None and speeds.noise < GOOD_SPEED[0] and (speeds.delay or 0.0) < GOOD_SPEED[1]
        self._sheet = sheet
        force, turn = (
            0.0 if sensor is None else sensor.within(period) for sensor in (sheet.accelerometer, sheet.gyroscope)
        )
        of = {"turning": (rate, attitude), "spans": (force, turn)}
        self._bank = Bank(vehicle, air_of(core), parameters_of(core), period, noise, inner.backend, **of)
        # By which age and delays cannot be told apart: by readings that are old, or as old as nobody says, as far as a
        # data sheet may be wrong; and within a period of the bank a faster law answers to noise.
        self._apart = SHEET / BAND * max(inertial, default=0.0) + self._bank.period - period
        unsaid = sheet.gyroscope is not None and sheet.gyroscope.delay is None
        self._unsaid = unsaid and sheet.attitude is not None and bool(sheet.attitude.delay)
        self._few = round(FEW / self._bank.period)
        self._lately = round(LAST / period)
        self._begins = np.ones(1)  # whether there is no other evidence yet
        self._soon, self._seldom = np.ones(1), np.ones(1)  # which of the paces of decisions counts
        # What rotor speeds tell is believed from the first reading on: a force waits neither for a push nor for a grid.
        self._waits = not isinstance(observer, SpeedFollowing)
        self._posterior, self._decision = Posterior(self._bank), Decision(0.0 if self._waits else BEGINS)
        self._fresh, self._unbiased, self._minus_bias = np.zeros(1), np.zeros(3), np.zeros(3)
        self._beliefs = NOTHING_KNOWN.copy()
        self._begin, self._judged = Acting(), False  # with what a flight begins, and whether it stays at that
        self._rows = np.zeros(len(core.node_times))

    def _plan(self, acting: Acting, dead_time: float, lag: float) -> None:
        """Plan with these delays, and with what else is acted on, from now on; sets `_rows`, of the reference."""
        raise NotImplementedError

    def forget(self) -> None:
        """See Controller.forget: nothing is known."""
        self._use(self._begin)
        self.inner.forget()

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset: nothing is known."""
        self._use(self._begin)
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
        self._time, self._again, self._begins[0] = 0.0, 0.0, 1.0
        self._soon[0], self._seldom[0] = self._waits, not self._waits
        self._observe(Acting(), Acting(), Senses())

    @contextmanager
    def settled(self, age: float, dead_time: float, lag: float) -> Iterator[None]:
        """Meanwhile it flies as it does once these delays (s) have been found, with the stiffest grid that it then may
        choose: what margins are taken of."""
        self._begin, self._judged = found_at(age, dead_time, lag), True
        try:
            yield
        finally:
            self._begin, self._judged = Acting(), False
            self.forget()

    def before(self, told: Told, state: np.ndarray) -> tuple[list[Operation], Told, np.ndarray]:
        """What stands before the controller: decisions, and what it is told, its state in an array of its own."""
        inside = copying.copy(told)
        inside.force = self._unbiased
        inside.turning = told.turning if self._turns else np.zeros(1)
        look = python(self._look, self._begins)._replace(every=max(2, round(LOOKS / self.control_period)))
        decide = [
            python(lambda: self._decide(told), when)._replace(every=max(1, round(each / self.control_period)))
            for each, when in ((DECIDES, self._seldom), (SOON, self._soon))
        ]
        predicted, by_model = self._to_now.before(state)
        propagated, by_readings = self._strapdown.before(inside, state)
        now = np.zeros(N_STATE)
        operations = [
            look,
            *decide,
            Operation("add", self._unbiased, told.force, self._minus_bias),
            *predicted,
            *propagated,
        ]
        operations += [copy(now, by_model), copy(now, by_readings, self._fresh)]
        return operations, inside, now

    def after(self, told: Told, state: np.ndarray, command: np.ndarray) -> list[Operation]:
        """What stands behind it."""
        return [*self._bank.after(told, state, command), *self._commands.after(command)]

    @property
    def lacking(self) -> list[str]:
        """What it lacks here, and what that leaves undone; a line each."""
        by_speeds = self._turns or isinstance(self._observer, SpeedFollowing)
        missing = {
            "no accelerometer: delays, wind and force are not found": not self._sheet.accelerometer,
            "no speeds of rotors that tell thrusts: these follow from the commands": not by_speeds,
            "a law that takes no belief: a late state alone is made good": not self._observer,
            "no drag in the model that shows a wind: it is a force": isinstance(self._observer, ForceFollowing),
        }
        return [line for line, holds in missing.items() if holds]

    def log(self) -> dict[str, float]:
        """See Controller.log."""
        return {**self.inner.log(), **dict(zip(COLUMNS, self._beliefs.tolist(), strict=True))}

    def _decide(self, told: Told) -> None:
        """Look at the evidence so far, and act on it from this instant on."""
        bank = self._bank
        if self._judged:
            return
        self._time = float(bank.part("count")[0]) * bank.period
        self._soon[0] = self._waits and self._time < BEGINS
        self._seldom[0] = not self._soon[0]
        senses, before = self._senses(), self._decision.acting
        softer = self._decision.soften(senses)
        if softer != before:
            self._use(softer)
        before, acting = softer, self._decision.shown(senses)
        if bank.count < self._few or self._time < self._again:
            self._observe(acting, before, senses)
            return
        self._again, self._begins[0] = min(self._time * LATER, self._time + LATEST), 0.0
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
        age, total, lag = evidence.mean
        apart = math.hypot(self._apart, self._unsaid * age / BAND, UNLIKE * lag)
        known = (age, total, lag, *np.hypot(evidence.deviation, np.hypot(INEXACT * evidence.mean, apart)))
        about = [known[i + j] for i in range(3) for j in (0, 3)]
        self._beliefs[: len(about) + 1] = *about, evidence.fresh

    def _look(self) -> None:
        """Act on a push, and on an age that attitude and rates show, before there is other evidence."""
        acting = before = self._decision.acting
        if self._judged:
            return
        senses, few = self._senses(), self._bank.part("count")[0] < self._few
        if self._waits:
            acting = self._decision.begin(senses, SHEET if few else 1.0)
        if self._bank.turns:
            acting = self._decision.at_once(*self._posterior.early())
        if acting != before:
            self._use(acting)
            self._observe(acting, before, senses)

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
        (position, attitude), (rate, twist) = self._bank.pose_noise, SPINS[self._bank.spin]
        pushes = float(away[:2].max()), float(away[2]), torque
        velocity, swing = part("x")[VELOCITY].copy(), float(part("sent")[2::3].std())
        sent, low, high = self._commands.values[-self._lately :], self.vehicle.thrust_min, self.vehicle.thrust_max
        limited = float((np.abs(sent - (low + high) / 2) > AT_LIMIT * (high - low) / 2).mean())
        noise = self._bank.reading_noise
        return Senses(pushes, strength, noise, position, attitude, rate, twist, velocity, swing, limited)

    def _use(self, acting: Acting) -> None:
        """Act on these delays from now on."""
        age, dead_time, lag = (min(getattr(acting, name), LARGEST) for name in ("age", "dead_time", "lag"))
        by_readings = age if acting.fresh else 0.0
        self._to_now.tune(by_readings - age, 0.0, dead_time, lag)
        self._strapdown.tune(by_readings)
        self._fresh[0] = by_readings > 0
        self._plan(acting, dead_time, lag)

    def _observe(self, acting: Acting, before: Acting, senses: Senses) -> None:
        """Gains of the observer: by the noise of what it compares; nothing of what has not shown itself."""
        doing = acting.age, acting.dead_time, acting.lag, acting.grid, *acting.push
        self._beliefs[KNOWN.index("acts_age") : -len(UNKNOWN)] = doing
        if self._observer is not None:
            inner: Any = self.inner
            inner.settings[...] = self._observer.follow(inner.estimate, acting, before, senses)
            self._beliefs[-len(UNKNOWN) :] = self._observer.deviations(inner.estimate)
