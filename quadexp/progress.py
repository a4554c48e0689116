"""Progress of long work on the error stream: a bar on a terminal, a line per 10 % elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import TracebackType
from typing import Any

from quadexp.messages import CleanStream, raw


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

        below, bar = self._below, self._bar
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
