"""A sweep while it runs: how far it is and its table so far, on the terminal and as a page.

The table is that of the results, of the flights that are there: over common flights, beside them each one's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from datetime import timedelta

from quadexp.plugins.page.document import Block, Section, document
from quadexp.report.metrics import metric_of
from quadexp.report.pairing import Row, is_invalid
from quadexp.report.table import Table
from quadexp.report.tables import error_table
from quadexp.report.text import shown


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
    rows: list[Row] = field(default_factory=list)

    @property
    def done(self) -> int:
        return len(self.rows)

    def progress_text(self) -> str:
        """How far it is, in a sentence; how long the rest will take at the rate so far, where that is known."""
        count = f"{self.done} of {self.total} flights"
        flown = self.done - self.before
        if self.state != "running":
            return f"{count}, {self.state}"
        rest = f", about {clock(self.elapsed / flown * (self.total - self.done))} left" if flown > 0 else ""
        return f"{count}, {clock(self.elapsed)} so far{rest}"

    def table(self) -> Table:
        """The error table of the flights that are there."""
        title = f"{metric_of(self.metric).title} so far ({shown(self.metric)[1]}): {self.progress_text()}"
        rows = [row for row in self.rows if not is_invalid(row)]  # settings that contradict each other are no flight
        if not rows:
            return Table(["trajectory", "m/s"], [], title)
        known = []
        for row in rows:
            known.append({**row, self.metric: math.nan if row[self.metric] is None else row[self.metric]})
        table = error_table(known, self.metric, baseline="")
        return replace(table, title=title, notes=table.notes[:1])


def clock(seconds: float) -> str:
    """Hours, minutes and seconds, such as "0:01:05"."""
    return str(timedelta(seconds=round(seconds)))


def page(live: Live, seconds: float) -> str:
    """The page, which loads itself anew every few seconds while the sweep runs."""
    block = Block(progress=(live.done, live.total, live.progress_text()), tables={"": live.table()})
    refresh = f"{seconds:g}" if live.state == "running" else ""
    return document(f"{live.title} - quadexp sweep", [Section("sweep", "", live.title, "", [block])], refresh=refresh)
