"""Progress of long work on the error stream: a bar on a terminal, a line per 10 % elsewhere.

Where nothing is counted, a line on the terminal says what a command does, and since when; what is printed replaces it.
"""

from __future__ import annotations

import shutil
import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

from quadexp.messages import CleanStream, clean, printable, raw

PATIENCE = 3.0  # s, after which a command says what it does
AGAIN = 0.5  # s, how often


class Waiting:
    """with Waiting("import"): a line "import: FILE (12 s)" on a terminal while it takes long; see `set_status`."""

    now: Waiting | None = None

    def __init__(self, command: str) -> None:
        self.command = command
        self.what = ""
        self._began = time.monotonic()
        self._ended = threading.Event()
        self._lock = threading.RLock()
        self._stream = raw(sys.stderr)
        self._shown = False

    def __enter__(self) -> Waiting:
        if sys.stderr is not None and sys.stderr.isatty():
            Waiting.now = self
            CleanStream.before = self.clear
            threading.Thread(target=self._tick, daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.end()

    def end(self) -> None:
        """Say nothing from now on."""
        self._ended.set()
        self.clear()
        if Waiting.now is self:
            Waiting.now = None
            CleanStream.before = None

    def clear(self) -> None:
        """Make room for what is printed."""
        with self._lock:
            if self._shown:
                self._stream.write("\r\x1b[K")
                self._stream.flush()
                self._shown = False

    def _tick(self) -> None:
        wait = PATIENCE
        while not self._ended.wait(wait):
            wait = AGAIN
            with self._lock:
                if self._ended.is_set():
                    return
                what = f": {self.what}" if self.what else ""
                text = f"{self.command}{what} ({time.monotonic() - self._began:.0f} s)"
                width = shutil.get_terminal_size().columns - 1
                self._stream.write(f"\r{clean(text)[:width]}\x1b[K")
                self._stream.flush()
                self._shown = True


def set_status(what: object) -> None:
    """What the command that runs is about, for a user who waits."""
    if Waiting.now is not None:
        Waiting.now.what = printable(what)


class Progress:
    """with Progress("flights") as progress: progress(done, total)

    below: makes what is shown below the bar on a terminal, anew twice a second.
    """

    def __init__(self, label: str, below: Callable[[], Any] | None = None) -> None:
        self.label = label
        self._below = below
        self._bar: Any = None
        self._shown: Any = None
        self._task: Any = None
        self._said = 0

    def __enter__(self) -> Progress:
        if Waiting.now is not None:
            Waiting.now.end()  # what is counted says more
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar

            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
            terminal = Console(file=raw(sys.stderr), stderr=True)
            self._bar = Bar(*columns, console=terminal, transient=True)
            self._shown = self._bar if self._below is None else self._live(terminal)
            self._shown.start()
            sys.stdout, sys.stderr = CleanStream(sys.stdout), CleanStream(sys.stderr)  # the bar's, until it stops
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._bar is not None:
            self._shown.stop()

    def _live(self, terminal: Any) -> Any:
        from rich.console import Group
        from rich.live import Live

        below = self._below
        bar = self._bar
        assert below is not None
        return Live(get_renderable=lambda: Group(below(), bar), console=terminal, transient=True, refresh_per_second=2)

    def __call__(self, done: float, total: float) -> None:
        """Show that `done` of `total` is finished; the first call tells where the work began."""
        if self._bar is not None:
            if self._task is None:
                self._task = self._bar.add_task(self.label, total=total)
            self._bar.update(self._task, completed=done, total=total)
            return
        tenth = int(10 * done / total) if total else 0
        if tenth > self._said:
            self._said = tenth
            count = f" ({done:g} of {total:g})" if total > 1 else ""
            print(f"{self.label}: {10 * tenth} %{count}", file=sys.stderr, flush=True)
