"""Ctrl-C and SIGTERM while the modules of a command are imported: one line, and the exit code that shells expect."""

import os
import signal
from types import FrameType

NOTHING = "interrupted: nothing was done, run the same command again"


def leave(number: int, frame: FrameType | None) -> None:
    """Handler of both."""
    os.write(2, f"error: {NOTHING}\n".encode())
    os._exit(128 + number)


def listen() -> None:
    """Handle both, unless somebody does."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, leave)
