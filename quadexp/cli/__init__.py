"""The command line: one module a command, `app.py` puts them together.

Ctrl-C and SIGTERM end it in one line from the beginning: nothing heavy is imported before that is so.
"""

import os
import signal
from types import FrameType

NOTHING = "interrupted: nothing was done, run the same command again"


def leave(number: int, frame: FrameType | None) -> None:
    """Handler of a signal that comes while modules are imported."""
    os.write(2, f"error: {NOTHING}\n".encode())
    os._exit(128 + number)


def main() -> None:
    """Entry point of `quadexp`."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, leave)
    from quadexp.cli.app import main as run

    run()
