"""The figures of a sweep, drawn in its processes while tables are made; only those whose inputs have changed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.report.drawing import Drawing, FigureFolder, draw, drawings
from quadexp.sweeps.engine import Workers, cause

LONGEST = 600.0  # s that one figure may take


class SweepFigures:
    """The figures of a folder of results; a context, at whose end no figure is half written.

    processes: that draw them; None: they are drawn in this one, by `end`. metric, confidence: of the figure of errors.
    failed: name of a figure -> why it was not drawn.
    """

    def __init__(self, out: str | Path, processes: Workers | None, metric: str, confidence: float) -> None:
        self._out, self._processes, self._options = Path(out), processes, (metric, confidence)
        self._folder = FigureFolder(out)
        self._asked: dict[str, Drawing] = {}
        self._running: dict[str, Callable[[], bool]] = {}
        self.failed: dict[str, str] = {}

    def __enter__(self) -> SweepFigures:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and self._processes is not None:
            self._processes.stop()  # what they have begun stays unfinished
        if self._asked:
            self._folder.clean()

    def begin(self, rows: Sequence[Mapping[str, Any]], record: Mapping[str, Any] | None = None) -> None:
        """Begin to draw the figures of the rows that are not there yet. The flights must be on disk. record: of the
        results, which says what was swept."""
        try:
            self._asked = {one.name: one for one in drawings(rows, self._out, *self._options, record)}
            todo = [one for one in self._asked.values() if not self._folder.shows(one)]
            self._folder.begin(todo)
            for one in todo:
                self._running[one.name] = self._begun(one, len(todo))
        except Exception as error:  # the tables are made all the same
            self.failed["all figures"] = cause(error, LONGEST)

    def _begun(self, one: Drawing, all_of_them: int) -> Callable[[], bool]:
        """What waits for a figure, and draws it where there are no other processes for that."""
        arguments = one.kind, one.inputs, self._folder.path(one.name)
        if self._processes is None:
            return lambda: draw(*arguments)
        return self._processes.call(draw, *arguments, timeout=LONGEST, calls=all_of_them).result

    def end(self) -> dict[str, str]:
        """Wait for the figures; returns figure_NAME -> path of those that are there (the SVG; a PNG lies beside it).

        What cannot be drawn is in `failed`; an earlier figure of that name is removed, for it shows other rows.
        """
        for name, drawn in self._running.items():
            try:
                self._folder.done(self._asked[name], drawn())
            except Exception as error:
                self._folder.remove(name)
                self.failed[name] = cause(error, LONGEST)
        return {f"figure_{name}": str(self._folder.path(name)) for name in self._asked if self._folder.is_there(name)}
