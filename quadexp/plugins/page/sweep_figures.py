"""The figures of a sweep, drawn in its processes while tables are made.

Nothing here imports matplotlib before a figure is drawn.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp import report
from quadexp.errors import UsageError
from quadexp.log.cell_store import CellStore
from quadexp.names import distinct, file_name
from quadexp.plugins.page.view import View, automatic
from quadexp.report.frame import SweepFrame
from quadexp.report.pairing import Row, Rows, condition_of, contestant_labels, contestant_of, grouped, is_flown
from quadexp.report.tables import course_labels
from quadexp.report.text import speed_text
from quadexp.sweeps.engine import Workers, cause
from quadexp.writer import clean

FOLDER = "figures"
LONGEST = 600.0  # s that one figure may take
MAX_CONDITIONS = 3  # of tracked paths side by side


class Drawing(NamedTuple):
    """A figure to be drawn. make: makes it from the inputs."""

    name: str
    make: Callable[..., Any]
    inputs: tuple[Any, ...]


def draw(drawing: Drawing, path: Path) -> None:
    """Draw a figure as SVG and PNG, each whole or not at all. path: of the SVG."""
    from quadexp.plugins.drawing.style import save

    save(drawing.make(*drawing.inputs), path)


def drawings(rows: Rows, out: str | Path, metric: str, confidence: float, record: Row | None = None) -> list[Drawing]:
    """The figures of these rows, the one that takes longest first. out: folder of the results. record: of the results,
    which says what was swept; without it the rows do, as far as they can."""
    store = CellStore(out)
    figures = []
    with contextlib.suppress(UsageError):  # no flight was completed
        for view in automatic(SweepFrame([*map(dict, rows)], out, record), metric, confidence):
            figures.append(Drawing(f"{metric.removesuffix('_error')}_error_{view.file_name}", _swept, (view,)))
    for trajectory, grid in path_grids(rows).items():
        flights = {}
        missing = {}
        for place, row in grid.cells.items():
            if is_flown(row):
                flights[place] = str(store.path(row["key"]))
            else:
                missing[place] = row["outcome"]
        figures.append(Drawing(f"path_{trajectory}", _paths, (flights, trajectory, missing, grid.left_out)))
    return figures


class PathGrid(NamedTuple):
    """Flights of one trajectory. cells: (controller, condition) -> row of the first completed seed, otherwise of the
    first seed; one condition after the other. left_out: conditions beyond MAX_CONDITIONS."""

    cells: dict[tuple[str, str], Row]
    left_out: list[str]


def path_grids(rows: Rows) -> dict[str, PathGrid]:
    """By trajectory with a completed flight. Of many speeds the slowest, the fastest, one between; where
    worlds and other settings differ too, the fastest of each."""
    names = contestant_labels(distinct(map(contestant_of, rows)))
    courses = course_labels((row["trajectory"], condition_of(row).setting) for row in rows)
    several = []
    for key in ("plant", "vehicle"):
        if len({row[key] for row in rows}) > 1:
            several.append(key)
    cells: dict[str, dict[tuple[str, float], dict[str, Row]]] = {}
    for row in rows:
        *_, speed, setting = condition_of(row)
        worlds = [str(row[key]) for key in several]  # as tables name them
        settings = courses[row["trajectory"], setting].removeprefix(row["trajectory"]).strip(", ")
        words = ", ".join(filter(None, [*worlds, settings])).replace("=", " ")
        name = names[contestant_of(row)]
        of_trajectory = cells.setdefault(row["trajectory"], {})
        of_condition = of_trajectory.setdefault((words, speed or 0.0), {})
        if name not in of_condition or (is_flown(row) and not is_flown(of_condition[name])):
            of_condition[name] = row
    grids: dict[str, PathGrid] = {}
    for trajectory, conditions in cells.items():
        flown = [condition for condition, of in conditions.items() if any(map(is_flown, of.values()))]
        flown.sort(key=lambda condition: condition[::-1])
        speeds = grouped(flown)
        each = max(1, MAX_CONDITIONS // max(len(speeds), 1))
        kept = []
        for words, of_words in list(speeds.items())[:MAX_CONDITIONS]:
            chosen = sorted({round(k) for k in np.linspace(len(of_words) - 1, 0, each)})
            kept += [(words, of_words[k]) for k in chosen]
        texts = {}
        for words, speed in flown:
            texts[words, speed] = ", ".join(filter(None, (speed_text(speed or None), words)))
        shown = {}
        for condition in kept:
            for name, row in conditions[condition].items():
                shown[name, texts[condition]] = row
        if kept:
            left_out = [text for condition, text in texts.items() if condition not in kept]
            grids[trajectory] = PathGrid(shown, left_out)
    return grids


def _swept(view: View) -> Any:
    """One of the figures that were chosen by what was swept."""
    from quadexp.plugins.page.draw import figure_of

    return figure_of(view)


def _paths(paths: Mapping[tuple[str, str], str], *about: Any) -> Any:
    from quadexp.log.store import read_flight
    from quadexp.plugins.page.flight_figures import tracked_paths

    return tracked_paths({place: read_flight(path) for place, path in paths.items()}, *about)


class SweepFigures:
    """The figures of a folder of results; a context, at whose end no figure is half written.

    processes: that draw them; None: they are drawn in this one, by `end`. metric, confidence: of the figure of errors.
    failed: name of a figure -> why it was not drawn.
    """

    def __init__(self, out: str | Path, processes: Workers | None, metric: str, confidence: float) -> None:
        self._out = Path(out)
        self._processes = processes
        self._options = (metric, confidence)
        self._asked: list[str] = []
        self._running: dict[str, Callable[[], None]] = {}
        self.failed: dict[str, str] = {}

    def __enter__(self) -> SweepFigures:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and self._processes is not None:
            self._processes.stop()  # what they have begun stays unfinished
        if self._asked:
            clean(self._out / FOLDER)

    def path(self, name: str) -> Path:
        """The SVG; the PNG lies beside it."""
        return self._out / FOLDER / f"{file_name(name)}.svg"

    def begin(self, rows: Rows, record: Row | None = None) -> None:
        """Begin to draw the figures of the rows. The flights must be on disk. record: of the results, which says what
        was swept."""
        try:
            asked = drawings(rows, self._out, *self._options, record)
            self._asked = [drawing.name for drawing in asked]
            for drawing in asked:
                self._running[drawing.name] = self._begun(drawing, len(asked))
        except Exception as error:  # the tables are made all the same
            self.failed["all figures"] = cause(error, LONGEST)

    def _begun(self, drawing: Drawing, all_of_them: int) -> Callable[[], None]:
        """What waits for a figure, and draws it where there are no other processes for that."""
        path = self.path(drawing.name)
        if self._processes is None:
            return lambda: draw(drawing, path)
        return self._processes.call(draw, drawing, path, timeout=LONGEST, calls=all_of_them).result

    def end(self) -> dict[str, str]:
        """Wait for the figures; returns figure_NAME -> path of those that are there (the SVG; a PNG lies beside it).

        What cannot be drawn is in `failed`; an earlier figure of that name is removed, for it shows other rows.
        """
        for name, wait in self._running.items():
            try:
                wait()
            except Exception as error:
                for form in report.FORMATS:
                    with contextlib.suppress(OSError):  # a folder that takes no files has none either
                        self.path(name).with_suffix(f".{form}").unlink(missing_ok=True)
                self.failed[name] = cause(error, LONGEST)
        drawn = {}
        for name in self._asked:
            path = self.path(name)
            if path.is_file():
                drawn[f"figure_{name}"] = str(path)
        return drawn
