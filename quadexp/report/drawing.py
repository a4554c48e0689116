"""Which figures a sweep has, what each is drawn from, and whether the one on disk still shows that.

Nothing here imports matplotlib before a figure is drawn: one whose inputs are those it was drawn from is left as it is,
and one that is drawn may be drawn in another process.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import UsageError
from quadexp.files.names import file_name
from quadexp.files.writer import clean, remove, write_text
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_text
from quadexp.provenance import source_hash
from quadexp.report import FORMATS
from quadexp.report.frame import SweepFrame
from quadexp.report.pairing import condition_of, is_flown
from quadexp.report.result_rows import to_columns
from quadexp.report.tables import column_labels, course_labels
from quadexp.report.text import speed_text
from quadexp.report.view import automatic

FOLDER = "figures"
DRAWN = ".drawn"  # file beside the figures: name of each -> digest of what it was drawn from


@dataclass(frozen=True)
class Drawing:
    """A figure to be drawn. kind: which function draws it, see `draw`. inputs: what that takes. digest: of all that
    decides the figure."""

    name: str
    kind: str
    inputs: tuple[Any, ...]
    digest: str


def draw(kind: str, inputs: tuple[Any, ...], path: Path) -> bool:
    """Draw a figure as SVG and PNG, each whole or not at all; returns False where there is nothing to show.

    path: of the SVG.
    """
    from quadexp.report import figures

    makers: dict[str, Any] = {"times": figures.solve_times, "paths": figures.path_figure, "axes": _swept}
    figure = makers[kind](*inputs)
    if figure is not None:
        figures.save(figure, path, inside=path.parent.parent)
    return figure is not None


def _swept(
    rows: Sequence[Mapping[str, Any]], out: str, metric: str, confidence: float, record: Mapping[str, Any], which: int
) -> Any:
    """One of the figures that were chosen by what was swept."""
    from quadexp.report.draw import figure_of

    return figure_of(automatic(SweepFrame(rows, out, record), metric, confidence)[which])


def drawings(
    rows: Sequence[Mapping[str, Any]], out: str | Path, metric: str, confidence: float,
    record: Mapping[str, Any] | None = None,
) -> list[Drawing]:  # fmt: skip
    """The figures of these rows, the one that takes longest first. out: folder of the results. record: of the results,
    which says what was swept; without it the rows do, as far as they can."""
    rows, store = [dict(row) for row in rows], CellStore(out)
    of_rows = _digest_of_columns(to_columns(rows))
    asked = {name: (record or {})[name] for name in ("grids", "without_flight") if name in (record or {})}
    swept = _over_what_was_swept(rows, str(out), metric, confidence, asked)
    found = [_drawing(*one, [of_rows, *one[2][2:]]) for one in swept]  # wherever the folder lies
    for trajectory, (chosen, missing) in fastest(rows).items():
        cells = {heading: str(store.path(row["key"])) for heading, row in chosen}
        title = ", ".join(filter(None, (trajectory, speed_text(chosen[0][1]["speed"]))))
        shown = [[heading, row] for heading, row in chosen]
        found.append(_drawing(f"path_{trajectory}", "paths", (cells, title, missing), [shown, title, missing]))
    return [*found, _drawing("solve_time", "times", (rows,), of_rows)]


def _over_what_was_swept(
    rows: Sequence[Mapping[str, Any]], out: str, metric: str, confidence: float, record: Mapping[str, Any]
) -> list[tuple[str, str, tuple[Any, ...]]]:
    """Name, kind and inputs of the figures of errors over the keys that were swept."""
    begin = f"{metric.removesuffix('_error')}_error"
    try:
        views = automatic(SweepFrame(rows, out, record), metric, confidence)
    except UsageError:  # no flight was completed
        return []
    return [
        (f"{begin}_{view.file_name}", "axes", (rows, out, metric, confidence, record, i))
        for i, view in enumerate(views)
    ]


def _drawing(name: str, kind: str, inputs: tuple[Any, ...], decided_by: Any) -> Drawing:
    text = json.dumps([kind, decided_by, _look()], sort_keys=True, default=str)
    return Drawing(name, kind, inputs, hashlib.sha256(text.encode()).hexdigest())


@cache
def _look() -> list[str]:
    """What decides the look of every figure: the sources of this room, and matplotlib."""
    return [source_hash([Path(__file__).parent]), version("matplotlib")]


def _digest_of_columns(columns: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name, column in columns.items():
        values = json.dumps(column.tolist()).encode() if column.dtype.kind == "O" else column.tobytes()
        digest.update(f"{name}\0{len(values)}\0".encode())
        digest.update(values)
    return digest.hexdigest()


class FigureFolder:
    """The figures of a folder of results, and what they were drawn from."""

    def __init__(self, out: str | Path) -> None:
        self.folder = Path(out) / FOLDER
        try:
            found = json.loads(read_text(self.folder / DRAWN) or "{}")
        except ValueError:  # of an earlier version
            found = {}
        self._drawn: dict[str, Any] = found if isinstance(found, dict) else {}

    def path(self, name: str) -> Path:
        """The SVG; the PNG lies beside it."""
        return self.folder / f"{file_name(name)}.svg"

    def shows(self, drawing: Drawing) -> bool:
        """Whether the figure is there as it would be drawn."""
        known = self._drawn.get(drawing.name)
        if known == [drawing.digest, False]:  # there is nothing to show
            return True
        return known == [drawing.digest, True] and all(map(Path.is_file, self._files(drawing.name)))

    def is_there(self, name: str) -> bool:
        return self.path(name).is_file()

    def begin(self, todo: Sequence[Drawing]) -> None:
        """Note that figures are about to be drawn: if that does not come to an end, they are drawn again."""
        before = len(self._drawn)
        for drawing in todo:
            self._drawn.pop(drawing.name, None)
        if len(self._drawn) < before:
            self._write()

    def done(self, drawing: Drawing, there: bool) -> None:
        """Note that a figure was drawn, or that there is none, in which case an earlier one goes."""
        if not there:
            self.remove(drawing.name)
        self._drawn[drawing.name] = [drawing.digest, there]
        self._write()

    def remove(self, name: str) -> None:
        """Remove a figure, which is of other rows."""
        for file in self._files(name):
            with contextlib.suppress(OSError):  # a folder that takes no files has none either
                remove(file, self.folder.parent)

    def clean(self) -> None:
        """Remove unfinished files of processes that were ended."""
        if not self.folder.is_symlink():
            clean(self.folder)

    def _files(self, name: str) -> list[Path]:
        return [self.path(name).with_suffix(f".{form}") for form in FORMATS]

    def _write(self) -> None:
        text = json.dumps(self._drawn, indent=1, sort_keys=True) + "\n"
        write_text(self.folder / DRAWN, text, inside=self.folder.parent)


def fastest(
    rows: Sequence[Mapping[str, Any]],
) -> dict[str, tuple[list[tuple[str, Mapping[str, Any]]], list[str]]]:
    """For each trajectory the flights at the highest speed of most controllers, one per controller, and the controllers
    without a completed flight."""
    found: dict[str, dict[float, dict[str, list[Mapping[str, Any]]]]] = {}
    courses = course_labels((row["trajectory"], condition_of(row)[4]) for row in rows)
    for row, label in zip(rows, column_labels(rows), strict=True):
        *_, speed, setting = condition_of(row)
        name = row["trajectory"]
        heading = ", ".join(filter(None, (label, courses[name, setting].removeprefix(name).strip(", "))))
        found.setdefault(name, {}).setdefault(speed or 0.0, {}).setdefault(heading, []).append(row)
    chosen = {}
    for name, speeds in found.items():
        good = {
            speed: [(x, next(filter(is_flown, own))) for x, own in by_heading.items() if any(map(is_flown, own))]
            for speed, by_heading in speeds.items()
        }
        speed = max(good, key=lambda v: (len(good[v]), v))
        if good[speed]:
            lost = {x: own for x, own in speeds[speed].items() if not any(map(is_flown, own))}
            outcomes = (", ".join(dict.fromkeys(row["outcome"] for row in own)) for own in lost.values())
            chosen[name] = good[speed], [f"{x} ({text})" for x, text in zip(lost, outcomes, strict=True)]
    return chosen
