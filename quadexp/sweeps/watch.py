"""A page that shows a sweep while it runs: a file in its folder, written anew, which a browser loads anew."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from quadexp.errors import QuadexpError
from quadexp.files.writer import write_text
from quadexp.report.live import Live, page

FILE = "watch.html"  # in the folder of results
RENEWED = 2.0  # s between two pages at least
SHARE = 0.05  # of the time at most that goes into pages


class Watch:
    """with Watch(out, metric) as watch: run_sweep(..., landed=watch.landed, progress=watch.progress)

    The page is there from the first flight on, and stays as it was last.
    """

    def __init__(self, out: Path, metric: str) -> None:
        self.live, self.path = Live(title=str(out), metric=metric), out / FILE
        self._began, self._lock, self._ended = time.monotonic(), threading.Lock(), threading.Event()
        self._writer = threading.Thread(target=self._renew, daemon=True)

    def __enter__(self) -> Watch:
        self._writer.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._ended.set()
        self._writer.join()
        now = self.shot()
        now.state = "finished" if kind is None else "interrupted" if kind is KeyboardInterrupt else f"ended: {error}"
        if isinstance(error, QuadexpError) and "run the same command to continue" in str(error):
            now.state = "interrupted: run the same command to continue"
        self._write(now)

    def landed(self, row: Mapping[str, Any]) -> None:
        """A flight is there."""
        with self._lock:
            self.live.rows.append(dict(row))

    def progress(self, done: float, total: float) -> None:
        """The first call says how many flights were there already."""
        with self._lock:
            if not self.live.total:
                self.live.before = int(done)
            self.live.total = int(total)

    def before(self, other: Callable[[int, int], None]) -> Callable[[int, int], None]:
        """Its own progress, and then another."""

        def both(done: int, total: int) -> None:
            self.progress(done, total)
            other(done, total)

        return both

    def shot(self) -> Live:
        """The state now, which nothing changes any more."""
        with self._lock:
            return Live(**{**vars(self.live), "rows": [*self.live.rows], "elapsed": time.monotonic() - self._began})

    def _renew(self) -> None:
        wait = RENEWED
        while not self._ended.wait(wait):
            began = time.monotonic()
            with contextlib.suppress(QuadexpError):  # a full disk ends the sweep, which says so
                self._write(self.shot())
            wait = max(RENEWED, (time.monotonic() - began) / SHARE)

    def _write(self, live: Live) -> None:
        if live.rows:  # a sweep that is refused leaves nothing
            write_text(self.path, page(live, RENEWED))
