"""A stand-in for PX4 on loopback: the bench's plant under a rate loop at 1 kHz, which speaks MAVLink.

In lockstep its clock stands until each state is answered; paced, it is the real one, and a command acts when it comes.
alpha = K (w* - w), tau = J alpha + w x J w.
"""

from __future__ import annotations

import socket
import threading
import time
from typing import Any

import numpy as np

from quadexp.loop import ControlLoop
from quadexp.physics.rotation import air_velocity
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.plugins.vehicle.mavlink.frames import BODY_FRD, FLIPPED, LOCAL_NED, swapped, turned

GAIN = np.array([25.0, 25.0, 10.0])  # 1/s
STEP = 1e-3  # s
PATIENCE = 60.0  # s, of a test


class StandIn(threading.Thread):
    """loop: vehicle, plant and reference. whole: whether it has ODOMETRY. reset_at, silent_at: instants at which its
    estimate is reset, and at which it falls silent. paced: whether its clock is the real one. beside: datagrams of
    others that come with every state. stamp: of a state at an instant of its clock (s). place: likewise, added to its
    position (m)."""

    def __init__(self, loop: ControlLoop, port: int, messages: Any, **faults: Any) -> None:
        super().__init__(daemon=True)
        self.loop, self.kinds = loop, messages
        self.autopilot = faults.get("autopilot", messages.MAV_AUTOPILOT_PX4)
        self.whole, self.reset_at = faults.get("whole", True), faults.get("reset_at", -1)
        self.paced = faults.get("paced", False)
        self.silent_at, self.arms = faults.get("silent_at", -1), faults.get("arms", False)
        self.beside: tuple[bytes, ...] = faults.get("beside", ())
        self.stamp, self.place = faults.get("stamp", lambda t: t), faults.get("place", lambda t: 0.0)
        self.errors, self.refused_early = list[float](), None
        self._mav = messages.MAVLink(None, srcSystem=1, srcComponent=1)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._peer = ("127.0.0.1", port)
        self._armed = self._offboard = self._answered = False
        self._targets = self._asked = 0
        self._rates, self._thrust = np.zeros(3), 0.0

    def _send(self, message: Any) -> None:
        self._socket.sendto(message.pack(self._mav), self._peer)

    def _listen(self, patience: float = 0.02) -> None:
        """The messages of one datagram, if one comes within so long (s)."""
        kinds = self.kinds
        self._socket.settimeout(patience)
        try:
            data = self._socket.recv(2048)
        except (TimeoutError, BlockingIOError, ConnectionRefusedError):
            return
        for message in self._mav.parse_buffer(data) or []:
            kind = message.get_type()
            if kind == "SET_ATTITUDE_TARGET":
                assert message.type_mask == 128
                self._targets += 1
                oldest = 5000 if self.paced else self._asked
                if self._armed and message.time_boot_ms < oldest:
                    continue  # of before the flight
                rates = [message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate]
                self._rates, self._thrust = FLIPPED * np.array(rates), message.thrust
                self._answered = True
            elif kind == "TIMESYNC" and message.tc1 == 0:
                self._send(kinds.MAVLink_timesync_message(time.monotonic_ns() + 5_000_000_000, message.ts1))
            elif kind == "COMMAND_LONG":
                self._send(kinds.MAVLink_command_ack_message(message.command, self._obey(message)))

    def _obey(self, message: Any) -> int:
        kinds = self.kinds
        accepted = int(kinds.MAV_RESULT_ACCEPTED)
        if message.command == kinds.MAV_CMD_DO_SET_MODE:
            if self._targets < 2:
                return int(kinds.MAV_RESULT_TEMPORARILY_REJECTED)
            self._offboard = message.param2 == 6
            self._armed = self._armed or self.arms
        elif message.command == kinds.MAV_CMD_COMPONENT_ARM_DISARM:
            self._armed = bool(message.param1)
        elif message.command == kinds.MAV_CMD_SET_MESSAGE_INTERVAL:
            has = self.whole or message.param1 != kinds.MAVLINK_MSG_ID_ODOMETRY
            return accepted if has else int(kinds.MAV_RESULT_UNSUPPORTED)
        return accepted

    def _beat(self) -> None:
        kinds, base = self.kinds, self.kinds.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        base |= kinds.MAV_MODE_FLAG_SAFETY_ARMED if self._armed else 0
        mode = 6 << 16 if self._offboard else 4 << 16
        state = kinds.MAV_STATE_ACTIVE
        for datagram in self.beside:
            self._socket.sendto(datagram, self._peer)
        self._send(kinds.MAVLink_heartbeat_message(kinds.MAV_TYPE_QUADROTOR, self.autopilot, base, mode, state, 3))

    def _tell(self, x: np.ndarray, t: float, resets: int) -> None:
        """A state, in the frames of an autopilot; its place is another than the reference's."""
        kinds, q = self.kinds, turned(x[ATTITUDE])
        place = swapped(x[POSITION] + np.array([3.0, -2.0, 1.0]) + self.place(t))
        rates, t = FLIPPED * x[RATE], self.stamp(t)
        self._asked = round(1e3 * (5 + t))
        if self.whole:
            v = FLIPPED * air_velocity(x[ATTITUDE], x[VELOCITY])
            unknown = [float("nan")] * 21
            frames = LOCAL_NED, BODY_FRD
            about = unknown, unknown, resets, 0, 100
            self._send(kinds.MAVLink_odometry_message(round(1e6 * (5 + t)), *frames, *place, q, *v, *rates, *about))
            return
        stamp = self._asked
        self._send(kinds.MAVLink_attitude_quaternion_message(stamp, *q, *rates))
        self._send(kinds.MAVLink_local_position_ned_message(stamp, *place, *swapped(x[VELOCITY])))

    def _wait(self, until: float) -> None:
        """Listen till this time."""
        while (left := until - time.monotonic()) > 0:
            self._listen(left)

    def run(self) -> None:
        loop, vehicle, plant = self.loop, self.loop.vehicle, self.loop.plant
        until, beat = time.monotonic() + PATIENCE, 0.0
        while not (self._armed and self._offboard) and time.monotonic() < until:
            if time.monotonic() - beat > 0.2:
                self._beat()
                beat = time.monotonic()
            self._listen()
        self._beat()
        J, mixer = vehicle.inertia_matrix, np.linalg.pinv(vehicle.allocation)
        x = loop.start.copy()
        duration = float(loop.times[-1]) + 1
        plant.advance(x, np.zeros(4), STEP, plant.begin(x, STEP, duration, np.random.default_rng(0)))  # is compiled
        noise = plant.begin(x, STEP, duration, np.random.default_rng(0))
        steps, began = round(loop.period / STEP), time.monotonic()
        for k in range(len(loop.times) + self.paced * round(1 / loop.period)):  # paced: the bridge begins later
            if k == self.silent_at:
                return
            reference = loop.reference_state(min(k, len(loop.times) - 1) * loop.period)
            self.errors.append(float(np.linalg.norm(x[POSITION] - reference[POSITION])))
            self._answered = False
            for datagram in self.beside:
                self._socket.sendto(datagram, self._peer)
            self._tell(x, k * loop.period, int(k >= self.reset_at >= 0))
            while not (self._answered or self.paced):
                if time.monotonic() > until:
                    return
                self._listen()
            for step in range(steps):
                if self.paced:
                    self._wait(began + k * loop.period + step * STEP)
                force = self._thrust * vehicle.n_rotors * vehicle.thrust_max
                rate = x[RATE]
                torque = J @ (GAIN * (self._rates - rate)) + np.cross(rate, J @ rate)
                thrusts = np.clip(mixer @ [force, *torque], vehicle.thrust_min, vehicle.thrust_max)
                x, _ = plant.advance(x, thrusts, STEP, noise)
        self._tell(x, len(loop.times) * loop.period, 0)
