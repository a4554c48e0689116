"""A page that shows a sweep while it runs: a file in its folder, written anew, which a browser loads anew."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from quadexp.errors import QuadexpError
from quadexp.plugins.page.live import Live, page
from quadexp.report.pairing import Row
from quadexp.writer import write_text

FILE = "watch.html"  # in the folder of results
RENEWED = 2.0  # s between two pages at least
SHARE = 0.05  # of the time at most that goes into pages


class Watch:
    """with Watch(out, metric) as watch: run_sweep(..., on_result=watch.on_result, progress=watch.progress)

    The page is there from the first flight on, and stays as it was last.
    """

    def __init__(self, out: Path, metric: str) -> None:
        self.live = Live(title=str(out), metric=metric)
        self.path = out / FILE
        self._began = self._due = time.monotonic()

    def __enter__(self) -> Watch:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        now = self.snapshot()
        if kind is None:
            now.state = "finished"
        elif kind is KeyboardInterrupt:
            now.state = "interrupted"
        else:
            now.state = f"ended: {error}"
        if isinstance(error, QuadexpError) and "run the same command to continue" in str(error):
            now.state = "interrupted: run the same command to continue"
        self._write(now)

    def on_result(self, row: Row) -> None:
        """A flight is there."""
        self.live.rows.append(dict(row))

    def progress(self, done: float, total: float) -> None:
        """Write the page where it is due. The first call says how many flights were there already."""
        if not self.live.total:
            self.live.before = int(done)
        self.live.total = int(total)
        began = time.monotonic()
        if began >= self._due:
            with contextlib.suppress(QuadexpError):  # a full disk ends the sweep, which says so
                self._write(self.snapshot())
            self._due = began + max(RENEWED, (time.monotonic() - began) / SHARE)

    def before(self, other: Callable[[int, int], None]) -> Callable[[int, int], None]:
        """Its own progress, and then another."""

        def both(done: int, total: int) -> None:
            self.progress(done, total)
            other(done, total)

        return both

    def snapshot(self) -> Live:
        """The state now, which nothing changes any more."""
        return Live(**{**vars(self.live), "rows": [*self.live.rows], "elapsed": time.monotonic() - self._began})

    def _write(self, live: Live) -> None:
        if live.rows:  # a sweep that is refused leaves nothing
            write_text(self.path, page(live, RENEWED))
