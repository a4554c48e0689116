"""Messages of MAVLink 2 over UDP: heartbeat, time synchronisation, commands with their answers."""

from __future__ import annotations

import ipaddress
import os
import socket
import time
from collections.abc import Callable
from typing import Any

from quadexp.errors import QuadexpError, UsageError

OWN = {"srcSystem": 245, "srcComponent": 191}  # an onboard computer
BEAT, SYNC = 0.5, 0.5  # s, between heartbeats, and between requests of the time
AGING = 1.01  # factor on the shortest round trip at every answer: clocks drift


def dialect() -> Any:
    """The messages. Raises UsageError where the package is missing."""
    os.environ.setdefault("MAVLINK20", "1")
    try:
        from pymavlink.dialects.v20 import common
    except ImportError:
        raise UsageError('fly: needs the package pymavlink: pip install "quadexp[mavlink]"') from None
    return common


def address(target: str, real: bool) -> tuple[str, int]:
    """Host and port of udp:HOST:PORT. Raises UsageError for one that is not of this machine, unless the vehicle is
    real."""
    kind, _, rest = target.partition(":")
    host, _, port = rest.rpartition(":")
    if kind != "udp" or not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise UsageError(f"fly {target}: must be udp:HOST:PORT, such as udp:127.0.0.1:14540")
    if not real and not is_local(host):
        raise UsageError(f"fly {target}: {host} is not this machine; --vehicle-is-real if a vehicle may move")
    return host, int(port)


def is_local(host: str) -> bool:
    """Whether a host is this machine's own loop."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Link:
    """Listens at an address, and answers who speaks first there. peer: its address. offset: of its clock from ours
    (ns), None before it is known. round_trip: the shortest (ns)."""

    def __init__(self, host: str, port: int, real: bool = False) -> None:
        self.messages = dialect()
        self._mav, self._real = self.messages.MAVLink(None, **OWN), real
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise UsageError(f"fly udp:{host}:{port}: cannot listen there ({error.strerror})") from None
        self.peer: tuple[str, int] | None = None
        self.system = 1
        self.offset: int | None = None
        self.round_trip = 10**12
        self._beaten = self._synchronised = 0.0

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()

    def send(self, message: Any) -> None:
        """A message to the autopilot, once there is one."""
        if self.peer is not None:
            self._socket.sendto(message.pack(self._mav), self.peer)

    def receive(self, patience: float) -> list[Any]:
        """The messages of the next datagram, none after so long (s); heartbeats and requests of the time go out."""
        now, kinds = time.monotonic(), self.messages
        if now - self._beaten > BEAT:
            self._beaten = now
            state = kinds.MAV_STATE_ACTIVE
            kind = kinds.MAV_TYPE_ONBOARD_CONTROLLER
            self.send(kinds.MAVLink_heartbeat_message(kind, kinds.MAV_AUTOPILOT_INVALID, 0, 0, state, 3))
        if now - self._synchronised > SYNC:
            self._synchronised = now
            self.send(kinds.MAVLink_timesync_message(0, time.monotonic_ns()))
        self._socket.settimeout(patience)
        try:
            data, peer = self._socket.recvfrom(2048)
        except TimeoutError:
            return []
        if not self._real and not is_local(peer[0]):
            return []
        self.peer = self.peer or peer
        if peer != self.peer:
            return []
        messages = self._mav.parse_buffer(data) or []
        for message in messages:
            if message.get_type() == "TIMESYNC":
                self._keep_time(message)
        return list(messages)

    def _keep_time(self, message: Any) -> None:
        """The clocks' offset, from the shortest round trip; and an answer to who asks."""
        now = time.monotonic_ns()
        if message.tc1 == 0:
            self.send(self.messages.MAVLink_timesync_message(now, message.ts1))
            return
        there_and_back = now - message.ts1
        if 0 <= there_and_back < self.round_trip:
            self.round_trip = there_and_back
            self.offset = message.tc1 - (message.ts1 + there_and_back // 2)
        self.round_trip = int(AGING * self.round_trip)

    def wait(self, kind: str, patience: float, accept: Callable[[Any], bool] = lambda _: True) -> Any:
        """The next message of a kind. Raises QuadexpError where none comes within this time (s)."""
        until = time.monotonic() + patience
        while time.monotonic() < until:
            for message in self.receive(0.05):
                if message.get_type() == kind and accept(message):
                    return message
        raise QuadexpError(f"no {kind} within {patience:g} s")

    def command(self, number: int, *parameters: float) -> int:
        """What the autopilot answers to a command: MAV_RESULT."""
        values = [*parameters, *[0.0] * 7][:7]
        self.send(self.messages.MAVLink_command_long_message(self.system, 1, number, 0, *values))
        answer = self.wait("COMMAND_ACK", 2.0, lambda message: message.command == number)
        return int(answer.result)
