"""A sweep while it runs: how far it is and its table so far, on the terminal and as a page.

Means are over the flights of each controller that have completed so far, so they are of different flights until all
are flown: the table of results, which compares common flights only, is made at the end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from quadexp.report.document import Block, PageTable, Section, document
from quadexp.report.pairing import condition_of, contestant_labels, contestant_of, is_flown, is_invalid
from quadexp.report.table import Table
from quadexp.report.tables import TITLES, course_labels
from quadexp.report.text import number, shown, speed_text

MOST_LINES = 60  # of the table on the page
SO_FAR = "Means over the completed flights so far; the table of results compares common flights only."


@dataclass
class Live:
    """What is known of a sweep that runs. total: of its flights. elapsed: s. before: flights that were there already.
    state: "running", "finished", or why it ended."""

    title: str
    metric: str
    total: int = 0
    elapsed: float = 0.0
    before: int = 0
    state: str = "running"
    rows: list[Mapping[str, Any]] = field(default_factory=list)

    @property
    def done(self) -> int:
        return len(self.rows)

    @property
    def left(self) -> float:
        """Seconds that the rest will take at the rate so far; NaN where it is not known."""
        flown = self.done - self.before
        return self.elapsed / flown * (self.total - self.done) if flown > 0 else math.nan

    def progress_text(self) -> str:
        """How far it is, in a sentence."""
        count = f"{self.done} of {self.total} flights"
        if self.state != "running":
            return f"{count}, {self.state}"
        rest = f", about {clock(self.left)} left" if math.isfinite(self.left) else ""
        return f"{count}, {clock(self.elapsed)} so far{rest}"

    def table(self) -> Table:
        """A column a controller, a line a world, trajectory and speed: the mean error of the completed flights,
        and how many were lost; first how many were completed at all."""
        rows = [row for row in self.rows if not is_invalid(row)]  # settings that contradict each other are no flight
        factor, unit = shown(self.metric)
        labels = contestant_labels(list(dict.fromkeys(map(contestant_of, rows))))
        names = sorted(labels.values())
        courses = course_labels((trajectory, setting) for _, _, trajectory, _, setting in map(condition_of, rows))
        several = len({condition_of(row)[:2] for row in rows}) > 1
        errors: dict[tuple[str, str, float], dict[str, list[float]]] = {}  # NaN for a flight that was not completed
        ended: dict[str, list[float]] = {name: [] for name in names}
        for row in rows:
            plant, vehicle, trajectory, speed, setting = condition_of(row)
            line = (
                f"{plant}, {vehicle}" if several else "",
                courses[trajectory, setting],
                -1.0 if speed is None else speed,
            )
            error = factor * row[self.metric] if is_flown(row) and row[self.metric] is not None else math.nan
            name = labels[contestant_of(row)]
            errors.setdefault(line, {}).setdefault(name, []).append(error)
            ended[name].append(error)
        lines = [
            [f"{course} ({world})" if world else course, speed_text(None if speed < 0 else speed, "")]
            + [_mean(cells.get(name, [])) for name in names]
            for (world, course, speed), cells in sorted(errors.items())
        ]
        well = (f"{_count(values)} of {len(values)}" for values in ended.values())
        title = f"{TITLES.get(self.metric, self.metric)} so far ({unit}): {self.progress_text()}"
        return Table(["trajectory", "m/s", *names], [["completed", "", *well], *lines], title, head=1, notes=[SO_FAR])


def _count(errors: list[float]) -> int:
    """How many flights were completed."""
    return sum(map(math.isfinite, errors))


def _mean(errors: list[float]) -> str:
    """Of the completed flights, and how many were not."""
    well = [error for error in errors if math.isfinite(error)]
    lost = f" ({len(errors) - len(well)} lost)" if len(well) < len(errors) else ""
    return (number(sum(well) / len(well) if well else math.nan) if errors else "") + lost


def clock(seconds: float) -> str:
    """Such as "1:05 min" or "2:03:10 h"; "?" where it is not known."""
    if not math.isfinite(seconds):
        return "?"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d} h" if hours else f"{minutes}:{rest:02d} min" if minutes else f"{rest} s"


def page(live: Live, seconds: float) -> str:
    """The page, which loads itself anew every few seconds while the sweep runs."""
    table = live.table()
    if (more := len(table.rows) - 1 - MOST_LINES) > 0:
        notes = [*table.notes, f"{more} more lines are not shown."]
        table = replace(table, rows=table.rows[: MOST_LINES + 1], notes=notes)
    block = Block(progress=(live.done, live.total, live.progress_text()), tables=[PageTable.of(table)])
    sections = [Section("sweep", "", live.title, "", [block])]
    refresh = f"{seconds:g}" if live.state == "running" else ""
    return document(f"{live.title} - quadexp sweep", sections, refresh=refresh)
