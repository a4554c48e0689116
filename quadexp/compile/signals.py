"""Signals that ask this process to end, where an exception in between would be lost or leave a mess.

Python raises KeyboardInterrupt wherever it is. A library may catch it: casadi has a bare `except` in what it imports.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Delay SIGINT and SIGTERM to the end of the block, where the first one acts; of no effect in another thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked: list[int] = []
    usual = {
        number: signal.signal(number, lambda number, frame: asked.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler or signal.SIG_DFL)
        for first in asked[:1]:
            os.kill(os.getpid(), first)
