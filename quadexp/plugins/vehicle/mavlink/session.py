"""A flight through an autopilot: its state in, body rates and thrust out, till the reference ends or something fails.

    heartbeat -> messages asked for -> 1 s of set-points -> OFFBOARD -> armed -> the reference, from where it hovers

It has flown a stand-in autopilot only, never a real PX4. World east north up, body forward left up, SI.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.control.base import Measurement
from quadexp.errors import QuadexpError
from quadexp.experiment.evaluate import describe
from quadexp.experiment.identity import find_model
from quadexp.experiment.rollout import _Log
from quadexp.log.schema import Flight
from quadexp.loop import ControlLoop, controller
from quadexp.parts.compose import compose
from quadexp.parts.options import Folders
from quadexp.physics.rotation import heading
from quadexp.physics.state import ATTITUDE, POSITION
from quadexp.plugins.vehicle.mavlink.frames import FLIPPED, ThrustMap, odometry_state, parts_state, thrust_map
from quadexp.plugins.vehicle.mavlink.link import Link, address
from quadexp.plugins.vehicle.rates import Rates, rates_of

OFFBOARD = 6  # main mode of PX4
RATES = 128  # type_mask: no attitude beside the rates
SILENT, SLOW = 0.3, 5.0  # s without a state, after which it gives up; in lockstep, where a simulator may take its time
TOGETHER = 20  # ms, by which position and attitude may differ
FIRST, ARMING = 30.0, 60.0  # s, for which it waits for a heartbeat, and for somebody who arms
WARM_UP = 1.0  # s of set-points before OFFBOARD
TURNED = 0.35  # rad, by which the heading may differ from the reference's


@dataclass(frozen=True)
class Asked:
    """thrust, rates: see frames.py. arm: whether it arms. real: whether the vehicle is. lockstep: whether a state is an
    instant of the reference, and not its stamp."""

    thrust: str = "full"
    rates: str = "predicted"
    arm: bool = False
    real: bool = False
    lockstep: bool = False


def fly_mavlink(target: str, overrides: Sequence[str], conf: Folders, asked: Asked) -> Flight:
    """Fly, and give what was flown. Raises UsageError, or QuadexpError where no flight began."""
    host, port = address(target, asked.real)
    config = compose(list(overrides), conf, "fly")
    loop = controller(*overrides, conf=conf)
    rates = rates_of(asked.rates, loop.controller)
    shares = thrust_map(asked.thrust, loop.vehicle)
    session = Session(loop, Link(host, port, asked.real), asked, rates, shares, config.trajectory.lost_distance)
    try:
        session.prepare()
        outcome, cause = session.fly()
    except KeyboardInterrupt:
        if not session.times:
            raise
        outcome, cause = "lost", "stopped by Ctrl-C"
        session.log.rows = len(session.times)  # without one that it was stopped in
    finally:
        session.link.close()
    if not session.times:
        raise QuadexpError(cause)
    columns = session.log.columns(np.array(session.times), [])
    metadata = describe(config, loop.vehicle, find_model(config))
    ages = 1e3 * np.array(session.ages or [np.nan])
    latency = {"p50": float(np.percentile(ages, 50)), "p99": float(np.percentile(ages, 99))}
    details = {"outcome": outcome, "cause": cause, "backend": loop.controller.backend, "corridor": float("nan")}
    return Flight(columns, metadata | details | {"latency_ms": latency, "autopilot": "PX4"})


class Session:
    """One flight. rates: see rates.py. shares: of thrust. far: m from the reference,
    beyond which it is lost. times, ages: of the rows of the log, and between the arrival of a state and its answer (s).
    """

    def __init__(
        self, loop: ControlLoop, link: Link, asked: Asked, rates: Rates, shares: ThrustMap, far: float
    ) -> None:
        self.loop, self.link, self.asked, self.rates = loop, link, asked, rates
        self.shares, self.far = shares, far
        self.kinds, self.ages, self.times = link.messages, list[float](), list[float]()
        self.log = _Log(len(loop.times), loop.vehicle.n_rotors, 0, False)
        self._force: np.ndarray | None = None
        self._parts: dict[str, Any] = {}
        self._resets: int | None = None
        self._newest: tuple[float, np.ndarray] | None = None  # state before the flight, which may wait for its answer
        self._armed = self._offboard = False

    def prepare(self) -> None:
        """Find the autopilot, ask for its messages, stream, change the mode, arm. Raises QuadexpError."""
        kinds = self.kinds
        beat = self.link.wait(
            "HEARTBEAT", FIRST, lambda message: message.autopilot != kinds.MAV_AUTOPILOT_INVALID
        )  # not of a ground station, nor of a gimbal
        if beat.autopilot != kinds.MAV_AUTOPILOT_PX4:
            raise QuadexpError(f"the autopilot says that it is {beat.autopilot}: PX4 (12) is needed")
        self.link.autopilot = beat.get_srcSystem(), beat.get_srcComponent()
        for name in ("ODOMETRY", "LOCAL_POSITION_NED", "ATTITUDE_QUATERNION", "HIGHRES_IMU"):
            number = getattr(kinds, f"MAVLINK_MSG_ID_{name}")
            answer = self.link.command(kinds.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 * self.loop.period)
            if name == "ODOMETRY" and answer == kinds.MAV_RESULT_ACCEPTED:
                self._parts = {"whole": True}
        self.loop.reset()
        self._stream(WARM_UP)
        mode = kinds.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        if self.link.command(kinds.MAV_CMD_DO_SET_MODE, mode, OFFBOARD) != kinds.MAV_RESULT_ACCEPTED:
            raise QuadexpError("the autopilot refuses OFFBOARD")
        if self.asked.arm and self.link.command(kinds.MAV_CMD_COMPONENT_ARM_DISARM, 1) != kinds.MAV_RESULT_ACCEPTED:
            raise QuadexpError("the autopilot refuses to arm")
        until = time.monotonic() + ARMING
        while not (self._armed and self._offboard):
            if time.monotonic() > until:
                raise QuadexpError(f"the vehicle was not armed within {ARMING:g} s (--arm arms it)")
            self._stream(0.1)

    def _stream(self, duration: float) -> None:
        """Hover for so long (s), and listen."""
        until, hover = time.monotonic() + duration, self.loop.vehicle.mass * self.loop.vehicle.gravity
        while time.monotonic() < until:
            for message in self.link.receive(0.02):
                self._newest = self._hear(message) or self._newest
            self._answer(np.zeros(3), hover, 0)

    def _answer(self, rates: np.ndarray, thrust: float, stamp: int) -> None:
        """Body rates (rad/s) and collective thrust (N). stamp: of the autopilot's boot (ms)."""
        roll, pitch, yaw = FLIPPED * rates
        share, no_attitude = self.shares.share(thrust), [1.0, 0.0, 0.0, 0.0]
        message = self.kinds.MAVLink_set_attitude_target_message
        stamp &= 0xFFFFFFFF
        self.link.send(message(stamp, *self.link.autopilot, RATES, no_attitude, roll, pitch, yaw, share))

    def _hear(self, message: Any) -> tuple[float, np.ndarray] | None:
        """Time (s) and state of a message that completes one. Raises QuadexpError where the estimate was reset."""
        kind = message.get_type()
        if kind == "HEARTBEAT":
            self._armed = bool(message.base_mode & self.kinds.MAV_MODE_FLAG_SAFETY_ARMED)
            self._offboard = message.custom_mode >> 16 & 0xFF == OFFBOARD
        elif kind == "HIGHRES_IMU":
            self._force = FLIPPED * np.array([message.xacc, message.yacc, message.zacc])
        elif kind == "ODOMETRY":
            if self._resets is not None and message.reset_counter != self._resets:
                raise QuadexpError("the autopilot's estimate was reset")
            self._resets = message.reset_counter
            return 1e-6 * message.time_usec, odometry_state(message)
        elif kind in ("LOCAL_POSITION_NED", "ATTITUDE_QUATERNION") and "whole" not in self._parts:
            self._parts[kind] = message
            position, attitude = self._parts.get("LOCAL_POSITION_NED"), self._parts.get("ATTITUDE_QUATERNION")
            if position and attitude and abs(position.time_boot_ms - attitude.time_boot_ms) <= TOGETHER:
                self._parts = {}
                return 1e-3 * max(position.time_boot_ms, attitude.time_boot_ms), parts_state(position, attitude)
        return None

    def fly(self) -> tuple[str, str]:
        """The reference, from where the vehicle is. Returns outcome and cause; then nothing streams any more."""
        loop, began, shift, heard = self.loop, 0.0, np.zeros(3), time.monotonic()
        k, silent = -1, SLOW if self.asked.lockstep else SILENT
        waiting = [] if self._newest is None else [self._newest]
        while True:
            try:
                states = waiting or [
                    measurement for message in self.link.receive(silent) if (measurement := self._hear(message))
                ]
            except QuadexpError as error:
                return "solver_failed", str(error)
            arrived, waiting, at = time.monotonic(), [], k
            if states:
                stamp, x = states[-1]
                at = k + 1 if self.asked.lockstep or k < 0 else round((stamp - began) / loop.period)
            if at <= k:
                if arrived - heard > silent:
                    return "lost", f"no new state for {silent:g} s: the link is silent"
                continue
            heard = arrived
            if not (self._armed and self._offboard):
                return "lost", "the autopilot left OFFBOARD, or was disarmed"
            if k >= 0 and (at - k) * loop.period > silent:
                return "lost", f"the time of the states jumps by {(at - k) * loop.period:.2f} s"
            if not np.isfinite(x).all():
                return "lost", "the autopilot's estimate is no number"
            if k < 0:
                began, shift = stamp, x[POSITION] - loop.start[POSITION]
                apart = float(heading(x[ATTITUDE]) - heading(loop.start[ATTITUDE]))
                if abs(np.angle(np.exp(1j * apart))) > TURNED:
                    return "lost", f"the vehicle's heading is {apart:.2f} rad from the reference's: turn it first"
            k = at
            if k >= len(loop.times):
                return "ok", ""
            x[POSITION] -= shift
            away = np.linalg.norm(x[POSITION] - loop.reference_state(float(loop.times[k]))[POSITION])
            if not away <= self.far:
                return "lost", f"{away:.1f} m from the reference at t={loop.times[k]:.2f} s"
            try:
                thrusts = loop.step(Measurement(float(loop.times[k]), x, self._force, None))
            except QuadexpError as failure:
                return "solver_failed", str(failure)
            if loop.failed:
                return "solver_failed", f"the control step failed at t={loop.times[k]:.2f} s"
            self._answer(self.rates(x, thrusts), float(thrusts.sum()), round(1e3 * stamp))
            self.ages.append(time.monotonic() - arrived)
            self._keep(k, x, thrusts)

    def _keep(self, k: int, x: np.ndarray, thrusts: np.ndarray) -> None:
        """A row of the log."""
        state, inputs = self.loop._reference.at(k)
        reading = np.full(3, np.nan) if self._force is None else self._force
        record = self.loop.record
        assert record is not None
        self.log.add(
            record, self.ages[-1], {}, state=x, input=thrusts, reading=reading, state_reference=state,
            input_reference=inputs, estimate=x,
        )  # fmt: skip
        self.times.append(float(self.loop.times[k]))
