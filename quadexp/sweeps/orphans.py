"""What the server of workers does with a worker that outlives its pool while it starts: it ends without a word.

Imported by the server only (server.start_server). After an interrupt the pool's semaphores are gone, and a worker that
was forked just before looks for them; Python would print that as a traceback behind the line that says how to go on.
"""

from __future__ import annotations

import sys
import traceback
from types import TracebackType


def _report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    where = [frame.name for frame in traceback.extract_tb(trace)]
    if not (isinstance(error, FileNotFoundError) and where[-1:] == ["__setstate__"]):
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _report
