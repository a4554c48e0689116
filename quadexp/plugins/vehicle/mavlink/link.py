"""Messages of MAVLink 2 over UDP: heartbeat, time synchronisation, commands with their answers."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import socket
import time
from collections.abc import Callable
from typing import Any

from quadexp.errors import QuadexpError, UsageError

OWN = {"srcSystem": 245, "srcComponent": 191}  # an onboard computer
ALL = (0, 0)  # system and component: everybody
BEAT = 0.5  # s, between heartbeats


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
    if kind != "udp" or not host or not port.isdecimal() or not 0 < int(port) < 65536:
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
    """Listens at an address, and answers who speaks first there. peer: its address. autopilot: system and component,
    beside whose messages those of gimbals and other vehicles may come there; ALL before it is known."""

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
        self.autopilot = ALL
        self._beaten = 0.0

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()

    def send(self, message: Any) -> None:
        """A message to the autopilot, once there is one."""
        if self.peer is not None:
            with contextlib.suppress(OSError):  # the network is down: then no state comes either
                self._socket.sendto(message.pack(self._mav), self.peer)

    def receive(self, patience: float) -> list[Any]:
        """The autopilot's messages of the next datagram, none after so long (s); heartbeats go out."""
        now, kinds = time.monotonic(), self.messages
        if now - self._beaten > BEAT:
            self._beaten = now
            state = kinds.MAV_STATE_ACTIVE
            kind = kinds.MAV_TYPE_ONBOARD_CONTROLLER
            self.send(kinds.MAVLink_heartbeat_message(kind, kinds.MAV_AUTOPILOT_INVALID, 0, 0, state, 3))
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
        parser = kinds.MAVLink(None)  # a new one: half a message in a datagram spoils no other
        parser.robust_parsing = True  # what is no message does not raise
        heard = []
        for message in parser.parse_buffer(data) or []:
            source = message.get_srcSystem(), message.get_srcComponent()
            if self.autopilot not in (ALL, source):
                continue
            heard.append(message)
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self.send(kinds.MAVLink_timesync_message(time.monotonic_ns(), message.ts1))
        return heard

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
        self.send(self.messages.MAVLink_command_long_message(*self.autopilot, number, 0, *values))
        answer = self.wait("COMMAND_ACK", 2.0, lambda message: message.command == number)
        return int(answer.result)
